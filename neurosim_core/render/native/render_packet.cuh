auto origin_of = [&](int axis, int) { return origin[axis]; };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_scene;
alignas(64) float total[3][N] = {};
const int layers = rays.shape[0];
for (int layer = layers > 1; layer < layers; ++layer) {
#include "aim_packet.cuh"
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
