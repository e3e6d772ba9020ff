"""The colour camera."""

from __future__ import annotations

from typing import Literal

from neurosim_core.registry import register
from neurosim_core.sensors.base import ImageSensorConfig


@register("sensor", "rgb")
class RgbSensorConfig(ImageSensorConfig):
    """A colour camera without noise; pictures are 8-bit sRGB, uint8 [H, W, 3]."""

    kind: Literal["rgb"] = "rgb"

    output = "rgb"
    encoding = "rgb8"
