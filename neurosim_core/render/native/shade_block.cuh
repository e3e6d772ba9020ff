// Radiance of 4 x 4 pixels from the faces that the first rays hit in and around them. `unresolved_out` has a bit for each
// pixel that has to be rendered by rays. Each face is shaded once per pixel, at the middle of the points that show it. With TIMED
// each pixel has a pose of its own.
const int width = view.width, height = view.height;
constexpr int LANES = 16, N = 16;
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
const int* const own_faces = wp::address(faces, instant, top, left);
alignas(64) int own[LANES];
const bool all = columns == 4 && rows == 4;
for (int y = 0; y < 4; ++y)
    if (all) __builtin_memcpy(own + 4 * y, own_faces + y * width, 4 * sizeof(int));
    else
        for (int x = 0; x < 4; ++x) own[4 * y + x] = own_faces[x < columns && y < rows ? y * width + x : 0];
// Whether the first rays hit one surface in the block and in the ring around it: the same place as in `list_seen_faces.cuh`.
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
int other_surface = 0, hit = 0, missed = 0;
const int surface_here = scene.face_surface.data[wp::max(own[0], 0)];
for (int y = 0; y < 6; ++y) // the same place at the next instant, which this core renders soon
    __builtin_prefetch(wp::address(faces, instant, wp::min(upper + y, height - 1), leftmost) + (size_t)height * width);
