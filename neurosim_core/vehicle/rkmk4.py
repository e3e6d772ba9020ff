# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""RKMK4: the classical Runge-Kutta method in the exponential chart of SO(3), with a moment-matched motor lag.

Rotations about a fixed axis are exact. Forces are computed in the body frame B0 of the start of the step;
gravity is added to velocity and position in closed form. See `motor` for what the stages see of the rotors.

The guard is the embedded difference h/6 |k1 - k2 - k3 + k4| on velocity and body rate; it catches blow-up and
is no estimate of accuracy.

Reference: Munthe-Kaas (1998), Runge-Kutta methods on Lie groups.
"""

from typing import Any

import warp as wp

from neurosim_core.frames import quaternion_exp
from neurosim_core.vehicle.aerodynamics import Airframe
from neurosim_core.vehicle.chart import chart_rate_4
from neurosim_core.vehicle.equations import Equations, Interval, RotorSums, Surroundings
from neurosim_core.vehicle.ground import touches

GUARD_ABSOLUTE = 1e-3
"""Guard: largest embedded error estimate of one step at rest [m/s, rad/s]."""
GUARD_RELATIVE = 2e-3
"""Guard: largest embedded error estimate of one step as a share of speed and body rate."""
GUARD_CONTACT = 1e4
"""How many times tighter the guard is while a foot is in the ground: forces have kinks there."""


def make_rkmk4(equations: Equations) -> Any:
    """Return the device function that moves one vehicle by a number of equal steps.

    Its arguments: the airframe; what surrounds it; the interval; the sums over the rotors; index of the
    vehicle and time at the beginning [ns]; position [m] and velocity [m/s] in W, attitude, body rate [rad/s].
    It returns the last four, what is left of the decaying part, and whether the guard tripped; then the
    others mean nothing.
    """
    motor_lag, air_terms = equations.motor_lag, equations.air_terms
    wind, changing_wind = equations.wind, equations.changing_wind
    near_ground = equations.ground or equations.ground_effect
    contact = equations.ground
    forces, rates, rotor_wrench = equations.forces, equations.rates, equations.rotor_wrench
    solve_inertia, lift, wind_at = equations.solve_inertia, equations.lift, equations.wind_at

    @wp.func
    def gust_at(
        airframe: Airframe,
        around: Surroundings,
        vehicle: wp.int32,
        start_ns: wp.int64,
        t: wp.float64,
        q: wp.quatd,
        v: wp.vec3d,
        air_0: wp.vec3d,
    ):
        """Change of the air speed in B0 since the beginning of the step, by the wind alone."""
        return wp.quat_rotate_inv(q, v - wind_at(airframe, around.wind, vehicle, start_ns, t)) - air_0

    @wp.func
    def above_ground(
        around: Surroundings,
        quadratic: wp.vec4d,
        z_1: wp.float64,
        up_0: wp.vec3d,
        duration_s: wp.float64,
        velocity_0: wp.vec3d,
    ):
        """Height of a stage that is reached at a velocity in B0, and the sums over the rotors there."""
        z = z_1
        if wp.static(near_ground):
            z = z_1 + duration_s * wp.dot(up_0, velocity_0)
        return z, lift(around.ground, z, quadratic)

    @wp.func
    def fly_fixed(
        airframe: Airframe,
        around: Surroundings,
        interval: Interval,
        sums: RotorSums,
        vehicle: wp.int32,
        start_ns: wp.int64,
        x_0: wp.vec3d,
        v_0: wp.vec3d,
        q_0: wp.quatd,
        w_0: wp.vec3d,
    ):
        x = x_0
        v = v_0
        q = q_0
        w = w_0
        quadratic_cd = sums.quadratic_cd
        quadratic_dd = sums.quadratic_dd
        linear_d = sums.linear_d
        speed_nodes = interval.speed_nodes
        square_nodes = interval.square_nodes
        decay = interval.decay
        down = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity)

        h = interval.step_s
        half = wp.float64(0.5) * h
        sixth = h / wp.float64(6.0)
        two = wp.float64(2.0)
        absolute2 = wp.static(wp.float64(GUARD_ABSOLUTE**2))
        relative2 = wp.static(wp.float64(GUARD_RELATIVE**2))

        remaining = wp.float64(1.0)
        tripped = wp.bool(False)
        for step in range(interval.step_count):
            t = wp.float64(step) * h
            quadratic_1 = sums.quadratic_cc
            quadratic_2 = sums.quadratic_cc
            quadratic_4 = sums.quadratic_cc
            linear_1 = sums.linear_c
            linear_2 = sums.linear_c
            linear_4 = sums.linear_c
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
                if wp.static(changing_wind):
                    air_0 = wp.quat_rotate_inv(q, v - wind_at(airframe, around.wind, vehicle, start_ns, t))
                elif wp.static(wind):
                    air_0 = wp.quat_rotate_inv(q, v - airframe.wind)
                else:
                    air_0 = wp.quat_rotate_inv(q, v)
                down_0 = wp.quat_rotate_inv(q, down)
            velocity_0 = v
            up_0 = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
            z_1 = x[2] - around.ground.height
            if wp.static(near_ground):
                down_0 = wp.quat_rotate_inv(q, down)
                velocity_0 = wp.quat_rotate_inv(q, v)
                up_0 = wp.quat_rotate_inv(q, up_0)
            quadratic_1 = lift(around.ground, z_1, quadratic_1)

            force_1, w_1 = forces(
                airframe, around.ground, quadratic_1, linear_1, air_0, velocity_0, up_0, z_1, w
            )
            a_1 = airframe.mass_inverse * force_1

            u_2 = half * w
            rate_2 = w + half * w_1
            air_2 = air_0 + half * (a_1 + down_0)
            velocity_2 = velocity_0 + half * (a_1 + down_0)
            if wp.static(changing_wind):
                gust_2 = gust_at(airframe, around, vehicle, start_ns, t + half, q, v, air_0)
                air_2 += gust_2
            z_2, lifted_2 = above_ground(around, quadratic_2, z_1, up_0, half, velocity_0)
            a_2, w_2 = rates(
                airframe, around.ground, lifted_2, linear_2, u_2, air_2, velocity_2, up_0, z_2, rate_2
            )
            u_rate_2 = chart_rate_4(u_2, rate_2)

            u_3 = half * u_rate_2
            rate_3 = w + half * w_2
            air_3 = air_0 + half * (a_2 + down_0)
            velocity_3 = velocity_0 + half * (a_2 + down_0)
            if wp.static(changing_wind):
                air_3 += gust_2
            z_3, lifted_3 = above_ground(around, quadratic_2, z_1, up_0, half, velocity_2)
            a_3, w_3 = rates(
                airframe, around.ground, lifted_3, linear_2, u_3, air_3, velocity_3, up_0, z_3, rate_3
            )
            u_rate_3 = chart_rate_4(u_3, rate_3)

            u_4 = h * u_rate_3
            rate_4 = w + h * w_3
            air_4 = air_0 + h * (a_3 + down_0)
            velocity_4 = velocity_0 + h * (a_3 + down_0)
            if wp.static(changing_wind):
                air_4 += gust_at(airframe, around, vehicle, start_ns, t + h, q, v, air_0)
            z_4, lifted_4 = above_ground(around, quadratic_4, z_1, up_0, h, velocity_3)
            a_4, w_4 = rates(
                airframe, around.ground, lifted_4, linear_4, u_4, air_4, velocity_4, up_0, z_4, rate_4
            )
            u_rate_4 = chart_rate_4(u_4, rate_4)

            v_next = v + h * down + wp.quat_rotate(q, sixth * (a_1 + two * (a_2 + a_3) + a_4))
            w_next = w + sixth * (w_1 + two * (w_2 + w_3) + w_4)
            u = sixth * (w + two * (u_rate_2 + u_rate_3) + u_rate_4)

            # guard: the embedded estimate, less what the lag alone puts into it (it is integrated exactly)
            a_error = a_1 - a_2 - a_3 + a_4
            w_error = w_1 - w_2 - w_3 + w_4
            if wp.static(motor_lag):
                lag_force, lag_torque = rotor_wrench(
                    airframe,
                    quadratic_1 - two * lifted_2 + lifted_4,
                    linear_1 - two * linear_2 + linear_4,
                    air_0,
                    w,
                )
                a_error -= airframe.mass_inverse * lag_force
                w_error -= solve_inertia(airframe, lag_torque)
            if wp.static(contact):
                up_4 = up_0 - wp.cross(u_4, up_0)  # turned by exp(-u), nearly
                if touches(around.ground, z_1, up_0) or touches(around.ground, z_4, up_4):
                    a_error *= wp.static(wp.float64(GUARD_CONTACT))
                    w_error *= wp.static(wp.float64(GUARD_CONTACT))
            # written so that a NaN trips it
            if not (sixth * sixth * wp.length_sq(a_error) <= absolute2 + relative2 * wp.length_sq(v_next)):
                tripped = True
                break
            if not (sixth * sixth * wp.length_sq(w_error) <= absolute2 + relative2 * wp.length_sq(w_next)):
                tripped = True
                break

            x += h * v + half * h * down + wp.quat_rotate(q, h * sixth * (a_1 + a_2 + a_3))
            v = v_next
            w = w_next
            q = q * quaternion_exp(u)
            # one Newton step towards unit length: exact to rounding this close to it
            q = (wp.float64(1.5) - wp.float64(0.5) * wp.dot(q, q)) * q
            if wp.static(motor_lag):
                remaining *= decay
                quadratic_cd = decay * quadratic_cd
                quadratic_dd = decay * decay * quadratic_dd
                if wp.static(air_terms):
                    linear_d = decay * linear_d
        return x, v, q, w, remaining, tripped

    return fly_fixed
