"""The range camera: the length of the ray of each pixel."""

from __future__ import annotations

from typing import Literal

from neurosim_core.registry import register
from neurosim_core.sensors.base import ImageSensorConfig


@register("sensor", "range")
class RangeSensorConfig(ImageSensorConfig):
    """A camera that measures the distance to what each pixel sees [m], float32 [H, W]; inf where nothing is.

    Unlike depth, which is measured along the optical axis, it is the length of the ray, through any lens.
    """

    kind: Literal["range"] = "range"

    output = "range"
    encoding = "32FC1"
