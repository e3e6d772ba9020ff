// CUDA: the light of a face of the scene where a direction intersects its plane.
wp::vec3 received;
#ifdef __CUDA_ARCH__
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
#include "edge_functions.cuh"
constexpr int N = 1;
float ts[N], us[N], vs[N], ray[3][N], slope_of[2][N], normals[3][N];
const float spread[N] = {width_rad};
const int faces[N] = {part};
{
#include "intersect_plane.cuh"
    ts[0] = length * near;
    us[0] = corner[0] * near;
    vs[0] = corner[1] * near;
    for (int side = 0; side < 2; ++side) slope_of[side][0] = slope[side];
    for (int axis = 0; axis < 3; ++axis) {
        ray[axis][0] = unit[axis];
        normals[axis][0] = normal[axis];
    }
}
{
    const auto& slope = slope_of;
    const auto& normal = normals;
#include "shade_lanes.cuh"
    for (int channel = 0; channel < 3; ++channel) received[channel] = radiance[channel][0];
}
#endif
return received;
