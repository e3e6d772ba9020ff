# mypy: disable-error-code="index,attr-defined,misc,no-any-return,operator,arg-type,assignment"
# mypy: disable-error-code="call-overload,empty-body,no-untyped-call,untyped-decorator,valid-type"
# mypy: disable-error-code="no-untyped-def,union-attr"
# ruff: noqa: UP018  (typed literals have a meaning in kernels)
"""One walk through the tree for all rays of a tile of pixels in several consecutive instants; exact.

The rays of 8 x 8 pixels in M instants lie in a narrow frustum: that of the tile, swept by the motion of the
camera. One walk lists the triangles that reach into it, and each ray is tested against the list alone.

1. A few of the rays are cast one by one. The furthest hit, and a little more, is the reach of the list: what
   lies behind the walls of a room is not in it.
2. The tree is walked with the swept frustum, cut off at the reach. On CUDA the threads of a block take nodes
   from one stack. What is listed is every triangle that one of the rays can hit within the reach.
3. A ray is tested against the list: three edge functions, normalised such that their sum is one over the
   distance. If one triangle is nearer than all others by more than rounding, hit inside its edges by more
   than rounding, and within the reach, it is what the ray hits first; where exactly, the tree's own
   intersection says. A ray of which that is not sure asks the tree, as do all of a tile with too long a list.

So nothing is approximated: the answers are those of `wp.mesh_query_ray` to the last bit, as far as a compiler
makes the same code of the same intersection in two places. Neither the number of instants per launch, nor how
many share a walk, nor the order in which threads find triangles, changes them.

Error bounds. Corners relative to the camera are rounded the same way in both tests, so they count as exact.
The edge function d . (b x (c - b)) is off by at most 6e-7 |b| |c - b|, that of Woop's test by 1.4e-6
max|a, b, c| |c - b|; a ray is within rounding of an edge if the function is below EDGE = 4e-6 of the same
product. The distance of a triangle is off by less than TIE / 2 of it, unless the triangle is seen nearly from
the side or is a sliver (SIDE): rays within rounding of such a one ask the tree.

Frustums and the sides of tiles hold all rays of a tile by an angle of 1e-5 rad to spare. What that has to
cover is the rounding of rays and of the camera's axes when they are rotated (5e-7 rad each), of the unit
normals of the sides (5e-7 rad), and of a triangle's corners along them (1e-6 of the distance): 3e-6 rad
together, wherever in the picture, because all of it is measured as angles. Bounds are kept as slopes x / z,
and a slope is an angle only short of 90 degrees from the axis: lenses are taken up to a slope of 100 (89.4
degrees), where the 1e-5 rad move a bound by two thousandths of itself at most, and are refused beyond. A
triangle whose plane contains the ray to within rounding is the one exception: Woop's test can hit it outside
of its edges, and where that is outside of the frustum, too, the tree may see it and a list not.

Reference: Woop, Benthin, Wald (2013), Watertight Ray/Triangle Intersection. The frustum: Reshetov, Soupikov,
Hurley (2005), Multi-Level Ray Tracing Algorithm.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import math
from functools import cache
from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.config import WalkConfig
from neurosim_core.render.launch import launch_split

TILE = 8
"""Width and height of a tile [px]."""
BLOCK = TILE * TILE
"""Threads that walk together on CUDA; on a CPU one does it all."""
ASK = -2
"""In place of a face: the list does not tell, ask the tree."""

UNFUSED = {"fuse_fp": False}
"""Products and sums are rounded one by one: so pixels have the same bits whichever kernel renders them."""
_BORDER_RAD = 1.0e-5
"""By how much the rays of a tile are taken to reach beyond their border [rad]."""
_SLOPE_MAX = 100.0
"""Largest |x / z| and |y / z| of a ray: 89.4 degrees from the axis."""
_INDEX_MAX = 2**31 - 1
"""Kernels count in 32 bits."""
_FAR_M = wp.constant(1.0e9)
_ROUNDING = wp.constant(4.0e-6)
"""Of the coordinates of a scene: what frustums are widened by."""
_REACH = wp.constant(1.01)
_REACH_M = wp.constant(0.01)
"""How much further than the furthest of the rays that are cast a list reaches: a share, and a length [m]."""
_COSINE_MIN = wp.constant(0.2)
"""Between the axis of a frustum and its rays; turned by more within M instants, a tile has no list."""
_AUTO_INSTANTS_MIN = 4
_AUTO_PIXEL_RAD = 3.5e-3
"""With fewer instants a walk takes as long as it saves, and with larger pixels, whose lists are long."""
_LEFT_SHARE = 8
"""There is room for one in so many pixels to be left; if there are more, the launch is done again by rays
that walk by themselves."""
_THREADS_PER_MULTIPROCESSOR = 640
"""Of those that render what is left: as many as run at a time."""
_CONSTANTS = """
    using namespace wp;
    constexpr float EDGE = 4.0e-6f, TIE = 2.0e-4f, SIDE = 4.0e-3f, SURE = 1.0f - TIE;
