// CUDA: the threads of a warp find together what the points of each of 4 x 4 pixels show, as `list_seen_faces.cuh` and
// `cover_lanes.cuh` do on a CPU. Leaves pairs of a pixel and a surface that it shows in shared memory. Returns their number;
// the first of the pixel and how many; how many of its points show none, -1: it has to be rendered by rays; whether the sky
// is behind; where the pairs are.
wp::vec_t<6, int> result;
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
#include "sample_points.cuh"
__shared__ Block blocks[2];
Block& block = blocks[threadIdx.x / 32 % 2];
constexpr unsigned ALL = 0xffffffffu;
const int lane = threadIdx.x % 32, pixel = lane % 16, half = lane / 16;
if (half == 0)
    for (int axis = 0; axis < 3; ++axis) {
        block.ray[axis][pixel] = center[axis];
        block.ray[3 + axis][pixel] = across[axis];
        block.ray[6 + axis][pixel] = down[axis];
    }
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
int count = 0;
bool sky = false, listed = true;
for (int place = lane; place < 64; place += 32) {
    const int y = upper + place / 6, x = leftmost + place % 6;
    const bool inside = place < 36 && y < height && x < width;
    const int part = inside ? *wp::address(faces, instant, y, x) : -1;
    sky |= inside && part < 0;
    const int face = part >= 0 ? scene.whole_of_face.data[part] : -1;
    const unsigned same = __match_any_sync(ALL, face);
    bool added = face >= 0 && __ffs(same) - 1 == lane;
    for (int entry = 0; entry < count; ++entry) added &= block.seen[entry] != face;
    const unsigned additions = __ballot_sync(ALL, added);
    listed = count + __popc(additions) <= MOST;
    if (!listed) break;
    if (added) {
        const int entry = count + __popc(additions & ((1u << lane) - 1));
        block.seen[entry] = face;
        block.part[entry] = part;
    }
    count += __popc(additions);
    __syncwarp();
}
sky = __any_sync(ALL, sky);
#include "edge_functions.cuh"
unsigned long long reaching = 0; // entries that reach the pixel
int edges = 0; // pairs of a pixel and a face whose edges cross it
for (int begin = 0; listed && begin < count;) {
    const int end = wp::min(begin + 32, count), entry = begin + lane;
    int surface = -1;
    if (entry < end) { // each thread prepares a face
        const int face = block.seen[entry];
        const wp::vec3* corner = scene.whole_corner.data + 3 * (size_t)face;
        float function[3][3];
        if (functions_of(corner[0] - origin, corner[1] - origin, corner[2] - origin, function) != 0.0f)
            surface = scene.whole_surface.data[face];
        for (int side = 0; side < 3; ++side)
            for (int axis = 0; axis < 3; ++axis) block.function[3 * side + axis][entry] = function[side][axis];
        for (int axis = 0; axis < 3; ++axis)
            block.plane[axis][entry] = function[0][axis] + function[1][axis] + function[2][axis];
        block.surface[entry] = surface;
    }
    __syncwarp();
    for (int pair_of_faces = begin; pair_of_faces < end; pair_of_faces += 2) { // each half of the threads: which pixels one reaches
        const bool there = pair_of_faces + half < end;
        const int at = there ? pair_of_faces + half : begin;
        bool reached = there && block.surface[at] >= 0;
        unsigned cut = 0;
#pragma unroll
        for (int side = 0; side < 3; ++side) {
            const float function[3] = {block.function[3 * side][at], block.function[3 * side + 1][at], block.function[3 * side + 2][at]};
            auto along = [&](const wp::vec3& toward) {
                return fmaf(function[0], toward[0], fmaf(function[1], toward[1], function[2] * toward[2]));
            };
            const float middle = along(center), extent = 0.5f * (wp::abs(along(across)) + wp::abs(along(down)));
            reached &= middle + extent >= 0.0f;
            cut |= (unsigned)(middle - extent < 0.0f) << side;
        }
        if (!reached) cut = 0;
        const unsigned half_of_lanes = 0xffffu << (16 * half);
        unsigned reach = __ballot_sync(ALL, reached) & half_of_lanes ? 8u : 0u;
#pragma unroll
        for (int side = 0; side < 3; ++side)
            if (__ballot_sync(ALL, cut & 1u << side) & half_of_lanes) reach |= 1u << side;
        const bool edged = cut != 0;
        const unsigned all_edged = __ballot_sync(ALL, edged);
        if (edged) block.listed[edges + __popc(all_edged & ((1u << lane) - 1))] = (unsigned short)(pixel | at << 4 | cut << 10);
        edges += __popc(all_edged);
        if (reached) reaching |= 1ull << at;
        if (there) block.shown[at][pixel] = reached ? ALL_POINTS : 0u;
        if (pixel == 0 && there) block.reach[at] = (unsigned char)reach; // edges that cross pixels; 8: it reaches one
    }
    __syncwarp();
    if (entry < end) {
        if (block.reach[entry] == 0) surface = -1;
        block.surface[entry] = surface;
    }
    __syncwarp();
    if (entry < end) {
        int first = entry; // entry of the same surface
        for (int other = entry - 1; other >= 0 && surface >= 0; --other)
            if (block.surface[other] == surface) first = other;
        block.first[entry] = (unsigned char)first;
    }
    for (int base = 3 * begin; listed && base < 3 * end; base += 32) { // each thread looks beyond an edge
        const int at = wp::min((base + lane) / 3, end - 1), side = (base + lane) % 3;
        int beyond = -1;
        if (base + lane < 3 * end && (block.reach[at] >> side) & 1)
            beyond = scene.whole_neighbor.data[3 * (size_t)block.seen[at] + side];
        for (int other = 0; other < count; ++other)
            if (block.seen[other] == beyond) beyond = -1;
        if (beyond >= 0) {
            const float function[3] = {block.function[3 * side][at], block.function[3 * side + 1][at],
                                       block.function[3 * side + 2][at]};
            if (!is_beyond(beyond, function)) beyond = -1;
        }
        for (unsigned waiting; listed && (waiting = __ballot_sync(ALL, beyond >= 0));) {
            const int face = __shfl_sync(ALL, beyond, __ffs(waiting) - 1);
            listed = count < MOST;
            if (listed && lane == 0) {
                block.seen[count] = face;
                block.part[count] = -1 - face;
            }
            count += listed;
            if (beyond == face) beyond = -1;
        }
        __syncwarp();
    }
    begin = end;
}
unsigned taken = 0; // points that show a face
unsigned long long surfaces = 0; // first entries of the surfaces that the pixel shows
if (listed) {
    reaching |= __shfl_xor_sync(ALL, reaching, 16);
    for (int base = 0; base < edges; base += 32) { // each thread looks at the points of a pixel and the edges of a face
        const unsigned code = base + lane < edges ? block.listed[base + lane] : 0u;
        const int at = code & 15, entry = (code >> 4) & 63;
        wp::vec3 toward[3];
        float near[3];
#pragma unroll
        for (int term = 0; term < 3; ++term) {
#pragma unroll
            for (int axis = 0; axis < 3; ++axis) toward[term][axis] = block.ray[3 * term + axis][at];
            near[term] = OVERLAP * fmaf(block.plane[0][entry], toward[term][0],
                                        fmaf(block.plane[1][entry], toward[term][1], block.plane[2][entry] * toward[term][2]));
        }
        unsigned outside = 0;
        for (unsigned cut = code >> 10; cut; cut &= cut - 1) {
            const int side = 3 * (__ffs(cut) - 1);
            float value[3];
#pragma unroll
            for (int term = 0; term < 3; ++term)
                value[term] = fmaf(block.function[side][entry], toward[term][0],
                                   fmaf(block.function[side + 1][entry], toward[term][1],
                                        fmaf(block.function[side + 2][entry], toward[term][2], near[term])));
            unsigned negative = 0;
#pragma unroll
            for (int sample = SAMPLES - 1; sample >= 0; --sample) {
                const float at_point = fmaf(points[1][sample], value[2], fmaf(points[0][sample], value[1], value[0]));
                negative = __funnelshift_l(__float_as_uint(at_point), negative, 1);
            }
            outside |= negative;
        }
        if (code >> 10) block.shown[entry][at] = ALL_POINTS & ~outside;
    }
    __syncwarp();
    unsigned long long holding = 0; // entries before that hold points
    for (unsigned long long rest = half ? 0u : reaching; rest; rest &= rest - 1) { // which of several shows where they are
        const int entry = __ffsll(rest) - 1;
        unsigned inside = block.shown[entry][pixel], overlap = inside & taken;
        for (unsigned long long others = holding; overlap && others; others &= others - 1) {
            const int other = __ffsll(others) - 1;
            const unsigned contested = block.shown[other][pixel] & overlap;
            overlap &= ~contested; // no two hold a point
            if (block.first[other] == block.first[entry]) inside &= ~contested;
            if (!contested || block.first[other] == block.first[entry]) continue;
            float nearer[3], plane[3];
#pragma unroll
            for (int axis = 0; axis < 3; ++axis) plane[axis] = fmaf(-NEARER, block.plane[axis][other], block.plane[axis][entry]);
            nearer[0] = fmaf(plane[0], center[0], fmaf(plane[1], center[1], plane[2] * center[2]));
            nearer[1] = fmaf(plane[0], across[0], fmaf(plane[1], across[1], plane[2] * across[2]));
            nearer[2] = fmaf(plane[0], down[0], fmaf(plane[1], down[1], plane[2] * down[2]));
            const float extent = 0.5f * (wp::abs(nearer[1]) + wp::abs(nearer[2]));
            unsigned won = nearer[0] > extent ? contested : 0u;
            if (wp::abs(nearer[0]) <= extent)
                for (unsigned points_left = contested; points_left; points_left &= points_left - 1) {
                    const int sample = __ffs(points_left) - 1;
                    const float x = ((float)sample + 0.5f) / SAMPLES - 0.5f;
                    const float y = ((float)(__brev(sample) / (0x80000000u / (SAMPLES / 2))) + 0.5f) / SAMPLES - 0.5f;
                    if (fmaf(y, nearer[2], fmaf(x, nearer[1], nearer[0])) > 0.0f) won |= 1u << sample;
                }
            block.shown[other][pixel] &= ~won;
            inside &= ~(contested & ~won);
        }
        block.shown[entry][pixel] = inside;
        if (inside) holding |= 1ull << entry;
        taken |= inside;
    }
    for (unsigned long long rest = holding; rest; rest &= rest - 1) { // faces of one surface are taken together
        const int entry = __ffsll(rest) - 1, first = block.first[entry];
        const unsigned shown = block.shown[entry][pixel];
        if (first < entry) block.shown[first][pixel] |= shown;
        if (shown) surfaces |= 1ull << first;
    }
}
const int bare = SAMPLES - __popc(taken);
const bool resolved = listed && (sky || 2 * bare <= SAMPLES);
if (half || outside || !resolved) surfaces = 0;
const int pairs = __popcll(surfaces);
int before = pairs;
#pragma unroll
for (int step = 1; step < 16; step *= 2) {
    const int other = __shfl_up_sync(ALL, before, step, 16);
    if (pixel >= step) before += other;
}
result[0] = __shfl_sync(ALL, before, 15);
before -= pairs;
for (int pair = before; surfaces; surfaces &= surfaces - 1) block.listed[pair++] = (unsigned short)(pixel | (__ffsll(surfaces) - 1) << 4);
__syncwarp();
result[1] = before;
result[2] = pairs;
result[3] = resolved ? bare : -1;
result[4] = sky;
result[5] = (int)__cvta_generic_to_shared(&block);
#endif
return result;
