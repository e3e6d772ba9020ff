auto origin_of = [&](int axis, int) { return origin[axis]; };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_scene;
alignas(64) float total[3][N] = {};
const int layers = rays.shape[0];
for (int layer = layers > 1; layer < layers; ++layer) {
    alignas(64) float ray[3][N], spread[N];
    const wp::vec4* aimed = wp::address(rays, layer, first_pixel);
    if (columns == SIDE && rows == SIDE)
        for (int lane = 0; lane < N; ++lane) {
            const wp::vec4& pixel = aimed[(lane / SIDE) * width + lane % SIDE];
            for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = pixel[axis];
            spread[lane] = pixel[3];
        }
    else
        for (int lane = 0; lane < N; ++lane) {
            const bool inside = lane % SIDE < columns && lane / SIDE < rows;
            const wp::vec4& pixel = aimed[inside ? (lane / SIDE) * width + lane % SIDE : 0];
            for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = inside ? pixel[axis] : 0.0f;
            spread[lane] = inside ? pixel[3] : 0.0f;
        }
    for (int lane = 0; lane < N; ++lane) {
        const wp::vec3 turned = wp::quat_rotate(q_WC, wp::vec3(ray[0][lane], ray[1][lane], ray[2][lane]));
        for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = turned[axis];
    }
#include "embree_packet.cuh"
constexpr float slope[2][N] = {};
#include "shade_lanes.cuh"
    for (int channel = 0; channel < 3; ++channel)
        for (int lane = 0; lane < N; ++lane) total[channel][lane] += radiance[channel][lane];
}
alignas(64) float luma[N];
const float share = layers > 1 ? 1.0f / (float)(layers - 1) : 1.0f;
for (int lane = 0; lane < N; ++lane) {
    luma[lane] = 0.2126f * (share * total[0][lane]) + 0.7152f * (share * total[1][lane])
                 + 0.0722f * (share * total[2][lane]);
    luma[lane] = luma[lane] + scene.dark_floor;
}
for (int y = 0; y < rows; ++y) {
    float* out = wp::address(log_radiance_out, instant, top + y, left);
    for (int x = 0; x < columns; ++x) out[x] = wp::log(luma[SIDE * y + x]);
}