"""


@wp.struct
class WalkData:
    """What the ray caster reads of the walks before it; empty without."""

    instants: int
    """M: instants that share a walk."""
    limit: int
    """The most triangles of a list."""
    faces: wp.array[int]
    """The lists, shape [walk, tile, limit] in one dimension; walk w is of the instants from M w on."""
    count: wp.array2d[int]
    """Length of each list, shape [walk, tile]; -1: too long, ask the tree."""
    reach: wp.array2d[float]
    """Distance up to which a list is complete [m], shape [walk, tile]."""
    bounds: wp.array[wp.vec4]
    """Least and largest x / z, least and largest y / z of the rays of a tile in C, shape [tile]."""
    left: wp.array[int]
    """Pixels that are left for rays that walk by themselves, in any order; empty on a CPU."""
    left_count: wp.array[int]
    """How many there are, also where there is no room for them, shape [1]."""
    left_threads: int
    """How many threads share them."""


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
    _CONSTANTS
    + """
    constexpr int ROOM = 1024, THREADS = 64;
    const Mesh mesh = mesh_get(id);
    const vec3 normal[6] = {
        frustum.x - frustum.slope_high[0] * frustum.z, frustum.slope_low[0] * frustum.z - frustum.x,
        frustum.y - frustum.slope_high[1] * frustum.z, frustum.slope_low[1] * frustum.z - frustum.y,
        frustum.z, -frustum.z};
    const float offset[6] = {frustum.foot_high[0], -frustum.foot_low[0], frustum.foot_high[1],
                             -frustum.foot_low[1], frustum.far, -frustum.near};
    auto box_outside = [&](const BVHPackedNodeHalf& low, const BVHPackedNodeHalf& high) {
        const vec3 upper(high.x, high.y, high.z), lower(low.x, low.y, low.z);
        const vec3 middle = 0.5f * (lower + upper) - frustum.origin, half = 0.5f * (upper - lower);
        bool outside = false;
        for (int k = 0; k < 6; ++k) {
            const vec3& n = normal[k];
            const float radius = wp::abs(n[0]) * half[0] + wp::abs(n[1]) * half[1] + wp::abs(n[2]) * half[2];
            outside |= dot(n, middle) - radius > offset[k];
        }
        return outside;
    };
    auto face_outside = [&](int face) {
        const vec3 a = mesh.points[mesh.indices[3 * face]] - frustum.origin;
        const vec3 b = mesh.points[mesh.indices[3 * face + 1]] - frustum.origin;
        const vec3 c = mesh.points[mesh.indices[3 * face + 2]] - frustum.origin;
        bool outside = false;
        for (int k = 0; k < 6; ++k) {
            const vec3& n = normal[k];
            outside |= dot(n, a) > offset[k] && dot(n, b) > offset[k] && dot(n, c) > offset[k];
        }
        return outside;
    };
    auto visit = [&](uint64_t node, auto&& list, auto&& push) {
        const int first = bvh_query_node_lower_payload(node), second = bvh_query_node_upper_payload(node);
        if (bvh_query_node_is_leaf(node)) {
            for (int k = first; k < second; ++k)
                if (const int face = mesh.bvh.primitive_indices[k]; !face_outside(face))
                    list(face);
            return;
        }
        const int children[2] = {first, second};
        for (int child : children) {
            const BVHPackedNodeHalf low = bvh_load_node(mesh.bvh.node_lowers, child);
            const BVHPackedNodeHalf high = bvh_load_node(mesh.bvh.node_uppers, child);
            if (!box_outside(low, high))
                push(bvh_query_node_pack(low, high));
        }
    };
