# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""The kernels of a batch: fixed steps first, and adaptive ones for the vehicles where those do not do."""

import functools
from typing import Any, NamedTuple

import warp as wp

from neurosim_core.vehicle.aerodynamics import Airframe, vec10d
from neurosim_core.vehicle.arrays import STATUS_COMMAND, STATUS_OK, MultirotorArrays
from neurosim_core.vehicle.dormand_prince import make_dormand_prince
from neurosim_core.vehicle.equations import Interval, RotorSums, Surroundings, held_command, make_equations
from neurosim_core.vehicle.motor import projected_exponential
from neurosim_core.vehicle.rkmk4 import make_rkmk4
from neurosim_core.vehicle.wind import draw_turbulence, start_turbulence, time_to_tick


class Kernels(NamedTuple):
    """The kernels of one set of terms."""

    move: Any
    """Device function that moves one vehicle by an interval, unless it is held."""
    accelerate: Any
    """Evaluates linear and angular acceleration at the current state."""
    begin: Any
    """Takes up the wind at time 0, and draws its turbulence; None without wind."""


@wp.func
def part_of(interval: Interval, duration_ns: wp.int64) -> Interval:
    """Return the first part of an interval, in equal steps of its own; see `motor.lag_constants`."""
    part = Interval()
    step_count = (duration_ns + interval.max_step_ns - wp.int64(1)) / interval.max_step_ns
    part.duration_ns = duration_ns
    part.max_step_ns = interval.max_step_ns
    part.step_count = wp.int32(step_count)
    part.step_s = wp.float64(duration_ns) / wp.float64(step_count) * wp.float64(1e-9)
    part.lag_rate = interval.lag_rate
    part.is_adaptive = interval.is_adaptive
    part.rtol = interval.rtol
    part.atol = interval.atol
    part.evaluation_count_max = interval.evaluation_count_max
    if part.step_s == interval.step_s:
        part.speed_nodes = interval.speed_nodes
        part.square_nodes = interval.square_nodes
        part.decay = interval.decay
    else:
        z = interval.lag_rate * part.step_s
        part.speed_nodes = projected_exponential(z)
        part.square_nodes = projected_exponential(wp.float64(2.0) * z)
        part.decay = wp.exp(-z)
    return part


