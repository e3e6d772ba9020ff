// Where a direction intersects the plane of a face: distance, weights of the first two corners, the normal of the front, `slope`.
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
#include "edge_functions.cuh"
#include "intersect_plane.cuh"
wp::vec_t<8, float> hit;
hit[0] = length * near;
hit[1] = corner[0] * near;
hit[2] = corner[1] * near;
for (int axis = 0; axis < 3; ++axis) hit[3 + axis] = normal[axis];
for (int side = 0; side < 2; ++side) hit[6 + side] = slope[side];
return hit;
