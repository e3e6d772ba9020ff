# mypy: disable-error-code="index,attr-defined,misc,call-overload,valid-type"
"""Shared by the processing of pictures: the pixel of a thread, the poses of a batch, and one launch."""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

import functools
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.render.launch import launch_split
from neurosim_core.scene.bodies import BodyPoses, make_body_poses
from neurosim_core.sensors.base import PictureContext, PictureViews


@wp.struct
class Views:
    """`PictureViews` at one time."""

    p_WC: wp.array[wp.vec3]
    q_WC: wp.array[wp.quat]
    stamps: wp.array2d[wp.int64]
    p_WO: wp.array2d[wp.vec3d]
    q_WO: wp.array2d[wp.quatd]


@wp.struct
class Batch:
    """The pictures of a batch as kernels read them (`PictureContext`, `PictureViews`)."""

    width: int
    element_count: int  # Of a picture: pixels, or what it has in their place
    stride: int
    part_count: int  # J, the times of the rays of a picture
    instant_count: int
    image_slot: wp.array[int]
    active: wp.array[int]
    seeds: wp.array[wp.uint64]
    lens_of_world: wp.array[int]
    scene_of_world: wp.array[int]
    here: Views


@wp.struct
class Element:
    """The pixel of a batch that a thread works on."""

    slot: int  # Of the picture; -1: there is none
    world: int
    view: int  # Which of the instants of all worlds it is
    last: int  # Row of the poses at its stamp
    number: int  # Of the element in the picture
    row: int
    col: int


@wp.func
def element_of(batch: Batch, index: int) -> Element:
    """Return the element that a thread works on."""
    at = Element()
    at.number = index % batch.element_count
    at.row = at.number // batch.width
    at.col = at.number % batch.width
    view = index // batch.element_count
    at.world = view // batch.instant_count
    at.view = at.world * batch.stride + view % batch.instant_count
    at.last = (at.view + 1) * batch.part_count - 1
    at.slot = batch.image_slot[at.view]
    if batch.active.shape[0] > 0:  # noqa: SIM102  (without worlds there is no element)
        if batch.active[at.world] == 0:
            at.slot = -1
    return at


class PixelProcess:
    """A `PictureProcess` of one kernel, a thread for each element of the pictures.

    The kernel's parameters: the index of its first thread, the inputs, `Batch`, and the picture.

    Attributes:
        picture: What it makes, shape [M, H, W] unless it is given.
        terms: What is computed.
    """

    def __init__(
        self,
        context: PictureContext,
        kernel: Any,
        *inputs: Any,
        dtype: Any,
        shape: tuple[int, ...] | None = None,
        element_count: int | None = None,
        terms: tuple[str, ...] = (),
    ) -> None:
        self._kernel, self._inputs, self.terms = kernel, inputs, terms
        source = context.source
        self.device = device = source.device
        self.picture: Any = wp.zeros(shape or source.shape, dtype=dtype, device=device)
        batch = self._batch = Batch()
        batch.width, batch.stride, batch.seeds = source.shape[2], context.stride, context.seeds
        batch.element_count = source.shape[1] * source.shape[2] if element_count is None else element_count
        batch.part_count = 1 if context.times is None else len(context.times.offsets_ns)
        batch.lens_of_world, batch.scene_of_world = context.lens_of_world, context.scene_of_world

    def launch(self, views: PictureViews) -> None:
        """Process the pictures of a batch; launches only."""
        self.run(self._kernel, views, *self._inputs, outputs=[self.picture])

    def run(self, kernel: Any, views: PictureViews, *inputs: Any, outputs: list[Any], dim: int = 0) -> None:
        """Launch a kernel for a batch, with a thread for each element if `dim` is 0."""
        batch = self.batch_of(views)
        every = views.image_slot.shape[0] // batch.stride * batch.instant_count * batch.element_count
        launch_split(kernel, dim=dim or every, inputs=[*inputs, batch], outputs=outputs, device=self.device)

    def batch_of(self, views: PictureViews) -> Any:
        """Return a batch for a kernel; it is valid until the next one."""
        batch = self._batch
        batch.instant_count, batch.image_slot = views.instant_count, views.image_slot
        batch.active = views.active
        bodies = views.bodies or _no_bodies(str(self.device))
        batch.here = make_views(views.p_WC, views.q_WC, views.stamps, bodies)
        return batch


def make_rays(context: PictureContext) -> Any:
    """Return the ray of each pixel of each lens on the device, vec3, shape [lens, H, W]."""
    rays = np.stack([lens.ray_table() for lens in context.lenses])
    return wp.array(rays, dtype=wp.vec3, device=context.source.device)


def make_views(p_WC: Any, q_WC: Any, stamps: Any, bodies: BodyPoses) -> Any:
    """Return the poses of one time for a kernel."""
    at = Views()
    at.p_WC, at.q_WC, at.stamps, at.p_WO, at.q_WO = p_WC, q_WC, stamps, bodies.p_WO, bodies.q_WO
    return at


@functools.cache
def _no_bodies(device: str) -> Any:
    return make_body_poses(0, 0, device)
