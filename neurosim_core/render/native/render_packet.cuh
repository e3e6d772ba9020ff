#include "pixel_block_names.cuh"
const wp::vec3 origin = *wp::address(view.p_WC, instant);
const wp::quat q_WC = *wp::address(view.q_WC, instant);
const auto& rays = view.rays;
const int width = view.width;
auto origin_of = [&](int axis, int) { return origin[axis]; };
auto turn = [&](int, float x, float y, float z) { return wp::quat_rotate(q_WC, wp::vec3(x, y, z)); };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_scene;
alignas(64) float total[3][N] = {};
const int layers = rays.shape[0];
#include "aim_rays.cuh"
// Of four layers a packet has 2 x 2 pixels, whose rays are closer together than those of 4 x 4 pixels of one layer.
const bool all = columns == SIDE && rows == SIDE;
const int samples = layers > 1 ? layers - 1 : 1, together = samples % 4 == 0 ? 4 : 1;
for (int sample = 0; sample < samples; ++sample) {
    const int quarter = sample % 4, corner = quarter / 2 * 2 * SIDE + quarter % 2 * 2;
    auto place_of = [&](int lane) { return corner + lane % 4 / 2 * SIDE + lane % 2; };
    const int layer = layers > 1 ? 1 + (together == 4 ? sample - quarter : sample) : 0;
    const wp::vec4* const aimed = wp::address(rays, layer, first_pixel);
    auto inside = [&](int x, int y) { return all || (x < columns && y < rows); };
    alignas(64) float ray[4][N];
    if (together == 1)
        aim_rays([&](int lane) { return inside(lane % SIDE, lane / SIDE) ? aimed + lane / SIDE * width + lane % SIDE : nullptr; }, ray);
    else
        aim_rays([&](int lane) {
            const int x = place_of(lane) % SIDE, y = place_of(lane) / SIDE;
            return inside(x, y) ? aimed + (size_t)(lane / 4) * rays.shape[1] + y * width + x : nullptr;
        }, ray);
    const auto& spread = ray[3];
#include "embree_packet.cuh"
    constexpr float slope[2][N] = {};
#include "shade_lanes.cuh"
    if (together == 1)
        for (int channel = 0; channel < 3; ++channel)
            for (int lane = 0; lane < N; ++lane) total[channel][lane] += radiance[channel][lane];
    else
        for (int lane = 0; lane < N; ++lane)
            for (int channel = 0; channel < 3; ++channel) total[channel][place_of(lane)] += radiance[channel][lane];
}
const float dark_floor = scene.dark_floor, share = layers > 1 ? 1.0f / (float)(layers - 1) : 1.0f;
auto radiance_of = [&](int channel, int lane) { return share * total[channel][lane]; };
#include "log_luma.cuh"
