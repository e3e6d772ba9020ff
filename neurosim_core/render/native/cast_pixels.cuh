// CPU: radiance of those of 4 x 4 pixels that have a bit in `unresolved`, the mean of SAMPLES rays each, to `radiance_out`
// [3][INSTANTS][64] at 16 times `block`. Four rays of 2 x 2 pixels are a packet. `rays` has the directions of pixels: centre and
// spread, and the changes across and down.
#include "pixel_block_names.cuh"
#include "pixel_poses.cuh"
#include "sample_points.cuh"
const float width_of_ray = 1.0f / wp::sqrt((float)SAMPLES);
alignas(64) float total[3][N] = {};
for (int quarter = 0; quarter < 4; ++quarter) {
    const int corner = quarter / 2 * 2 * SIDE + quarter % 2 * 2;
    auto place_of = [&](int lane) { return corner + lane % 4 / 2 * SIDE + lane % 2; };
    auto wanted = [&](int lane) {
        const int place = place_of(lane);
        return (unresolved >> place & 1) && place % SIDE < columns && place / SIDE < rows;
    };
    if (!(wanted(0) || wanted(1) || wanted(2) || wanted(3))) continue;
    auto origin_of = [&](int axis, int lane) { return position[axis][TIMED ? place_of(lane) : 0]; };
    alignas(64) float term[3][4][N], spread[N]; // of the pixel of each lane
    for (int lane = 0; lane < N; ++lane) {
        const int place = wanted(lane) ? place_of(lane) : -1;
        for (int k = 0; k < 3; ++k)
            for (int axis = 0; axis < 4; ++axis)
                term[k][axis][lane] =
                    place < 0 ? 0.0f : (*wp::address(rays, k, first_pixel + place / SIDE * view.width + place % SIDE))[axis];
        spread[lane] = width_of_ray * term[0][3][lane];
    }
    for (int sample = 0; sample < SAMPLES; sample += N / 4) {
        alignas(64) float ray[3][N];
        for (int lane = 0; lane < N; ++lane) {
            const float x = points[0][sample + lane / 4], y = points[1][sample + lane / 4];
            float aimed[3];
            for (int axis = 0; axis < 3; ++axis)
                aimed[axis] = term[0][axis][lane] + x * term[1][axis][lane] + y * term[2][axis][lane];
            const float length = __builtin_elementwise_sqrt(aimed[0] * aimed[0] + aimed[1] * aimed[1] + aimed[2] * aimed[2]);
            const float divisor = length > 0.0f ? length : 1.0f;
            const wp::vec3 turned = turn(place_of(lane), aimed[0] / divisor, aimed[1] / divisor, aimed[2] / divisor);
            for (int axis = 0; axis < 3; ++axis) ray[axis][lane] = turned[axis];
        }
        const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_quick;
#include "embree_packet.cuh"
        constexpr float slope[2][N] = {};
#include "shade_lanes.cuh"
        for (int lane = 0; lane < N; ++lane)
            for (int channel = 0; channel < 3; ++channel) total[channel][place_of(lane)] += radiance[channel][lane];
    }
}
for (int lane = 0; lane < N; ++lane)
    if (unresolved >> lane & 1)
        for (int channel = 0; channel < 3; ++channel)
            radiance_out.data[64 * INSTANTS * channel + 16 * block + lane] = total[channel][lane] / (float)SAMPLES;
