#include "pixel_poses.cuh"
auto origin_of = [&](int axis, int lane) { return position[axis][TIMED ? lane : 0]; };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_scene;
const auto& rays = view.rays;
#include "aim_rays.cuh"
alignas(64) float ray[4][N];
auto pixel_of = [&](int lane) {
    return lane % SIDE < columns && lane / SIDE < rows ? first_pixel + lane / SIDE * view.width + lane % SIDE : -1;
};
aim_rays([&](int) { return rays.shape[0] - 1; }, pixel_of, ray);
#include "embree_packet.cuh"
for (int y = 0; y < rows; ++y) {
    int* out = wp::address(face_out, instant, top + y, left);
    for (int x = 0; x < columns; ++x) out[x] = faces[SIDE * y + x];
}
