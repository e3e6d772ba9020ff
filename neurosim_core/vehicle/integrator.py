# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
"""RKMK4: the classical Runge-Kutta method in the exponential chart of SO(3), with a moment-matched motor lag.

Within a step the attitude is R = R_0 exp(u) and u' = dexp^-1(w) = w + u x w / 2 + u x (u x w) / 12, which is
as many terms as order 4 needs. Rotations about a fixed axis are exact. Forces are computed in the body frame
B0 of the start of the step; gravity is added to velocity and position in closed form. See `motor` for what
the stages see of the rotors.

Reference: Munthe-Kaas (1998), Runge-Kutta methods on Lie groups.
"""

import functools
import math
from typing import Any, NamedTuple

import warp as wp

from neurosim_core.frames import quaternion_exp
from neurosim_core.vehicle.aerodynamics import AIR_TERMS, Airframe, make_wrench, vec10d

STATUS_OK = wp.constant(wp.int32(0))
STATUS_COMMAND = wp.constant(wp.int32(1))
STATUS_VELOCITY = wp.constant(wp.int32(2))
STATUS_BODY_RATE = wp.constant(wp.int32(3))

STATUS_TERMS = ("ok", "rotor_speed_command", "velocity", "body_rate")
"""What each status code means: the quantity that was not finite or left what the step can resolve."""

GUARD_ABSOLUTE = 1e-3
"""Guard: largest embedded error estimate of one step at rest [m/s, rad/s]."""
GUARD_RELATIVE = 1e-2
"""Guard: largest embedded error estimate of one step as a share of speed and body rate."""


_vec7d = wp.types.vector(length=7, dtype=wp.float64)
# Taylor coefficients in t^2, the highest first; what is left out is below 1e-16 for t < 1/2
_SINE_SERIES = wp.constant(_vec7d(*((-1.0) ** k / math.factorial(2 * k + 1) for k in range(6, -1, -1))))
_COSINE_SERIES = wp.constant(_vec7d(*((-1.0) ** k / math.factorial(2 * k + 2) for k in range(6, -1, -1))))


class Kernels(NamedTuple):
    """The kernels of one set of terms."""

    advance: Any
    """Moves every vehicle by a duration."""
    accelerate: Any
    """Evaluates linear and angular acceleration at the current state."""


@wp.func
def _chart_rate(u: wp.vec3d, w: wp.vec3d) -> wp.vec3d:
    turn = wp.cross(u, w)
    return w + wp.float64(0.5) * turn + wp.cross(u, turn) / wp.float64(12.0)


@wp.func
def _rotation_series(u: wp.vec3d) -> wp.vec2d:
    """Return a = sin(t) / t and b = (1 - cos(t)) / t^2, t = |u|: exp(u) x = x + a u x x + b u x (u x x)."""
    t2 = wp.dot(u, u)
    a = wp.float64(0.0)
    b = wp.float64(0.0)
    for term in range(7):
        a = a * t2 + _SINE_SERIES[term]
        b = b * t2 + _COSINE_SERIES[term]
    if t2 > wp.float64(0.25):
        t = wp.sqrt(t2)
        a = wp.sin(t) / t
        b = (wp.float64(1.0) - wp.cos(t)) / t2
    return wp.vec2d(a, b)


