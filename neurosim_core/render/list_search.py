# mypy: disable-error-code="no-any-return,untyped-decorator,valid-type,no-untyped-def"
"""What rays hit, found in the list of their tile alone, where that is sure.

A ray is tested against the list: three edge functions, normalised such that their sum is one over the
distance. If one triangle is nearer than all others by more than rounding, hit inside its edges by more than
rounding, and within the reach, it is what the ray hits first; where exactly, the tree's own intersection says
(`ray_hit.meet_face`). Of a ray of which that is not sure the answer is ASK.

Error bounds. Corners relative to the camera are rounded the same way in both tests, so they count as exact.
The edge function d . (b x (c - b)) is off by at most 6e-7 |b| |c - b|, that of Woop's test by 1.4e-6
max|a, b, c| |c - b|; a ray is within rounding of an edge if the function is below EDGE = 4e-6 of the same
product. The distance of a triangle is off by less than TIE / 2 of it, unless the triangle is seen nearly from
the side or is a sliver (SIDE): rays within rounding of such a one ask the tree.

Reference: Woop, Benthin, Wald (2013), Watertight Ray/Triangle Intersection.
"""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

from functools import cache

import warp as wp

from neurosim_core.render.walk_data import ASK

_CONSTANTS = """
    using namespace wp;
    constexpr float EDGE = 4.0e-6f, TIE = 2.0e-4f, SIDE = 4.0e-3f, SURE = 1.0f - TIE;
"""

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
