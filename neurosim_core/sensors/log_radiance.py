"""The picture of what event cameras see: log radiance, the truth for reconstruction from events."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.sensors.base import ImageSensorConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class LogRadiance(Packet):
    """A picture of log radiance, as event cameras see it at its stamp."""

    data: Annotated[NDArray[np.float32], FieldSpec("H", "W")]
    """Natural logarithm of Rec. 709 luma of linear radiance plus `render.dark_floor`, shape [H, W]."""


@register("sensor", "log_radiance")
class LogRadianceSensorConfig(ImageSensorConfig):
    """A camera that measures the logarithm of linear radiance, without noise, float32 [H, W]."""

    kind: Literal["log_radiance"] = "log_radiance"

    packet_type = LogRadiance
    output = "log_radiance"
    encoding = "32FC1"

    def packet(self, picture: NDArray[Any], **header: Any) -> LogRadiance:
        """Return the picture, shape [H, W]."""
        return LogRadiance(data=picture, **header)
