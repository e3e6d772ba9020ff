# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
# ruff: noqa: UP018, RUF046  (a short circuit, typed literals: they have a meaning in kernels)
"""Corners of the geometry as a list: where they are in the picture, exactly, under numbers that stay.

The corners are those of the meshes of the scene and of moving bodies (`scene.topology`), found once. Each is
projected through the lens and is seen unless a ray to it hits something before. So positions have no
resolution, a corner has the same number in all pictures, runs and worlds of a scene, and what looks like a
corner because one thing ends behind another is none.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import functools
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.render.launch import kernel_variant
from neurosim_core.render.projection import projector
from neurosim_core.scene.topology import find_corners
from neurosim_core.sensors.base import CameraConfig, PictureContext, PictureSensorConfig, PictureViews
from neurosim_core.sensors.edges import EdgeLimits, make_edge_finder
from neurosim_core.sensors.occlusion import NEAR_RATIO, Surroundings, is_hidden_by_bodies, make_surroundings
from neurosim_core.sensors.pixel_process import Batch, PixelProcess, element_of

_COLUMNS = 6
"""Numbers of a corner: column, row, position in C, edge."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Corners(Packet):
    """The corners that a camera sees, in the order of their numbers."""

    pixels: Annotated[NDArray[np.float32], FieldSpec("corner", 2, unit="px")]
    """Column and row [px], shape [n, 2]; the centre of the first pixel is at 0.5."""
    points: Annotated[NDArray[np.float32], FieldSpec("corner", 3, unit="m", frame="sensor")]
    """Positions in C (x right, y down, z forward) [m], shape [n, 3]."""
    id: Annotated[NDArray[np.int32], FieldSpec("corner")]
    """Number of each corner, the same in all pictures, shape [n]."""
    edge: Annotated[NDArray[np.uint8], FieldSpec("corner")]
    """The foremost label that an `edges` camera gives pixels around it, 1: depth, 2: object, 3: crease; 0: no
    edge there is large enough for the pixels; shape [n]."""


@register("sensor", "corners")
class CornersConfig(EdgeLimits, CameraConfig, PictureSensorConfig):
    """A camera that finds corners of the geometry: sub-pixel positions with persistent numbers."""

    kind: Literal["corners"] = "corners"
    turn_rad: Annotated[float, Field(gt=0.0, lt=1.5)] = 0.5
    """Smallest angle between two edges, or the continuation of one, that makes a corner [rad]."""

    packet_type = Corners
    output: ClassVar[str] = "instance"

    def make_process(self, context: PictureContext) -> "CornersProcess":
        """Return what finds corners."""
        return CornersProcess(self, context)

    def packet(self, picture: NDArray[Any], **header: Any) -> Corners:
        """Return the corners that are seen; the picture has all there are, shape [C, 6]."""
        seen = np.flatnonzero(np.isfinite(picture[:, 0]))
        rows = picture[seen]
        return Corners(
            pixels=np.ascontiguousarray(rows[:, :2]),
            points=np.ascontiguousarray(rows[:, 2:5]),
            edge=rows[:, 5].astype(np.uint8),
            id=seen.astype(np.int32),
            **header,
        )


@wp.struct
class _Model:
    around: Surroundings
    corners: wp.array2d[wp.vec3]  # of each scene, in W; then of all bodies, each in its O; nan: none
    first_of_bodies: int
    body: wp.array[int]  # of each corner from there on


