const int height = view.height, width = view.width;
// The faces that a pixel shows, of those that first rays hit in and around its block of 4 x 4 pixels.
const int top = row / 4 * 4, left = col / 4 * 4;
#include "list_seen_faces.cuh"
if (!listed) return -1;
constexpr int LANES = 1;
constexpr bool TIMED = false; // `origin` is where the pixel is seen from
const float shift[3][LANES] = {};
#include "sample_points.cuh"
const float ray[3][3][LANES] = {{{center[0]}, {center[1]}, {center[2]}},
                                {{across[0]}, {across[1]}, {across[2]}},
                                {{down[0]}, {down[1]}, {down[2]}}};
#include "cover_lanes.cuh"
if (!listed) return -1;
int whole = 0, found = 0;
for (int layer = 0; layer < layer_count; ++layer) {
    if (number[layer][0] == 0.0f) continue;
    const wp::vec3 toward = center + middle[0][layer][0] * across + middle[1][layer][0] * down;
    const int part = part_of(layer, *wp::address(faces, instant, row, col), origin, toward);
#include "intersect_plane.cuh"
    auto& hit = hit_out.data[found];
    hit.face = part;
    hit.t = length * near;
    hit.u = corner[0] * near;
    hit.v = corner[1] * near;
    hit.normal = normal;
    number_out.data[found] = number[layer][0];
    ray_out.data[found] = toward / length;
    slope_out.data[found++] = wp::vec2(slope[0], slope[1]);
    whole += (int)number[layer][0];
}
if (sky && whole < SAMPLES) {
    hit_out.data[found].face = -1;
    number_out.data[found++] = (float)(SAMPLES - whole);
}
return sky || 2 * whole >= SAMPLES ? found : -1;