#ifdef __CUDA_ARCH__
    __shared__ uint64_t stack[ROOM];
    __shared__ int height, found;
    const int thread = threadIdx.x;
    __syncthreads();
    if (thread == 0) {
        stack[0] = bvh_query_node_load(mesh.bvh, *mesh.bvh.root);
        height = 1;
        found = 0;
    }
    __syncthreads();
    while (height > 0 && height <= ROOM - THREADS && found <= limit) {
        const int taken = wp::min(height, THREADS), rest = height - taken;
        const uint64_t node = thread < taken ? stack[rest + thread] : 0;
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
                [&](uint64_t child) { stack[atomicAdd(&height, 1)] = child; });
        __syncthreads();
    }
    const int left = height, count = found;
#else
    uint64_t stack[ROOM];
    int left = 1, count = 0;
    stack[0] = bvh_query_node_load(mesh.bvh, *mesh.bvh.root);
    while (left > 0 && left <= ROOM - THREADS && count <= limit)
        visit(
            stack[--left],
            [&](int face) {
                if (count++ < limit)
                    faces_out.data[begin + count - 1] = face;
            },
            [&](uint64_t child) { stack[left++] = child; });
#endif
    return left > 0 || count > limit ? -1 : count;
"""
)


@wp.func_native(_LIST_FACES)
def _list_faces(id: wp.uint64, frustum: _Frustum, limit: int, begin: int, faces_out: wp.array[int]) -> int:
    """Write the triangles that reach into a frustum from `begin` on, in any order; return how many.

    -1: more than `limit`. On CUDA a block of 64 threads calls it together.
    """
    ...


# What a ray is tested against: edge functions u, v, w and normal n of a triangle, such that n . ray is one
# over the distance and all three are positive inside. Nearly seen from the side: not scaled, and slack < 0.
_FACE_TEST = (
    _CONSTANTS
    + """
    struct Face {
        vec3 u; float slack;
        vec3 v; int face;
        vec3 w; float unused;
        vec3 n; float unused_too;
    };
    const Mesh mesh = mesh_get(id);
    // The sides of a tile at an instant, which are planes, and its corners, which are rays.
    struct Tile {
        vec3 border[4], corner[4];
    };
    auto bound = [&](int side, const quat& q, Tile& to) {
        const vec3 x = quat_rotate(q, vec3(1.0f, 0.0f, 0.0f)), y = quat_rotate(q, vec3(0.0f, 1.0f, 0.0f)),
                   z = quat_rotate(q, vec3(0.0f, 0.0f, 1.0f));
        const float slope = bounds[side];
        to.border[side] = normalize((side % 2 ? -1.0f : 1.0f) * ((side < 2 ? x : y) - slope * z));
        to.corner[side] = normalize(bounds[side % 2] * x + bounds[2 + side / 2] * y + z);
    };
    auto prepare = [&](int face, const vec3& origin, const Tile& tile, Face& to) {
        const vec3 a = mesh.points[mesh.indices[3 * face]] - origin;
        const vec3 b = mesh.points[mesh.indices[3 * face + 1]] - origin;
        const vec3 c = mesh.points[mesh.indices[3 * face + 2]] - origin;
        const float size = wp::sqrt(wp::max(dot(a, a), wp::max(dot(b, b), dot(c, c))));
        for (const vec3& side : tile.border)
            if (wp::max(dot(side, a), wp::max(dot(side, b), dot(side, c))) < -1.0e-6f * size)
                return false;
        const vec3 ab = b - a, bc = c - b, ca = a - c;
        const float ab2 = dot(ab, ab), bc2 = dot(bc, bc), ca2 = dot(ca, ca);
        to.face = face;
        to.u = cross(b, bc);
        to.v = cross(c, ca);
        to.w = cross(a, ab);
        to.n = cross(ca, ab);
        to.slack = EDGE * size * wp::sqrt(wp::max(ab2, wp::max(bc2, ca2)));
        const float volume = dot(a, to.n);
        if (wp::abs(volume) < SIDE * size * wp::sqrt(ab2 * ca2)) {
            to.slack = -wp::max(to.slack, 1.0e-30f);
            return true;
        }
        const float scale = 1.0f / volume;
        to.u = scale * to.u;
        to.v = scale * to.v;
        to.w = scale * to.w;
        to.n = scale * to.n;
        to.slack *= wp::abs(scale);
        float u = -FLT_MAX, v = -FLT_MAX, w = -FLT_MAX;
        for (const vec3& corner : tile.corner) {
            u = wp::max(u, dot(to.u, corner));
            v = wp::max(v, dot(to.v, corner));
            w = wp::max(w, dot(to.w, corner));
        }
        return wp::min(u, wp::min(v, w)) >= -to.slack;
    };
    // The best so far, the runner-up, and the nearest that may or may not be hit: one over the distance.
    auto along = [](const vec3& n, float x, float y, float z) {
#ifdef __CUDA_ARCH__
        return fmaf(n[0], x, fmaf(n[1], y, n[2] * z));
#else
        return n[0] * x + n[1] * y + n[2] * z;
#endif
    };
    auto test = [&](const Face& face, float x, float y, float z, float& best, float& next, float& unsure,
                    int& which) {
        const float u = along(face.u, x, y, z), v = along(face.v, x, y, z), w = along(face.w, x, y, z);
        const float low = wp::min(u, wp::min(v, w));
        if (face.slack < 0.0f) {
            const bool missed = low < face.slack && wp::max(u, wp::max(v, w)) > -face.slack;
            unsure = missed ? unsure : FLT_MAX;
        } else {
            const float inverse = along(face.n, x, y, z);
            const float maybe = low > -face.slack ? wp::max(inverse, FLT_MIN) : 0.0f;
            const float hit = low > face.slack ? inverse : 0.0f;
            unsure = wp::max(unsure, low > face.slack ? 0.0f : maybe);
            next = wp::max(next, wp::min(hit, best));
            which = hit > best ? face.face : which;
            best = wp::max(best, hit);
        }
    };
    auto decide = [&](float best, float next, float unsure, int which) {
        if (best == 0.0f)
            return unsure == 0.0f && reach >= far_m ? -1 : ASK;
        const bool sure = wp::max(next, unsure) < SURE * best && best * reach > 1.0f + TIE;
        return sure ? which : ASK;
    };
