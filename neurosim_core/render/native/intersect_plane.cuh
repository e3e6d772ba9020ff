// Where direction `toward` intersects the plane of face `part` of `mesh`: weights of the corners in `corner`, times the nearness
// `near` [1/m]; `normal` of the front; `slope`, the change of the weights of the first two per radian along the footprint, in
// the direction in which the plane recedes. Needs `edge_functions.cuh`.
constexpr float NEARNESS_MIN = 1e-6f; // [1/m]: where a plane seen edge-on is extrapolated beyond its horizon
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
normal = wp::normalize(normal);
const wp::vec3 unit = toward / length;
const float facing = wp::dot(unit, normal), longer = length * near / wp::max(wp::abs(facing), 0.05f);
float slope[2];
for (int side = 0; side < 2; ++side) {
    slope[side] = 0.0f;
    for (int axis = 0; axis < 3; ++axis) slope[side] += longer * function[side][axis] * (unit[axis] - facing * normal[axis]);
}