@functools.cache
def make_kernels(terms: frozenset[str]) -> Kernels:
    """Return the kernels that compute only the given terms (see `multirotor.TERMS`)."""
    motor_lag = "motor_lag" in terms
    air_terms = any(term in terms for term in AIR_TERMS)
    wind = air_terms and "wind" in terms
    full_inertia = "full_inertia" in terms
    wrench = make_wrench(terms)
    rotor_wrench = make_wrench(terms & {"rotor_drag", "flapping"})  # linear in the sums over the rotors
    module = wp.get_module("neurosim_core.vehicle.integrator." + ("_".join(sorted(terms)) or "rigid"))

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
    def rates(
        airframe: Airframe, quadratic: wp.vec4d, linear: vec10d, u: wp.vec3d, air_0: wp.vec3d, w: wp.vec3d
    ):
        """Specific force in B0 and angular acceleration in B, where B is B0 turned by exp(u)."""
        series = _rotation_series(u)
        air = air_0
        if wp.static(air_terms):
            turn = wp.cross(u, air_0)
            air = air_0 - series[0] * turn + series[1] * wp.cross(u, turn)
        force, torque = wrench(airframe, quadratic, linear, air, w)
        swing = wp.cross(u, force)
        force_0 = force + series[0] * swing + series[1] * wp.cross(u, swing)
        return airframe.mass_inverse * force_0, angular_acceleration(airframe, torque, w)

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Model:
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        speed_nodes: wp.vec3d,
        square_nodes: wp.vec3d,
        decay: wp.float64,
        step_s: wp.float64,
        step_count: wp.int32,
        duration_ns: wp.int64,
        # In:
        rotor_speed_command: wp.array2d[wp.float64],
        # In/out:
        position: wp.array[wp.vec3d],
        velocity: wp.array[wp.vec3d],
        orientation: wp.array[wp.quatd],
        body_rate: wp.array[wp.vec3d],
        rotor_speed: wp.array2d[wp.float64],
        stamp_ns: wp.array[wp.int64],
        status: wp.array[wp.int32],
    ):
        vehicle = wp.tid()
        if status[vehicle] != STATUS_OK:
            return
        rotor_count = rotor_speed_command.shape[1]
        for rotor in range(rotor_count):
            if not wp.isfinite(rotor_speed_command[vehicle, rotor]):
                status[vehicle] = STATUS_COMMAND
                return

        # sums over the rotors of Omega^2 = c^2 + 2 c d + d^2 and Omega = c + d, where d = Omega_0 - c decays
        quadratic_cc = wp.vec4d()
        quadratic_cd = wp.vec4d()
        quadratic_dd = wp.vec4d()
        linear_c = vec10d()
        linear_d = vec10d()
        for rotor in range(rotor_count):
            c = wp.clamp(
                rotor_speed_command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max
            )
            d = rotor_speed[vehicle, rotor] - c
            quadratic_cc += c * c * quadratic_weight[rotor]
            if wp.static(motor_lag):
                quadratic_cd += wp.float64(2.0) * c * d * quadratic_weight[rotor]
                quadratic_dd += d * d * quadratic_weight[rotor]
            if wp.static(air_terms):
                linear_c += c * linear_weight[rotor]
                if wp.static(motor_lag):
                    linear_d += d * linear_weight[rotor]

        x = position[vehicle]
        v = velocity[vehicle]
        q = orientation[vehicle]
        w = body_rate[vehicle]
        down = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity)

        h = step_s
        half = wp.float64(0.5) * h
        sixth = h / wp.float64(6.0)
        two = wp.float64(2.0)
        absolute2 = wp.static(wp.float64(GUARD_ABSOLUTE**2))
        relative2 = wp.static(wp.float64(GUARD_RELATIVE**2))

        remaining = wp.float64(1.0)
        failure = STATUS_OK
        done = wp.int32(0)
        for _step in range(step_count):
            quadratic_1 = quadratic_cc
            quadratic_2 = quadratic_cc
            quadratic_4 = quadratic_cc
            linear_1 = linear_c
            linear_2 = linear_c
            linear_4 = linear_c
            if wp.static(motor_lag):
                quadratic_1 += speed_nodes[0] * quadratic_cd + square_nodes[0] * quadratic_dd
                quadratic_2 += speed_nodes[1] * quadratic_cd + square_nodes[1] * quadratic_dd
                quadratic_4 += speed_nodes[2] * quadratic_cd + square_nodes[2] * quadratic_dd
                if wp.static(air_terms):
                    linear_1 += speed_nodes[0] * linear_d
                    linear_2 += speed_nodes[1] * linear_d
                    linear_4 += speed_nodes[2] * linear_d

            air_0 = v
            down_0 = down
            if wp.static(air_terms):
                if wp.static(wind):
                    air_0 = wp.quat_rotate_inv(q, v - airframe.wind)
                else:
                    air_0 = wp.quat_rotate_inv(q, v)
                down_0 = wp.quat_rotate_inv(q, down)

            force_1, torque_1 = wrench(airframe, quadratic_1, linear_1, air_0, w)
            a_1 = airframe.mass_inverse * force_1
            w_1 = angular_acceleration(airframe, torque_1, w)

            u_2 = half * w
            rate_2 = w + half * w_1
            a_2, w_2 = rates(airframe, quadratic_2, linear_2, u_2, air_0 + half * (a_1 + down_0), rate_2)
            u_rate_2 = _chart_rate(u_2, rate_2)

            u_3 = half * u_rate_2
            rate_3 = w + half * w_2
            a_3, w_3 = rates(airframe, quadratic_2, linear_2, u_3, air_0 + half * (a_2 + down_0), rate_3)
            u_rate_3 = _chart_rate(u_3, rate_3)

            u_4 = h * u_rate_3
            rate_4 = w + h * w_3
            a_4, w_4 = rates(airframe, quadratic_4, linear_4, u_4, air_0 + h * (a_3 + down_0), rate_4)
            u_rate_4 = _chart_rate(u_4, rate_4)

            v_next = v + h * down + wp.quat_rotate(q, sixth * (a_1 + two * (a_2 + a_3) + a_4))
            w_next = w + sixth * (w_1 + two * (w_2 + w_3) + w_4)
            u = sixth * (w + two * (u_rate_2 + u_rate_3) + u_rate_4)

            # guard: the embedded estimate, less what the lag alone puts into it (it is integrated exactly)
            a_error = a_1 - a_2 - a_3 + a_4
            w_error = w_1 - w_2 - w_3 + w_4
            if wp.static(motor_lag):
                lag_force, lag_torque = rotor_wrench(
                    airframe,
                    quadratic_1 - two * quadratic_2 + quadratic_4,
                    linear_1 - two * linear_2 + linear_4,
                    air_0,
                    w,
                )
                a_error -= airframe.mass_inverse * lag_force
                w_error -= solve_inertia(airframe, lag_torque)
            # written so that a NaN trips it
            if not (sixth * sixth * wp.length_sq(a_error) <= absolute2 + relative2 * wp.length_sq(v_next)):
                failure = STATUS_VELOCITY
                break
            if not (sixth * sixth * wp.length_sq(w_error) <= absolute2 + relative2 * wp.length_sq(w_next)):
                failure = STATUS_BODY_RATE
                break

            x += h * v + half * h * down + wp.quat_rotate(q, h * sixth * (a_1 + a_2 + a_3))
            v = v_next
            w = w_next
            q = q * quaternion_exp(u)
            # one Newton step towards unit length: exact to rounding this close to it
            q = (wp.float64(1.5) - wp.float64(0.5) * wp.dot(q, q)) * q
            done += 1
            if wp.static(motor_lag):
                remaining *= decay
                quadratic_cd = decay * quadratic_cd
                quadratic_dd = decay * decay * quadratic_dd
                if wp.static(air_terms):
                    linear_d = decay * linear_d

        position[vehicle] = x
        velocity[vehicle] = v
        orientation[vehicle] = q
        body_rate[vehicle] = w
        for rotor in range(rotor_count):
            c = wp.clamp(
                rotor_speed_command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max
            )
            if done == 0:
                c = rotor_speed[vehicle, rotor]
            if wp.static(motor_lag):
                rotor_speed[vehicle, rotor] = c + remaining * (rotor_speed[vehicle, rotor] - c)
            else:
                rotor_speed[vehicle, rotor] = c
        stamp_ns[vehicle] += wp.int64(done) * duration_ns / wp.int64(step_count)
        status[vehicle] = failure

    @wp.kernel(module=module, enable_backward=False)
    def accelerate(
        # Model:
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        # In:
        velocity: wp.array[wp.vec3d],
        orientation: wp.array[wp.quatd],
        body_rate: wp.array[wp.vec3d],
        rotor_speed: wp.array2d[wp.float64],
        # Out:
        acceleration_out: wp.array[wp.vec3d],
        angular_acceleration_out: wp.array[wp.vec3d],
    ):
        vehicle = wp.tid()
        quadratic = wp.vec4d()
        linear = vec10d()
        for rotor in range(rotor_speed.shape[1]):
            speed = rotor_speed[vehicle, rotor]
            quadratic += speed * speed * quadratic_weight[rotor]
            if wp.static(air_terms):
                linear += speed * linear_weight[rotor]
        q = orientation[vehicle]
        w = body_rate[vehicle]
        air = velocity[vehicle]
        if wp.static(air_terms):
            if wp.static(wind):
                air -= airframe.wind
            air = wp.quat_rotate_inv(q, air)
        force, torque = wrench(airframe, quadratic, linear, air, w)
        down = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity)
        acceleration_out[vehicle] = down + airframe.mass_inverse * wp.quat_rotate(q, force)
        angular_acceleration_out[vehicle] = angular_acceleration(airframe, torque, w)

    return Kernels(advance, accelerate)