"""
)

# A thread prepares a triangle for one of the instants; then each tests its rays against those of theirs.
_FIND_TOGETHER = (
    _FACE_TEST
    + """
    float best[GROUP] = {}, next[GROUP] = {}, unsure[GROUP] = {};
    int which[GROUP];
    vec3 ray[GROUP];
    for (int k = 0; k < GROUP; ++k) {
        which[k] = ASK;
        ray[k] = quat_rotate(q_WC.data[first + wp::min(k, instants - 1)], ray_C);
    }
#ifdef __CUDA_ARCH__
    constexpr int EACH = 64 / GROUP;
    __shared__ Tile tiles[GROUP];
    __shared__ Face tested[GROUP][EACH];
    __shared__ int tested_count[2][GROUP];
    const int lane = threadIdx.x, own = lane % GROUP;
    const vec3 origin = p_WC.data[first + wp::min(own, instants - 1)];
    __syncthreads();
    if (lane < 4 * GROUP)
        bound(lane / GROUP, q_WC.data[first + wp::min(own, instants - 1)], tiles[own]);
    if (lane < GROUP)
        tested_count[0][lane] = 0;
    for (int place = 0, turn = 0; place < count; place += EACH, turn ^= 1) {
        __syncthreads();
        if (lane < GROUP)
            tested_count[turn ^ 1][lane] = 0;
        const int k = place + lane / GROUP;
        Face face;
        if (k < count && own < instants && prepare(faces.data[begin + k], origin, tiles[own], face))
            tested[own][atomicAdd(&tested_count[turn][own], 1)] = face;
        __syncthreads();
#pragma unroll
        for (int k = 0; k < GROUP; ++k)
            for (int j = 0; j < tested_count[turn][k]; ++j)
                test(tested[k][j], ray[k][0], ray[k][1], ray[k][2], best[k], next[k], unsure[k], which[k]);
    }
