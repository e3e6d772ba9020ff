// Finds what SAMPLES points of LANES pixels show of the faces in `seen`, and of their neighbours beyond edges that cross
// the pixels. A pixel's directions are `ray`[0] + x `ray`[1] + y `ray`[2], each [3][LANES], with x and y in `points`.
// With TIMED each is seen from a position of its own, `shift` [3][LANES] away from `origin`. Faces of one surface are taken
// together. For each of `layer_count` surfaces `number` [LANES] is how many points show it, and `middle` [2][LANES] their mean.
// Where the first rays hit one surface only, all points show it.
constexpr float NEARNESS_MIN = 1e-6f; // [1/m]: where a plane seen edge-on is extrapolated beyond its horizon
#include "edge_functions.cuh"
alignas(64) float number[MOST][LANES], middle[2][MOST][LANES];
int layer_surface[MOST], layer_part[MOST], layer_count = 0; // layer_part: a part that a first ray hit, -1 - face: none
// Bits of the lanes of which something holds.
auto lanes_where = [](const auto& holds) {
#ifndef __CUDA_ARCH__
    if constexpr (LANES == 16) {
        int values __attribute__((ext_vector_type(16)));
        using Bits = bool __attribute__((ext_vector_type(16)));
        __builtin_memcpy(&values, holds, sizeof(holds));
        return (unsigned)__builtin_bit_cast(unsigned short, __builtin_convertvector(values != 0, Bits));
    }
#endif
    return holds[0] ? 1u : 0u;
};
bool even = !sky;
for (int entry = 1; entry < seen_count; ++entry)
    even &= scene.whole_surface.data[seen[entry]] == scene.whole_surface.data[seen[0]];
