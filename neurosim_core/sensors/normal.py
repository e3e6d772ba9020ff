"""Surface normals: which way the surface that each pixel sees faces."""

from __future__ import annotations

from typing import Literal

from neurosim_core.registry import register
from neurosim_core.sensors.base import ImageSensorConfig


@register("sensor", "normal")
class NormalSensorConfig(ImageSensorConfig):
    """A camera that takes the normal of the triangle that each pixel sees, float32 [H, W, 3].

    Normals are unit vectors in W that point towards the camera; 0 where nothing is hit. A pixel has the
    normal of its centre.
    """

    kind: Literal["normal"] = "normal"

    output = "normal"
    encoding = "32FC3"
