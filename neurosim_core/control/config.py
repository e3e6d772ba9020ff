"""Which controller flies the path: the settings of a controller, by kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

from pydantic import Field

from neurosim_core.control.modes import Controller
from neurosim_core.control.se3 import Se3Config
from neurosim_core.registry import register
from neurosim_core.settings import Settings
from neurosim_core.trajectory.path import Path
from neurosim_core.vehicle.airframe import MultirotorConfig


class PathController(Protocol):
    """What flies the vehicles of all worlds along their paths."""

    def update(self, arrays: Any) -> None:
        """Write `arrays.rotor_speed_command` from the state in `arrays`, at each control period.

        On a CUDA device it only launches, and is captured in a graph.

        Args:
            arrays: Of the vehicles (`MultirotorArrays`), on the device.
        """

    def begin(self, mask: Any) -> None:
        """Forget what was before, where the mask, device array of int32, shape [N], is not 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ControllerContext:
    """What a controller is made for."""

    airframe: MultirotorConfig
    """What the vehicles are taken for."""
    paths: Sequence[Path]
    """The path of each world, shape [N]."""
    device: Any
    """Where the states of the vehicles are."""


class ControllerConfig(Settings):
    """Settings that all controllers have. A kind adds its `kind`, what it needs, and `make`."""

    kind: str
    """Under which name the class is registered."""
    rate_hz: Annotated[float, Field(gt=0.0, le=10_000.0)] = 200.0
    """Commands a second [Hz]; each is held until the next."""
    gains: Se3Config = Se3Config()
    """Gains and limits of the geometric controller; it also turns outside setpoints into rotor speeds."""

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
