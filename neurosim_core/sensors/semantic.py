# mypy: disable-error-code="index,attr-defined,misc,call-overload,valid-type,operator"
"""Semantic segmentation: what each pixel sees is."""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import warp as wp
from pydantic import Field

from neurosim_core.registry import register
from neurosim_core.scene.labels import describe_labels, label_scenes, warn_of_patterns
from neurosim_core.sensors.base import ImageSensorConfig, PictureContext
from neurosim_core.sensors.instance import LabelImage
from neurosim_core.sensors.pixel_process import Batch, PixelProcess, element_of

wp.set_module_options({"enable_backward": False})


@register("sensor", "semantic")
class SemanticSensorConfig(ImageSensorConfig):
    """A camera that labels each pixel with the class of what it sees, int32 [H, W].

    0 is "unlabelled", -1 nothing; the packets say what the other numbers mean. Worlds in several scenes have
    the same classes.
    """

    kind: Literal["semantic"] = "semantic"
    classes: dict[str, tuple[str, ...]] | None = Field(default=None, repr=False)
    """Patterns of names of objects by class, numbered from 1: {seat: ["chair*", "sofa_*"], floor: [floor*]};
    they are compared with the name of an object and with what its file says of it (`extras.semantic` of a
    node in glTF). null: a class for each thing that files say, or names without the number at their end."""

    packet_type = LabelImage
    is_overlay = True
    output = "instance"
    encoding = "32SC1"

    def constants(self, context: PictureContext) -> Mapping[str, Any]:
        """Return what labels mean."""
        return {"labels": describe_labels(label_scenes(context.scenes, self.classes))}

    def make_process(self, context: PictureContext) -> PixelProcess:
        """Return what makes classes of instances."""
        warn_of_patterns(context.name, context.scenes, self.classes)
        instances = label_scenes(context.scenes, self.classes).instances
        table = np.zeros((len(instances), max(map(len, instances))), np.int32)
        for row, labels in zip(table, instances, strict=True):
            row[: len(labels)] = [number for _, number in labels]
        class_of: Any = wp.array(table, dtype=int, device=context.source.device)
        return PixelProcess(context, _look_up, class_of, context.source, dtype=int)


@wp.kernel
def _look_up(
    first: int,
    class_of: wp.array2d[int],
    instance: wp.array3d[int],
    batch: Batch,
    # Out:
    class_out: wp.array3d[int],
) -> None:
    at = element_of(batch, first + wp.tid())
    if at.slot < 0:
        return
    label = instance[at.slot, at.row, at.col]
    if label >= 0:
        label = class_of[batch.scene_of_world[at.world], label]
    class_out[at.slot, at.row, at.col] = label
