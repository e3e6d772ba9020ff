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
    """Settings that all vehicles have. A kind adds its `kind`, what it needs, `airframe` and `make`."""

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
        """Name for texts that people read."""
        return self.kind

    def airframe(self) -> MultirotorConfig:
        """Return what planners, controllers and IMUs take the vehicle for: mass, inertia, rotors, ranges."""
        raise NotImplementedError

    def make(self, context: VehicleContext) -> Vehicle:
        """Return the vehicles of all worlds."""
        raise NotImplementedError


class FlightKernel(NamedTuple):
    """A kernel that moves all vehicles by equal spans, and records the state after each."""

    kernel: wp.Kernel
    inputs: Callable[[int], list[Any]]
    """Returns its first inputs for spans of a length [ns]; those that say what is recorded follow."""


class Vehicle(Protocol):
    """The vehicles of all worlds. What they do only launches, on a device."""

    config: MultirotorConfig
    """The multirotor that planners, controllers and IMUs assume."""
    count: int
    """Number of worlds, N."""
    device: Any
    """Device of `arrays`."""
    max_step_ns: int
    """Longest integration step [ns]."""
    arrays: MultirotorArrays
    """The state; `rotor_speed_command` is written by others."""
    terms: tuple[str, ...]
    """Optional terms that are compiled in."""

    def advance(self, duration_ns: int) -> None:
        """Move all vehicles on by a duration [ns] under the commands that hold."""

    def begin(self, mask: Any) -> None:
        """Take up the state that `arrays` have, where the mask, int32 of shape [N], is not 0."""

    def accelerate(self) -> None:
        """Compute the accelerations at the present state."""

    def flight_kernel(self, record: Any) -> FlightKernel | None:
        """Return what moves all vehicles by equal spans, and records them; None: `advance` moves them.

        Args:
            record: Warp function that records the state of a vehicle; see `integrator.make_flight`.
        """


class HostVehicle:
    """Base of a vehicle whose motion is computed in Python: define `move` and `acceleration`.

    It flies on the CPU, one world after the other. What `move` returns for a world that is not finite holds
    that world at its last good state, and ends a run with `DynamicsError`, as in all vehicles.
    """

    terms: tuple[str, ...] = ()

    def __init__(self, config: MultirotorConfig, context: VehicleContext) -> None:
        """Allocate the state.

        Args:
            config: The multirotor that planners, controllers and IMUs assume.
            context: What it is made for.

        Raises:
            ValueError: The device is not the CPU.
        """
        self.config, self.count, self.max_step_ns = config, context.count, context.max_step_ns
        self.device = wp.get_device(context.device)
        if self.device.is_cuda:
            raise ValueError(f"{type(self).__name__} is computed in Python: it needs device: cpu")
        self.arrays = allocate_arrays(self.count, config.rotor_count, self.device)
        self._views = {name: getattr(self.arrays, name).numpy() for name in MultirotorArrays.vars}

    def move(
        self, state: MultirotorState, command: NDArray[np.float64], duration_s: float
    ) -> MultirotorState:
        """Return the state of one world a while later.

        Args:
            state: Of the vehicle, without the leading axis.
            command: Rotor speeds that are commanded [rad/s], shape [R].
            duration_s: How long they hold [s].
        """
        raise NotImplementedError

    def acceleration(self, state: MultirotorState, command: NDArray[np.float64]) -> Acceleration:
        """Return dv/dt in W [m/s^2] and dw/dt in B [rad/s^2] of one world, each of shape [3].

        Args:
            state: Of the vehicle, without the leading axis.
            command: Rotor speeds that are commanded [rad/s], shape [R].
        """
        raise NotImplementedError

    def advance(self, duration_ns: int) -> None:
        """Move all vehicles on that are not held."""
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
        """Python moves the vehicles."""

    def begin(self, mask: Any) -> None:
        """Nothing is kept beside the state."""

    def accelerate(self) -> None:
        """Compute the accelerations at the present state."""
        for world in range(self.count):
            found = self.acceleration(self._row(world), self._views["rotor_speed_command"][world])
            self._views["acceleration"][world] = found.linear
            self._views["angular_acceleration"][world] = found.angular

    def _row(self, world: int) -> MultirotorState:
        return MultirotorState(*(self._views[name][world].copy() for name in MultirotorState._fields))
