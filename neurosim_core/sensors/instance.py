"""Instance segmentation: which object each pixel sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.scene.labels import describe_labels, label_scenes
from neurosim_core.sensors.base import ImageSensorConfig, PictureContext


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelImage(Packet):
    """A picture of labels: of objects, or of what they are."""

    display: ClassVar[str] = "segmentation"

    data: Annotated[NDArray[np.int32], FieldSpec("H", "W")]
    """Label of each pixel, -1 where nothing is hit, shape [H, W]."""
    labels: Annotated[str, FieldSpec(constant=True)]
    """What labels mean, as JSON: {"instances": [[name, class], ...], "classes": [name, ...]}. The data are
    indices into the first list, or into the second one."""
    encoding: Annotated[str, FieldSpec(constant=True)] = "32SC1"
    """Encoding of a pixel, named as in ROS."""


@register("sensor", "instance")
class InstanceSensorConfig(ImageSensorConfig):
    """A camera that labels each pixel with the object it sees, int32 [H, W].

    A label is an index into the names of the scene's instances (`Scene.instance_names`) and then of the
    moving bodies, in the order of the settings; -1 where nothing is hit. A pixel has the label of its centre.
    """

    kind: Literal["instance"] = "instance"

    packet_type = LabelImage
    is_overlay = True
    output = "instance"
    encoding = "32SC1"

    def constants(self, context: PictureContext) -> Mapping[str, Any]:
        """Return the names and classes of instances, if all worlds are in one scene."""
        return {"labels": describe_labels(label_scenes(context.scenes, None))}