@functools.cache
def _make_kernel(kind: str) -> Any:
    project = projector(kind)

    @kernel_variant(__name__, kind)
    def find_seen_corners(
        first: int,
        model: _Model,
        edges: wp.array3d[int],
        batch: Batch,
        # Out:
        corner_out: wp.array3d[float],
    ):
        at = element_of(batch, first + wp.tid())
        slot = at.slot
        if slot < 0:
            return
        corner = at.number
        here = batch.here
        corner_out[slot, corner, 0] = wp.nan
        scene = batch.scene_of_world[at.world]
        p_W = wp.vec3d(model.corners[scene, corner])
        if corner >= model.first_of_bodies:
            body = model.body[corner - model.first_of_bodies]
            p_W = here.p_WO[at.view, body] + wp.quat_rotate(here.q_WO[at.view, body], p_W)
        p_WC = wp.vec3d(here.p_WC[at.view])
        q_WC = wp.normalize(wp.quatd(here.q_WC[at.view]))
        way = p_W - p_WC
        p_C = wp.quat_rotate_inv(q_WC, way)
        seen = project(model.around.lenses[batch.lens_of_world[at.world]], p_C)
        u = float(seen[0])
        v = float(seen[1])
        if not (seen[2] != wp.float64(0.0) and u >= 0.0 and u < float(edges.shape[2])):
            return  # of no corner p_C is nan
        if not (v >= 0.0 and v < float(edges.shape[1])):
            return
        far = NEAR_RATIO * float(wp.length(way))
        way_W = wp.vec3(wp.normalize(way))
        if wp.mesh_query_ray_anyhit(model.around.mesh[scene], here.p_WC[at.view], way_W, far):
            return
        if is_hidden_by_bodies(model.around.body_mesh, here, at.view, here.p_WC[at.view], way_W, far):
            return
        label = int(0)
        for row in range(wp.max(int(v) - 1, 0), wp.min(int(v) + 2, edges.shape[1])):
            for col in range(wp.max(int(u) - 1, 0), wp.min(int(u) + 2, edges.shape[2])):
                found = edges[slot, row, col]
                if found > 0 and (label == 0 or found < label):
                    label = found
        corner_out[slot, corner, 0] = u
        corner_out[slot, corner, 1] = v
        for axis in range(3):
            corner_out[slot, corner, 2 + axis] = float(p_C[axis])
        corner_out[slot, corner, 5] = float(label)

    return find_seen_corners


class CornersProcess(PixelProcess):
    """Finds which corners are seen, and where.

    Attributes:
        picture: Column, row, position in C and edge of each corner, float32, shape [M, C, 6]; the column is
            nan where it is not seen.
    """

    def __init__(self, config: CornersConfig, context: PictureContext) -> None:
        device, scene = context.source.device, context.scenes[0]
        self._edges = make_edge_finder(config, context)
        model = _Model()
        kind, model.around, self._lenses = make_surroundings(context)

        def corners_of(meshes: Any) -> list[NDArray[np.float32]]:
            return [_corners_of(mesh, config.crease_rad, config.turn_rad) for mesh in meshes]

        scenes = corners_of(each.scene for each in context.scenes)
        moving = corners_of(body.solid for body in scene.bodies.bodies) if context.motions is not None else []
        model.first_of_bodies = max(map(len, scenes))
        body = np.repeat(np.arange(len(moving)), list(map(len, moving)))
        model.body = wp.array(body, dtype=int, device=device)
        table = np.full((len(scenes), max(1, model.first_of_bodies + len(body)), 3), np.nan)
        for row, corners in zip(table, scenes, strict=True):
            row[: len(corners)] = corners
            if moving:
                row[model.first_of_bodies :] = np.concatenate(moving)
        model.corners = wp.array(table, dtype=wp.vec3, device=device)
        shape = (context.source.shape[0], table.shape[1], _COLUMNS)
        inputs = [model, self._edges.picture]
        super().__init__(
            context, _make_kernel(kind), *inputs, dtype=float, shape=shape, element_count=shape[1]
        )

    def launch(self, views: PictureViews) -> None:
        """Find the corners of the pictures of a batch; launches only."""
        self._edges.launch(views)
        super().launch(views)


@functools.lru_cache(maxsize=16)
def _corners_of(mesh: Any, crease_rad: float, turn_rad: float) -> NDArray[np.float32]:
    """Return the corners of a scene or of the solid of a body [m], shape [C, 3]."""
    groups = getattr(mesh, "face_instance", None)
    return find_corners(mesh.vertices, mesh.faces, groups, crease_rad=crease_rad, turn_rad=turn_rad)
