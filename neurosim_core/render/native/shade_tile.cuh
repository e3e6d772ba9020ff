// CPU: radiance of the 8 x 8 pixels at `tile_top`, `tile_left` at those of INSTANTS instants that have a bit in `wanted`, from the
// faces that the first rays hit in and around them, to `radiance_out` [3][INSTANTS][64], one block of 4 x 4 pixels after another.
// `unresolved_out` [INSTANTS][4] has a bit for each pixel of a block that has to be rendered by rays. Each face is shaded once per
// pixel, at the middle of the points that show it. These pairs are collected, and then shaded 16 at a time: each stage is done for
// all instants, so that its instructions stay in the cache. With TIMED each pixel has a pose of its own.
const int width = view.width, height = view.height, first_ray = tile.first_ray;
const int first_instant = tile.instant, tile_top = tile.top, tile_left = tile.left;
constexpr int LANES = 16, N = 16, BLOCKS = 4 * INSTANTS;
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
struct alignas(64) Pairs { // of a pixel, `owner`, and a surface that it shows
    float direction[3][N], spread[N], share[N];
    int face[N], owner[N];
} pairs[BLOCKS * SAMPLES];
int pair_count = 0;
alignas(64) float total[3][BLOCKS * LANES] = {}, seen_from[3][TIMED ? BLOCKS * LANES : 1];
#include "transpose_quads.cuh"
auto list_pairs = [&](int block, int instant, int top, int left, bool one_surface) -> int {
#include "list_pairs.cuh"
};
enum { SKY, ONE_SURFACE, SEVERAL, OUTSIDE };
auto kind_of = [&](int instant, int top, int left) {
#include "block_kind.cuh"
};
int kinds[BLOCKS];
for (int block = 0; block < BLOCKS; ++block) {
    const int instant = first_instant + block / 4, top = tile_top + block % 4 / 2 * 4, left = tile_left + block % 2 * 4;
    if (block % 4 == 0)
        for (int y = -1; y < 9; ++y) // the same place INSTANTS later, which this core renders soon
            for (int x = -1; x < 9; x += 9) {
                const int row = wp::clamp(tile_top + y, 0, height - 1), column = wp::clamp(tile_left + x, 0, width - 1);
                __builtin_prefetch(wp::address(faces, instant, row, column) + (size_t)INSTANTS * height * width);
            }
    kinds[block] = (wanted >> block / 4 & 1) && top < height && left < width ? kind_of(instant, top, left) : OUTSIDE;
    unresolved_out.data[block] = 0;
    if (kinds[block] == SKY)
        for (int channel = 0; channel < 3; ++channel)
            for (int lane = 0; lane < LANES; ++lane) total[channel][LANES * block + lane] = scene.sky[channel];
}
for (int turn = 0; turn < 2 * BLOCKS; ++turn) { // of an instant, blocks of one surface first: they fill packets
    const int block = turn / 8 * 4 + turn % 4, kind = turn % 8 < 4 ? ONE_SURFACE : SEVERAL;
    if (kinds[block] == kind)
        unresolved_out.data[block] = list_pairs(block, first_instant + block / 4, tile_top + block % 4 / 2 * 4,
                                                tile_left + block % 2 * 4, kind == ONE_SURFACE);
    if (turn % 8 < 7) continue;
    for (; pair_count % N != 0; ++pair_count) { // a packet is of one instant
        Pairs& packet = pairs[pair_count / N];
        const int lane = pair_count % N;
        packet.face[lane] = packet.face[lane - 1];
        packet.owner[lane] = packet.owner[lane - 1];
        packet.spread[lane] = packet.spread[lane - 1];
        packet.share[lane] = 0.0f;
        for (int axis = 0; axis < 3; ++axis) packet.direction[axis][lane] = packet.direction[axis][lane - 1];
    }
}
constexpr float NEARNESS_MIN = 1e-6f, COSINE_MIN = 0.05f; // as in `intersect_plane.cuh`
auto root = [](float square) { return __builtin_elementwise_sqrt(square); }; // a vector instruction without a branch
for (int begin = 0; begin < pair_count; begin += N) {
    const Pairs& packet = pairs[begin / N];
    const auto& parts = packet.face;
    const wp::vec3 origin = view.p_WC.data[first_instant + packet.owner[0] / (4 * LANES)];
    alignas(64) float ts[N], us[N], vs[N], toward[3][N], normal[3][N], slope[2][N], tip[3][3][N];
    int other_faces = 0;
    for (int lane = 0; lane < N; ++lane) other_faces |= parts[lane] ^ parts[0];
    for (int corner = 0; corner < 3; ++corner) {
        auto point_of = [&](int lane) {
            const wp::vec3& point = mesh.points[mesh.indices[3 * (size_t)parts[lane] + corner]];
            return Quad{point[0], point[1], point[2], 0.0f};
        };
        if (other_faces) {
            alignas(64) float unused[N];
            float* const rows[4] = {tip[corner][0], tip[corner][1], tip[corner][2], unused};
            transpose_quads(point_of, rows);
        } else
            for (int axis = 0; axis < 3; ++axis)
                for (int lane = 0; lane < N; ++lane) tip[corner][axis][lane] = point_of(0)[axis];
        for (int axis = 0; axis < 3; ++axis)
            for (int lane = 0; lane < N; ++lane)
                tip[corner][axis][lane] -= TIMED ? seen_from[axis][packet.owner[lane]] : origin[axis];
    }
    for (int lane = 0; lane < N; ++lane) { // as in `intersect_plane.cuh`
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
        const float x = packet.direction[0][lane], y = packet.direction[1][lane], z = packet.direction[2][lane];
        for (int side = 0; side < 3; ++side)
            weight_of[side] = scale * (function[side][0] * x + function[side][1] * y + function[side][2] * z);
        const float length = root(x * x + y * y + z * z);
        const float near = 1.0f / wp::max(weight_of[0] + weight_of[1] + weight_of[2], NEARNESS_MIN);
        float square = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            toward[axis][lane] = packet.direction[axis][lane] / length;
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
        const auto& faces = parts;
        const auto& spread = packet.spread;
#include "shade_lanes.cuh"
        for (int lane = 0; lane < N; ++lane)
            for (int channel = 0; channel < 3; ++channel)
                total[channel][packet.owner[lane]] += packet.share[lane] * radiance[channel][lane];
    }
}
for (int channel = 0; channel < 3; ++channel)
    for (int pixel = 0; pixel < BLOCKS * LANES; ++pixel) radiance_out.data[BLOCKS * LANES * channel + pixel] = total[channel][pixel];
