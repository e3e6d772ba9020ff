# mypy: disable-error-code="index,attr-defined,misc,call-overload,union-attr,assignment"
"""Rigid multirotors: state, and stepping in integer time, for one vehicle or thousands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError, model_validator

from neurosim_core.config_errors import explain
from neurosim_core.frames import as_rows, normalised
from neurosim_core.registry import register
from neurosim_core.runtime.cuda import RecordedLaunch
from neurosim_core.vehicle.airframe import (
    TERMS,
    MultirotorConfig,
    alike,
    make_airframe,
    preset,
    preset_values,
)
from neurosim_core.vehicle.arrays import (
    BLOCK_DIM,
    Acceleration,
    MultirotorState,
    allocate_arrays,
    check_status,
    read_state,
)
from neurosim_core.vehicle.base import FlightKernel, VehicleConfig, VehicleContext
from neurosim_core.vehicle.equations import Interval, Surroundings
from neurosim_core.vehicle.ground import make_ground
from neurosim_core.vehicle.integrator import make_flight, make_kernels, record_nothing
from neurosim_core.vehicle.motor import lag_constants
from neurosim_core.vehicle.wind import make_wind

Integrator = Literal["rkmk4", "dormand_prince"]
"""How a vehicle is integrated: see `Multirotor`."""

_STEP_MAX_NS = 10**12
_INTERVAL_COUNT_MAX = 256  # that are kept, one for each duration


class Effort(NamedTuple):
    """Counts of the adaptive integrator for each vehicle since the reset, on the host."""

    redone_count: NDArray[np.int64]
    """Intervals that fixed steps could not resolve and that were redone, [N]."""
    evaluation_count: NDArray[np.int64]
    """Evaluations of the right-hand side in adaptive steps, [N]; fixed steps take 4 each, not counted."""


class Multirotor:
    """A batch of equal multirotors, each with its own state.

    `step` and the properties are the convenient form: they check, copy and wait. `advance` and `accelerate`
    are the device form: they only launch one kernel on `arrays`, without allocation or waiting, and can be
    captured in a CUDA graph. Rotor speed commands outside the range of the rotors saturate, as they do in a
    motor controller.

    An interval is the duration of one call of `advance`, cut at the ticks of turbulence. It is integrated in
    equal steps of RKMK4 (`rkmk4.py`). If these do not resolve the motion of a vehicle, its interval is
    repeated from its beginning in adaptive steps of Dormand-Prince 5(4) (`dormand_prince.py`), on the device,
    and counted (`effort`). The criterion is RK4's embedded difference h/6 |k1 - k2 - k3 + k4| on velocity and
    body rate, against sqrt(1e-3^2 + (2e-3 |.|)^2); it catches blow-up and is no estimate of accuracy. A
    vehicle that adaptive steps cannot move either stops at the beginning of the interval: its `status` is set
    on the device, and `check` raises DynamicsError.

    Args:
        config: Parameters, the same for all vehicles.
        count: Number of vehicles N.
        device: Warp device.
        max_step_ns: Longest integration step [ns]. Adaptive steps begin with it, and may be longer.
        terms: Terms to compile in, of `TERMS`; by default those that the parameters need. More than needed
            change nothing but the speed.
        integrator: rkmk4: as above. dormand_prince: adaptive steps only.
        rtol: Of adaptive steps: largest error of one, as a share of displacement and rotation in the step, of
            velocity and of body rate.
        atol: What is added to that [m, m/s, rad, rad/s].
        evaluation_count_max: The most evaluations of the right-hand side for one interval of one vehicle.
        seed: Of the turbulence, 0 <= seed < 2^64: that of vehicle 0; the others count on from it.
        seeds: A seed for each vehicle in place of `seed`, device array of uint64, shape [N].

    Raises:
        TypeError: What counts is not an integer.
        ValueError: An argument is out of range, or there is no such device.
    """

    def __init__(
        self,
        config: MultirotorConfig,
        *,
        count: int = 1,
        device: str = "cpu",
        max_step_ns: int = 1_000_000,
        terms: Iterable[str] | None = None,
        integrator: Integrator = "rkmk4",
        rtol: float = 1e-6,
        atol: float = 1e-8,
        evaluation_count_max: int = 100_000,
        seed: int = 0,
        seeds: Any = None,
    ) -> None:
        _check_integer("count", count, 1, 2**31 - 1)
        _check_integer("max_step_ns", max_step_ns, 1, _STEP_MAX_NS)
        _check_integer("evaluation_count_max", evaluation_count_max, 7, 2**31 - 8)
        _check_integer("seed", seed, 0, 2**64 - 1)
        chosen = set(config.terms() if terms is None else terms)
        if not set(config.terms()) <= chosen <= set(TERMS):
            raise ValueError(
                f"terms must hold {config.terms()}, which the parameters need, and be of {TERMS}, got {terms}"
            )
        if integrator not in get_args(Integrator):
            raise ValueError(f"integrator must be of {get_args(Integrator)}, got {integrator!r}")
        if not 1e-14 <= rtol <= 0.1:
            raise ValueError(f"rtol must be in [1e-14, 0.1], got {rtol}")
        if not 0.0 < atol < np.inf:
            raise ValueError(f"atol must be > 0 and finite, got {atol}")
        self.config = config
        self.count = count
        self.device = wp.get_device(device)
        self.max_step_ns = max_step_ns
        self.terms = tuple(term for term in TERMS if term in chosen)
        """The terms that are compiled in."""
        self.arrays = allocate_arrays(count, config.rotor_count, self.device)
        self._kernels = make_kernels(frozenset(self.terms))
        self._adaptive = (integrator == "dormand_prince", rtol, atol, evaluation_count_max)
        airframe, rotors = make_airframe(config, self.device)
        self.airframes = alike(airframe, count, self.device)
        """Parameters of each vehicle, [N], which may be written between steps."""
        if seeds is None:
            own = np.arange(count, dtype=np.uint64) + np.uint64(seed)
            seeds = wp.array(own, dtype=wp.uint64, device=self.device)
        wind = make_wind(
            config.gusts if "gusts" in self.terms else (),
            config.turbulence,
            turbulent="turbulence" in self.terms,
            wind_m_s=config.wind_m_s,
            ground_height_m=0.0 if config.ground is None else config.ground.height_m,
            seeds=seeds,
            count=count,
            device=self.device,
        )
        self._around = _struct(
            Surroundings,
            wind=wind,
            ground=make_ground(config.ground, config.rotor_position_m, self.device),
            rotors=rotors,
        )
        self._intervals: dict[int, Any] = {}
        self._advance = RecordedLaunch(
            self.flight_kernel(record_nothing).kernel, self.device, block_dim=BLOCK_DIM
        )
        self._accelerate = RecordedLaunch(self._kernels.accelerate, self.device, block_dim=BLOCK_DIM)
        self.reset()

    def reset(
        self,
        position: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        orientation: ArrayLike | None = None,
        body_rate: ArrayLike | None = None,
        rotor_speed: ArrayLike | None = None,
    ) -> None:
        """Set the state of all vehicles, the time to 0, and release those that are held.

        Args:
            position: p_WB [m], shape [N, 3], or [3] for all alike; the origin by default.
            velocity: v_WB in W [m/s], likewise; 0 by default.
            orientation: q_WB, xyzw, shape [N, 4] or [4], normalised here; the identity by default.
            body_rate: w_WB in B [rad/s], shape [N, 3] or [3]; 0 by default.
            rotor_speed: [rad/s], shape [N, R] or [R]; hover by default. Also becomes the command.

        Raises:
            ValueError: A shape is wrong, a number is not finite, a quaternion is 0, or a rotor speed is out
            of range.
        """
        config, arrays = self.config, self.arrays
        q = self._rows((0.0, 0.0, 0.0, 1.0) if orientation is None else orientation, "orientation", 4)
        rotors = config.rotor_count
        hover = np.full(rotors, config.hover_rotor_speed_rad_s)
        speed = self._rows(hover if rotor_speed is None else rotor_speed, "rotor_speed", rotors)
        low, high = config.rotor_speed_min_rad_s, config.rotor_speed_max_rad_s
        slack = 1e-9 * high  # a state that was read from here is in range up to rounding
        if not ((speed >= low - slack) & (speed <= high + slack)).all():
            raise ValueError(f"rotor_speed must be in [{low:g}, {high:g}] rad/s, got {speed.tolist()}")
        zero = (0.0, 0.0, 0.0)
        rows = [
            (arrays.position, self._rows(zero if position is None else position, "position", 3)),
            (arrays.velocity, self._rows(zero if velocity is None else velocity, "velocity", 3)),
            (arrays.orientation, normalised(q)),
            (arrays.body_rate, self._rows(zero if body_rate is None else body_rate, "body_rate", 3)),
            (arrays.rotor_speed, speed),
            (arrays.rotor_speed_command, speed),
        ]
        for array, value in rows:
            array.assign(value)
        for counter in (arrays.stamp_ns, arrays.status, arrays.redone_count, arrays.evaluation_count):
            counter.zero_()
        self.begin(None)
        self._stamp_ns = 0

    def step(self, rotor_speed_command: ArrayLike, duration_ns: int) -> None:
        """Hold a command and move all vehicles, in equal steps of at most `max_step_ns`.

        Args:
            rotor_speed_command: [rad/s], shape [N, R] or [R]; saturates at the range of the rotors.
            duration_ns: How long [ns], > 0.

        Raises:
            TypeError: The duration is not an integer.
            ValueError: The shape is wrong, a command is not finite, or the duration is not positive.
            DynamicsError: A vehicle cannot be moved on; the others have been.
        """
        self.command(rotor_speed_command)
        self.advance(duration_ns)
        self.check()

    def command(self, rotor_speed_command: ArrayLike) -> None:
        """Set the command that `advance` holds.

        Args:
            rotor_speed_command: [rad/s], shape [N, R] or [R]; saturates at the range of the rotors.

        Raises:
            ValueError: The shape is wrong or a command is not finite.
        """
        rows = self._rows(rotor_speed_command, "rotor_speed_command", self.config.rotor_count)
        self.arrays.rotor_speed_command.assign(rows)

    def advance(self, duration_ns: int) -> None:
        """Move all vehicles with the command in `arrays`; device form of `step`, without checks.

        Raises:
            TypeError: The duration is not an integer.
            ValueError: The duration is not positive.
        """
        if not isinstance(duration_ns, (int, np.integer)):
            raise TypeError(f"duration_ns must be an integer, got {duration_ns!r}")
        kernel_inputs = [*self._flight_inputs(duration_ns), 0, 1, 0, 0, 0, 0]
        self._advance.launch(self.count, kernel_inputs, key=duration_ns)
        self._stamp_ns += duration_ns

    def flight_kernel(self, record: Any) -> FlightKernel:
        """Return what moves all vehicles by equal spans, and records the state after each.

        Args:
            record: Warp function that records the state of a vehicle; see `integrator.make_flight`.
        """
        return FlightKernel(make_flight(frozenset(self.terms), record), self._flight_inputs)

    def _flight_inputs(self, duration_ns: int) -> list[Any]:
        return [self.airframes, self._around, self._interval(duration_ns), self.arrays]

    def begin(self, mask: Any) -> None:
        """Take up the wind at time 0 for some vehicles, whose state was set in `arrays`; device form.

        Args:
            mask: Not 0 for those vehicles, device array of int32, shape [N]; None: all.
        """
        if self._kernels.begin is not None:
            wp.launch(
                self._kernels.begin,
                dim=self.count,
                inputs=[self.airframes, self._around, mask, self.arrays],
                device=self.device,
                block_dim=BLOCK_DIM,
            )

    def accelerate(self) -> None:
        """Evaluate `arrays.acceleration` and `.angular_acceleration` at the current state; device form."""
        self._accelerate.launch(self.count, [self.airframes, self._around, self.arrays])

    def check(self) -> None:
        """Wait for the device and raise if a vehicle is held.

        Raises:
            DynamicsError: For the first vehicle that is held.
        """
        check_status(self.arrays)

    @property
    def stamp_ns(self) -> int:
        """Time that `step` and `advance` have been called for since the reset [ns].

        A CUDA graph that is replayed moves `arrays.stamp_ns`, not this.
        """
        return self._stamp_ns

    @property
    def state(self) -> MultirotorState:
        """A copy of the state on the host; waits for the device."""
        return read_state(self.arrays)

    @property
    def acceleration(self) -> Acceleration:
        """Accelerations at the current state on the host; waits for the device."""
        self.accelerate()
        a = self.arrays
        return Acceleration(np.array(a.acceleration.numpy()), np.array(a.angular_acceleration.numpy()))

    @property
    def effort(self) -> Effort:
        """Counts of adaptive steps since the reset, on the host; waits for the device."""
        a = self.arrays
        return Effort(np.array(a.redone_count.numpy()), np.array(a.evaluation_count.numpy()))

    def _rows(self, value: ArrayLike, name: str, width: int) -> NDArray[np.float64]:
        return as_rows(value, name=name, count=self.count, width=width)

    def _interval(self, duration_ns: int) -> Any:
        """Return the parameters of an interval: the same struct each time, so that launches know it again."""
        if duration_ns in self._intervals:
            return self._intervals[duration_ns]
        if duration_ns <= 0:
            raise ValueError(f"duration_ns must be > 0, got {duration_ns}")
        if duration_ns > (longest_ns := (2**31 - 1) * self.max_step_ns):
            raise ValueError(f"duration_ns must be at most 2^31 steps, {longest_ns}, got {duration_ns}")
        if len(self._intervals) >= _INTERVAL_COUNT_MAX:
            self._intervals.clear()
        step_count = -(-duration_ns // self.max_step_ns)
        step_s = duration_ns / step_count * 1e-9
        lag = lag_constants(step_s, self.config.motor_time_constant_s)
        is_adaptive, rtol, atol, evaluation_count_max = self._adaptive
        self._intervals[duration_ns] = interval = _struct(
            Interval,
            duration_ns=duration_ns,
            max_step_ns=self.max_step_ns,
            step_s=step_s,
            step_count=step_count,
            speed_nodes=wp.vec3d(*lag.speed_nodes),
            square_nodes=wp.vec3d(*lag.square_nodes),
            decay=lag.decay,
            lag_rate=lag.rate_1_s,
            is_adaptive=is_adaptive,
            rtol=rtol,
            atol=atol,
            evaluation_count_max=evaluation_count_max,
        )
        return interval


@register("vehicle", "multirotor")
class MultirotorVehicleConfig(VehicleConfig):
    """The multirotor that carries the sensors."""

    kind: Literal["multirotor"] = "multirotor"
    preset: str = "hummingbird"
    """Name of the airframe: crazyflie, hummingbird or racer."""
    parameters: dict[str, Any] = Field(default_factory=dict)
    """Parameters to change, by name (see `MultirotorConfig`), of the airframe, such as {mass_kg: 0.6}, and of
    its environment: {wind_m_s: [3, 0, 0], gusts: [{velocity_m_s: [5, 0, 0], start_s: 1, rise_s: 0.5, hold_s:
    2}], turbulence: {wind_20ft_m_s: 7.7}, ground: {height_m: 0, rotor_radius_m: 0.1}}. A gust without hold_s
    stays for good."""
    integrator: Integrator = "rkmk4"
    """rkmk4: fixed steps of a Runge-Kutta-Munthe-Kaas method, adaptive ones for intervals that these cannot
    resolve. dormand_prince: adaptive steps only."""

    @model_validator(mode="after")
    def _airframe_exists(self) -> MultirotorVehicleConfig:
        try:
            MultirotorConfig.model_validate(preset_values(self.preset) | self.parameters)
        except ValidationError as error:
            lines = explain(MultirotorConfig, error)
            whole = any(not item["loc"] for item in error.errors())
            before = "parameters: " if whole else "parameters."
            raise ValueError("; ".join(f"{before}{line}" for line in lines)) from None
        return self

    @property
    def title(self) -> str:
        """Name of the airframe."""
        return self.preset

    def airframe(self) -> MultirotorConfig:
        """Return all parameters of the airframe."""
        return preset(self.preset, **self.parameters)

    def make(self, context: VehicleContext) -> Multirotor:
        """Return the multirotors of all worlds."""
        return Multirotor(
            self.airframe(),
            count=context.count,
            device=context.device,
            max_step_ns=context.max_step_ns,
            integrator=self.integrator,
            seeds=context.seeds,
        )


def _check_integer(name: str, value: Any, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be an integer, got {value!r}")
    if not low <= value <= high:
        raise ValueError(f"{name} must be in [{low}, {high}], got {value}")


def _struct(kind: Any, **values: Any) -> Any:
    """Return a struct of the kernels with its members set."""
    filled = kind()
    for name, value in values.items():
        setattr(filled, name, value)
    return filled