for (int y = 0; y < 6; ++y) {
    const int* const row = wp::address(faces, instant, wp::min(upper + y, height - 1));
    for (int x = 0; x < 6; ++x) {
        const int part = row[wp::min(leftmost + x, width - 1)];
        missed |= part;
        hit |= ~part;
        const volatile int& surface = scene.face_surface.data[wp::max(part, 0)]; // volatile: a vector gather takes longer
        other_surface |= surface ^ surface_here;
    }
}
if (hit >= 0) { // all of it is the sky
    for (int lane = 0; lane < LANES; ++lane) radiance_out.data[lane] = scene.sky;
    unresolved_out.data[0] = 0;
    return;
}
other_surface |= missed < 0;
#include "pixel_poses.cuh"
const wp::vec3 origin(position[0][0], position[1][0], position[2][0]);
alignas(64) float shift[3][POSES]; // of the positions from `origin`
for (int lane = 0; lane < POSES; ++lane)
    for (int axis = 0; axis < 3; ++axis) shift[axis][lane] = position[axis][lane] - origin[axis];
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
auto footprint_width = [](float points_shown) { // as in `coverage.py`
    return 0.01f * SHARPNESS * __builtin_elementwise_sqrt(points_shown / SAMPLES);
};
constexpr int PAIRS_MAX = LANES * SAMPLES; // of a pixel and a surface that it shows
alignas(64) float direction[3][PAIRS_MAX], spread_of[PAIRS_MAX], share[PAIRS_MAX], total[3][LANES] = {};
alignas(64) int faces_of[PAIRS_MAX], owner[PAIRS_MAX];
int pair_count = 0, unresolved = 0;
if (!other_surface) {
    for (int lane = 0; lane < LANES; ++lane) {
        faces_of[lane] = own[lane];
        owner[lane] = lane;
        spread_of[lane] = footprint_width(SAMPLES) * ray[0][3][lane];
        share[lane] = 1.0f;
        for (int axis = 0; axis < 3; ++axis) direction[axis][lane] = ray[0][axis][lane];
    }
    pair_count = LANES;
} else {
    unresolved_out.data[0] = 0xffff;
#include "list_seen_faces.cuh"
    if (!listed) return;
    turn_rays(1);
    turn_rays(2);
#include "sample_points.cuh"
#include "cover_lanes.cuh"
    if (!listed) return;
    alignas(64) float whole[LANES] = {}, weight[LANES];
    for (int layer = 0; layer < layer_count; ++layer)
        for (int lane = 0; lane < LANES; ++lane) whole[lane] += number[layer][lane];
    for (int lane = 0; lane < LANES; ++lane) {
        unresolved |= (!sky && whole[lane] < 0.5f * SAMPLES) << lane;
        weight[lane] = 1.0f / (sky ? (float)SAMPLES : wp::max(whole[lane], 1.0f));
        if (sky)
            for (int channel = 0; channel < 3; ++channel)
                total[channel][lane] = (1.0f - whole[lane] * weight[lane]) * scene.sky[channel];
    }
    for (int layer = 0; layer < layer_count; ++layer) {
        alignas(64) float middles[3][LANES], spreads[LANES], shares[LANES];
        alignas(64) int shows[LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            for (int axis = 0; axis < 3; ++axis)
                middles[axis][lane] = ray[0][axis][lane] + middle[0][layer][lane] * ray[1][axis][lane]
                                      + middle[1][layer][lane] * ray[2][axis][lane];
            spreads[lane] = footprint_width(number[layer][lane]) * ray[0][3][lane];
            shares[lane] = number[layer][lane] * weight[lane];
            shows[lane] = number[layer][lane] != 0.0f;
        }
        for (unsigned rest = lanes_where(shows); rest; rest &= rest - 1) {
            const int lane = lowest_of(rest);
            const int pose = TIMED ? lane : 0;
            const wp::vec3 from(position[0][pose], position[1][pose], position[2][pose]);
            const wp::vec3 toward(middles[0][lane], middles[1][lane], middles[2][lane]);
            faces_of[pair_count] = part_of(layer, own[lane], from, toward);
            owner[pair_count] = lane;
            spread_of[pair_count] = spreads[lane];
            share[pair_count] = shares[lane];
            for (int axis = 0; axis < 3; ++axis) direction[axis][pair_count] = toward[axis];
            ++pair_count;
        }
    }
    for (int pair = pair_count; pair % N != 0; ++pair) {
        faces_of[pair] = faces_of[pair_count - 1];
        owner[pair] = owner[pair_count - 1];
        spread_of[pair] = spread_of[pair_count - 1];
        for (int axis = 0; axis < 3; ++axis) direction[axis][pair] = direction[axis][pair_count - 1];
    }
}
constexpr float NEARNESS_MIN = 1e-6f, COSINE_MIN = 0.05f; // as in `meet_plane.cuh`
auto root = [](float square) { return __builtin_elementwise_sqrt(square); }; // a vector instruction without a branch
for (int begin = 0; begin < pair_count; begin += N) {
    const int* const parts = faces_of + begin;
    alignas(64) float ts[N], us[N], vs[N], toward[3][N], normal[3][N], slope[2][N], tip[3][3][N];
    int other_faces = 0;
    for (int lane = 0; lane < N; ++lane) other_faces |= parts[lane] ^ parts[0];
    for (int lane = 0; lane < (other_faces ? N : 1); ++lane)
        for (int corner = 0; corner < 3; ++corner) {
            const wp::vec3& point = mesh.points[mesh.indices[3 * (size_t)parts[lane] + corner]];
            for (int axis = 0; axis < 3; ++axis) tip[corner][axis][lane] = TIMED ? point[axis] : point[axis] - origin[axis];
        }
    if (!other_faces)
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                for (int lane = 1; lane < N; ++lane) tip[corner][axis][lane] = tip[corner][axis][0];
    if constexpr (TIMED)
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                for (int lane = 0; lane < N; ++lane) tip[corner][axis][lane] -= position[axis][owner[begin + lane]];
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
        const float x = direction[0][begin + lane], y = direction[1][begin + lane], z = direction[2][begin + lane];
        for (int side = 0; side < 3; ++side)
            weight_of[side] = scale * (function[side][0] * x + function[side][1] * y + function[side][2] * z);
        const float length = root(x * x + y * y + z * z);
        const float near = 1.0f / wp::max(weight_of[0] + weight_of[1] + weight_of[2], NEARNESS_MIN);
        float square = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            toward[axis][lane] = direction[axis][begin + lane] / length;
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
        const auto& ray = toward;
        const int* const faces = parts;
        const float* const spread = spread_of + begin;
#include "shade_lanes.cuh"
        for (int lane = 0; lane < wp::min(pair_count - begin, N); ++lane)
            for (int channel = 0; channel < 3; ++channel)
                total[channel][owner[begin + lane]] += share[begin + lane] * radiance[channel][lane];
    }
}
for (int lane = 0; lane < LANES; ++lane)
    for (int channel = 0; channel < 3; ++channel) radiance_out.data[lane][channel] = total[channel][lane];
unresolved_out.data[0] = unresolved;
