# mypy: disable-error-code="index,attr-defined,no-any-return,operator,arg-type,assignment,empty-body"
# mypy: disable-error-code="no-untyped-call,untyped-decorator"
# ruff: noqa: UP018  (typed literals have a meaning in kernels)
"""The walk through the tree with the frustum of a tile, swept by the motion of the camera.

Reference: Reshetov, Soupikov, Hurley (2005), Multi-Level Ray Tracing Algorithm.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from functools import cache

import warp as wp

from neurosim_core.render.ray_hit import FAR_M
from neurosim_core.render.ray_tree import READ_ROWS, RayTree, walk_tree
from neurosim_core.render.walk_data import WalkData

_ROUNDING = wp.constant(4.0e-6)
"""Of the coordinates of a scene: what frustums are widened by."""
_REACH = wp.constant(1.01)
_REACH_M = wp.constant(0.01)
"""How much further than the furthest of the rays that are cast a list reaches: a share, and a length [m]."""
_COSINE_MIN = wp.constant(0.2)
"""Between the axis of a frustum and its rays; turned by more within M instants, a tile has no list."""


@wp.struct
class _Frustum:
    """The rays of a tile in several instants: z along the axis, all of them between four planes."""

    origin: wp.vec3
    """In W [m], as the axes; what follows is relative to it."""
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    slope_low: wp.vec2
    """Least x / z and y / z of the rays."""
    slope_high: wp.vec2
    foot_low: wp.vec2
    """Where the lower planes cross z = 0: x >= foot_low[0] + slope_low[0] z."""
    foot_high: wp.vec2
    near: float
    """Least z [m]."""
    far: float
    """Largest z [m]."""


_BLOCK_MAX = """
#ifdef __CUDA_ARCH__
    __shared__ float parts[2];
    for (int step = 16; step > 0; step >>= 1)
        value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, step));
    __syncthreads();
    if ((threadIdx.x & 31) == 0)
        parts[threadIdx.x >> 5] = value;
    __syncthreads();
    value = fmaxf(parts[0], parts[1]);
#endif
    return value;
"""


@wp.func_native(_BLOCK_MAX)
def _block_max(value: float) -> float:
    """Return the largest value of the threads of a block; on a CPU, of the one."""
    ...


# A thread takes a node: of a leaf it lists the triangles that are not outside, else it puts children back.
_LIST_FACES = (
    READ_ROWS
    + """
    constexpr int ROOM = 1024, THREADS = 64;
    const vec3 normal[6] = {
        frustum.x - frustum.slope_high[0] * frustum.z, frustum.slope_low[0] * frustum.z - frustum.x,
        frustum.y - frustum.slope_high[1] * frustum.z, frustum.slope_low[1] * frustum.z - frustum.y,
        frustum.z, -frustum.z};
    const float offset[6] = {frustum.foot_high[0], -frustum.foot_low[0], frustum.foot_high[1],
                             -frustum.foot_low[1], frustum.far, -frustum.near};
    auto box_outside = [&](const vec3& lower, const vec3& upper) {
        const vec3 middle = 0.5f * (lower + upper) - frustum.origin, half = 0.5f * (upper - lower);
        bool outside = false;
        for (int k = 0; k < 6; ++k) {
            const vec3& n = normal[k];
            const float radius = wp::abs(n[0]) * half[0] + wp::abs(n[1]) * half[1] + wp::abs(n[2]) * half[2];
            outside |= dot(n, middle) - radius > offset[k];
        }
        return outside;
    };
    auto face_outside = [&](const Row& p, const Row& q, const Row& r) {
        const vec3 a = vec3(p.x, p.y, p.z) - frustum.origin, b = vec3(q.x, q.y, q.z) - frustum.origin,
                   c = vec3(r.x, r.y, r.z) - frustum.origin;
        bool outside = false;
        for (int k = 0; k < 6; ++k) {
            const vec3& n = normal[k];
            outside |= dot(n, a) > offset[k] && dot(n, b) > offset[k] && dot(n, c) > offset[k];
        }
        return outside;
    };
    auto visit = [&](int node, auto&& list, auto&& push) {
        if (node < 0) {
            bool more = true;
            for (int place = -1 - node; more; ++place) {
                const Row a = row(tree.triangles, 3 * place), b = row(tree.triangles, 3 * place + 1),
                          c = row(tree.triangles, 3 * place + 2);
                if (!face_outside(a, b, c))
                    list(__float_as_int(a.w));
                more = __float_as_int(b.w) == 0;
            }
            return;
        }
        const Row a = row(tree.nodes, 4 * node), b = row(tree.nodes, 4 * node + 1),
                  c = row(tree.nodes, 4 * node + 2), d = row(tree.nodes, 4 * node + 3);
        if (!box_outside(vec3(a.x, a.z, c.x), vec3(a.y, a.w, c.y)))
            push(__float_as_int(d.x));
        if (!box_outside(vec3(b.x, b.z, c.z), vec3(b.y, b.w, c.w)))
            push(__float_as_int(d.y));
    };
