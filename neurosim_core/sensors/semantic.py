# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,call-overload,valid-type"
# mypy: disable-error-code="untyped-decorator,operator"
"""Semantic segmentation: what each pixel sees is."""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.registry import register
from neurosim_core.render.launch import launch_split
from neurosim_core.scene.labels import Labels, describe_labels, label_scenes
from neurosim_core.sensors.base import ImageSensorConfig, PictureContext, PictureViews
from neurosim_core.sensors.instance import LabelImage

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
    output = "instance"
    encoding = "32SC1"

    def constants(self, context: PictureContext) -> Mapping[str, Any]:
        """Return what labels mean."""
        return {"labels": describe_labels(label_scenes(context.scenes, self.classes))}

    def make_process(self, context: PictureContext) -> "SemanticProcess":
        """Return what makes classes of instances."""
        return SemanticProcess(label_scenes(context.scenes, self.classes), context)

    def packet(self, picture: NDArray[Any], **header: Any) -> LabelImage:
        """Return a picture as a packet."""
        return LabelImage(data=picture, **header)


@wp.kernel
def _look_up(
    first: int,
    # Model:
    width: int,
    height: int,
    stride: int,
    class_of: wp.array2d[int],
    scene_of_world: wp.array[int],
    # In:
    instant_count: int,
    image_slot: wp.array[int],
    active: wp.array[int],
    instance: wp.array3d[int],
    # Out:
    class_out: wp.array3d[int],
) -> None:
    index = first + wp.tid()
    pixel = index % (width * height)
    view = index // (width * height)
    world = view // instant_count
    slot = image_slot[world * stride + view % instant_count]
    if slot < 0:
        return
    if active.shape[0] > 0:  # noqa: SIM102  (without worlds there is no element)
        if active[world] == 0:
            return
    row = pixel // width
    col = pixel % width
    name = instance[slot, row, col]
    label = -1
    if name >= 0:
        label = class_of[scene_of_world[world], name]
    class_out[slot, row, col] = label


class SemanticProcess:
    """Makes classes of instances.

    Attributes:
        picture: Class of each pixel, int32, shape [M, H, W].
        terms: What is computed.
    """

    terms: tuple[str, ...] = ()

    def __init__(self, labels: Labels, context: PictureContext) -> None:
        self._context = context
        table = np.zeros((len(labels.instances), max(map(len, labels.instances))), np.int32)
        for row, instances in zip(table, labels.instances, strict=True):
            row[: len(instances)] = [number for _, number in instances]
        device = context.source.device
        self._class_of: Any = wp.array(table, dtype=int, device=device)
        self.picture: Any = wp.zeros(context.source.shape, dtype=int, device=device)

    def launch(self, views: PictureViews) -> None:
        """Look up the classes of the pictures of a batch; launches only."""
        context = self._context
        _, height, width = context.source.shape
        world_count = views.image_slot.shape[0] // context.stride
        launch_split(
            _look_up,
            dim=world_count * views.instant_count * width * height,
            inputs=[
                width,
                height,
                context.stride,
                self._class_of,
                context.scene_of_world,
                views.instant_count,
                views.image_slot,
                views.active,
                context.source,
            ],
            outputs=[self.picture],
            device=context.source.device,
        )
