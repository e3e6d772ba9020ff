// Radiance of 4 x 4 pixels from the faces that the first rays hit in and around them. `unresolved_out` has a bit for each
// pixel that has to be rendered by rays. Each face is shaded once per pixel, at the middle of the points that show it.
#include "list_seen_faces.cuh"
unresolved_out.data[0] = 0xffff;
if (!listed) return;
constexpr int LANES = 16, N = 16;
#include "sample_points.cuh"
alignas(64) float ray[3][3][LANES], pixel_spread[LANES];
alignas(64) int own[LANES];
for (int lane = 0; lane < LANES; ++lane) {
    const bool inside = lane % 4 < columns && lane / 4 < rows;
    own[lane] = *wp::address(faces, instant, inside ? top + lane / 4 : top, inside ? left + lane % 4 : left);
    const int pixel = first_pixel + (inside ? (lane / 4) * width + lane % 4 : 0);
    for (int term = 0; term < 3; ++term) {
        const wp::vec4& from = *wp::address(rays, term, pixel);
        if (term == 0) pixel_spread[lane] = from[3];
        for (int axis = 0; axis < 3; ++axis) ray[term][axis][lane] = from[axis];
    }
}
for (int term = 0; term < 3; ++term)
    for (int lane = 0; lane < LANES; ++lane) {
        const wp::vec3 turned =
            wp::quat_rotate(q_WC, wp::vec3(ray[term][0][lane], ray[term][1][lane], ray[term][2][lane]));
        for (int axis = 0; axis < 3; ++axis) ray[term][axis][lane] = turned[axis];
    }
#include "cover_lanes.cuh"
if (!listed) return;
alignas(64) float whole[LANES] = {};
for (int layer = 0; layer < layer_count; ++layer)
    for (int lane = 0; lane < LANES; ++lane) whole[lane] += number[layer][lane];
int unresolved = 0;
for (int lane = 0; lane < LANES; ++lane) unresolved |= (!sky && whole[lane] < 0.5f * SAMPLES) << lane;
alignas(64) float total[3][LANES] = {}, weight[LANES];
for (int lane = 0; lane < LANES; ++lane) {
    weight[lane] = 1.0f / (sky ? (float)SAMPLES : wp::max(whole[lane], 1.0f));
    if (sky)
        for (int channel = 0; channel < 3; ++channel)
            total[channel][lane] = (1.0f - whole[lane] * weight[lane]) * scene.sky[channel];
}
auto footprint_width = [](float points_shown) { // as in `coverage.py`
    return 0.01f * SHARPNESS * wp::sqrt(points_shown / SAMPLES);
};
alignas(64) float direction[3][N], corner[3][N], normal[3][N], spread[N], share[N];
alignas(64) int faces_of[N], owner[N];
int filled = 0;
auto shade = [&]() {
    alignas(64) float ts[N], us[N], vs[N], toward[3][N];
    for (int lane = filled; lane < N; ++lane) {
        faces_of[lane] = faces_of[0];
        spread[lane] = spread[0];
        for (int axis = 0; axis < 3; ++axis) {
            direction[axis][lane] = direction[axis][0];
            corner[axis][lane] = corner[axis][0];
            normal[axis][lane] = normal[axis][0];
        }
    }
    for (int lane = 0; lane < N; ++lane) {
        const float x = direction[0][lane], y = direction[1][lane], z = direction[2][lane];
        const float square = x * x + y * y + z * z;
#ifdef __CUDA_ARCH__
        const float length = sqrtf(square);
#else
        const float length = __builtin_elementwise_sqrt(square);
#endif
        const float near = 1.0f / wp::max(corner[0][lane] + corner[1][lane] + corner[2][lane], NEARNESS_MIN);
        ts[lane] = length * near;
        us[lane] = corner[0][lane] * near;
        vs[lane] = corner[1][lane] * near;
        toward[0][lane] = x / length;
        toward[1][lane] = y / length;
        toward[2][lane] = z / length;
    }
    {
        auto& ray = toward;
        auto& faces = faces_of;
#include "shade_lanes.cuh"
        for (int lane = 0; lane < filled; ++lane)
            for (int channel = 0; channel < 3; ++channel)
                total[channel][owner[lane]] += share[lane] * radiance[channel][lane];
    }
    filled = 0;
};
int current = -1;
float function[3][3], front = 1.0f;
for (int layer = 0; layer < layer_count; ++layer)
    for (int lane = 0; lane < LANES; ++lane) {
        if (number[layer][lane] == 0.0f) continue;
        wp::vec3 toward;
        for (int axis = 0; axis < 3; ++axis)
            toward[axis] = ray[0][axis][lane] + middle[0][layer][lane] * ray[1][axis][lane]
                           + middle[1][layer][lane] * ray[2][axis][lane];
        const int part = part_of(layer, own[lane], toward);
        if (part != current) {
            const int* index = &mesh.indices[3 * (size_t)part];
            const float volume = functions_of(mesh.points[index[0]] - origin, mesh.points[index[1]] - origin,
                                              mesh.points[index[2]] - origin, function);
            front = volume < 0.0f ? -1.0f : 1.0f;
            current = part;
        }
        faces_of[filled] = part;
        owner[filled] = lane;
        spread[filled] = footprint_width(number[layer][lane]) * pixel_spread[lane];
        share[filled] = number[layer][lane] * weight[lane];
        for (int axis = 0; axis < 3; ++axis) {
            direction[axis][filled] = toward[axis];
            normal[axis][filled] = front * (function[0][axis] + function[1][axis] + function[2][axis]);
        }
        for (int side = 0; side < 3; ++side)
            corner[side][filled] = function[side][0] * toward[0] + function[side][1] * toward[1] + function[side][2] * toward[2];
        if (++filled == N) shade();
    }
if (filled) shade();
for (int lane = 0; lane < LANES; ++lane)
    for (int channel = 0; channel < 3; ++channel) radiance_out.data[lane][channel] = total[channel][lane];
unresolved_out.data[0] = unresolved;