#else
    for (int k = 0; k < instants; ++k) {
        Tile tile;
        for (int side = 0; side < 4; ++side)
            bound(side, q_WC.data[first + k], tile);
        for (int j = 0; j < count; ++j)
            if (Face face; prepare(faces.data[begin + j], p_WC.data[first + k], tile, face))
                test(face, ray[k][0], ray[k][1], ray[k][2], best[k], next[k], unsure[k], which[k]);
    }
#endif
    vec_t<GROUP, int> found;
    for (int k = 0; k < GROUP; ++k)
        found[k] = count < 0 ? ASK : decide(best[k], next[k], unsure[k], which[k]);
    return found;
"""
)

_FIND_FACES = (
    _FACE_TEST
    + """
    float best[64] = {}, next[64] = {}, unsure[64] = {}, ray_x[64], ray_y[64], ray_z[64];
    int which[64];
    for (int pixel = 0; pixel < 64; ++pixel) {
        which[pixel] = ASK;
        ray_x[pixel] = rays.data[pixel][0];
        ray_y[pixel] = rays.data[pixel][1];
        ray_z[pixel] = rays.data[pixel][2];
    }
    Tile tile;
    for (int side = 0; side < 4; ++side)
        bound(side, q, tile);
    for (int k = 0; k < count; ++k)
        if (Face face; prepare(faces.data[begin + k], origin, tile, face))
            for (int pixel = 0; pixel < 64; ++pixel)
                test(face, ray_x[pixel], ray_y[pixel], ray_z[pixel], best[pixel], next[pixel], unsure[pixel],
                     which[pixel]);
    for (int pixel = 0; pixel < 64; ++pixel)
        face_out.data[pixel]
            = count < 0 ? ASK : decide(best[pixel], next[pixel], unsure[pixel], which[pixel]);
