# mypy: disable-error-code="attr-defined"
"""The interface of vehicles: settings, the methods that the engine calls, and a base class in Python."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.settings import BaseConfig
from neurosim_core.vehicle.airframe import MultirotorConfig
from neurosim_core.vehicle.arrays import (
    STATUS_BODY_RATE,
    STATUS_VELOCITY,
    Acceleration,
    MultirotorArrays,
    MultirotorState,
    allocate_arrays,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class VehicleContext:
    """The context that a vehicle is made in."""

    count: int
    """Number of worlds, each with one vehicle."""
    device: str
    """Device of its state."""
    max_step_ns: int
    """Longest integration step [ns]."""
    seeds: Any
    """Seed of each world, device array of uint64, shape [N]."""


class VehicleConfig(BaseConfig):
    """Base class of the settings of vehicles. Subclasses add `kind`, their fields, `airframe` and `make`."""

    kind: str
    """Under which name the class is registered."""
    max_step_s: Annotated[float, Field(ge=1e-6, le=0.1)] = 0.001
    """Longest integration step [s]; intervals end exactly on control and sensor stamps."""
    collision_radius_m: Annotated[float, Field(gt=0.0)] = 0.2
    """Radius of the sphere around the vehicle that must not touch the scene [m]. Where `parameters.ground`
    is set, the sphere shrinks near that plane to end 1 cm above it: to land is no collision."""
    on_collision: Literal["end", "report"] = "end"
    """Response to contact with the scene. end: the run stops at the first contact; report: the vehicle flies
    on, through things, and yields Collision packets."""

    @property
    def title(self) -> str:
        """Name of the vehicle in printed texts."""
        return self.kind

    def airframe(self) -> MultirotorConfig:
        """Return the multirotor that planners, controllers and IMUs assume: mass, inertia, rotors, ranges."""
        raise NotImplementedError

    def make(self, context: VehicleContext) -> Vehicle:
        """Return the vehicles of all worlds."""
        raise NotImplementedError


class FlightKernel(NamedTuple):
    """A kernel that moves all vehicles by equal spans, and records the state after each."""

    kernel: wp.Kernel
    inputs: Callable[[int], list[Any]]
    """Returns its first inputs for spans of a length [ns]; the inputs of the recording follow."""


class Vehicle(Protocol):
    """The vehicles of all worlds. On a CUDA device, methods only launch kernels and copies."""

    config: MultirotorConfig
    """The multirotor that planners, controllers and IMUs assume."""
    count: int
    """Number of worlds, N."""
    device: Any
    """Device of `arrays`."""
    max_step_ns: int
    """Longest integration step [ns]."""
    arrays: MultirotorArrays
    """The state; controllers write `rotor_speed_command`."""
    terms: tuple[str, ...]
    """Optional terms that are compiled in."""

    def advance(self, duration_ns: int) -> None:
        """Integrate all vehicles for a duration [ns] with their present commands."""

    def begin(self, mask: Any) -> None:
        """Begin an episode at the state in `arrays`, for vehicles whose mask, int32 [N], is not 0."""

    def accelerate(self) -> None:
        """Compute the accelerations at the present state."""

    def flight_kernel(self, record: Any) -> FlightKernel | None:
        """Return the kernel that moves all vehicles by equal spans, and records them; None: use `advance`.

        Args:
            record: Warp function that records the state of a vehicle; see `integrator.make_flight`.
        """


class HostVehicle:
    """Base class of vehicles in plain Python. Define `move` and `acceleration`.

    It runs on the CPU, one world after the other. If `move` returns numbers that are not finite, the world is
    held at its last good state, and a run ends with `DynamicsError`, as for all vehicles.
    """

    terms: tuple[str, ...] = ()

    def __init__(self, config: MultirotorConfig, context: VehicleContext) -> None:
        """Allocate the state.

        Args:
            config: The multirotor that planners, controllers and IMUs assume.
            context: Context of `VehicleConfig.make`.

        Raises:
            ValueError: The device is not the CPU.
        """
        self.config, self.count, self.max_step_ns = config, context.count, context.max_step_ns
        self.device = wp.get_device(context.device)
        if self.device.is_cuda:
            raise ValueError(f"{type(self).__name__} runs in Python: it needs device: cpu")
        self.arrays = allocate_arrays(self.count, config.rotor_count, self.device)
        self._views = {name: getattr(self.arrays, name).numpy() for name in MultirotorArrays.vars}

    def move(
        self, state: MultirotorState, command: NDArray[np.float64], duration_s: float
    ) -> MultirotorState:
        """Return the state of one world after a duration.

        Args:
            state: State of the vehicle, without the leading axis.
            command: Rotor speed commands [rad/s], shape [R].
            duration_s: Duration for which they hold [s].
        """
        raise NotImplementedError

    def acceleration(self, state: MultirotorState, command: NDArray[np.float64]) -> Acceleration:
        """Return dv/dt in W [m/s^2] and dw/dt in B [rad/s^2] of one world, each of shape [3].

        Args:
            state: State of the vehicle, without the leading axis.
            command: Rotor speed commands [rad/s], shape [R].
        """
        raise NotImplementedError

    def advance(self, duration_ns: int) -> None:
        """Integrate all vehicles that are not held."""
        views = self._views
        for world in np.flatnonzero(views["status"] == 0).tolist():
            now = self._row(world)
            later = self.move(now, views["rotor_speed_command"][world], 1e-9 * duration_ns)
            turned = [*later.orientation, *later.body_rate, *later.rotor_speed]
            if not np.all(np.isfinite([*later.position, *later.velocity])):
                views["status"][world] = int(STATUS_VELOCITY)
            elif not np.all(np.isfinite(turned)):
                views["status"][world] = int(STATUS_BODY_RATE)
            else:
                views["stamp_ns"][world] += duration_ns
                for name, value in later._asdict().items():
                    views[name][world] = value

    def flight_kernel(self, record: Any) -> None:
        """Return None: `advance` moves the vehicles."""

    def begin(self, mask: Any) -> None:
        """Do nothing: there is no memory besides the state."""

    def accelerate(self) -> None:
        """Compute the accelerations at the present state."""
        for world in range(self.count):
            found = self.acceleration(self._row(world), self._views["rotor_speed_command"][world])
            self._views["acceleration"][world] = found.linear
            self._views["angular_acceleration"][world] = found.angular

    def _row(self, world: int) -> MultirotorState:
        return MultirotorState(*(self._views[name][world].copy() for name in MultirotorState._fields))
