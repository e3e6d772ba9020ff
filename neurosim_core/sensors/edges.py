# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,call-overload,valid-type"
# mypy: disable-error-code="untyped-decorator,operator,arg-type"
# ruff: noqa: SIM102, UP018, RUF046  (a short circuit, typed literals: they have a meaning in kernels)
"""Geometric edges: where depth jumps, another object begins, or a surface bends, whatever the light."""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.registry import register
from neurosim_core.render.launch import launch_split
from neurosim_core.sensors.base import ImageSensorConfig, PictureContext, PictureViews
from neurosim_core.sensors.instance import LabelImage
from neurosim_core.settings import Settings

wp.set_module_options({"enable_backward": False})

KINDS = ("none", "depth", "object", "crease")
"""What the labels 0 to 3 mean."""


class EdgeLimits(Settings):
    """What is an edge, and what is rendered to find it."""

    jump_ratio: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    """Distance between two surfaces that is an edge, as a part of the range."""
    crease_rad: Annotated[float, Field(gt=0.0, lt=3.2)] = 0.5
    """Angle between two normals that is an edge [rad]."""

    @property
    def outputs(self) -> frozenset[str]:
        """Ranges, normals and objects."""
        return frozenset(["range", "normal", "instance"])


@register("sensor", "edges")
class EdgesConfig(EdgeLimits, ImageSensorConfig):
    """A camera that sees edges of the geometry: int32 [H, W], 0 none, 1 depth, 2 object, 3 crease.

    A pixel is an edge if it differs from the one to its right or below it: by more than `jump_ratio` of the
    range off its tangent plane and the other's; by the object; by the direction of its surface. The first of
    these counts. So edges are one pixel wide, and a plane has none, however steep it is seen.
    """

    kind: Literal["edges"] = "edges"

    packet_type = LabelImage
    output = "instance"
    encoding = "32SC1"

    def constants(self, context: PictureContext) -> Mapping[str, Any]:
        """Return what labels mean."""
        return {"labels": json.dumps({"classes": KINDS})}

    def make_process(self, context: PictureContext) -> "EdgesProcess":
        """Return what finds edges."""
        return EdgesProcess(self, context)

    def packet(self, picture: NDArray[Any], **header: Any) -> LabelImage:
        """Return a picture as a packet."""
        return LabelImage(data=picture, **header)


@wp.func
def _edge_between(
    jump_ratio: float,
    crease_cosine: float,
    slot: int,
    row: int,
    col: int,
    row_b: int,
    col_b: int,
    ray: wp.vec3,
    ray_b: wp.vec3,
    ranges: wp.array3d[float],
    normals: wp.array3d[wp.vec3],
    instance: wp.array3d[int],
) -> int:
    """Return the label of the edge between two pixels, whose rays are given in W."""
    r = ranges[slot, row, col]
    r_b = ranges[slot, row_b, col_b]
    near = wp.min(r, r_b)
    if near == wp.inf:
        return 0
    if wp.max(r, r_b) == wp.inf:
        return 1
    n = normals[slot, row, col]
    n_b = normals[slot, row_b, col_b]
    apart = r_b * ray_b - r * ray
    off = wp.min(wp.abs(wp.dot(n, apart)), wp.abs(wp.dot(n_b, apart)))
    if off > jump_ratio * near:
        return 1
    if instance[slot, row, col] != instance[slot, row_b, col_b]:
        return 2
    if wp.dot(n, n_b) < crease_cosine:
        return 3
    return 0


@wp.kernel
def _find_edges(
    first: int,
    # Model:
    jump_ratio: float,
    crease_cosine: float,
    stride: int,
    part_count: int,
    rays: wp.array3d[wp.vec3],
    lens_of_world: wp.array[int],
    # In:
    instant_count: int,
    image_slot: wp.array[int],
    q_WC: wp.array[wp.quat],
    active: wp.array[int],
    ranges: wp.array3d[float],
    normals: wp.array3d[wp.vec3],
    instance: wp.array3d[int],
    # Out:
    edge_out: wp.array3d[int],
) -> None:
    index = first + wp.tid()
    height = ranges.shape[1]
    width = ranges.shape[2]
    pixel = index % (width * height)
    view = index // (width * height)
    world = view // instant_count
    view = world * stride + view % instant_count
    slot = image_slot[view]
    if slot < 0:
        return
    if active.shape[0] > 0:
        if active[world] == 0:
            return
    row = pixel // width
    col = pixel % width
    q = q_WC[(view + 1) * part_count - 1]
    lens = lens_of_world[world]
    ray = wp.quat_rotate(q, rays[lens, row, col])
    label = int(0)
    for side in range(2):
        row_b = row + side
        col_b = col + 1 - side
        if row_b < height and col_b < width:
            found = _edge_between(
                jump_ratio,
                crease_cosine,
                slot,
                row,
                col,
                row_b,
                col_b,
                ray,
                wp.quat_rotate(q, rays[lens, row_b, col_b]),
                ranges,
                normals,
                instance,
            )
            if found > 0 and (label == 0 or found < label):
                label = found
    edge_out[slot, row, col] = label


class EdgesProcess:
    """Finds edges.

    Attributes:
        picture: Label of each pixel, int32, shape [M, H, W].
        terms: What is computed.
    """

    terms: tuple[str, ...] = ()

    def __init__(self, config: EdgeLimits, context: PictureContext) -> None:
        self._context = context
        limits = [config.jump_ratio, float(np.cos(config.crease_rad))]
        self._device = device = context.source.device
        parts = 1 if context.times is None else len(context.times.offsets_ns)
        rays: Any = wp.array(
            np.stack([lens.ray_table() for lens in context.lenses]), dtype=wp.vec3, device=device
        )
        lens_of_world: Any = wp.array(list(context.lens_of_world), dtype=int, device=device)
        self._model = [*limits, context.stride, parts, rays, lens_of_world]
        self.picture: Any = wp.zeros(context.source.shape, dtype=int, device=device)

    def launch(self, views: PictureViews) -> None:
        """Find the edges in the pictures of a batch; launches only."""
        context = self._context
        _, height, width = context.source.shape
        world_count = views.image_slot.shape[0] // context.stride
        sources = context.sources
        seen = [views.instant_count, views.image_slot, views.q_WC, views.active]
        launch_split(
            _find_edges,
            dim=world_count * views.instant_count * width * height,
            inputs=[*self._model, *seen, sources["range"], sources["normal"], sources["instance"]],
            outputs=[self.picture],
            device=self._device,
        )