"""
)


def shared_walk(
    asked: WalkConfig | Literal["auto"] | None,
    rays: NDArray[np.float32],
    *,
    instant_count: int,
    is_cuda: bool,
) -> WalkConfig | None:
    """Return how rays share walks; None: each walks by itself.

    Args:
        asked: `RenderConfig.shared_walk`.
        rays: Rays of the pixels in C, shape [layer, H * W, 4], as `warp_renderer.ray_layers` gives them.
        instant_count: The most instants of a launch, of one world.
        is_cuda: Where they are rendered.
    """
    if asked != "auto":
        return asked
    if not is_cuda or instant_count < _AUTO_INSTANTS_MIN or not looks_forward(rays):
        return None
    sample_count = max(1, len(rays) - 1)  # each of which has its share of the pixel
    pixel_rad = float(np.median(rays[..., 3])) * math.sqrt(sample_count)
    return WalkConfig() if pixel_rad <= _AUTO_PIXEL_RAD else None


def group_size(instants: int) -> int:
    """Return how many of the instants that share a walk a block looks at together: 4, 2 or 1, a divisor."""
    return math.gcd(instants, 4)


@cache
def together_finder(group: int) -> wp.Function:
    """Return the function that finds what a pixel sees at up to `group` instants; a divisor of 64.

    It returns, for each instant, the triangle that the pixel's ray hits first, of a list; -1: it hits
    nothing, ASK: that is not sure; as a vector of `group` integers. On CUDA a block of 64 threads, the
    pixels of a tile, calls it together: triangles are prepared once for all of them.

    Its parameters: the mesh; the lists; where that of the tile begins; its length, -1: there is none; the
    distance up to which it is complete, and what counts as infinitely far [m]; `WalkData.bounds` of the tile;
    the positions [m] and orientations of the camera in W; the first instant, and how many are looked at;
    the direction of the pixel's ray in C, of unit length.
    """
    found = wp.types.vector(length=group, dtype=int)

    @wp.func_native(_FIND_TOGETHER.replace("ASK", str(ASK)).replace("GROUP", str(group)))
    def find_together(
        id: wp.uint64,
        faces: wp.array[int],
        begin: int,
        count: int,
        reach: float,
        far_m: float,
        bounds: wp.vec4,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        first: int,
        instants: int,
        ray_C: wp.vec3,
    ) -> found: ...

    return find_together


@wp.func_native(_FIND_FACES.replace("ASK", str(ASK)))
def find_faces(
    id: wp.uint64,
    faces: wp.array[int],
    begin: int,
    count: int,
    reach: float,
    far_m: float,
    bounds: wp.vec4,
    q: wp.quat,
    origin: wp.vec3,
    rays: wp.array[wp.vec3],
    face_out: wp.array[int],
):
    """Find what all 64 rays of a tile at one instant hit, for CPU kernels: vectorised over rays.

    Args:
        id: The mesh.
        faces: Lists.
        begin: Where that of the tile begins.
        count: Its length; -1: there is none.
        reach: Distance up to which it is complete [m].
        far_m: What counts as infinitely far [m].
        bounds: `WalkData.bounds` of the tile.
        q: Orientation of the camera in W.
        origin: Of the rays, in W [m].
        rays: Their directions in W, of unit length.
        face_out: The triangle that each hits first; -1: nothing, ASK: that is not sure.
    """
    ...


@wp.func_native("""
    using namespace wp;
#ifdef __CUDA_ARCH__
    // one atomic for a warp, whose pixels stay side by side
    const unsigned mask = __ballot_sync(0xffffffffu, is_left), lane = threadIdx.x & 31;
    int place = 0;
    if (mask && lane == 0)
        place = atomicAdd(count.data, __popc(mask));
    place = __shfl_sync(0xffffffffu, place, 0) + __popc(mask & ((1u << lane) - 1));
#else
    const int place = is_left ? __atomic_fetch_add(count.data, 1, __ATOMIC_RELAXED) : 0;
#endif
    if (is_left && place < left.shape[0])
        left.data[place] = index;
""")
def leave(is_left: wp.bool, index: int, left: wp.array[int], count: wp.array[int]):
    """Note that the pixel of a thread is left, and count it, also where there is no room for it.

    All threads of a block call it together.
    """
    ...


@wp.func_native("""
    using namespace wp;
    const Mesh mesh = mesh_get(id);
    const vec3 a = mesh.points[mesh.indices[3 * face]], b = mesh.points[mesh.indices[3 * face + 1]],
               c = mesh.points[mesh.indices[3 * face + 2]];
    float t, u, v, sign;
    if (intersect_ray_tri_woop(origin, ray, a, b, c, t, u, v, sign, (vec3*)nullptr) && t >= 0.0f)
        return vec3(t, u, v);
    return vec3(-1.0f, 0.0f, 0.0f);
