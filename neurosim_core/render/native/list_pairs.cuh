// Lists what the 4 x 4 pixels at `top`, `left` show in `pairs`, and returns a bit for each pixel that has to be rendered by rays.
const int rows = wp::min(height - top, 4), columns = wp::min(width - left, 4), first_pixel = first_ray + top * width + left;
const bool all = columns == 4 && rows == 4;
const int* const own_faces = wp::address(faces, instant, top, left);
alignas(64) int own[LANES];
for (int y = 0; y < 4; ++y)
    if (all) __builtin_memcpy(own + 4 * y, own_faces + y * width, 4 * sizeof(int));
    else
        for (int x = 0; x < 4; ++x) own[4 * y + x] = own_faces[x < columns && y < rows ? y * width + x : 0];
#include "pixel_poses.cuh"
#include "aim_rays.cuh"
alignas(64) float ray[3][4][LANES]; // direction at the centres of pixels, and its changes across and down; in [0][3] the spread
auto turn_rays = [&](int term) {
    const wp::vec4* const aimed = wp::address(rays, term, first_pixel);
    auto ray_of = [&](int lane) {
        return all || (lane % 4 < columns && lane / 4 < rows) ? aimed + lane / 4 * width + lane % 4 : aimed;
    };
    aim_rays(ray_of, ray[term]);
};
turn_rays(0);
auto footprint_width = [](float points_shown) { // as in `antialias_groups.py`
    return 0.01f * SHARPNESS * __builtin_elementwise_sqrt(points_shown / SAMPLES);
};
if constexpr (TIMED)
    for (int axis = 0; axis < 3; ++axis)
        for (int lane = 0; lane < LANES; ++lane) seen_from[axis][LANES * block + lane] = position[axis][lane];
if (one_surface) {
    Pairs& packet = pairs[pair_count / N];
    for (int lane = 0; lane < LANES; ++lane) {
        packet.face[lane] = own[lane];
        packet.owner[lane] = LANES * block + lane;
        packet.spread[lane] = footprint_width(SAMPLES) * ray[0][3][lane];
        packet.share[lane] = 1.0f;
        for (int axis = 0; axis < 3; ++axis) packet.direction[axis][lane] = ray[0][axis][lane];
    }
    pair_count += LANES;
    return 0;
}
#include "list_seen_faces.cuh"
if (!listed) return 0xffff;
const wp::vec3 origin(position[0][0], position[1][0], position[2][0]);
alignas(64) float shift[3][POSES]; // of the positions from `origin`
for (int lane = 0; lane < POSES; ++lane)
    for (int axis = 0; axis < 3; ++axis) shift[axis][lane] = position[axis][lane] - origin[axis];
turn_rays(1);
turn_rays(2);
#include "sample_points.cuh"
#include "cover_lanes.cuh"
if (!listed) return 0xffff;
alignas(64) float whole[LANES] = {}, weight[LANES];
int unresolved = 0;
for (int layer = 0; layer < layer_count; ++layer)
    for (int lane = 0; lane < LANES; ++lane) whole[lane] += number[layer][lane];
for (int lane = 0; lane < LANES; ++lane) {
    unresolved |= (!sky && whole[lane] < 0.5f * SAMPLES) << lane;
    weight[lane] = 1.0f / (sky ? (float)SAMPLES : wp::max(whole[lane], 1.0f));
    if (sky)
        for (int channel = 0; channel < 3; ++channel)
            total[channel][LANES * block + lane] = (1.0f - whole[lane] * weight[lane]) * scene.sky[channel];
}
alignas(64) int own_surface[LANES];
for (int lane = 0; lane < LANES; ++lane) own_surface[lane] = own[lane] < 0 ? -1 : scene.face_surface.data[own[lane]];
for (int layer = 0; layer < layer_count; ++layer) {
    alignas(64) float middles[3][LANES], spreads[LANES], shares[LANES];
    alignas(64) int shows[LANES], parts[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        for (int axis = 0; axis < 3; ++axis)
            middles[axis][lane] = ray[0][axis][lane] + middle[0][layer][lane] * ray[1][axis][lane]
                                  + middle[1][layer][lane] * ray[2][axis][lane];
        spreads[lane] = footprint_width(number[layer][lane]) * ray[0][3][lane];
        shares[lane] = number[layer][lane] * weight[lane];
        shows[lane] = number[layer][lane] != 0.0f;
        parts[lane] = own_surface[lane] == layer_surface[layer] ? own[lane] : layer_part[layer];
    }
    for (unsigned rest = lanes_where(shows); rest; rest &= rest - 1) {
        const int lane = lowest_of(rest), pose = TIMED ? lane : 0;
        const wp::vec3 from(position[0][pose], position[1][pose], position[2][pose]);
        const wp::vec3 toward(middles[0][lane], middles[1][lane], middles[2][lane]);
        Pairs& packet = pairs[pair_count / N];
        const int place = pair_count++ % N;
        packet.face[place] = parts[lane] >= 0 ? parts[lane] : nearest_part(-1 - parts[lane], from, toward);
        packet.owner[place] = LANES * block + lane;
        packet.spread[place] = spreads[lane];
        packet.share[place] = shares[lane];
        for (int axis = 0; axis < 3; ++axis) packet.direction[axis][place] = toward[axis];
    }
}
return unresolved;
