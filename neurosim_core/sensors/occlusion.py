# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""Occlusion of points from a camera, found by a ray, or by the picture of the same camera at another time.

Nothing is on the way from the other camera to a point where the picture shows only what is further than that
way, and near the camera where no surface is as near. The least range around a pixel tells most of it at once.
"""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

from typing import Any

import numpy as np
import warp as wp

from neurosim_core.render.projection import LensData, make_lens_data
from neurosim_core.scene.bodies import Motion
from neurosim_core.sensors.base import PictureContext
from neurosim_core.sensors.pixel_process import Views

NEAR_RATIO = wp.constant(1.0 - 3.0e-4)
"""What hides a point is nearer than it by this ratio: rays and points are float32."""
TILE = 16
"""Width and height of a tile whose least range is known [px]."""
_SHORT_PX = wp.constant(float(TILE - 2))
"""Ways in the picture that are shorter stay within the tiles around a pixel, with the pixels beside them."""
_NEARBY_PX = wp.constant(3.0)
"""Length of the way of a point as far from the camera as surfaces are looked for."""
_CLEARANCE_M = wp.constant(0.5)
"""No surface is looked for that is further from a camera than this."""
_HORIZON_M = wp.constant(1.0e5)
"""Where a way to the sky ends [m]."""
_WAY_PX = wp.constant(64.0)
"""Longest way in a picture that is followed."""


@wp.struct
class Surroundings:
    """The surroundings of cameras, and the lenses of the cameras."""

    lenses: wp.array[LensData]
    mesh: wp.array[wp.uint64]  # Of each scene
    scene_instances: int  # How many there are before those of bodies
    motions: wp.array[Motion]
    body_mesh: wp.array[wp.uint64]


def make_surroundings(context: PictureContext) -> tuple[str, Any, list[Any]]:
    """Return the kind of the lenses, what is around, and what must be kept for it.

    Raises:
        ValueError: There are lenses of several kinds, or they do not project points.
    """
    kinds = {getattr(lens, "kind", "") for lens in context.lenses}
    if len(kinds) > 1:
        raise ValueError(f"{context.name}: worlds have lenses of several kinds, {sorted(kinds)}")
    around, device = Surroundings(), context.source.device
    lenses = [make_lens_data(lens, device) for lens in context.lenses]
    around.lenses = wp.array(lenses, dtype=LensData, device=device)
    mesh = np.array([scene.mesh_id for scene in context.scenes], np.uint64)
    around.mesh = wp.array(mesh, dtype=wp.uint64, device=device)
    if context.motions is not None:
        scene = context.scenes[0]
        around.scene_instances = len(scene.scene.instance_names)
        around.motions, around.body_mesh = context.motions, scene.bodies.data.mesh
    return str(kinds.pop()), around, lenses


@wp.func
def is_hidden_by_bodies(
    bodies: wp.array[wp.uint64], views: Views, view: int, p_W: wp.vec3, ray_W: wp.vec3, far: float
) -> bool:
    """Return whether a moving body is on the ray from the camera, nearer than a distance [m]."""
    for body in range(bodies.shape[0]):
        q_WO = views.q_WO[view, body]
        p_O = wp.vec3(wp.quat_rotate_inv(q_WO, wp.vec3d(p_W) - views.p_WO[view, body]))
        ray_O = wp.vec3(wp.quat_rotate_inv(q_WO, wp.vec3d(ray_W)))
        if wp.mesh_query_ray_anyhit(bodies[body], p_O, ray_O, far):
            return True
    return False


@wp.func
def measure_clearance(mesh: wp.uint64, p_W: wp.vec3, other: wp.vec3, focal_px: float) -> float:
    """Return a distance from the camera within which there is no surface of the scene [m].

    Surfaces are looked for as far as it takes to leave ways of a few pixels; `other` is the position of the
    other camera, in C [m].
    """
    clearance = wp.min(_CLEARANCE_M, focal_px * wp.length(other) / _NEARBY_PX)
    found = wp.mesh_query_point_no_sign(mesh, p_W, clearance)
    if found.result:
        clearance = wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - p_W)
    return NEAR_RATIO * clearance


@wp.kernel(enable_backward=False)
def measure_tiles(ranges: wp.array3d[float], nearest_out: wp.array3d[float]):
    """Write the least range of each tile of pictures; 0 for one that is not whole [m]."""
    slot, row, col = wp.tid()
    tile = wp.tile_load(ranges, shape=(1, TILE, TILE), offset=(slot, row * TILE, col * TILE))
    nearest_out[slot, row, col] = wp.tile_min(tile)[0]


@wp.func
def _leave(other: wp.vec3, along: wp.vec3, radius: float) -> float:
    """Return the distance from `other` to where a way leaves the sphere about the camera it begins in."""
    middle = wp.dot(other, along)
    return wp.sqrt(wp.max(middle * middle + radius * radius - wp.dot(other, other), 0.0)) - middle


@wp.func
def is_way_free(
    lens: LensData,
    ranges: wp.array2d[float],
    nearest: wp.array2d[float],
    row: int,
    col: int,
    other: wp.vec3,
    point: wp.vec3,
    clearance: float,
) -> bool:
    """Return whether the picture of a pinhole camera shows that a way is free, but for its last pixel.

    The way leads from `other` to `point`, in C [m], which the pixel at row and col sees. Ranges are the
    picture, `nearest` the least of its tiles; within `clearance` of the camera there is no surface [m].
    """
    if wp.length_sq(other) == 0.0:
        return True
    point *= wp.min(1.0, _HORIZON_M / wp.length(point))
    length = wp.length(point - other)
    along = (point - other) / length
    if wp.length_sq(other) >= clearance * clearance:
        return False
    leaving = _leave(other, along, clearance)
    if leaving >= length:
        return True
    begin = other + leaving * along
    if begin[2] <= 0.0:
        return False
    scale = wp.vec2(float(lens.fx), float(lens.fy))
    center = wp.vec2(float(lens.cx), float(lens.cy))
    height = ranges.shape[0]
    width = ranges.shape[1]
    here = wp.vec3(point[0] / point[2], point[1] / point[2], 1.0)
    first = wp.vec3(begin[0] / begin[2], begin[1] / begin[2], 1.0)
    step = first - here
    count = wp.max(wp.abs(step[0] * scale[0]), wp.abs(step[1] * scale[1]))
    if count > _WAY_PX:
        return False
    x = first[0] * scale[0] + center[0]
    y = first[1] * scale[1] + center[1]
    inside = x > 0.0 and y > 0.0 and x < float(width) and y < float(height)
    if inside and count <= _SHORT_PX:
        radius = float(_HORIZON_M)
        for tile in range(9):
            tile_row = wp.clamp(row / TILE + tile / 3 - 1, 0, nearest.shape[0] - 1)
            tile_col = wp.clamp(col / TILE + tile % 3 - 1, 0, nearest.shape[1] - 1)
            radius = wp.min(radius, NEAR_RATIO * nearest[tile_row, tile_col])
        if radius > clearance:
            leaving = _leave(other, along, radius)
            if leaving >= length:
                return True
            begin = other + leaving * along
            step = wp.vec3(begin[0] / begin[2], begin[1] / begin[2], 1.0) - here
            count = wp.max(wp.abs(step[0] * scale[0]), wp.abs(step[1] * scale[1]))
    nearness = 1.0 / point[2]
    for k in range(1, int(wp.ceil(count))):
        share = float(k) / count
        toward = here + share * step
        away = wp.length(toward) / (nearness + share * (1.0 / begin[2] - nearness))
        left = int(wp.floor(toward[0] * scale[0] + center[0] - 0.5))
        top = int(wp.floor(toward[1] * scale[1] + center[1] - 0.5))
        if left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
            return False
        least = wp.min(
            wp.min(ranges[top, left], ranges[top, left + 1]),
            wp.min(ranges[top + 1, left], ranges[top + 1, left + 1]),
        )
        if NEAR_RATIO * least <= away:
            return False
    return True
