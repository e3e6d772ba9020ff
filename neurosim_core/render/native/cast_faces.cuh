auto origin_of = [&](int axis, int) { return origin[axis]; };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_scene;
#include "aim_rays.cuh"
alignas(64) float ray[4][N];
auto pixel_of = [&](int lane) {
    return lane % SIDE < columns && lane / SIDE < rows ? first_pixel + lane / SIDE * width + lane % SIDE : -1;
};
aim_rays([&](int) { return rays.shape[0] - 1; }, pixel_of, [&](int) { return q_WC; }, ray);
#include "embree_packet.cuh"
for (int y = 0; y < rows; ++y) {
    int* out = wp::address(face_out, instant, top + y, left);
    for (int x = 0; x < columns; ++x) out[x] = faces[SIDE * y + x];
}