""")
def meet_face(id: wp.uint64, face: int, origin: wp.vec3, ray: wp.vec3) -> wp.vec3:
    """Return t [m], u and v where a ray meets a triangle, as `wp.mesh_query_ray` does; t = -1: nowhere."""
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
        mesh: wp.uint64,
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
            query = wp.mesh_query_ray(mesh, p_WC[instant], ray, _FAR_M)
            reach = wp.max(reach, wp.where(query.result, query.t, _FAR_M))
        reach = wp.min(_block_max(reach) * _REACH + _REACH_M, _FAR_M)

        frustum = _Frustum()
        middle = begin + instants // 2
        q = q_WC[middle]
        axis_C = wp.vec3(0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[2] + bounds[3]), 1.0)
        frustum.origin = p_WC[middle]
        frustum.z = wp.normalize(wp.quat_rotate(q, axis_C))
        frustum.x = wp.normalize(wp.cross(wp.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0)), frustum.z))
        frustum.y = wp.cross(frustum.z, frustum.x)
        low = wp.vec2(_FAR_M)
        high = wp.vec2(-_FAR_M)
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
        low = wp.vec2(_FAR_M)
        high = wp.vec2(-_FAR_M)
        near = float(_FAR_M)
        far = float(-_FAR_M)
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
            count = _list_faces(mesh, frustum, data.limit, begin_of_list, data.faces)
        if lane == 0:
            data.count[walk, tile] = count
            data.reach[walk, tile] = reach

    return walk_tiles


@cache
def _normal_kernel() -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED)
    def write_normals(mesh: wp.uint64, normal_out: wp.array[wp.vec3]) -> None:
        face = wp.tid()
        normal_out[face] = wp.mesh_eval_face_normal(mesh, face)

    return write_normals


def face_normals(mesh: wp.Mesh) -> wp.array[wp.vec3]:
    """Return the unit normal of each face's front, with the bits that `wp.mesh_query_ray` gives."""
    normals = wp.empty(mesh.indices.shape[0] // 3, dtype=wp.vec3, device=mesh.device)
    wp.launch(_normal_kernel(), dim=normals.shape[0], inputs=[mesh.id], outputs=[normals], device=mesh.device)
    return normals


def looks_forward(rays: NDArray[np.float32]) -> bool:
    """Return whether `tile_bounds` takes the rays of a lens."""
    x, y, z = np.moveaxis(rays[..., :3].astype(np.float64), -1, 0)
    return bool((z > 0.0).all() and (np.maximum(np.abs(x), np.abs(y)) <= _SLOPE_MAX * z).all())


def tile_bounds(rays: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return the least and largest x / z and the least and largest y / z of the rays of each tile.

    They are widened by 1e-5 rad, more than rounding. A ray that reaches z = 1 after the length L, and a plane
    x = (s + ds) z where it has the slope s, are ds / (L sqrt(1 + s^2)) apart [rad].

    Args:
        rays: Rays in C, shape [layer, H * W, 3 or more].
        width: Columns of the picture [px].
        height: Rows of the picture [px].

    Returns:
        Bounds, shape [tile, 4], tiles row by row.

    Raises:
        ValueError: A ray does not look forward (z <= 0), or is too close to 90 degrees from the axis: |x / z|
            or |y / z| is above 100.
    """
    directions = rays[..., :3].astype(np.float64).reshape(-1, height, width, 3)
    if not (directions[..., 2] > 0.0).all():
        raise ValueError("rays that share a walk must look forward, and some of this lens do not (z <= 0)")
    slopes = directions[..., :2] / directions[..., 2:]
    steepest = float(np.abs(slopes).max())
    if steepest > _SLOPE_MAX:
        raise ValueError(
            f"rays that share a walk must have |x / z| and |y / z| up to {_SLOPE_MAX:g} "
            f"({math.degrees(math.atan(_SLOPE_MAX)):.1f} deg from the axis), and this lens has "
            f"{steepest:.4g}: take a narrower lens, or set render.shared_walk to null"
        )
    length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
    widened = _BORDER_RAD * length * np.sqrt(1.0 + slopes**2)
    lowest, highest = slopes - widened, slopes + widened
    bounds = []
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            part = np.s_[:, top : top + TILE, left : left + TILE]
            low, high = lowest[part].min(axis=(0, 1, 2)), highest[part].max(axis=(0, 1, 2))
            bounds.append((low[0], high[0], low[1], high[1]))
    return np.array(bounds, dtype=np.float32)


def _check_counts(config: WalkConfig, *, walks: int, tiles: int) -> None:
    """Refuse what kernels, which count in 32 bits, cannot address: threads, and entries of the lists."""
    longest = _INDEX_MAX // (walks * tiles)
    if max(config.face_count_max, BLOCK) > longest:
        allowed = f"at most {longest}" if longest >= BLOCK else "no value is small enough"
        raise ValueError(
            f"{walks} shared walks of {tiles} tiles with render.shared_walk.face_count_max = "
            f"{config.face_count_max} are more than 2^31 - 1 entries: {allowed} here; or take fewer worlds "
            "or pixels, or share a walk between more instants (render.shared_walk.instants)"
        )


class TileWalk:
    """The lists of one renderer, and the launch that fills them.

    Attributes:
        data: For kernels; overwritten by `launch`.
    """

    def __init__(
        self,
        mesh: wp.Mesh,
        rays: NDArray[np.float32],
        *,
        width: int,
        height: int,
        extent_m: float,
        config: WalkConfig,
        instant_count: int,
        leaves: bool,
        thread_count: int | None = None,
    ) -> None:
        """Allocate the lists.

        Args:
            mesh: What rays hit.
            rays: Rays of the pixels in C, shape [layer, H * W, 4].
            width: Columns of the picture [px].
            height: Rows of the picture [px].
            extent_m: Largest coordinate of the mesh [m].
            config: How walks are shared.
            instant_count: K, the most instants per launch.
            leaves: Pixels are left to another kernel (`raycast.asking_kernel`).
            thread_count: Threads on a CPU device; all cores if None.

        Raises:
            ValueError: A ray does not look forward enough (`tile_bounds`), or there are more than 2^31 - 1
                threads or entries of the lists.
        """
        walks = -(-instant_count // config.instants)
        _check_counts(config, walks=walks, tiles=-(-width // TILE) * -(-height // TILE))
        bounds = tile_bounds(rays, width, height)
        self._mesh, self._width, self._height, self._extent_m = mesh, width, height, extent_m
        self._device = str(mesh.device)
        self._thread_count = thread_count
        self._lanes = 1 if mesh.device.is_cpu else BLOCK
        self.data = WalkData()
        self.data.instants = config.instants
        self.data.limit = config.face_count_max
        size = walks * len(bounds) * config.face_count_max
        self.data.faces = wp.zeros(size, dtype=int, device=self._device)
        self.data.count = wp.zeros((walks, len(bounds)), dtype=int, device=self._device)
        self.data.reach = wp.zeros((walks, len(bounds)), dtype=float, device=self._device)
        self.data.bounds = wp.array(bounds, dtype=wp.vec4, device=self._device)
        self.data.left_count = wp.zeros(1, dtype=int, device=self._device)
        room = instant_count * len(bounds) * BLOCK // _LEFT_SHARE if leaves else 0
        self.data.left = wp.zeros(room, dtype=int, device=self._device)
        processors = mesh.device.sm_count if mesh.device.is_cuda else 0
        self.data.left_threads = max(1, processors * _THREADS_PER_MULTIPROCESSOR)

    def launch(
        self,
        rays: wp.array2d[wp.vec4],
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        *,
        instant_count: int,
    ) -> None:
        """List the triangles that rays may hit at the first `instant_count` poses.

        Args:
            rays: Rays of the pixels in C, shape [layer, H * W].
            p_WC: Position of the camera [m], shape [K].
            q_WC: Orientation of the camera's optical frame, xyzw, shape [K].
            instant_count: How many of the K instants are rendered.
        """
        walks = -(-instant_count // self.data.instants)
        self.data.left_count.zero_()
        launch_split(
            walk_kernel(self._lanes),
            dim=walks * self.data.bounds.shape[0] * self._lanes,
            inputs=[
                self._mesh.id,
                rays,
                self._width,
                self._height,
                self._extent_m,
                instant_count,
                p_WC,
                q_WC,
            ],
            outputs=[self.data],
            device=self._device,
            thread_count=self._thread_count,
        )