if (even) {
    layer_count = 1;
    layer_surface[0] = scene.whole_surface.data[seen[0]];
    layer_part[0] = part_hit[0];
    for (int lane = 0; lane < LANES; ++lane) {
        number[0][lane] = SAMPLES;
        middle[0][0][lane] = middle[1][0][lane] = 0.0f;
    }
} else {
#ifndef __CUDA_ARCH__
    using Row = float __attribute__((ext_vector_type(SAMPLES)));
    using Bits = bool __attribute__((ext_vector_type(SAMPLES)));
    static_assert(SAMPLES == 32, "a bit of an unsigned for each point");
    constexpr auto placed = [](auto reversed) { // constants: a vector that is filled one by one is loaded slowly
        struct {
            float at[2][SAMPLES];
        } rows{};
        for (int sample = 0; sample < SAMPLES; ++sample) {
            rows.at[0][sample] = ((float)sample + 0.5f) / SAMPLES - 0.5f;
            rows.at[1][sample] = ((float)reversed(sample) + 0.5f) / SAMPLES - 0.5f;
        }
        return rows;
    }(reversed_bits);
    Row columns_of_points, rows_of_points;
    __builtin_memcpy(&columns_of_points, placed.at[0], sizeof(Row));
    __builtin_memcpy(&rows_of_points, placed.at[1], sizeof(Row));
#endif
    // Bits of the points where a linear function of a lane, of its value at the centre and its slopes, is below 0.
    auto points_below = [&](const auto& at, int lane) {
#ifdef __CUDA_ARCH__
        unsigned below = 0;
        for (int sample = 0; sample < SAMPLES; ++sample)
            below |= at[0][lane] + points[0][sample] * at[1][lane] + points[1][sample] * at[2][lane] < 0.0f ? 1u << sample : 0u;
        return below;
#else
        const Row value = at[0][lane] + columns_of_points * at[1][lane] + rows_of_points * at[2][lane];
        return __builtin_bit_cast(unsigned, __builtin_convertvector(value < 0.0f, Bits));
#endif
    };
    int layer_of[MOST], touching = 0;
    unsigned lanes_of[MOST]; // of touching faces: bits of the lanes that they reach
    float plane[MOST][3]; // of touching faces: the nearness [1/m] along a direction is its product with this
    alignas(64) float distance[TIMED ? MOST : 1][LANES]; // of their planes, by that from the origin
    alignas(64) unsigned shown[MOST][LANES]; // bits of the points that show it
    for (int entry = 0; entry < seen_count; ++entry) {
        const int face = seen[entry];
        const wp::vec3* corner = scene.whole_corner.data + 3 * (size_t)face;
        float function[3][3];
        if (functions_of(corner[0] - origin, corner[1] - origin, corner[2] - origin, function) == 0.0f) continue;
        float value[3][3][LANES]; // of each function: at the centre, and its slopes
        for (int side = 0; side < 3; ++side)
            for (int term = 0; term < 3; ++term)
                for (int lane = 0; lane < LANES; ++lane)
                    value[side][term][lane] = function[side][0] * ray[term][0][lane] + function[side][1] * ray[term][1][lane]
                                              + function[side][2] * ray[term][2][lane];
        if constexpr (TIMED)
            for (int lane = 0; lane < LANES; ++lane) {
                float along_shift[3];
                for (int side = 0; side < 3; ++side)
                    along_shift[side] = function[side][0] * shift[0][lane] + function[side][1] * shift[1][lane]
                                        + function[side][2] * shift[2][lane];
                shift_values([&](int side, int term) -> float& { return value[side][term][lane]; }, along_shift);
            }
        alignas(64) unsigned* inside = shown[touching];
        alignas(64) int reached[LANES], cut[3][LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            reached[lane] = 1;
            for (int side = 0; side < 3; ++side) {
                const float half = 0.5f * (wp::abs(value[side][1][lane]) + wp::abs(value[side][2][lane]));
                reached[lane] &= value[side][0][lane] + half >= 0.0f;
                cut[side][lane] = value[side][0][lane] - half < 0.0f;
            }
            for (int side = 0; side < 3; ++side) cut[side][lane] &= reached[lane];
            inside[lane] = reached[lane] ? ALL_POINTS : 0u;
        }
        const unsigned touched = lanes_where(reached); // bits of the lanes
        if (!touched) continue;
        const unsigned crossed[3] = {lanes_where(cut[0]), lanes_where(cut[1]), lanes_where(cut[2])};
        if (entry < MOST)
            for (int side = 0; side < 3; ++side) {
                const int beyond = crossed[side] ? scene.whole_neighbor.data[3 * (size_t)face + side] : -1;
                if (beyond >= 0 && !is_listed(beyond) && is_beyond(beyond, function[side])) list_face(beyond, -1 - beyond);
            }
        const int surface = scene.whole_surface.data[face];
        int layer = 0;
        while (layer < layer_count && layer_surface[layer] != surface) ++layer;
        if (layer == layer_count) {
            layer_surface[layer] = surface;
            layer_part[layer] = part_hit[entry];
            ++layer_count;
        }
        for (int side = 0; side < 3; ++side) {
            if (!crossed[side]) continue;
            alignas(64) float at[3][LANES];
            for (int term = 0; term < 3; ++term)
                for (int lane = 0; lane < LANES; ++lane)
                    at[term][lane] = value[side][term][lane]
                                     + OVERLAP * (value[0][term][lane] + value[1][term][lane] + value[2][term][lane]);
            for (unsigned rest = crossed[side]; rest; rest &= rest - 1) {
                const int lane = lowest_of(rest);
                inside[lane] &= ~points_below(at, lane);
            }
        }
        for (int axis = 0; axis < 3; ++axis)
            plane[touching][axis] = function[0][axis] + function[1][axis] + function[2][axis];
        if constexpr (TIMED)
            for (int lane = 0; lane < LANES; ++lane)
                distance[touching][lane] = 1.0f - (plane[touching][0] * shift[0][lane] + plane[touching][1] * shift[1][lane]
                                                   + plane[touching][2] * shift[2][lane]);
        for (int other = 0; other < touching; ++other) { // which of two shows where both are
            if (layer_of[other] == layer || !(lanes_of[other] & touched)) continue;
            alignas(64) unsigned contested[LANES], undecided[LANES];
            alignas(64) float farther[3][LANES]; // by how much the others are nearer
            alignas(64) int open[LANES];
            unsigned any = 0;
            for (int lane = 0; lane < LANES; ++lane) any |= contested[lane] = shown[other][lane] & inside[lane];
            if (!any) continue;
            auto difference = [&](int axis, int lane) {
                if constexpr (TIMED) { // distances to planes that the camera crosses are negative
                    const float own = distance[touching][lane], others = distance[other][lane];
                    return NEARER * __builtin_copysignf(own, others) * plane[other][axis]
                           - __builtin_copysignf(others, own) * plane[touching][axis];
                }
                return NEARER * plane[other][axis] - plane[touching][axis];
            };
            for (int term = 0; term < 3; ++term)
                for (int lane = 0; lane < LANES; ++lane)
                    farther[term][lane] = difference(0, lane) * ray[term][0][lane] + difference(1, lane) * ray[term][1][lane]
                                         + difference(2, lane) * ray[term][2][lane];
            for (int lane = 0; lane < LANES; ++lane) {
                const float half = 0.5f * (wp::abs(farther[1][lane]) + wp::abs(farther[2][lane]));
                const bool in_front = farther[0][lane] < -half, behind = farther[0][lane] >= half;
                shown[other][lane] &= in_front ? ~contested[lane] : ALL_POINTS;
                inside[lane] &= behind ? ~contested[lane] : ALL_POINTS;
                undecided[lane] = in_front || behind ? 0u : contested[lane];
                open[lane] = undecided[lane] != 0u;
            }
            for (unsigned rest = lanes_where(open); rest; rest &= rest - 1) {
                const int lane = lowest_of(rest);
                const unsigned in_front = points_below(farther, lane);
                shown[other][lane] &= ~(undecided[lane] & in_front);
                inside[lane] &= ~(undecided[lane] & ~in_front);
            }
        }
        lanes_of[touching] = touched;
        layer_of[touching++] = layer;
        if (!listed) break;
    }
    for (int layer = 0; layer < layer_count; ++layer) {
        alignas(64) unsigned bits[LANES] = {};
        for (int face = 0; face < touching; ++face)
            if (layer_of[face] == layer)
                for (int lane = 0; lane < LANES; ++lane) bits[lane] |= shown[face][lane];
        for (int lane = 0; lane < LANES; ++lane) {
            number[layer][lane] = bits[lane] == ALL_POINTS ? SAMPLES : 0.0f;
            middle[0][layer][lane] = middle[1][layer][lane] = 0.0f;
        }
        for (int lane = 0; lane < LANES; ++lane)
            if (bits[lane] != 0 && bits[lane] != ALL_POINTS)
                number[layer][lane] = mean_of(bits[lane], middle[0][layer][lane], middle[1][layer][lane]);
    }
}
#include "nearest_part.cuh"
// Returns the part of a layer to shade in a direction: the one that the pixel's own ray hit, if it is of this surface;
// else one that another ray hit; else, of a face that none hit, the one in this direction from the pixel's position.
auto part_of = [&](int layer, int own, const wp::vec3& from, const wp::vec3& direction) {
    if (own >= 0 && scene.face_surface.data[own] == layer_surface[layer]) return own;
    if (layer_part[layer] >= 0) return layer_part[layer];
    return nearest_part(-1 - layer_part[layer], from, direction);
};
