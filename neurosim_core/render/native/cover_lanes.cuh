// Finds what SAMPLES points of LANES pixels show of the faces in `seen`, and of their neighbours beyond edges that cross
// the pixels. A pixel's directions are `ray`[0] + x `ray`[1] + y `ray`[2], each [3][LANES], with x and y in `points`.
// With TIMED each is seen from a position of its own, `shift` [3][LANES] away from `origin`. Faces of one surface are taken
// together. For each of `layer_count` surfaces `number` [LANES] is how many points show it, and `middle` [2][LANES] their mean.
// Where the first rays hit one surface only, all points show it.
constexpr float NEARNESS_MIN = 1e-6f; // [1/m]: where a plane seen edge-on is extrapolated beyond its horizon
#include "edge_functions.cuh"
alignas(64) float number[MOST][LANES], middle[2][MOST][LANES];
alignas(64) int layer_surface[MOST];
int layer_part[MOST], layer_count = 0; // layer_part: a part that a first ray hit, -1 - face: none
// Bits of the lanes of which something holds, and of the first `count` of MOST entries.
using Lanes = int __attribute__((ext_vector_type(LANES)));
auto lanes_of_values = [](auto values) {
    using LaneBits = bool __attribute__((ext_vector_type(sizeof(values) / sizeof(int))));
    if constexpr (sizeof(values) == sizeof(int)) return values[0] != 0 ? 1u : 0u;
    else return (unsigned)__builtin_bit_cast(unsigned short, __builtin_convertvector(values != 0, LaneBits));
};
auto vector_of = [](const auto& values) {
    Lanes vector;
    __builtin_memcpy(&vector, values, sizeof(vector));
    return vector;
};
auto lanes_where = [&](const auto& holds) { return lanes_of_values(vector_of(holds)); };
using Sixteen = int __attribute__((ext_vector_type(16)));
using SixteenBits = bool __attribute__((ext_vector_type(16)));
static_assert(MOST % 16 == 0);
auto entries_where = [](int count, auto holds_of) {
    unsigned long long bits = 0;
    for (int begin = 0; begin < MOST; begin += 16) {
        const auto holds = __builtin_convertvector(holds_of(begin), SixteenBits);
        bits |= (unsigned long long)__builtin_bit_cast(unsigned short, holds) << begin;
    }
    return bits & ((1ull << count) - 1);
};
auto sixteen_of = [](const auto* values) {
    Sixteen sixteen;
    __builtin_memcpy(&sixteen, values, sizeof(sixteen));
    return sixteen;
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
    // Bits of the points where a linear function of a lane, of its value at the centre and its slopes, is below 0.
    auto points_below = [&](const auto& at, int lane) {
        const Row value = at[0][lane] + columns_of_points * at[1][lane] + rows_of_points * at[2][lane];
        return __builtin_bit_cast(unsigned, __builtin_convertvector(value < 0.0f, Bits));
    };
    Lanes own_place; // of each lane
    for (int lane = 0; lane < LANES; ++lane) own_place[lane] = lane;
    alignas(64) int layer_of[MOST], lanes_of[MOST]; // of touching faces; lanes_of: bits of the lanes that show it
    int touching = 0;
    float plane[MOST][3]; // of touching faces: the nearness [1/m] along a direction is its product with this
    alignas(64) float distance[TIMED ? MOST : 1][LANES]; // of their planes, by that from the origin
    alignas(64) int shown[MOST][LANES]; // bits of the points that show it
    constexpr int WAVE = 8; // faces whose functions are computed side by side
    for (int begin = 0, end; begin < seen_count && listed; begin = end) { // neighbours that are listed meanwhile come later
        end = wp::min(begin + WAVE, seen_count);
        float function[WAVE][3][3];
        alignas(64) float value[WAVE][3][3][LANES]; // of each function: at the centre, and its slopes
        alignas(64) int reached_by[WAVE][LANES]; // -1: reached
        unsigned crossed_by[WAVE][3]; // bits of the lanes that its sides cross
        for (int entry = begin; entry < end; ++entry) {
            const int member = entry - begin;
            const wp::vec3* const corner = scene.whole_corner.data + 3 * (size_t)seen[entry];
            const float volume = functions_of(corner[0] - origin, corner[1] - origin, corner[2] - origin, function[member]);
            auto& values = value[member];
            for (int side = 0; side < 3; ++side)
                for (int term = 0; term < 3; ++term)
                    for (int lane = 0; lane < LANES; ++lane)
                        values[side][term][lane] = function[member][side][0] * ray[term][0][lane]
                                                   + function[member][side][1] * ray[term][1][lane]
                                                   + function[member][side][2] * ray[term][2][lane];
            if constexpr (TIMED)
                for (int lane = 0; lane < LANES; ++lane) {
                    float along_shift[3];
                    for (int side = 0; side < 3; ++side)
                        along_shift[side] = function[member][side][0] * shift[0][lane] + function[member][side][1] * shift[1][lane]
                                            + function[member][side][2] * shift[2][lane];
                    shift_values([&](int side, int term) -> float& { return values[side][term][lane]; }, along_shift);
                }
            auto& reached = reached_by[member];
            alignas(64) int cut[3][LANES];
            for (int lane = 0; lane < LANES; ++lane) {
                reached[lane] = volume != 0.0f ? -1 : 0;
                for (int side = 0; side < 3; ++side) {
                    const float half = 0.5f * (wp::abs(values[side][1][lane]) + wp::abs(values[side][2][lane]));
                    reached[lane] &= values[side][0][lane] + half >= 0.0f ? -1 : 0;
                    cut[side][lane] = values[side][0][lane] - half < 0.0f;
                }
                for (int side = 0; side < 3; ++side) cut[side][lane] &= reached[lane];
            }
            for (int side = 0; side < 3; ++side) crossed_by[member][side] = lanes_where(cut[side]);
        }
        for (int entry = begin; entry < end && listed; ++entry) {
            const int member = entry - begin, face = seen[entry];
            const Lanes reached = vector_of(reached_by[member]);
            if (!lanes_of_values(reached)) continue;
            const auto& crossed = crossed_by[member];
            const auto& values = value[member];
            const int* const neighbors = scene.whole_neighbor.data + 3 * (size_t)face;
            unsigned unlisted = 0; // bits of sides: computed without branches, which would mostly be mispredicted
            for (int side = 0; side < 3; ++side)
                unlisted |= (unsigned)((crossed[side] != 0) & (neighbors[side] >= 0) & !is_listed(neighbors[side])) << side;
            for (; unlisted; unlisted &= unlisted - 1) {
                const int side = lowest_of(unlisted), beyond = neighbors[side];
                if (is_beyond(beyond, function[member][side]) && !is_listed(beyond)) list_face(beyond, -1 - beyond);
            }
            const int surface = scene.whole_surface.data[face];
            const auto layers = entries_where(layer_count, [&](int begin) { return sixteen_of(layer_surface + begin) == surface; });
            const int layer = layers ? __builtin_ctzll(layers) : layer_count;
            if (!layers) {
                layer_surface[layer] = surface;
                layer_part[layer_count++] = part_hit[entry];
            }
            alignas(64) float at[3][3 * LANES]; // of the edges
            for (int term = 0; term < 3; ++term)
                for (int side = 0; side < 3; ++side)
                    for (int lane = 0; lane < LANES; ++lane)
                        at[term][side * LANES + lane]
                            = values[side][term][lane]
                              + OVERLAP * (values[0][term][lane] + values[1][term][lane] + values[2][term][lane]);
            Lanes outside = 0; // bits of points beyond the edges
            auto crossings = crossed[0] | (unsigned long long)crossed[1] << LANES | (unsigned long long)crossed[2] << 2 * LANES;
            for (; crossings; crossings &= crossings - 1) {
                const int crossing = __builtin_ctzll(crossings);
                outside |= (Lanes)(int)points_below(at, crossing) & (own_place == crossing % LANES);
            }
            Lanes inside = reached & ~outside; // bits of points
            const unsigned touched = lanes_of_values(inside);
            if (!touched) continue;
            for (int axis = 0; axis < 3; ++axis)
                plane[touching][axis] = function[member][0][axis] + function[member][1][axis] + function[member][2][axis];
            if constexpr (TIMED)
                for (int lane = 0; lane < LANES; ++lane)
                    distance[touching][lane] = 1.0f - (plane[touching][0] * shift[0][lane] + plane[touching][1] * shift[1][lane]
                                                       + plane[touching][2] * shift[2][lane]);
            auto rivals = entries_where(touching, [&](int begin) {
                return (sixteen_of(layer_of + begin) != layer) & ((sixteen_of(lanes_of + begin) & (int)touched) != 0);
            });
            for (; rivals; rivals &= rivals - 1) { // which of two shows where both are
                const int other = __builtin_ctzll(rivals);
                const Lanes others = vector_of(shown[other]), contested = others & inside;
                if (!lanes_of_values(contested)) continue;
                auto difference = [&](int axis, int lane) {
                    if constexpr (TIMED) { // distances to planes that the camera crosses are negative
                        const float own = distance[touching][lane], others = distance[other][lane];
                        return NEARER * __builtin_copysignf(own, others) * plane[other][axis]
                               - __builtin_copysignf(others, own) * plane[touching][axis];
                    }
                    return NEARER * plane[other][axis] - plane[touching][axis];
                };
                alignas(64) float farther[3][LANES]; // by how much the others are nearer
                for (int term = 0; term < 3; ++term)
                    for (int lane = 0; lane < LANES; ++lane)
                        farther[term][lane] = difference(0, lane) * ray[term][0][lane] + difference(1, lane) * ray[term][1][lane]
                                             + difference(2, lane) * ray[term][2][lane];
                alignas(64) int in_front[LANES], open[LANES]; // in_front: bits of points
                for (int lane = 0; lane < LANES; ++lane) {
                    const float half = 0.5f * (wp::abs(farther[1][lane]) + wp::abs(farther[2][lane]));
                    in_front[lane] = farther[0][lane] < -half ? -1 : 0;
                    open[lane] = farther[0][lane] >= -half && farther[0][lane] < half ? -1 : 0;
                }
                Lanes nearer = vector_of(in_front);
                for (unsigned rest = lanes_of_values(vector_of(open) & contested); rest; rest &= rest - 1) {
                    const int lane = lowest_of(rest);
                    nearer |= (Lanes)(int)points_below(farther, lane) & (own_place == lane);
                }
                const Lanes left = others & ~(contested & nearer);
                __builtin_memcpy(shown[other], &left, sizeof(left));
                lanes_of[other] = lanes_of_values(left);
                inside &= ~(contested & ~nearer);
            }
            __builtin_memcpy(shown[touching], &inside, sizeof(inside));
            lanes_of[touching] = lanes_of_values(inside);
            layer_of[touching++] = layer;
        }
    }
    alignas(64) unsigned bits[MOST][LANES];
    for (int layer = 0; layer < layer_count; ++layer)
        for (int lane = 0; lane < LANES; ++lane) bits[layer][lane] = 0;
    for (int face = 0; face < touching; ++face)
        for (int lane = 0; lane < LANES; ++lane) bits[layer_of[face]][lane] |= shown[face][lane];
    for (int layer = 0; layer < layer_count; ++layer)
        for (int lane = 0; lane < LANES; ++lane)
            number[layer][lane] = mean_of(bits[layer][lane], middle[0][layer][lane], middle[1][layer][lane]);
}
#include "nearest_part.cuh"
// Returns the part of a layer to shade in a direction: the one that the pixel's own ray hit, if it is of this surface;
// else one that another ray hit; else, of a face that none hit, the one in this direction from the pixel's position.
auto part_of = [&](int layer, int own, const wp::vec3& from, const wp::vec3& direction) {
    if (own >= 0 && scene.face_surface.data[own] == layer_surface[layer]) return own;
    if (layer_part[layer] >= 0) return layer_part[layer];
    return nearest_part(-1 - layer_part[layer], from, direction);
};
