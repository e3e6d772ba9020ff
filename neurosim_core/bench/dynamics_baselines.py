# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
"""Integrators to compare with, which are no part of the product: explicit Euler, RK4, implicit midpoint.

Each integrates the vehicle's own equations (`aerodynamics.make_wrench`) with the rotor speeds as part of the
state, for vehicles of four rotors, and is compiled by Warp like the product's kernels, on the same arrays:

    euler     explicit Euler on the components of the quaternion, normalised after each step
    rk4       classical Runge-Kutta on the same, as most simulators have it
    midpoint  implicit midpoint with R_1 = R_0 cay(h w_m), which keeps energy and momentum of a free body
              (Lie-Poisson); solved by fixed-point iteration, and by Newton's method with differences where
              that does not contract; the motor's part in closed form

They have no guard: what they cannot resolve becomes infinite or NaN.

Reference: Hairer, Lubich, Wanner (2006), Geometric Numerical Integration, II.1 and VII.5.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from neurosim_core.vehicle.aerodynamics import AIR_TERMS, Airframe, make_wrench, vec10d

KNOWN_TERMS = frozenset({"motor_lag", *AIR_TERMS, "wind", "full_inertia"})
"""Terms of the product that the baselines have too."""

_ITERATION_COUNT_MAX = wp.constant(30)
"""Fixed-point iterations of one step; where they contract well, a dozen reach rounding."""
_NEWTON_COUNT_MAX = wp.constant(20)
_CONVERGED = wp.constant(wp.float64(1e-15))  # change of an iterate, as a share of it
_NEWTON_CONVERGED = wp.constant(wp.float64(1e-12))  # likewise; the Jacobian is of differences
_DIFFERENCE = wp.constant(wp.float64(1e-7))  # relative step of the differences

_vec6d = wp.types.vector(length=6, dtype=wp.float64)
_mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)


@wp.struct
class Motion:
    """What is integrated, and likewise its rate."""

    position: wp.vec3d
    """p_WB [m]."""
    velocity: wp.vec3d
    """v_WB in W [m/s]."""
    orientation: wp.quatd
    """q_WB; within a step not of unit length."""
    body_rate: wp.vec3d
    """w_WB in B [rad/s]."""
    rotor_speed: wp.vec4d
    """[rad/s]."""


class Baselines(NamedTuple):
    """The kernels of one set of terms. Those that advance take the same arguments."""

    derivative: Any
    """Evaluates the rate of (position, velocity, orientation, body rate) for given rotor speeds."""
    euler: Any
    rk4: Any
    midpoint: Any


@wp.func
def _moved(s: Motion, rate: Motion, h: wp.float64) -> Motion:
    moved = Motion()
    moved.position = s.position + h * rate.position
    moved.velocity = s.velocity + h * rate.velocity
    moved.orientation = s.orientation + h * rate.orientation
    moved.body_rate = s.body_rate + h * rate.body_rate
    moved.rotor_speed = s.rotor_speed + h * rate.rotor_speed
    return moved


@wp.func
def _solve6(a: _mat66d, b: _vec6d) -> _vec6d:
    """Return x with a x = b, by elimination with partial pivoting."""
    for column in range(6):
        pivot = column
        for row in range(column + 1, 6):
            if wp.abs(a[row, column]) > wp.abs(a[pivot, column]):
                pivot = row
        for k in range(6):
            held = a[column, k]
            a[column, k] = a[pivot, k]
            a[pivot, k] = held
        held = b[column]
        b[column] = b[pivot]
        b[pivot] = held
        for row in range(column + 1, 6):
            factor = a[row, column] / a[column, column]
            for k in range(6):
                a[row, k] = a[row, k] - factor * a[column, k]
            b[row] = b[row] - factor * b[column]
    x = _vec6d()
    for back in range(6):
        row = 5 - back
        rest = b[row]
        for k in range(row + 1, 6):
            rest -= a[row, k] * x[k]
        x[row] = rest / a[row, row]
    return x


@functools.cache
def make_baselines(terms: frozenset[str]) -> Baselines:
    """Return the baselines with the given terms in them.

    Raises:
        ValueError: There are terms that the baselines do not have.
    """
    if unknown := terms - KNOWN_TERMS:
        raise ValueError(f"the baselines have the terms {sorted(KNOWN_TERMS)}, got {sorted(unknown)} as well")
    motor_lag = "motor_lag" in terms
    module = wp.get_module(f"{__name__}.{'_'.join(sorted(terms)) or 'rigid'}")
    body_wrench = _make_body_wrench(terms)
    angular_acceleration = _make_angular_acceleration(full_inertia="full_inertia" in terms)
    motion_rate = _make_motion_rate(body_wrench, angular_acceleration, motor_lag=motor_lag)
    midpoint_map = _make_midpoint_map(body_wrench, angular_acceleration)
    middle = _make_middle(midpoint_map, _make_newton(midpoint_map))
    load = _make_load(motor_lag=motor_lag)
    return Baselines(
        derivative=_make_derivative(module, motion_rate),
        euler=_make_advance(module, load, _make_euler_step(motion_rate)),
        rk4=_make_advance(module, load, _make_rk4_step(motion_rate)),
        midpoint=_make_advance(module, load, _make_midpoint_step(middle, motor_lag=motor_lag)),
    )


@wp.func
def _clamped(airframe: Airframe, rotor_speed_command: wp.array2d[wp.float64], vehicle: int) -> wp.vec4d:
    """Return the commands of one vehicle within its limits [rad/s]."""
    command = wp.vec4d()
    for rotor in range(4):
        command[rotor] = wp.clamp(
            rotor_speed_command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max
        )
    return command


def _make_load(*, motor_lag: bool) -> Any:
    """Return the device function that gathers the `Motion` of one vehicle from arrays [N] and [N, 4].

    Without motor lag its rotors turn as commanded [rad/s].
    """

    @wp.func
    def load(
        vehicle: int,
        position: wp.array[wp.vec3d],
        velocity: wp.array[wp.vec3d],
        orientation: wp.array[wp.quatd],
        body_rate: wp.array[wp.vec3d],
        rotor_speed: wp.array2d[wp.float64],
        command: wp.vec4d,
    ) -> Motion:
        s = Motion()
        s.position = position[vehicle]
        s.velocity = velocity[vehicle]
        s.orientation = orientation[vehicle]
        s.body_rate = body_rate[vehicle]
        s.rotor_speed = command
        if wp.static(motor_lag):
            for rotor in range(4):
                s.rotor_speed[rotor] = rotor_speed[vehicle, rotor]
        return s

    return load


def _make_angular_acceleration(*, full_inertia: bool) -> Any:
    """Return the device function of Euler's equations: dw/dt in B [rad/s^2] from torque [N m] and w [rad/s].

    Without full inertia it reads the diagonal alone.
    """

    @wp.func
    def angular_acceleration(airframe: Airframe, torque: wp.vec3d, w: wp.vec3d) -> wp.vec3d:
        if wp.static(full_inertia):
            return airframe.inertia_inverse * (torque - wp.cross(w, airframe.inertia * w))
        else:
            momentum = wp.cw_mul(airframe.inertia_diagonal, w)
            return wp.cw_mul(airframe.inertia_diagonal_inverse, torque - wp.cross(w, momentum))

    return angular_acceleration


def _make_body_wrench(terms: frozenset[str]) -> Any:
    """Return the device function of force [N] and torque [N m] in B, from the motion and four rotor speeds.

    Its velocity is v_WB in W [m/s], its w the body rate in B [rad/s]; its weights have shape [4], one for
    each rotor (`aerodynamics.quadratic_weights`, `aerodynamics.linear_weights`).
    """
    wrench = make_wrench(terms)

    @wp.func
    def body_wrench(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        attitude: wp.quatd,
        velocity: wp.vec3d,
        w: wp.vec3d,
        rotor_speed: wp.vec4d,
    ):
        quadratic = wp.vec4d()
        linear = vec10d()
        for rotor in range(4):
            quadratic += rotor_speed[rotor] * rotor_speed[rotor] * quadratic_weight[rotor]
            linear += rotor_speed[rotor] * linear_weight[rotor]
        air = wp.quat_rotate_inv(attitude, velocity - airframe.wind)
        return wrench(airframe, quadratic, linear, air, w)

    return body_wrench


def _make_motion_rate(body_wrench: Any, angular_acceleration: Any, *, motor_lag: bool) -> Any:
    """Return the device function of d/dt of a `Motion`, for commands [rad/s] that hold.

    Without motor lag the rate of the rotor speeds is zero.
    """

    @wp.func
    def motion_rate(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        time_constant_s: wp.float64,
        command: wp.vec4d,
        s: Motion,
    ) -> Motion:
        attitude = wp.normalize(s.orientation)
        w = s.body_rate
        force, torque = body_wrench(
            airframe, quadratic_weight, linear_weight, attitude, s.velocity, w, s.rotor_speed
        )
        down = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity)
        rate = Motion()
        rate.position = s.velocity
        rate.velocity = down + airframe.mass_inverse * wp.quat_rotate(attitude, force)
        rate.orientation = wp.float64(0.5) * (s.orientation * wp.quatd(w[0], w[1], w[2], wp.float64(0.0)))
        rate.body_rate = angular_acceleration(airframe, torque, w)
        if wp.static(motor_lag):
            rate.rotor_speed = (command - s.rotor_speed) / time_constant_s
        return rate

    return motion_rate


def _make_euler_step(motion_rate: Any) -> Any:
    """Return the device function of one step of h [s] of explicit Euler, normalised at its end."""

    @wp.func
    def euler_step(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        time_constant_s: wp.float64,
        h: wp.float64,
        command: wp.vec4d,
        s: Motion,
    ) -> Motion:
        rate = motion_rate(airframe, quadratic_weight, linear_weight, time_constant_s, command, s)
        end = _moved(s, rate, h)
        end.orientation = wp.normalize(end.orientation)
        return end

    return euler_step


def _make_rk4_step(motion_rate: Any) -> Any:
    """Return the device function of one step of h [s] of classical Runge-Kutta, normalised at its end.

    Reference: Hairer, Lubich, Wanner (2006), II.1.
    """

    @wp.func
    def rk4_step(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        time_constant_s: wp.float64,
        h: wp.float64,
        command: wp.vec4d,
        s: Motion,
    ) -> Motion:
        half = wp.float64(0.5) * h
        third = h / wp.float64(3.0)
        sixth = h / wp.float64(6.0)
        k_1 = motion_rate(airframe, quadratic_weight, linear_weight, time_constant_s, command, s)
        s_2 = _moved(s, k_1, half)
        k_2 = motion_rate(airframe, quadratic_weight, linear_weight, time_constant_s, command, s_2)
        s_3 = _moved(s, k_2, half)
        k_3 = motion_rate(airframe, quadratic_weight, linear_weight, time_constant_s, command, s_3)
        s_4 = _moved(s, k_3, h)
        k_4 = motion_rate(airframe, quadratic_weight, linear_weight, time_constant_s, command, s_4)
        end = _moved(_moved(_moved(_moved(s, k_1, sixth), k_2, third), k_3, third), k_4, sixth)
        end.orientation = wp.normalize(end.orientation)
        return end

    return rk4_step


@wp.func
def _cayley_turn(orientation: wp.quatd, h: wp.float64, w: wp.vec3d) -> wp.quatd:
    """Return the orientation turned by cay(h w), with w in B [rad/s] and h [s]."""
    u = wp.float64(0.5) * h * w
    return orientation * wp.normalize(wp.quatd(u[0], u[1], u[2], wp.float64(1.0)))


def _make_midpoint_map(body_wrench: Any, angular_acceleration: Any) -> Any:
    """Return the device function whose fixed point solves a step of the implicit midpoint.

    It maps guesses of velocity in W [m/s] and body rate in B [rad/s] in the middle of the step, shape [6], to
    better ones, at given rotor speeds in the middle [rad/s].
    """

    @wp.func
    def midpoint_map(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        h: wp.float64,
        s: Motion,
        rotor_speed: wp.vec4d,
        middle: _vec6d,
    ) -> _vec6d:
        half = wp.float64(0.5) * h
        v = wp.vec3d(middle[0], middle[1], middle[2])
        w = wp.vec3d(middle[3], middle[4], middle[5])
        attitude = wp.normalize(s.orientation + _cayley_turn(s.orientation, h, w))
        force, torque = body_wrench(airframe, quadratic_weight, linear_weight, attitude, v, w, rotor_speed)
        down = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity)
        v = s.velocity + half * (down + airframe.mass_inverse * wp.quat_rotate(attitude, force))
        w = s.body_rate + half * angular_acceleration(airframe, torque, w)
        return _vec6d(v[0], v[1], v[2], w[0], w[1], w[2])

    return midpoint_map


def _make_newton(midpoint_map: Any) -> Any:
    """Return the device function that solves z = midpoint_map(z), shape [6], by Newton's method.

    It begins at `start`; the Jacobian is of forward differences.
    """

    @wp.func
    def newton(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        h: wp.float64,
        s: Motion,
        rotor_speed: wp.vec4d,
        start: _vec6d,
    ) -> _vec6d:
        z = wp.float64(1.0) * start
        for _iteration in range(_NEWTON_COUNT_MAX):
            image = midpoint_map(airframe, quadratic_weight, linear_weight, h, s, rotor_speed, z)
            jacobian = _mat66d()
            for column in range(6):
                moved = wp.float64(1.0) * z
                step = _DIFFERENCE * (wp.float64(1.0) + wp.abs(z[column]))
                moved[column] = z[column] + step
                slope = midpoint_map(airframe, quadratic_weight, linear_weight, h, s, rotor_speed, moved)
                for row in range(6):
                    jacobian[row, column] = -(slope[row] - image[row]) / step
                jacobian[column, column] = jacobian[column, column] + wp.float64(1.0)
            change = _solve6(jacobian, image - z)
            z = z + change
            if wp.length(change) <= _NEWTON_CONVERGED * wp.length(z):
                break
        return z

    return newton


def _make_middle(midpoint_map: Any, newton: Any) -> Any:
    """Return the device function that solves z = midpoint_map(z), shape [6], by fixed-point iteration.

    Where that does not converge from `start`, it begins again with Newton's method.
    """

    @wp.func
    def middle(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        h: wp.float64,
        s: Motion,
        rotor_speed: wp.vec4d,
        start: _vec6d,
    ) -> _vec6d:
        z = wp.float64(1.0) * start  # a copy: a bare name would be the same variable
        solved = wp.bool(False)
        for _iteration in range(_ITERATION_COUNT_MAX):
            z_next = midpoint_map(airframe, quadratic_weight, linear_weight, h, s, rotor_speed, z)
            size = wp.length(z_next)
            solved = wp.length(z_next - z) <= _CONVERGED * size and wp.isfinite(size)
            z = z_next
            if solved or not wp.isfinite(size):
                break
        if not solved:
            z = newton(airframe, quadratic_weight, linear_weight, h, s, rotor_speed, start)
        return z

    return middle


def _make_midpoint_step(middle: Any, *, motor_lag: bool) -> Any:
    """Return the device function of one step of h [s] of the implicit midpoint, the motor in closed form.

    Velocity, body rate and rotor speed at its end are mirrored at the middle of the step.

    Reference: Hairer, Lubich, Wanner (2006), VII.5.
    """

    @wp.func
    def midpoint_step(
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        time_constant_s: wp.float64,
        h: wp.float64,
        command: wp.vec4d,
        s: Motion,
    ) -> Motion:
        speed = s.rotor_speed
        if wp.static(motor_lag):
            share = wp.float64(0.5) * h / time_constant_s
            speed = (s.rotor_speed + share * command) / (wp.float64(1.0) + share)
        start = _vec6d(
            s.velocity[0], s.velocity[1], s.velocity[2], s.body_rate[0], s.body_rate[1], s.body_rate[2]
        )
        z = middle(airframe, quadratic_weight, linear_weight, h, s, speed, start)
        v = wp.vec3d(z[0], z[1], z[2])
        w = wp.vec3d(z[3], z[4], z[5])
        end = Motion()
        end.position = s.position + h * v
        end.velocity = wp.float64(2.0) * v - s.velocity
        end.body_rate = wp.float64(2.0) * w - s.body_rate
        end.orientation = wp.normalize(_cayley_turn(s.orientation, h, w))
        end.rotor_speed = speed
        if wp.static(motor_lag):
            end.rotor_speed = wp.float64(2.0) * speed - s.rotor_speed
        return end

    return midpoint_step


def _make_advance(module: wp.Module, load: Any, step: Any) -> Any:
    """Return the kernel that makes `step_count` steps of `step_s` for each vehicle, in place.

    Commands and rotor speeds have shape [N, 4] [rad/s], all else [N] with the units of `Motion`.
    """

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Model:
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        time_constant_s: wp.float64,
        step_s: wp.float64,
        step_count: wp.int32,
        # In:
        rotor_speed_command: wp.array2d[wp.float64],
        # In/out:
        position: wp.array[wp.vec3d],
        velocity: wp.array[wp.vec3d],
        orientation: wp.array[wp.quatd],
        body_rate: wp.array[wp.vec3d],
        rotor_speed: wp.array2d[wp.float64],
    ):
        vehicle = wp.tid()
        command = _clamped(airframe, rotor_speed_command, vehicle)
        s = load(vehicle, position, velocity, orientation, body_rate, rotor_speed, command)
        for _step in range(step_count):
            s = step(airframe, quadratic_weight, linear_weight, time_constant_s, step_s, command, s)
        position[vehicle] = s.position
        velocity[vehicle] = s.velocity
        orientation[vehicle] = s.orientation
        body_rate[vehicle] = s.body_rate
        for rotor in range(4):
            rotor_speed[vehicle, rotor] = s.rotor_speed[rotor]

    return advance


def _make_derivative(module: wp.Module, motion_rate: Any) -> Any:
    """Return the kernel of the rate of one vehicle's motion, launched with one thread.

    It reads p_WB [m], v_WB in W [m/s], q_WB, w_WB in B [rad/s] and rotor speeds [rad/s], shape [17], and
    overwrites the rates of the first four, shape [13].
    """

    @wp.kernel(module=module, enable_backward=False)
    def derivative(
        # Model:
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        # In:
        y: wp.array[wp.float64],
        # Out:
        rate_out: wp.array[wp.float64],
    ):
        s = Motion()
        for axis in range(3):
            s.position[axis] = y[axis]
            s.velocity[axis] = y[3 + axis]
            s.body_rate[axis] = y[10 + axis]
        s.orientation = wp.quatd(y[6], y[7], y[8], y[9])
        for rotor in range(4):
            s.rotor_speed[rotor] = y[13 + rotor]
        one = wp.float64(1.0)
        rate = motion_rate(airframe, quadratic_weight, linear_weight, one, s.rotor_speed, s)
        for axis in range(3):
            rate_out[axis] = rate.position[axis]
            rate_out[3 + axis] = rate.velocity[axis]
            rate_out[10 + axis] = rate.body_rate[axis]
        for part in range(4):
            rate_out[6 + part] = rate.orientation[part]

    return derivative
