# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""The equations of motion with only the terms that a vehicle needs: one right-hand side, all integrators.

The rotors act by sums over them of Omega and Omega^2. Within an interval Omega = c + d exp(-t / tau), c the
command held and d = Omega_0 - c, so three sums hold for the whole interval: of the constant part, of what
decays, and of what decays twice as fast.
"""

from typing import Any, NamedTuple

import warp as wp

from neurosim_core.vehicle.aerodynamics import AIR_TERMS, Airframe, Rotors, make_wrench, vec10d
from neurosim_core.vehicle.chart import rotation_series, turned_back
from neurosim_core.vehicle.ground import Ground, contact_wrench, lifted
from neurosim_core.vehicle.wind import Wind, make_wind_at


@wp.struct
class RotorSums:
    """The sums over rotors."""

    quadratic_cc: wp.vec4d  # of `aerodynamics.quadratic_weights` times Omega^2 = c^2 + 2 c d + d^2
    quadratic_cd: wp.vec4d
    quadratic_dd: wp.vec4d
    linear_c: vec10d  # of `aerodynamics.linear_weights` times Omega = c + d
    linear_d: vec10d
    rate: wp.float64  # 1 / time constant [1/s]


@wp.struct
class Interval:
    """A stretch of time that vehicles are integrated over, with the settings of the integrator."""

    duration_ns: wp.int64
    max_step_ns: wp.int64
    step_s: wp.float64
    step_count: wp.int32
    speed_nodes: wp.vec3d  # see `motor.LagConstants`
    square_nodes: wp.vec3d
    decay: wp.float64
    lag_rate: wp.float64
    is_adaptive: wp.bool  # take no fixed steps
    rtol: wp.float64  # of adaptive steps
    atol: wp.float64
    evaluation_count_max: wp.int32


@wp.struct
class Surroundings:
    """All that acts on a vehicle besides its airframe; arrays of terms that are not compiled in are empty."""

    wind: Wind
    ground: Ground
    rotors: Rotors


@wp.func
def held_command(airframe: Airframe, command: wp.array2d[wp.float64], vehicle: wp.int32, rotor: wp.int32):
    """Return the command of a rotor within its range [rad/s]."""
    return wp.clamp(command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max)


class Equations(NamedTuple):
    """Device functions of one set of terms, and which of them there are."""

    motor_lag: bool
    air_terms: bool
    """Something depends on the air speed."""
    wind: bool
    """The air speed is not the velocity."""
    changing_wind: bool
    """The wind depends on time."""
    turbulence: bool
    ground: bool
    ground_effect: bool
    rotor_wrench: Any
    """(airframe, quadratic, linear, air, w) -> force and torque in B that are linear in the sums over the
    rotors."""
    solve_inertia: Any
    """(airframe, torque) -> J^-1 torque."""
    forces: Any
    """(airframe, ground, quadratic, linear, air, velocity, up, height, w) -> force [N], dw/dt [rad/s^2], all
    in B. The arguments: sums over the rotors, air speed and velocity [m/s], direction of world z, height of
    the centre of mass above ground [m], body rate [rad/s]."""
    rates: Any
    """(airframe, ground, quadratic, linear, u, air_0, velocity_0, up_0, height, w) -> specific force in B0,
    dw/dt in B, B being B0 turned by exp(u); what ends in 0 is in B0."""
    lift: Any
    """(ground, height, quadratic) -> the sums over the rotors with the ground effect."""
    sums_at: Any
    """(sums, t) -> the sums over the rotors, of Omega^2 and of Omega, at t [s] in the interval."""
    wind_at: Any
    """See `wind.make_wind_at`."""


def make_equations(terms: frozenset[str]) -> Equations:
    """Return the equations with the given terms (see `multirotor.TERMS`)."""
    air_terms = any(term in terms for term in AIR_TERMS)
    motor_lag = "motor_lag" in terms
    full_inertia = "full_inertia" in terms
    ground_contact = "ground" in terms
    ground_effect = "ground_effect" in terms
    wrench = make_wrench(terms)
    changing_wind = air_terms and not terms.isdisjoint(("gusts", "turbulence"))

    @wp.func
    def solve_inertia(airframe: Airframe, torque: wp.vec3d) -> wp.vec3d:
        if wp.static(full_inertia):
            return airframe.inertia_inverse * torque
        else:
            return wp.cw_mul(airframe.inertia_diagonal_inverse, torque)

    @wp.func
    def angular_acceleration(airframe: Airframe, torque: wp.vec3d, w: wp.vec3d) -> wp.vec3d:
        momentum = wp.cw_mul(airframe.inertia_diagonal, w)
        if wp.static(full_inertia):
            momentum = airframe.inertia * w
        return solve_inertia(airframe, torque - wp.cross(w, momentum))

    @wp.func
    def forces(
        airframe: Airframe,
        ground: Ground,
        quadratic: wp.vec4d,
        linear: vec10d,
        air: wp.vec3d,
        velocity: wp.vec3d,
        up: wp.vec3d,
        height: wp.float64,
        w: wp.vec3d,
    ):
        force, torque = wrench(airframe, quadratic, linear, air, w)
        if wp.static(ground_contact):
            push, twist = contact_wrench(ground, height, up, velocity, w)
            force += push
            torque += twist
        return force, angular_acceleration(airframe, torque, w)

    @wp.func
    def rates(
        airframe: Airframe,
        ground: Ground,
        quadratic: wp.vec4d,
        linear: vec10d,
        u: wp.vec3d,
        air_0: wp.vec3d,
        velocity_0: wp.vec3d,
        up_0: wp.vec3d,
        height: wp.float64,
        w: wp.vec3d,
    ):
        series = rotation_series(u)
        air = air_0
        velocity = velocity_0
        up = up_0
        if wp.static(air_terms):
            air = turned_back(u, series, air_0)
        if wp.static(ground_contact):
            velocity = turned_back(u, series, velocity_0)
            up = turned_back(u, series, up_0)
        force, spin = forces(airframe, ground, quadratic, linear, air, velocity, up, height, w)
        swing = wp.cross(u, force)
        force_0 = force + series[0] * swing + series[1] * wp.cross(u, swing)
        return airframe.mass_inverse * force_0, spin

    @wp.func
    def lift(ground: Ground, height: wp.float64, quadratic: wp.vec4d):
        if wp.static(ground_effect):
            return lifted(ground, height, quadratic)
        else:
            return quadratic

    @wp.func
    def sums_at(sums: RotorSums, t: wp.float64):
        quadratic = sums.quadratic_cc
        linear = sums.linear_c
        if wp.static(motor_lag):
            left = wp.exp(-sums.rate * t)
            quadratic = quadratic + left * sums.quadratic_cd + left * left * sums.quadratic_dd
            if wp.static(air_terms):
                linear = linear + left * sums.linear_d
        return quadratic, linear

    return Equations(
        motor_lag=motor_lag,
        air_terms=air_terms,
        wind=changing_wind or (air_terms and "wind" in terms),
        changing_wind=changing_wind,
        turbulence="turbulence" in terms,
        ground=ground_contact,
        ground_effect=ground_effect,
        rotor_wrench=make_wrench(terms & {"rotor_drag", "flapping"}),
        solve_inertia=solve_inertia,
        forces=forces,
        rates=rates,
        lift=lift,
        sums_at=sums_at,
        wind_at=make_wind_at(terms),
    )
