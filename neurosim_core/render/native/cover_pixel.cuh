// The faces that a pixel shows, of those that first rays hit in and around its block of 4 x 4 pixels.
const int top = row / 4 * 4, left = col / 4 * 4;
#include "list_seen_faces.cuh"
if (!listed) return -1;
constexpr int LANES = 1;
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
    const int part = part_of(layer, *wp::address(faces, instant, row, col), toward);
    const int* index = &mesh.indices[3 * (size_t)part];
    float function[3][3], corner[3];
    const float volume = functions_of(mesh.points[index[0]] - origin, mesh.points[index[1]] - origin,
                                      mesh.points[index[2]] - origin, function);
    for (int side = 0; side < 3; ++side)
        corner[side] = function[side][0] * toward[0] + function[side][1] * toward[1] + function[side][2] * toward[2];
    const float near = 1.0f / wp::max(corner[0] + corner[1] + corner[2], NEARNESS_MIN), length = wp::length(toward);
    wp::vec3 normal;
    for (int axis = 0; axis < 3; ++axis)
        normal[axis] = (volume < 0.0f ? -1.0f : 1.0f) * (function[0][axis] + function[1][axis] + function[2][axis]);
    face_out.data[found] = part;
    number_out.data[found] = number[layer][0];
    ray_out.data[found] = toward / length;
    hit_out.data[found] = wp::vec3(length * near, corner[0] * near, corner[1] * near);
    normal_out.data[found++] = wp::normalize(normal);
    whole += (int)number[layer][0];
}
if (sky && whole < SAMPLES) {
    face_out.data[found] = -1;
    number_out.data[found++] = (float)(SAMPLES - whole);
}
return sky || 2 * whole >= SAMPLES ? found : -1;
