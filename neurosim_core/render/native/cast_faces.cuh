#include "pixel_block_names.cuh"
#include "pixel_poses.cuh"
auto origin_of = [&](int axis, int lane) { return position[axis][TIMED ? lane : 0]; };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_quick;
#include "aim_rays.cuh"
alignas(64) float ray[4][N];
const wp::vec4* const aimed = wp::address(view.rays, view.rays.shape[0] - 1, first_pixel);
const bool all = columns == SIDE && rows == SIDE;
auto ray_of = [&](int lane) {
    return all || (lane % SIDE < columns && lane / SIDE < rows) ? aimed + lane / SIDE * view.width + lane % SIDE : nullptr;
};
aim_rays(ray_of, ray);
#include "embree_packet.cuh"
for (int y = 0; y < rows; ++y) {
    int* out = wp::address(face_out, instant, top + y, left);
    for (int x = 0; x < columns; ++x) out[x] = faces[SIDE * y + x];
}
