auto origin_of = [&](int axis, int) { return origin[axis]; };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_scene;
auto pixel_of = [](int lane) { return lane; };
auto layer_of = [&](int) { return rays.shape[0] - 1; };
#include "aim_packet.cuh"
#include "embree_packet.cuh"
for (int y = 0; y < rows; ++y) {
    int* out = wp::address(face_out, instant, top + y, left);
    for (int x = 0; x < columns; ++x) out[x] = faces[SIDE * y + x];
}
