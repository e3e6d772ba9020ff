"""The interface of controllers: settings, the methods that the engine calls, and a base class in Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import warp as wp
from pydantic import Field

from neurosim_core.control.modes import Controller
from neurosim_core.control.se3 import Se3Config
from neurosim_core.control.setpoints import Setpoint
from neurosim_core.registry import register
from neurosim_core.settings import BaseConfig
from neurosim_core.trajectory.path import Path, PathCursor
from neurosim_core.vehicle.airframe import MultirotorConfig
from neurosim_core.vehicle.arrays import MultirotorState


class PathController(Protocol):
    """A controller that flies the vehicles of all worlds along their paths."""

    def update(self, arrays: Any) -> None:
        """Write `arrays.rotor_speed_command` from the state in `arrays`, at each control period.

        On a CUDA device it must only launch kernels and copies, because it is captured in a graph.

        Args:
            arrays: Arrays of the vehicles (`MultirotorArrays`), on the device.
        """

    def begin(self, mask: Any) -> None:
        """Reset the memory of worlds whose mask is not 0, device array of int32, shape [N]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ControllerContext:
    """Arguments of `ControllerConfig.make`."""

    airframe: MultirotorConfig
    """The multirotor that controllers assume."""
    paths: Sequence[Path]
    """The path of each world, shape [N]."""
    device: Any
    """Device of the states of the vehicles."""


class ControllerConfig(BaseConfig):
    """Base class of the settings of controllers. Subclasses add `kind`, their fields, and `make`."""

    kind: str
    """Name under which the class is registered."""
    rate_hz: Annotated[float, Field(gt=0.0, le=10_000.0)] = 200.0
    """Command rate [Hz]; each command is held until the next."""
    gains: Se3Config = Se3Config()
    """Gains and limits of the geometric controller, which also turns external setpoints into rotor speeds."""

    def make(self, context: ControllerContext) -> PathController:
        """Return the controller of all worlds."""
        raise NotImplementedError


@register("controller", "se3")
class Se3ControllerConfig(ControllerConfig):
    """The geometric controller, with all derivatives of the path."""

    kind: Literal["se3"] = "se3"

    def make(self, context: ControllerContext) -> Controller:
        """Return the controller of all worlds."""
        paths = context.paths
        return Controller(
            "path",
            context.airframe,
            self.gains,
            count=len(paths),
            device=context.device,
            paths=paths[0] if all(path is paths[0] for path in paths) else paths,
        )


class HostController:
    """Base class of controllers in plain Python. Define `command`, and `forget` if it has memory.

    It runs on the CPU, one world after the other.
    """

    def __init__(self, context: ControllerContext, gains: Se3Config | None = None) -> None:
        """Prepare the paths.

        Args:
            context: Context of `ControllerConfig.make`.
            gains: Gains of the conversion from setpoints to rotor speeds.

        Raises:
            ValueError: The device is not the CPU.
        """
        if wp.get_device(context.device).is_cuda:
            raise ValueError(f"{type(self).__name__} runs in Python: it needs device: cpu")
        self.airframe, self._gains = context.airframe, gains
        self._cursors = [PathCursor(path) for path in context.paths]
        self._lower: Controller | None = None

    def command(self, state: MultirotorState, target: np.void, *, stamp_ns: int, world: int) -> Setpoint:
        """Return the setpoint of one vehicle for a control period; the mode must always be the same.

        Args:
            state: State of the vehicle, without a leading axis.
            target: The path at the stamp: a record with the fields of `PathPoint`, such as
                `position`, `velocity`, `acceleration` and `yaw`; valid until the next call.
            stamp_ns: Time since the start of the episode [ns].
            world: Index of the world.
        """
        raise NotImplementedError

    def forget(self, world: int) -> None:
        """Reset the memory of one world, at the begin of an episode."""

    def begin(self, mask: Any) -> None:
        """Reset the memory of worlds whose mask is not 0."""
        for world in np.flatnonzero(mask.numpy()).tolist():
            self.forget(world)

    def update(self, arrays: Any) -> None:
        """Write the rotor speed commands of the vehicles of all worlds.

        Raises:
            ValueError: A setpoint is not finite, or its mode differs from that of the first.
            TypeError: `command` returns no setpoint.
        """
        stamps_ns = arrays.stamp_ns.numpy()
        fields = [getattr(arrays, name).numpy() for name in MultirotorState._fields]
        rows = []
        for world, cursor in enumerate(self._cursors):
            stamp_ns = int(stamps_ns[world])
            state = MultirotorState(*(field[world].copy() for field in fields))
            setpoint = self.command(state, cursor.at(stamp_ns), stamp_ns=stamp_ns, world=world)
            if not isinstance(setpoint, Setpoint):
                raise TypeError(f"{type(self).__name__}.command must return a setpoint, got {setpoint!r}")
            if self._lower is None:
                self._lower = Controller(setpoint.mode, self.airframe, self._gains, count=len(self._cursors))
            if setpoint.mode != self._lower.mode:
                raise ValueError(
                    f"{type(self).__name__} commands {self._lower.mode}: it cannot change to {setpoint.mode}"
                )
            rows.append(setpoint.row())
        assert self._lower is not None
        self._lower.set(rows)
        self._lower.update(arrays)
