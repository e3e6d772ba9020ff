// CUDA: the threads of a warp find together what the 16 points of each of 4 x 4 pixels show, as `list_seen_faces.cuh` and
// `cover_lanes.cuh` do on a CPU. Threads 0 to 15 have points 0 to 7 of a pixel each, threads 16 to 31 the other points.
// Leaves pairs of a pixel and a surface that it shows in shared memory. Returns their number; the first of the pixel and how
// many; how many of its points show none, -1: it has to be rendered by rays; whether the sky is behind; where the pairs are.
wp::vec_t<6, int> result;
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
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
        block.surface[entry] = surface;
    }
    __syncwarp();
    for (int pair_of_faces = begin; pair_of_faces < end; pair_of_faces += 2) { // each half of the threads: which pixels one reaches
        const int at = wp::min(pair_of_faces + half, end - 1);
        bool reached = block.surface[at] >= 0, cut[3];
#pragma unroll
        for (int side = 0; side < 3; ++side) {
            const float function[3] = {block.function[3 * side][at], block.function[3 * side + 1][at], block.function[3 * side + 2][at]};
            auto along = [&](const wp::vec3& toward) {
                return fmaf(function[0], toward[0], fmaf(function[1], toward[1], function[2] * toward[2]));
            };
            const float middle = along(center), extent = 0.5f * (wp::abs(along(across)) + wp::abs(along(down)));
            reached &= middle + extent >= 0.0f;
            cut[side] = middle - extent < 0.0f;
        }
        unsigned reach = (__ballot_sync(ALL, reached) >> (16 * half)) & 0xffffu;
#pragma unroll
        for (int side = 0; side < 3; ++side)
            if ((__ballot_sync(ALL, reached && cut[side]) >> (16 * half)) & 0xffffu) reach |= 0x10000u << side;
        if (pixel == 0) block.reach[at] = (int)reach; // the upper bits: edges that cross pixels
    }
    __syncwarp();
    if (entry < end) {
        if ((block.reach[entry] & 0xffff) == 0) surface = -1;
        block.surface[entry] = surface;
    }
    __syncwarp();
    if (entry < end) {
        int first = entry; // entry of the same surface
        for (int other = entry - 1; other >= 0 && surface >= 0; --other)
            if (block.surface[other] == surface) first = other;
        block.first[entry] = first;
    }
    for (int base = 3 * begin; listed && base < 3 * end; base += 32) { // each thread looks beyond an edge
        const int at = wp::min((base + lane) / 3, end - 1), side = (base + lane) % 3;
        int beyond = -1;
        if (base + lane < 3 * end && (block.reach[at] >> (16 + side)) & 1)
            beyond = scene.whole_neighbor.data[3 * (size_t)block.seen[at] + side];
        const float function[3] = {block.function[3 * side][at], block.function[3 * side + 1][at], block.function[3 * side + 2][at]};
        if (beyond >= 0 && !is_beyond(beyond, function)) beyond = -1;
        for (int other = 0; other < count; ++other)
            if (block.seen[other] == beyond) beyond = -1;
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
unsigned nearest[4] = {ALL, ALL, ALL, ALL}; // of each point in a byte: the first entry of what it shows, 255: nothing
if (listed) {
    unsigned low = 0, high = 0; // entries that reach the pixel
    for (int entry = 0; entry < wp::min(count, 32); ++entry) low |= ((unsigned)(block.reach[entry] >> pixel) & 1u) << entry;
    for (int entry = 32; entry < count; ++entry) high |= ((unsigned)(block.reach[entry] >> pixel) & 1u) << (entry - 32);
    float best[SAMPLES / 2];
#pragma unroll
    for (int sample = 0; sample < SAMPLES / 2; ++sample) best[sample] = 0.0f;
    while (low | high) {
        const int entry = low ? __ffs(low) - 1 : 31 + __ffs(high);
        if (low) low &= low - 1;
        else high &= high - 1;
        const unsigned first = block.first[entry];
        float value[3][3];
#pragma unroll
        for (int side = 0; side < 3; ++side) {
            const float function[3] = {block.function[3 * side][entry], block.function[3 * side + 1][entry],
                                       block.function[3 * side + 2][entry]};
            auto along = [&](const wp::vec3& toward) {
                return fmaf(function[0], toward[0], fmaf(function[1], toward[1], function[2] * toward[2]));
            };
            value[side][0] = along(center);
            value[side][1] = along(across);
            value[side][2] = along(down);
            // `sample` counts from 8 `half`: its point is half a pixel to the right, and 1/16 further down
            value[side][0] = fmaf(half * (1.0f / 16.0f), value[side][2], fmaf(half * 0.5f, value[side][1], value[side][0]));
        }
#pragma unroll
        for (int sample = 0; sample < SAMPLES / 2; ++sample) {
            const int reversed = (sample & 1) << 3 | (sample & 2) << 1 | (sample & 4) >> 1;
            const float x = ((float)sample + 0.5f) / SAMPLES - 0.5f, y = ((float)reversed + 0.5f) / SAMPLES - 0.5f;
            float shown[3];
#pragma unroll
            for (int side = 0; side < 3; ++side) shown[side] = fmaf(y, value[side][2], fmaf(x, value[side][1], value[side][0]));
            const float near = shown[0] + shown[1] + shown[2];
            const float least = fminf(fminf(shown[0], shown[1]), shown[2]);
            const bool nearer = least >= -OVERLAP * near && near > NEARER * best[sample];
            best[sample] = nearer ? near : best[sample];
            const unsigned byte = sample % 4, selector = 0x3210u ^ ((byte ^ 4u) << (4 * byte));
            nearest[sample / 4] = nearer ? __byte_perm(nearest[sample / 4], first, selector) : nearest[sample / 4];
        }
    }
    __syncwarp();
#pragma unroll
    for (int word = 0; word < 2; ++word) {
        const unsigned own = nearest[word], other = __shfl_xor_sync(ALL, own, 16);
        nearest[word] = half ? other : own;
        nearest[2 + word] = half ? own : other;
    }
}
int bare = 0; // points that show none of the faces
#pragma unroll
for (int word = 0; word < 4; ++word) bare += __popc(__vcmpeq4(nearest[word], ALL)) / 8;
const bool resolved = listed && (sky || bare <= SAMPLES / 2);
auto shown_at = [&](int sample) {
    return (sample < 8 ? __byte_perm(nearest[0], nearest[1], sample) : __byte_perm(nearest[2], nearest[3], sample - 8)) & 255u;
};
auto points_like = [&](int sample) { // bits of the points that show what this one does
    const unsigned shown = shown_at(sample);
    unsigned bits = 0;
#pragma unroll
    for (int word = 0; word < 4; ++word) {
        const unsigned equal = __vcmpeq4(nearest[word], 0x01010101u * shown) & 0x08040201u;
        bits |= ((equal | equal >> 8 | equal >> 16 | equal >> 24) & 15u) << (4 * word);
    }
    return bits;
};
unsigned covered = 0;
#pragma unroll
for (int word = 0; word < 4; ++word) {
    const unsigned equal = ~__vcmpeq4(nearest[word], ALL) & 0x08040201u;
    covered |= ((equal | equal >> 8 | equal >> 16 | equal >> 24) & 15u) << (4 * word);
}
if (half || outside || !resolved) covered = 0;
int pairs = 0;
for (unsigned left_over = covered; left_over; ++pairs) left_over &= ~points_like(__ffs(left_over) - 1);
int before = pairs;
#pragma unroll
for (int step = 1; step < 16; step *= 2) {
    const int other = __shfl_up_sync(ALL, before, step, 16);
    if (pixel >= step) before += other;
}
result[0] = __shfl_sync(ALL, before, 15);
before -= pairs;
for (int pair = before; covered; ++pair) {
    const int sample = __ffs(covered) - 1;
    const unsigned bits = points_like(sample);
    covered &= ~bits;
    float x = 0.0f, y = 0.0f;
#pragma unroll
    for (int other = 0; other < SAMPLES; ++other) {
        const int reversed = (other & 1) << 3 | (other & 2) << 1 | (other & 4) >> 1 | (other & 8) >> 3;
        const float shows = (bits >> other) & 1u ? 1.0f : 0.0f;
        x += shows * (((float)other + 0.5f) / SAMPLES - 0.5f);
        y += shows * (((float)reversed + 0.5f) / SAMPLES - 0.5f);
    }
    const int number = __popc(bits);
    block.pair[0][pair] = __int_as_float(pixel | (int)shown_at(sample) << 8 | number << 16);
    block.pair[1][pair] = x / (float)number;
    block.pair[2][pair] = y / (float)number;
}
__syncwarp();
result[1] = before;
result[2] = pairs;
result[3] = resolved ? bare : -1;
result[4] = sky;
result[5] = (int)__cvta_generic_to_shared(&block);
#endif
return result;
