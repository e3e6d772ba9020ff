// Finds what SAMPLES points of LANES pixels show of the faces in `seen`, and of their neighbours beyond edges that cross
// the pixels. A pixel's directions are `ray`[0] + x `ray`[1] + y `ray`[2], each [3][LANES], with x and y in `points`.
// Faces of one surface are taken together. For each of `layer_count` surfaces `number` [LANES] is how many points show it,
// and `middle` [2][LANES] their mean. Where the first rays hit one surface only, all points show it.
constexpr float NEARNESS_MIN = 1e-6f; // [1/m]: where a plane seen edge-on is extrapolated beyond its horizon
#include "edge_functions.cuh"
alignas(64) float number[MOST][LANES], middle[2][MOST][LANES];
int layer_surface[MOST], layer_part[MOST], layer_count = 0; // layer_part: a part that a first ray hit, -1 - face: none
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
    int layer_of[MOST], touching[MOST], touching_count = 0;
    alignas(64) float best[SAMPLES][LANES];
    alignas(64) int nearest[SAMPLES][LANES]; // layer
    for (int sample = 0; sample < SAMPLES; ++sample)
        for (int lane = 0; lane < LANES; ++lane) {
            best[sample][lane] = 0.0f;
            nearest[sample][lane] = -1;
        }
    const int hit_count = seen_count;
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
        int touched = 0, crossed[3] = {};
        for (int lane = 0; lane < LANES; ++lane) {
            int reached = 1, cut[3];
            for (int side = 0; side < 3; ++side) {
                const float half = 0.5f * (wp::abs(value[side][1][lane]) + wp::abs(value[side][2][lane]));
                reached &= value[side][0][lane] + half >= 0.0f;
                cut[side] = value[side][0][lane] - half < 0.0f;
            }
            touched |= reached;
            for (int side = 0; side < 3; ++side) crossed[side] |= cut[side] & reached;
        }
        if (!touched) continue;
        if (entry < MOST)
            for (int side = 0; side < 3; ++side) {
                const int beyond = crossed[side] ? scene.whole_neighbor.data[3 * (size_t)face + side] : -1;
                if (beyond >= 0 && is_beyond(beyond, function[side])) list_face(beyond, -1 - beyond);
            }
        const int surface = scene.whole_surface.data[face];
        int layer = 0;
        while (layer < layer_count && layer_surface[layer] != surface) ++layer;
        if (layer == layer_count) {
            layer_surface[layer] = surface;
            layer_part[layer] = part_hit[entry];
            ++layer_count;
        }
        for (int sample = 0; sample < SAMPLES; ++sample)
            for (int lane = 0; lane < LANES; ++lane) {
                float at[3];
                for (int side = 0; side < 3; ++side)
                    at[side] = value[side][0][lane] + points[0][sample] * value[side][1][lane]
                               + points[1][sample] * value[side][2][lane];
                const float near = at[0] + at[1] + at[2];
                const float least = wp::min(wp::min(at[0], at[1]), at[2]);
                const bool nearer = least >= -OVERLAP * near && near > NEARER * best[sample][lane];
                best[sample][lane] = nearer ? near : best[sample][lane];
                nearest[sample][lane] = nearer ? layer : nearest[sample][lane];
            }
        if (!listed) break;
    }
    for (int layer = 0; layer < layer_count; ++layer) {
        float count[LANES] = {}, x[LANES] = {}, y[LANES] = {};
        for (int sample = 0; sample < SAMPLES; ++sample)
            for (int lane = 0; lane < LANES; ++lane) {
                const float shows = nearest[sample][lane] == layer ? 1.0f : 0.0f;
                count[lane] += shows;
                x[lane] += shows * points[0][sample];
                y[lane] += shows * points[1][sample];
            }
        for (int lane = 0; lane < LANES; ++lane) {
            const float share = 1.0f / wp::max(count[lane], 1.0f);
            number[layer][lane] = count[lane];
            middle[0][layer][lane] = share * x[lane];
            middle[1][layer][lane] = share * y[lane];
        }
    }
}
#include "nearest_part.cuh"
// Returns the part of a layer to shade in a direction: the one that the pixel's own ray hit, if it is of this surface;
// else one that another ray hit; else, of a face that none hit, the one in this direction.
auto part_of = [&](int layer, int own, const wp::vec3& direction) {
    if (own >= 0 && scene.whole_surface.data[scene.whole_of_face.data[own]] == layer_surface[layer]) return own;
    if (layer_part[layer] >= 0) return layer_part[layer];
    return nearest_part(-1 - layer_part[layer], direction);
};
