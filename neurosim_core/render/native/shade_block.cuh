// Radiance of 4 x 4 pixels from the faces that the first rays hit in and around them. `unresolved_out` has a bit for each
// pixel that has to be rendered by rays. Each face is shaded once per pixel, at the middle of the points that show it. With TIMED
// each pixel has a pose of its own.
const int width = view.width, height = view.height;
#include "list_seen_faces.cuh"
unresolved_out.data[0] = 0xffff;
if (!listed) return;
constexpr int LANES = 16, N = 16, POSES = TIMED ? LANES : 1;
auto pose_of = [&](int row, int column) {
    return TIMED ? instant * view.pose_count + *wp::address(view.pose, 0, row * width + column) : instant;
};
const wp::vec3 origin = view.p_WC.data[pose_of(top, left)];
#include "sample_points.cuh"
alignas(64) float ray[3][3][LANES], pixel_spread[LANES];
alignas(64) int own[LANES];
alignas(64) float shift[3][POSES];
wp::vec3 position[POSES];
wp::quat q_WC[POSES];
for (int lane = 0; lane < POSES; ++lane) {
    const bool inside = lane % 4 < columns && lane / 4 < rows;
    const int pose = pose_of(inside ? top + lane / 4 : top, inside ? left + lane % 4 : left);
    position[lane] = view.p_WC.data[pose];
    q_WC[lane] = view.q_WC.data[pose];
    for (int axis = 0; axis < 3; ++axis) shift[axis][lane] = position[lane][axis] - origin[axis];
}
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
            wp::quat_rotate(q_WC[TIMED ? lane : 0], wp::vec3(ray[term][0][lane], ray[term][1][lane], ray[term][2][lane]));
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
constexpr float COSINE_MIN = 0.05f;
auto root = [](float square) {
#ifdef __CUDA_ARCH__
    return sqrtf(square);
#else
    return __builtin_elementwise_sqrt(square); // a vector instruction without a branch
#endif
};
alignas(64) float direction[3][N], from[3][N], spread[N], share[N];
alignas(64) int faces_of[N], owner[N];
int filled = 0;
auto shade = [&]() {
    alignas(64) float ts[N], us[N], vs[N], toward[3][N], normal[3][N], slope[2][N], tip[3][3][N];
    for (int lane = filled; lane < N; ++lane) {
        faces_of[lane] = faces_of[0];
        spread[lane] = spread[0];
        for (int axis = 0; axis < 3; ++axis) direction[axis][lane] = direction[axis][0];
        if constexpr (TIMED)
            for (int axis = 0; axis < 3; ++axis) from[axis][lane] = from[axis][0];
    }
    int other_faces = 0;
    for (int lane = 0; lane < N; ++lane) other_faces |= faces_of[lane] ^ faces_of[0];
    for (int lane = 0; lane < (other_faces ? N : 1); ++lane)
        for (int corner = 0; corner < 3; ++corner) {
            const wp::vec3& point = mesh.points[mesh.indices[3 * (size_t)faces_of[lane] + corner]];
            for (int axis = 0; axis < 3; ++axis) tip[corner][axis][lane] = TIMED ? point[axis] : point[axis] - origin[axis];
        }
    if (!other_faces)
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                for (int lane = 1; lane < N; ++lane) tip[corner][axis][lane] = tip[corner][axis][0];
    if constexpr (TIMED)
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                for (int lane = 0; lane < N; ++lane) tip[corner][axis][lane] -= from[axis][lane];
    for (int lane = 0; lane < N; ++lane) { // as in `meet_plane.cuh`
        float function[3][3], weight_of[3], unit[3], facing = 0.0f;
        for (int side = 0; side < 3; ++side)
            for (int axis = 0; axis < 3; ++axis) {
                const auto& from = tip[(side + 1) % 3];
                const auto& to = tip[(side + 2) % 3];
                const int next = (axis + 1) % 3, last = (axis + 2) % 3;
                function[side][axis] = from[next][lane] * to[last][lane] - from[last][lane] * to[next][lane];
            }
        const float volume = tip[0][0][lane] * function[0][0] + tip[0][1][lane] * function[0][1] + tip[0][2][lane] * function[0][2];
        const float scale = wp::abs(volume) > 1e-30f ? 1.0f / volume : 0.0f;
        const float x = direction[0][lane], y = direction[1][lane], z = direction[2][lane];
        for (int side = 0; side < 3; ++side)
            weight_of[side] = scale * (function[side][0] * x + function[side][1] * y + function[side][2] * z);
        const float length = root(x * x + y * y + z * z);
        const float near = 1.0f / wp::max(weight_of[0] + weight_of[1] + weight_of[2], NEARNESS_MIN);
        float square = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            toward[axis][lane] = direction[axis][lane] / length;
            unit[axis] = function[0][axis] + function[1][axis] + function[2][axis];
            square += unit[axis] * unit[axis];
        }
        const float size = wp::max(root(square), 1e-30f);
        for (int axis = 0; axis < 3; ++axis) {
            unit[axis] = unit[axis] / size;
            facing += unit[axis] * toward[axis][lane];
            normal[axis][lane] = unit[axis];
        }
        ts[lane] = length * near;
        us[lane] = weight_of[0] * near;
        vs[lane] = weight_of[1] * near;
        const float longer = scale * ts[lane] / wp::max(wp::abs(facing), COSINE_MIN);
        for (int side = 0; side < 2; ++side) {
            slope[side][lane] = 0.0f;
            for (int axis = 0; axis < 3; ++axis)
                slope[side][lane] += longer * function[side][axis] * (toward[axis][lane] - facing * unit[axis]);
        }
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
for (int layer = 0; layer < layer_count; ++layer)
    for (int lane = 0; lane < LANES; ++lane) {
        if (number[layer][lane] == 0.0f) continue;
        wp::vec3 toward;
        for (int axis = 0; axis < 3; ++axis)
            toward[axis] = ray[0][axis][lane] + middle[0][layer][lane] * ray[1][axis][lane]
                           + middle[1][layer][lane] * ray[2][axis][lane];
        const wp::vec3& place = position[TIMED ? lane : 0];
        faces_of[filled] = part_of(layer, own[lane], place, toward);
        if constexpr (TIMED)
            for (int axis = 0; axis < 3; ++axis) from[axis][filled] = place[axis];
        owner[filled] = lane;
        spread[filled] = footprint_width(number[layer][lane]) * pixel_spread[lane];
        share[filled] = number[layer][lane] * weight[lane];
        for (int axis = 0; axis < 3; ++axis) direction[axis][filled] = toward[axis];
        if (++filled == N) shade();
    }
if (filled) shade();
for (int lane = 0; lane < LANES; ++lane)
    for (int channel = 0; channel < 3; ++channel) radiance_out.data[lane][channel] = total[channel][lane];
unresolved_out.data[0] = unresolved;
