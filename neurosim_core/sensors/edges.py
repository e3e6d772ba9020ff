# mypy: disable-error-code="index,attr-defined,misc,call-overload,valid-type,operator,arg-type"
# ruff: noqa: UP018, RUF046  (a short circuit, typed literals: they have a meaning in kernels)
"""Geometric edges: where depth jumps, another object begins, or a surface bends, whatever the light."""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from pydantic import Field

from neurosim_core.registry import register
from neurosim_core.sensors.base import ImageSensorConfig, PictureContext
from neurosim_core.sensors.instance import LabelImage
from neurosim_core.sensors.pixel_process import Batch, Element, PixelProcess, element_of, make_rays
from neurosim_core.settings import BaseConfig

wp.set_module_options({"enable_backward": False})

KINDS = ("none", "depth", "object", "crease")
"""What the labels 0 to 3 mean."""


class EdgeLimits(BaseConfig):
    """What is an edge, and what is rendered to find it."""

    jump_ratio: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    """Smallest distance between two surfaces that makes an edge, relative to the range."""
    crease_rad: Annotated[float, Field(gt=0.0, lt=3.2)] = 0.5
    """Smallest angle between two normals that makes an edge [rad]."""

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
    is_overlay = True
    output = "instance"
    encoding = "32SC1"

    def constants(self, context: PictureContext) -> Mapping[str, Any]:
        """Return what labels mean."""
        return {"labels": json.dumps({"classes": KINDS})}

    def make_process(self, context: PictureContext) -> PixelProcess:
        """Return what finds edges."""
        return make_edge_finder(self, context)


@wp.struct
class _Model:
    jump_ratio: float
    crease_cosine: float
    rays: wp.array3d[wp.vec3]
    # Pictures, shape [slot, row, col]:
    ranges: wp.array3d[float]
    normals: wp.array3d[wp.vec3]
    instance: wp.array3d[int]


@wp.func
def _edge_between(model: _Model, at: Element, row_b: int, col_b: int, ray: wp.vec3, ray_b: wp.vec3) -> int:
    """Return the label of the edge between two pixels, whose rays are given in W."""
    r = model.ranges[at.slot, at.row, at.col]
    r_b = model.ranges[at.slot, row_b, col_b]
    near = wp.min(r, r_b)
    if near == wp.inf:
        return 0
    if wp.max(r, r_b) == wp.inf:
        return 1
    n = model.normals[at.slot, at.row, at.col]
    n_b = model.normals[at.slot, row_b, col_b]
    apart = r_b * ray_b - r * ray
    off = wp.min(wp.abs(wp.dot(n, apart)), wp.abs(wp.dot(n_b, apart)))
    if off > model.jump_ratio * near:
        return 1
    if model.instance[at.slot, at.row, at.col] != model.instance[at.slot, row_b, col_b]:
        return 2
    if wp.dot(n, n_b) < model.crease_cosine:
        return 3
    return 0


@wp.kernel
def _find_edges(
    first: int,
    model: _Model,
    batch: Batch,
    # Out:
    edge_out: wp.array3d[int],
) -> None:
    at = element_of(batch, first + wp.tid())
    if at.slot < 0:
        return
    q = batch.here.q_WC[at.last]
    lens = batch.lens_of_world[at.world]
    ray = wp.quat_rotate(q, model.rays[lens, at.row, at.col])
    label = int(0)
    for side in range(2):
        row_b = at.row + side
        col_b = at.col + 1 - side
        if row_b < model.ranges.shape[1] and col_b < model.ranges.shape[2]:
            ray_b = wp.quat_rotate(q, model.rays[lens, row_b, col_b])
            found = _edge_between(model, at, row_b, col_b, ray, ray_b)
            if found > 0 and (label == 0 or found < label):
                label = found
    edge_out[at.slot, at.row, at.col] = label


def make_edge_finder(limits: EdgeLimits, context: PictureContext) -> PixelProcess:
    """Return what finds edges: the label of each pixel, int32, shape [M, H, W]."""
    model = _Model()
    model.jump_ratio, model.crease_cosine = limits.jump_ratio, float(np.cos(limits.crease_rad))
    model.rays = make_rays(context)
    model.ranges, model.normals = context.sources["range"], context.sources["normal"]
    model.instance = context.sources["instance"]
    return PixelProcess(context, _find_edges, model, dtype=int)
