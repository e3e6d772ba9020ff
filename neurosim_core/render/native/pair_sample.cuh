// CUDA: what a pixel sees of a surface, of the pairs that `cover_block.cuh` leaves: the number of points that show it; the width
// of a ray [rad]; the part to shade (see `part_of` in `cover_lanes.cuh`), as bits; direction and origin. All threads of a warp
// call it, with what is theirs of the pixels.
const wp::vec3 position = rays.position, center = rays.center, across = rays.across, down = rays.down;
wp::vec_t<9, float> sample;
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
const Block& block = *(const Block*)__cvta_shared_to_generic((size_t)(unsigned)place);
#include "sample_points.cuh"
const int code = block.pair[pair], owner = code % 32, first = code / 32, face = alone ? first : first + owner / 16 * (MOST / 2);
auto of_owner = [&](const wp::vec3& value) {
    wp::vec3 theirs;
    for (int axis = 0; axis < 3; ++axis) theirs[axis] = __shfl_sync(0xffffffffu, value[axis], owner);
    return theirs;
};
float x, y;
sample[0] = mean_of(block.shown[0][first * (alone ? 16 : 32) + owner], x, y);
sample[1] = __shfl_sync(0xffffffffu, spread_rad, owner);
const wp::vec3 middle = of_owner(center), sideways = of_owner(across), downwards = of_owner(down), origin = of_owner(position);
wp::vec3 toward;
for (int axis = 0; axis < 3; ++axis) toward[axis] = fmaf(y, downwards[axis], fmaf(x, sideways[axis], middle[axis]));
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
#include "nearest_part.cuh"
const int own = __shfl_sync(0xffffffffu, own_part, owner), hit = block.part[face];
int part = own;
if (own < 0 || scene.face_surface.data[own] != __float_as_int(block.plane[face].w)) part = hit >= 0 ? hit : nearest_part(-1 - hit, origin, toward);
sample[2] = __int_as_float(part);
for (int axis = 0; axis < 3; ++axis) {
    sample[3 + axis] = toward[axis];
    sample[6 + axis] = origin[axis];
}
#endif
return sample;
