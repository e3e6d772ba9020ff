// CUDA: the 16 threads of a block of 4 x 4 pixels find together what `list_seen_faces.cuh` and `cover_lanes.cuh` find on a
// CPU. Returns 0: the pixel shows the surface of its first ray only; 1: the surfaces of layers; -1: it has to be rendered by
// rays; whether the sky is behind; the layer of each of 16 points in a byte, 255: none; where the layers are.
wp::vec_t<7, int> result;
#ifdef __CUDA_ARCH__
struct Group {
    int seen[MOST], part[MOST], layer_surface[MOST], layer_part[MOST]; // layer_part: as in `cover_lanes.cuh`
    int surface[16], beyond[3][16];
    float function[9][16];
};
__shared__ Group groups[4];
Group& group = groups[threadIdx.x / 16 % 4];
const int lane = threadIdx.x % 16, shift = threadIdx.x & 16;
const unsigned mask = 0xffffu << shift;
auto votes = [&](bool vote) { return (__ballot_sync(mask, vote) >> shift) & 0xffffu; };
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
const int top = row / 4 * 4, left = col / 4 * 4;
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
int count = 0;
bool sky = false, listed = true;
for (int place = lane; place < 48; place += 16) {
    const int y = upper + place / 6, x = leftmost + place % 6;
    const bool inside = place < 36 && y < height && x < width;
    const int part = inside ? *wp::address(faces, instant, y, x) : -1;
    listed &= part < mesh.num_tris;
    sky |= inside && part < 0;
    const int face = part >= 0 && part < mesh.num_tris ? scene.whole_of_face.data[part] : -1;
    const unsigned same = __match_any_sync(mask, face) >> shift;
    bool first = face >= 0 && __ffs(same) - 1 == lane;
    for (int entry = 0; entry < count; ++entry) first &= group.seen[entry] != face;
    const unsigned added = votes(first);
    if (first) {
        const int entry = count + __popc(added & ((1u << lane) - 1));
        group.seen[entry] = face;
        group.part[entry] = part;
    }
    count += __popc(added);
    __syncwarp(mask);
}
sky = votes(sky) != 0;
listed = votes(!listed) == 0;
bool uneven = sky;
for (int entry = lane; entry < count; entry += 16)
    uneven |= scene.whole_surface.data[group.seen[entry]] != scene.whole_surface.data[group.seen[0]];
uneven = votes(uneven) != 0;
unsigned nearest[4] = {};
if (listed && uneven) {
#include "edge_functions.cuh"
    float best[SAMPLES];
#pragma unroll
    for (int sample = 0; sample < SAMPLES; ++sample) best[sample] = 0.0f;
    for (int word = 0; word < 4; ++word) nearest[word] = 0xffffffffu;
    int layer_count = 0;
    for (int begin = 0; listed && begin < count;) {
        const int end = wp::min(begin + 16, count);
        if (begin + lane < end) { // each thread prepares a face
            const int face = group.seen[begin + lane];
            const wp::vec3* corner = scene.whole_corner.data + 3 * (size_t)face;
            float function[3][3];
            const float volume = functions_of(corner[0] - origin, corner[1] - origin, corner[2] - origin, function);
            group.surface[lane] = volume == 0.0f ? -1 : scene.whole_surface.data[face];
            for (int side = 0; side < 3; ++side) {
                const int beyond = scene.whole_neighbor.data[3 * (size_t)face + side];
                group.beyond[side][lane] = beyond >= 0 && is_beyond(beyond, function[side]) ? beyond : -1;
                for (int axis = 0; axis < 3; ++axis) group.function[3 * side + axis][lane] = function[side][axis];
            }
        }
        __syncwarp(mask);
        for (int entry = begin; listed && entry < end; ++entry) {
            const int at = entry - begin, surface = group.surface[at];
            if (surface < 0) continue;
            float value[3][3]; // of each function: at the centre, and its slopes
            bool reached = true, cut[3];
#pragma unroll
            for (int side = 0; side < 3; ++side) {
                auto along = [&](const wp::vec3& toward) {
                    return fmaf(group.function[3 * side][at], toward[0],
                                fmaf(group.function[3 * side + 1][at], toward[1], group.function[3 * side + 2][at] * toward[2]));
                };
                value[side][0] = along(center);
                value[side][1] = along(across);
                value[side][2] = along(down);
                const float half = 0.5f * (wp::abs(value[side][1]) + wp::abs(value[side][2]));
                reached &= value[side][0] + half >= 0.0f;
                cut[side] = value[side][0] - half < 0.0f;
            }
            if (!votes(reached)) continue;
#pragma unroll
            for (int side = 0; side < 3; ++side) {
                const bool crossed = votes(reached && cut[side]) != 0;
                const int beyond = group.beyond[side][at];
                if (!crossed || beyond < 0) continue;
                bool known = false;
                for (int other = lane; other < count; other += 16) known |= group.seen[other] == beyond;
                if (votes(known)) continue;
                listed &= count < MOST;
                if (!listed) continue;
                if (lane == 0) {
                    group.seen[count] = beyond;
                    group.part[count] = -1 - beyond;
                }
                ++count;
                __syncwarp(mask);
            }
            int layer = layer_count;
            for (int other = 0; other < layer_count && layer == layer_count; other += 16) {
                const unsigned equal =
                    votes(other + lane < layer_count && group.layer_surface[wp::min(other + lane, MOST - 1)] == surface);
                if (equal) layer = other + __ffs(equal) - 1;
            }
            if (layer == layer_count) {
                if (lane == 0) {
                    group.layer_surface[layer] = surface;
                    group.layer_part[layer] = group.part[entry];
                }
                ++layer_count;
                __syncwarp(mask);
            }
            if (reached) {
#pragma unroll
                for (int sample = 0; sample < SAMPLES; ++sample) {
                    const int reversed = (sample & 1) << 3 | (sample & 2) << 1 | (sample & 4) >> 1 | (sample & 8) >> 3;
                    const float x = ((float)sample + 0.5f) / SAMPLES - 0.5f, y = ((float)reversed + 0.5f) / SAMPLES - 0.5f;
                    float shown[3];
#pragma unroll
                    for (int side = 0; side < 3; ++side) shown[side] = fmaf(y, value[side][2], fmaf(x, value[side][1], value[side][0]));
                    const float near = shown[0] + shown[1] + shown[2];
                    const float least = fminf(fminf(shown[0], shown[1]), shown[2]);
                    const bool nearer = least >= -OVERLAP * near && near > best[sample];
                    best[sample] = nearer ? near : best[sample];
                    const unsigned byte = sample % 4, selector = 0x3210u ^ ((byte ^ 4u) << (4 * byte));
                    nearest[sample / 4] = nearer ? __byte_perm(nearest[sample / 4], layer, selector) : nearest[sample / 4];
                }
            }
        }
        begin = end;
        __syncwarp(mask);
    }
    if (!sky) {
        int bare = 0; // bits of the points that show none of the faces
        for (int word = 0; word < 4; ++word) bare += __popc(__vcmpeq4(nearest[word], 0xffffffffu));
        listed &= bare <= 4 * SAMPLES;
    }
}
result[0] = listed ? uneven : -1;
result[1] = sky;
for (int word = 0; word < 4; ++word) result[2 + word] = (int)nearest[word];
result[6] = (int)__cvta_generic_to_shared(&group);
#endif
return result;
