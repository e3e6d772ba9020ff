# mypy: disable-error-code="index,attr-defined,operator,arg-type,assignment,empty-body"
# ruff: noqa: UP018  (typed literals have a meaning in kernels)
"""Frustum search: the triangles of the tree in the frustum of a tile, swept by the motion of the camera.

Reference: Reshetov, Soupikov, Hurley (2005), Multi-Level Ray Tracing Algorithm.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from functools import cache

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.candidate_data import CandidateListData
from neurosim_core.render.ray_intersection import FAR_M
from neurosim_core.render.ray_tree import RayTree, intersect_tree

_ROUNDING = wp.constant(4.0e-6)
"""Of the coordinates of a scene: what frustums are widened by."""
_REACH = wp.constant(1.01)
_REACH_M = wp.constant(0.01)
"""A list reaches further than the furthest probe ray: by this factor, and by this length [m]."""
_COSINE_MIN = wp.constant(0.2)
"""Least cosine between the axis of a frustum and its rays; a tile that turns further has no list."""


@wp.struct
class _Frustum:
    """The rays of a tile in several instants: z along the axis, all of them between four planes."""

    origin: wp.vec3  # In W [m], as the axes; what follows is relative to it
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    slope_low: wp.vec2  # Least x / z and y / z of the rays
    slope_high: wp.vec2
    foot_low: wp.vec2  # Where the lower planes cross z = 0: x >= foot_low[0] + slope_low[0] z
    foot_high: wp.vec2
    near: float  # Least z [m]
    far: float  # Largest z [m]


@wp.func_native(read_native(__file__, "block_max"))
def _block_max(value: float) -> float:
    """Return the largest value of the threads of a block; on a CPU, of the one."""
    ...


@wp.func_native(read_native(__file__, "list_frustum_faces"))
def _list_frustum_faces(
    tree: RayTree, frustum: _Frustum, limit: int, begin: int, faces_out: wp.array[int]
) -> int:
    """Write the faces that reach into a frustum from `begin` on, in any order; return their number.

    It returns -1 if there are more than `limit`. On CUDA the 64 threads of a block call it together.
    A thread takes a node: it lists the faces of a leaf, or puts the children on the stack.
    """
    ...


@wp.func
def _corner_ray(bounds: wp.vec4, corner: int) -> wp.vec3:
    return wp.vec3(bounds[corner % 2], bounds[2 + corner // 2], 1.0)


@cache
def frustum_search_kernel(lanes: int) -> wp.Kernel:
    """Return the kernel that fills candidate lists; `lanes` threads share a tile: 64 on CUDA, else 1."""

    @wp.kernel(module="unique", enable_backward=False)
    def search_frustums(
        first: int,
        # Model:
        tree: RayTree,
        rays: wp.array2d[wp.vec4],
        width: int,
        height: int,
        extent_m: float,
        # In:
        instant_count: int,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        # In/out:
        data: CandidateListData,
    ) -> None:
        index = first + wp.tid()
        lane = index % lanes
        tile = (index // lanes) % data.bounds.shape[0]
        group = index // lanes // data.bounds.shape[0]
        begin = group * data.instants
        instants = wp.min(data.instants, instant_count - begin)
        tile_columns = (width + 7) // 8
        left = (tile % tile_columns) * 8
        top = (tile // tile_columns) * 8
        bounds = data.bounds[tile]
        # A probe is one of 4 x 4 pixels spread over the tile, at one of up to four instants.
        times = wp.min(instants, 4)
        reach = float(0.0)
        for probe in range(lane, 16 * times, lanes):
            instant = begin + (probe // 16) * (instants - 1) // wp.max(times - 1, 1)
            col = wp.min(left + (7 * (probe % 4) + 1) // 3, width - 1)
            row = wp.min(top + (7 * ((probe // 4) % 4) + 1) // 3, height - 1)
            ray_C = rays[0, row * width + col]
            ray = wp.quat_rotate(q_WC[instant], wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
            reach = wp.max(reach, intersect_tree(tree, p_WC[instant], ray, FAR_M)[0])
        reach = wp.min(_block_max(reach) * _REACH + _REACH_M, FAR_M)

        frustum = _Frustum()
        middle = begin + instants // 2
        q = q_WC[middle]
        axis_C = wp.vec3(0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[2] + bounds[3]), 1.0)
        frustum.origin = p_WC[middle]
        frustum.z = wp.normalize(wp.quat_rotate(q, axis_C))
        frustum.x = wp.normalize(wp.cross(wp.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0)), frustum.z))
        frustum.y = wp.cross(frustum.z, frustum.x)
        low = wp.vec2(FAR_M)
        high = wp.vec2(-FAR_M)
        cosine = float(1.0)
        for corner in range(lane, 4 * instants, lanes):
            ray = wp.normalize(wp.quat_rotate(q_WC[begin + corner // 4], _corner_ray(bounds, corner % 4)))
            cosine = wp.min(cosine, wp.dot(ray, frustum.z))
            slope = wp.vec2(wp.dot(ray, frustum.x), wp.dot(ray, frustum.y)) / wp.dot(ray, frustum.z)
            low = wp.min(low, slope)
            high = wp.max(high, slope)
        cosine = -_block_max(-cosine)
        frustum.slope_low = wp.vec2(-_block_max(-low[0]), -_block_max(-low[1]))
        frustum.slope_high = wp.vec2(_block_max(high[0]), _block_max(high[1]))
        low = wp.vec2(FAR_M)
        high = wp.vec2(-FAR_M)
        near = float(FAR_M)
        far = float(-FAR_M)
        for instant in range(begin + lane, begin + instants, lanes):
            moved = p_WC[instant] - frustum.origin
            place = wp.vec2(wp.dot(moved, frustum.x), wp.dot(moved, frustum.y))
            along = wp.dot(moved, frustum.z)
            low = wp.min(low, place - along * frustum.slope_low)
            high = wp.max(high, place - along * frustum.slope_high)
            near = wp.min(near, along)
            far = wp.max(far, along)
        margin = _ROUNDING * (extent_m + wp.length(frustum.origin))
        frustum.foot_low = wp.vec2(-_block_max(-low[0]) - margin, -_block_max(-low[1]) - margin)
        frustum.foot_high = wp.vec2(_block_max(high[0]) + margin, _block_max(high[1]) + margin)
        frustum.near = -_block_max(-near) - margin
        frustum.far = _block_max(far) + reach + margin
        count = -1
        if cosine > _COSINE_MIN:  # of all lanes or of none
            begin_of_list = (group * data.bounds.shape[0] + tile) * data.limit
            count = _list_frustum_faces(tree, frustum, data.limit, begin_of_list, data.faces)
        if lane == 0:
            data.count[group, tile] = count
            data.reach[group, tile] = reach

    return search_frustums