@functools.cache
def make_kernels(terms: frozenset[str]) -> Kernels:
    """Return the kernels that compute only the given terms (see `multirotor.TERMS`)."""
    equations = make_equations(terms)
    motor_lag, air_terms = equations.motor_lag, equations.air_terms
    wind, changing_wind, turbulence = equations.wind, equations.changing_wind, equations.turbulence
    windy = not terms.isdisjoint(("wind", "gusts", "turbulence"))
    near_ground = equations.ground or equations.ground_effect
    forces, lift, wind_at = equations.forces, equations.lift, equations.wind_at
    fly_fixed = make_rkmk4(equations)
    fly_adaptive = make_dormand_prince(equations)
    module = _module(terms)

    @wp.func
    def fly(
        airframe: Airframe,
        around: Surroundings,
        interval: Interval,
        arrays: MultirotorArrays,
        vehicle: wp.int32,
    ):
        """Move one vehicle by an interval, or set its status and leave it where it is."""
        rotor_count = arrays.rotor_speed_command.shape[1]
        # sums over the rotors of Omega^2 = c^2 + 2 c d + d^2 and Omega = c + d, where d = Omega_0 - c decays
        sums = RotorSums()
        sums.rate = interval.lag_rate
        for rotor in range(rotor_count):
            c = held_command(airframe, arrays.rotor_speed_command, vehicle, rotor)
            d = arrays.rotor_speed[vehicle, rotor] - c
            sums.quadratic_cc += c * c * around.rotors.quadratic_weight[rotor]
            if wp.static(motor_lag):
                sums.quadratic_cd += wp.float64(2.0) * c * d * around.rotors.quadratic_weight[rotor]
                sums.quadratic_dd += d * d * around.rotors.quadratic_weight[rotor]
            if wp.static(air_terms):
                sums.linear_c += c * around.rotors.linear_weight[rotor]
                if wp.static(motor_lag):
                    sums.linear_d += d * around.rotors.linear_weight[rotor]

        x = arrays.position[vehicle]
        v = arrays.velocity[vehicle]
        q = arrays.orientation[vehicle]
        w = arrays.body_rate[vehicle]
        start_ns = arrays.stamp_ns[vehicle]
        remaining = wp.float64(0.0)
        redo = wp.bool(True)
        if not interval.is_adaptive:
            x, v, q, w, remaining, redo = fly_fixed(
                airframe, around, interval, sums, vehicle, start_ns, x, v, q, w
            )
        if redo:
            x, v, q, w, used, failure = fly_adaptive(
                airframe, around, interval, sums, vehicle, start_ns,
                arrays.position[vehicle], arrays.velocity[vehicle],
                arrays.orientation[vehicle], arrays.body_rate[vehicle],
            )  # fmt: skip
            arrays.evaluation_count[vehicle] += wp.int64(used)
            if not interval.is_adaptive:
                arrays.redone_count[vehicle] += wp.int64(1)
            if failure != STATUS_OK:
                arrays.status[vehicle] = failure
                return
            if wp.static(motor_lag):
                duration_s = wp.float64(interval.step_count) * interval.step_s
                remaining = wp.exp(-interval.lag_rate * duration_s)

        arrays.position[vehicle] = x
        arrays.velocity[vehicle] = v
        arrays.orientation[vehicle] = q
        arrays.body_rate[vehicle] = w
        for rotor in range(rotor_count):
            c = held_command(airframe, arrays.rotor_speed_command, vehicle, rotor)
            if wp.static(motor_lag):
                arrays.rotor_speed[vehicle, rotor] = c + remaining * (arrays.rotor_speed[vehicle, rotor] - c)
            else:
                arrays.rotor_speed[vehicle, rotor] = c
        arrays.stamp_ns[vehicle] += interval.duration_ns
        if wp.static(windy):
            arrays.air_velocity[vehicle] = wind_at(
                airframe, around.wind, vehicle, arrays.stamp_ns[vehicle], wp.float64(0.0)
            )

    @wp.func
    def move(
        airframe: Airframe,
        around: Surroundings,
        interval: Interval,
        arrays: MultirotorArrays,
        vehicle: wp.int32,
    ):
        """Move one vehicle by an interval, unless it is held."""
        if arrays.status[vehicle] != STATUS_OK:
            return
        for rotor in range(arrays.rotor_speed_command.shape[1]):
            if not wp.isfinite(arrays.rotor_speed_command[vehicle, rotor]):
                arrays.status[vehicle] = STATUS_COMMAND
                return
        if wp.static(not turbulence):
            fly(airframe, around, interval, arrays, vehicle)
        else:
            left_ns = wp.int64(interval.duration_ns)
            while left_ns > wp.int64(0) and arrays.status[vehicle] == STATUS_OK:
                now_ns = arrays.stamp_ns[vehicle]
                draw_turbulence(
                    around.wind, airframe, vehicle, now_ns, arrays.position[vehicle], arrays.velocity[vehicle]
                )
                part = part_of(interval, wp.min(left_ns, time_to_tick(around.wind, now_ns)))
                fly(airframe, around, part, arrays, vehicle)
                left_ns -= part.duration_ns

    @wp.kernel(module=module, enable_backward=False)
    def accelerate(
        # Model:
        airframes: wp.array[Airframe],
        around: Surroundings,
        # In/out:
        arrays: MultirotorArrays,
    ):
        vehicle = wp.tid()
        airframe = airframes[vehicle]
        quadratic = wp.vec4d()
        linear = vec10d()
        for rotor in range(arrays.rotor_speed.shape[1]):
            speed = arrays.rotor_speed[vehicle, rotor]
            quadratic += speed * speed * around.rotors.quadratic_weight[rotor]
            if wp.static(air_terms):
                linear += speed * around.rotors.linear_weight[rotor]
        q = arrays.orientation[vehicle]
        w = arrays.body_rate[vehicle]
        v = arrays.velocity[vehicle]
        air = v
        if wp.static(air_terms):
            if wp.static(changing_wind):
                air -= wind_at(airframe, around.wind, vehicle, arrays.stamp_ns[vehicle], wp.float64(0.0))
            elif wp.static(wind):
                air -= airframe.wind
            air = wp.quat_rotate_inv(q, air)
        up = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
        height = arrays.position[vehicle][2] - around.ground.height
        if wp.static(near_ground):
            v = wp.quat_rotate_inv(q, v)
            up = wp.quat_rotate_inv(q, up)
            quadratic = lift(around.ground, height, quadratic)
        force, spin = forces(airframe, around.ground, quadratic, linear, air, v, up, height, w)
        down = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity)
        arrays.acceleration[vehicle] = down + airframe.mass_inverse * wp.quat_rotate(q, force)
        arrays.angular_acceleration[vehicle] = spin

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        # Model:
        airframes: wp.array[Airframe],
        around: Surroundings,
        # In:
        mask: wp.array[wp.int32],
        # In/out:
        arrays: MultirotorArrays,
    ):
        vehicle = wp.tid()
        if mask.shape[0] == 0 or mask[vehicle] != 0:
            if wp.static(turbulence):
                start_turbulence(around.wind, vehicle, arrays.position[vehicle])
            arrays.air_velocity[vehicle] = wind_at(
                airframes[vehicle], around.wind, vehicle, wp.int64(0), wp.float64(0.0)
            )

    return Kernels(move, accelerate, begin if windy else None)


@wp.func
def record_nothing(
    log: wp.int32,
    vehicle: wp.int32,
    slot: wp.int32,
    elapsed_ns: wp.int64,
    is_first: wp.bool,
    is_last: wp.bool,
) -> None:
    """Record no state, in place of a function that does."""


@functools.cache
def make_flight(terms: frozenset[str], record: Any) -> Any:
    """Return the kernel that moves every vehicle by equal intervals, and records its state after each.

    Args:
        terms: As of `make_kernels`.
        record: Warp function of a `log` of any type; the vehicle; the slot; time since the beginning of the
            batch [ns]; whether the state is the first and the last of the batch.
    """
    move = make_kernels(terms).move
    log_type = next(iter(record.input_types.values()))

    @wp.kernel(module=_module(terms, record.key), enable_backward=False)
    def fly(
        # Model:
        airframes: wp.array[Airframe],
        around: Surroundings,
        interval: Interval,
        # In/out:
        arrays: MultirotorArrays,
        log: log_type,
        # In:
        interval_count: wp.int32,
        slot: wp.int32,
        elapsed_ns: wp.int64,
        is_first: wp.int32,
        is_last: wp.int32,
    ):
        vehicle = wp.tid()
        airframe = airframes[vehicle]
        for index in range(interval_count):
            move(airframe, around, interval, arrays, vehicle)
            record(
                log,
                vehicle,
                slot + index,
                elapsed_ns + wp.int64(index + 1) * interval.duration_ns,
                is_first != 0 and index == 0,
                is_last != 0 and index == interval_count - 1,
            )

    return fly


def _module(terms: frozenset[str], *more: str) -> wp.Module:
    """Return the module of kernels with some terms."""
    return wp.get_module(".".join((__name__, "_".join(sorted(terms)) or "rigid", *more)))