#ifdef __CUDA_ARCH__
    __shared__ int stack[ROOM];
    __shared__ int height, found;
    const int thread = threadIdx.x;
    __syncthreads();
    if (thread == 0) {
        stack[0] = tree.root;
        height = 1;
        found = 0;
    }
    __syncthreads();
    while (height > 0 && height <= ROOM - THREADS && found <= limit) {
        const int taken = wp::min(height, THREADS), rest = height - taken;
        const int node = thread < taken ? stack[rest + thread] : 0;
        __syncthreads();
        if (thread == 0)
            height = rest;
        __syncthreads();
        if (thread < taken)
            visit(
                node,
                [&](int face) {
                    const int place = atomicAdd(&found, 1);
                    if (place < limit)
                        faces_out.data[begin + place] = face;
                },
                [&](int child) { stack[atomicAdd(&height, 1)] = child; });
        __syncthreads();
    }
    const int left = height, count = found;
#else
    int stack[ROOM], left = 1, count = 0;
    stack[0] = tree.root;
    while (left > 0 && left <= ROOM - THREADS && count <= limit)
        visit(
            stack[--left],
            [&](int face) {
                if (count++ < limit)
                    faces_out.data[begin + count - 1] = face;
            },
            [&](int child) { stack[left++] = child; });
#endif
    return left > 0 || count > limit ? -1 : count;
"""
)


@wp.func_native(_LIST_FACES)
def _list_faces(tree: RayTree, frustum: _Frustum, limit: int, begin: int, faces_out: wp.array[int]) -> int:
    """Write the triangles that reach into a frustum from `begin` on, in any order; return how many.

    -1: more than `limit`. On CUDA a block of 64 threads calls it together.
    """
    ...


@wp.func
def _corner_ray(bounds: wp.vec4, corner: int) -> wp.vec3:
    return wp.vec3(bounds[corner % 2], bounds[2 + corner // 2], 1.0)


@cache
def walk_kernel(lanes: int) -> wp.Kernel:
    """Return the kernel that lists triangles; `lanes` threads share a tile: 64 on CUDA, else 1."""

    @wp.kernel(module="unique", enable_backward=False)
    def walk_tiles(
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
        data: WalkData,
    ) -> None:
        index = first + wp.tid()
        lane = index % lanes
        tile = (index // lanes) % data.bounds.shape[0]
        walk = index // lanes // data.bounds.shape[0]
        begin = walk * data.instants
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
            reach = wp.max(reach, walk_tree(tree, p_WC[instant], ray, FAR_M)[0])
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
            begin_of_list = (walk * data.bounds.shape[0] + tile) * data.limit
            count = _list_faces(tree, frustum, data.limit, begin_of_list, data.faces)
        if lane == 0:
            data.count[walk, tile] = count
            data.reach[walk, tile] = reach

    return walk_tiles
