"""Instance segmentation: which object each pixel sees."""

from __future__ import annotations

from typing import Literal

from neurosim_core.registry import register
from neurosim_core.sensors.base import ImageSensorConfig


@register("sensor", "instance")
class InstanceSensorConfig(ImageSensorConfig):
    """A camera that labels each pixel with the object it sees, int32 [H, W].

    A label is an index into the names of the scene's instances (`Scene.instance_names`) and then of the
    moving bodies, in the order of the settings; -1 where nothing is hit. A pixel has the label of its centre.
    """

    kind: Literal["instance"] = "instance"

    output = "instance"
    encoding = "32SC1"
