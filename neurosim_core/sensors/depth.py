"""The depth camera."""

from __future__ import annotations

from typing import Literal

from neurosim_core.registry import register
from neurosim_core.sensors.base import ImageSensorConfig


@register("sensor", "depth")
class DepthSensorConfig(ImageSensorConfig):
    """A camera that measures planar depth z [m], without noise; inf where nothing is hit, float32 [H, W]."""

    kind: Literal["depth"] = "depth"

    output = "depth"
    encoding = "32FC1"
