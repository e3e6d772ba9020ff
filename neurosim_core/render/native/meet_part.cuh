// Where a direction meets the plane of a face: distance, weights of the first two corners, the normal of the front.
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
#include "edge_functions.cuh"
constexpr float NEARNESS_MIN = 1e-6f; // [1/m]: where a plane seen edge-on is extrapolated beyond its horizon
const int* index = &mesh.indices[3 * (size_t)part];
float function[3][3], corner[3];
const float volume = functions_of(mesh.points[index[0]] - origin, mesh.points[index[1]] - origin,
                                  mesh.points[index[2]] - origin, function);
for (int side = 0; side < 3; ++side)
    corner[side] = function[side][0] * toward[0] + function[side][1] * toward[1] + function[side][2] * toward[2];
const float near = 1.0f / wp::max(corner[0] + corner[1] + corner[2], NEARNESS_MIN);
wp::vec3 normal;
for (int axis = 0; axis < 3; ++axis)
    normal[axis] = (volume < 0.0f ? -1.0f : 1.0f) * (function[0][axis] + function[1][axis] + function[2][axis]);
normal = wp::normalize(normal);
wp::vec_t<6, float> met;
met[0] = wp::length(toward) * near;
met[1] = corner[0] * near;
met[2] = corner[1] * near;
for (int axis = 0; axis < 3; ++axis) met[3 + axis] = normal[axis];
return met;
