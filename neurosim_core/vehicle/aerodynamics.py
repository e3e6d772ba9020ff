# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""Forces and torques on the airframe: thrust, rotor drag, translational lift, flapping, parasitic drag.

With u_i = v_a + w x r_i the air speed of rotor i in B, v_a that of the centre of mass, Omega_i its speed and
K = diag(k_d, k_d, k_z):

    thrust              k_eta Omega_i^2 z                  rotor drag           -Omega_i K u_i
    translational lift  k_h (u_ix^2 + u_iy^2) z            parasitic drag       -|v_a| diag(c) v_a
    reaction torque     k_m d_i Omega_i^2 z                flapping torque      -k_flap Omega_i u_i x z

Parasitic drag acts at the centre of mass, all other forces at the hub r_i. Everything is linear in Omega_i,
in Omega_i^2, or free of both, with coefficients that depend on geometry alone; so a few sums over the rotors
replace the rotors, and no right-hand side loops over them.

Reference: Svacha, Mohta, Kumar (2017), Improving quadrotor trajectory tracking by compensating for
aerodynamic effects; the same equations as in RotorPy 3.0 (Folk, Paulos, Kumar 2023).
"""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

vec8d = wp.types.vector(length=8, dtype=wp.float64)
vec10d = wp.types.vector(length=10, dtype=wp.float64)

AIR_TERMS = ("rotor_drag", "translational_lift", "flapping", "parasitic_drag")
"""Terms that depend on the air speed."""


@wp.struct
class Airframe:
    """Parameters of a multirotor as the kernels read them."""

    gravity: wp.float64
    mass_inverse: wp.float64
    inertia: wp.mat33d
    inertia_inverse: wp.mat33d
    inertia_diagonal: wp.vec3d
    inertia_diagonal_inverse: wp.vec3d
    rotor_drag: wp.vec3d  # k_d, k_d, k_z
    flapping: wp.float64
    translational_lift: wp.float64
    lift_force: vec8d  # sums over the rotors of 1, x, y, z, x^2 + y^2, z^2, x z, y z
    lift_torque_x: vec8d  # the same, weighted with y
    lift_torque_y: vec8d  # the same, weighted with -x
    parasitic_drag: wp.vec3d
    wind: wp.vec3d
    rotor_speed_min: wp.float64
    rotor_speed_max: wp.float64


@wp.struct
class Rotors:
    """Weight of each rotor in the sums over the rotors, [R]."""

    quadratic_weight: wp.array[wp.vec4d]  # see `quadratic_weights`
    linear_weight: wp.array[vec10d]  # see `linear_weights`


def quadratic_weights(
    position: NDArray[np.float64],
    direction: NDArray[np.float64],
    *,
    thrust: float | NDArray[np.float64],
    torque: float | NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return what one (rad/s)^2 of each rotor adds to thrust and to torque about x, y, z, shape [R, 4].

    Hubs are in B [m], shape [R, 3]; directions are the signs of the reaction torques, [R]. The coefficients,
    of all rotors or of each, are in N/(rad/s)^2 and N m/(rad/s)^2.
    """
    x, y = position[:, 0], position[:, 1]
    return np.stack([np.full(len(x), thrust), thrust * y, -thrust * x, torque * direction], axis=1)


def linear_weights(position: NDArray[np.float64], drag: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what one rad/s of each rotor adds to the sums that rotor drag and flapping need, shape [R, 10].

    These are 1, the hub position r, and the symmetric matrix B of r x (K (w x r)) = B w as B_xx, B_yy, B_zz,
    B_yz, B_xz, B_xy.
    """
    x, y, z = position.T
    k_x, k_y, k_z = drag
    return np.stack(
        [
            np.ones_like(x), x, y, z,
            k_z * y * y + k_y * z * z, k_x * z * z + k_z * x * x, k_x * y * y + k_y * x * x,
            -k_x * y * z, -k_y * x * z, -k_z * x * y,
        ],
        axis=1,
    )  # fmt: skip


def lift_moments(position: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weighted moments of the rotor positions that translational lift needs, shape [8]."""
    x, y, z = position.T
    return np.asarray(np.stack([np.ones_like(x), x, y, z, x * x + y * y, z * z, x * z, y * z]) @ weight)


def make_wrench(terms: frozenset[str]) -> Any:
    """Return the device function of force and torque in B, with only the given terms in it.

    Its arguments: the airframe, the sums over the rotors of `quadratic_weights` times Omega^2 and of
    `linear_weights` times Omega, air speed in B [m/s], body rate [rad/s]. It returns the force [N] and the
    torque [N m].
    """
    rotor_drag = "rotor_drag" in terms
    translational_lift = "translational_lift" in terms
    flapping = "flapping" in terms
    parasitic_drag = "parasitic_drag" in terms

    @wp.func
    def wrench(airframe: Airframe, quadratic: wp.vec4d, linear: vec10d, air: wp.vec3d, w: wp.vec3d):
        zero = wp.float64(0.0)
        two = wp.float64(2.0)
        force = wp.vec3d(zero, zero, quadratic[0])
        torque = wp.vec3d(quadratic[1], quadratic[2], quadratic[3])
        if wp.static(rotor_drag or flapping):
            # sum of Omega_i u_i
            arm = wp.vec3d(linear[1], linear[2], linear[3])
            flow = linear[0] * air + wp.cross(w, arm)
            if wp.static(rotor_drag):
                damping = wp.vec3d(
                    linear[4] * w[0] + linear[9] * w[1] + linear[8] * w[2],
                    linear[9] * w[0] + linear[5] * w[1] + linear[7] * w[2],
                    linear[8] * w[0] + linear[7] * w[1] + linear[6] * w[2],
                )
                force -= wp.cw_mul(airframe.rotor_drag, flow)
                torque -= wp.cross(arm, wp.cw_mul(airframe.rotor_drag, air)) + damping
            if wp.static(flapping):
                torque -= airframe.flapping * wp.vec3d(flow[1], -flow[0], zero)
        if wp.static(translational_lift):
            # u_x^2 + u_y^2 of a rotor at r is a quadratic in r with these coefficients
            speed2 = vec8d(
                air[0] * air[0] + air[1] * air[1],
                two * air[1] * w[2],
                -two * air[0] * w[2],
                two * (air[0] * w[1] - air[1] * w[0]),
                w[2] * w[2],
                w[0] * w[0] + w[1] * w[1],
                -two * w[2] * w[0],
                -two * w[2] * w[1],
            )
            k_h = airframe.translational_lift
            force += wp.vec3d(zero, zero, k_h * wp.dot(airframe.lift_force, speed2))
            torque += wp.vec3d(
                k_h * wp.dot(airframe.lift_torque_x, speed2),
                k_h * wp.dot(airframe.lift_torque_y, speed2),
                zero,
            )
        if wp.static(parasitic_drag):
            force -= wp.length(air) * wp.cw_mul(airframe.parasitic_drag, air)
        return force, torque

    return wrench
