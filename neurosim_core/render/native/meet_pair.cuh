// CUDA: what a pixel sees of a surface, of the pairs that `cover_block.cuh` leaves: the pixel; the number of points that
// show it; the part to shade (see `part_of` in `cover_lanes.cuh`), as bits; the direction; distance, weights of the first two
// corners and the normal of the front where it meets the plane of the part.
wp::vec_t<14, float> met;
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
const Block& block = *(const Block*)__cvta_shared_to_generic((size_t)(unsigned)place);
#include "sample_points.cuh"
const int pixel = block.listed[pair] & 15, first = block.listed[pair] >> 4;
float x, y;
const float number = mean_of(block.shown[first][pixel], x, y);
wp::vec3 toward;
for (int axis = 0; axis < 3; ++axis)
    toward[axis] = fmaf(y, block.ray[6 + axis][pixel], fmaf(x, block.ray[3 + axis][pixel], block.ray[axis][pixel]));
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
#include "edge_functions.cuh"
#include "nearest_part.cuh"
const int own = *wp::address(faces, instant, top + pixel / 4, left + pixel % 4), hit = block.part[first];
int part = own;
if (own < 0 || scene.face_surface.data[own] != block.surface[first])
    part = hit >= 0 ? hit : nearest_part(-1 - hit, toward);
#include "meet_plane.cuh"
met[0] = (float)pixel;
met[1] = number;
met[2] = __int_as_float(part);
met[6] = length * near;
met[7] = corner[0] * near;
met[8] = corner[1] * near;
for (int axis = 0; axis < 3; ++axis) {
    met[3 + axis] = toward[axis];
    met[9 + axis] = normal[axis];
}
for (int side = 0; side < 2; ++side) met[12 + side] = slope[side];
#endif
return met;
