# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""Dormand-Prince 5(4) with adaptive steps, in the exponential chart of SO(3), with the exact motor lag.

Each step begins in a new chart, u = 0. What is controlled is the largest of the embedded errors of
displacement, velocity, rotation and body rate, each in the Euclidean norm against atol + rtol |.|, where
displacement and rotation are those of the step: so the origin of the world does not matter. The controller is
proportional-integral with the constants of DOPRI5.

Reference: Dormand, Prince (1980), A family of embedded Runge-Kutta formulae; Hairer, Norsett, Wanner (1993),
Solving ordinary differential equations I, II.4 and IV.2 (the stabilised controller).
"""

from typing import Any

import warp as wp

from neurosim_core.frames import quaternion_exp
from neurosim_core.vehicle.aerodynamics import Airframe
from neurosim_core.vehicle.arrays import STATUS_BODY_RATE, STATUS_OK, STATUS_VELOCITY
from neurosim_core.vehicle.chart import chart_rate
from neurosim_core.vehicle.equations import Equations, Interval, RotorSums, Surroundings

_PROPORTIONAL = wp.constant(wp.float64(0.2 - 0.75 * 0.04))
_INTEGRAL = wp.constant(wp.float64(0.04))
_SAFETY = wp.constant(wp.float64(0.9))
_SHRINK = wp.constant(wp.float64(0.2))
_GROWTH = wp.constant(wp.float64(10.0))
_STEP_MIN = wp.constant(wp.float64(1e-14))  # as a share of the duration
_ROTATION_MAX_RAD = wp.constant(wp.float64(2.0))  # in one step; the chart ends at 2 pi

_vec7d = wp.types.vector(length=7, dtype=wp.float64)
_vec12d = wp.types.vector(length=12, dtype=wp.float64)
_mat7d = wp.types.matrix(shape=(7, 7), dtype=wp.float64)
_stages = wp.types.matrix(shape=(7, 12), dtype=wp.float64)

_TABLEAU = wp.constant(
    _mat7d(
        [
            [0, 0, 0, 0, 0, 0, 0],
            [1 / 5, 0, 0, 0, 0, 0, 0],
            [3 / 40, 9 / 40, 0, 0, 0, 0, 0],
            [44 / 45, -56 / 15, 32 / 9, 0, 0, 0, 0],
            [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0, 0],
            [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0, 0],
            [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84, 0],
        ]
    )
)
"""Weights of the slopes of the stages before, for each stage; the last one is the solution of order 5."""
_NODES = wp.constant(_vec7d(0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0))
_ERROR = wp.constant(_vec7d(71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40))
"""Weights of the slopes in the difference of the solutions of orders 5 and 4."""


@wp.func
def _part(y: _vec12d, first: wp.int32) -> wp.vec3d:
    return wp.vec3d(y[first], y[first + 1], y[first + 2])


@wp.func
def _joined(displacement: wp.vec3d, v: wp.vec3d, u: wp.vec3d, w: wp.vec3d) -> _vec12d:
    y = _vec12d()
    y[0:3] = displacement
    y[3:6] = v
    y[6:9] = u
    y[9:12] = w
    return y


@wp.func
def _larger(a: wp.float64, b: wp.float64) -> wp.float64:
    """Return the larger one, or NaN if one is NaN."""
    if a >= b:
        return a
    if b > a:
        return b
    return a + b


@wp.func
def _scaled_error(
    error: _vec12d, y: _vec12d, first: wp.int32, size_0: wp.float64, rtol: wp.float64, atol: wp.float64
) -> wp.float64:
    size = wp.max(size_0, wp.length(_part(y, first)))
    return wp.length(_part(error, first)) / (atol + rtol * size)


def make_dormand_prince(equations: Equations) -> Any:
    """Return the device function that moves one vehicle by a duration.

    Its arguments: the airframe; what surrounds it; the interval; the sums over the rotors; index of the
    vehicle and time at the beginning [ns]; position [m] and velocity [m/s] in W, attitude, body rate [rad/s].
    It returns the last four, the number of evaluations, and why it failed or STATUS_OK.
    """
    wind, changing_wind = equations.wind, equations.changing_wind
    near_ground = equations.ground or equations.ground_effect
    rates, lift, wind_at, sums_at = equations.rates, equations.lift, equations.wind_at, equations.sums_at

    @wp.func
    def derivative(
        airframe: Airframe,
        around: Surroundings,
        sums: RotorSums,
        vehicle: wp.int32,
        start_ns: wp.int64,
        t: wp.float64,
        height_0: wp.float64,
        q: wp.quatd,
        y: _vec12d,
    ):
        """d/dt of displacement, velocity, rotation vector, body rate; q is the attitude at u = 0."""
        quadratic, linear = sums_at(sums, t)
        v = _part(y, 3)
        u = _part(y, 6)
        w = _part(y, 9)
        air = v
        if wp.static(changing_wind):
            air = v - wind_at(airframe, around.wind, vehicle, start_ns, t)
        elif wp.static(wind):
            air = v - airframe.wind
        air_0 = wp.quat_rotate_inv(q, air)
        velocity_0 = air_0
        up_0 = air_0
        height = height_0 + y[2] - around.ground.height
        if wp.static(near_ground):
            velocity_0 = wp.quat_rotate_inv(q, v)
            up_0 = wp.quat_rotate_inv(q, wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0)))
            quadratic = lift(around.ground, height, quadratic)
        force_0, spin = rates(
            airframe, around.ground, quadratic, linear, u, air_0, velocity_0, up_0, height, w
        )
        a = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity) + wp.quat_rotate(q, force_0)
        return _joined(v, a, chart_rate(u, w), spin)

    @wp.func
    def fly_adaptive(
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
        zero = wp.vec3d()
        x = x_0
        q = q_0
        y = _joined(zero, v_0, zero, w_0)
        t = wp.float64(0.0)
        rtol = interval.rtol
        atol = interval.atol
        duration_s = wp.float64(interval.step_count) * interval.step_s
        h = wp.min(interval.step_s, duration_s)
        error_before = wp.float64(1e-4)
        growth = _GROWTH
        failure = STATUS_OK
        k = _stages()
        k[0] = derivative(airframe, around, sums, vehicle, start_ns, t, x[2], q, y)
        evaluation_count = wp.int32(1)
        while t < duration_s:
            h = wp.min(h, _ROTATION_MAX_RAD / (wp.length(_part(y, 9)) + wp.float64(1e-9)))
            last = bool(t + wp.float64(1.01) * h >= duration_s)
            if last:
                h = duration_s - t
            y7 = y + h * _TABLEAU[1, 0] * k[0]
            k[1] = derivative(airframe, around, sums, vehicle, start_ns, t + _NODES[1] * h, x[2], q, y7)
            for stage in range(2, 7):
                slope = _TABLEAU[stage, 0] * k[0]
                for before in range(1, stage):
                    slope += _TABLEAU[stage, before] * k[before]
                y7 = y + h * slope
                now = t + _NODES[stage] * h
                k[stage] = derivative(airframe, around, sums, vehicle, start_ns, now, x[2], q, y7)
            evaluation_count += 6
            slope = _ERROR[0] * k[0]
            for stage in range(1, 7):
                slope += _ERROR[stage] * k[stage]
            difference = h * slope
            v_size = wp.length(_part(y, 3))
            w_size = wp.length(_part(y, 9))
            none = wp.float64(0.0)
            v_error = _larger(
                _scaled_error(difference, y7, 0, none, rtol, atol),
                _scaled_error(difference, y7, 3, v_size, rtol, atol),
            )
            w_error = _larger(
                _scaled_error(difference, y7, 6, none, rtol, atol),
                _scaled_error(difference, y7, 9, w_size, rtol, atol),
            )
            error = _larger(v_error, w_error)
            if error <= wp.float64(1.0):  # false for NaN
                t += h
                x += _part(y7, 0)
                u = _part(y7, 6)
                q = q * quaternion_exp(u)
                # one Newton step towards unit length: exact to rounding this close to it
                q = (wp.float64(1.5) - wp.float64(0.5) * wp.dot(q, q)) * q
                y = _joined(zero, _part(y7, 3), zero, _part(y7, 9))
                # the last stage is the first of the next step, where u' = w
                k[0] = _joined(_part(y7, 3), _part(k[6], 3), _part(y7, 9), _part(k[6], 9))
                scaled = wp.pow(wp.max(error, wp.float64(1e-10)), _PROPORTIONAL)
                h *= wp.clamp(_SAFETY * wp.pow(error_before, _INTEGRAL) / scaled, _SHRINK, growth)
                error_before = wp.max(error, wp.float64(1e-4))
                growth = _GROWTH
                if last:
                    t = duration_s
            else:
                shrink = _SHRINK
                if error > wp.float64(1.0) and error < wp.float64(1e100):
                    shrink = wp.max(_SHRINK, _SAFETY / wp.pow(error, _PROPORTIONAL))
                h *= shrink
                growth = wp.float64(1.0)
            if t < duration_s and (
                evaluation_count >= interval.evaluation_count_max or h < _STEP_MIN * duration_s
            ):
                failure = STATUS_VELOCITY
                spins = w_error > v_error or not wp.isfinite(wp.length(_part(k[0], 9)))
                if spins and wp.isfinite(wp.length(_part(k[0], 3))):
                    failure = STATUS_BODY_RATE
                break
        return x, _part(y, 3), q, _part(y, 9), evaluation_count, failure

    return fly_adaptive
