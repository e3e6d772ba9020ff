#include "pixel_poses.cuh"
auto origin_of = [&](int axis, int lane) { return position[axis][TIMED ? lane : 0]; };
const uint64_t embree_intersect = scene.embree_intersect, embree_scene = scene.embree_scene;
auto pixel_of = [](int lane) { return lane; };
auto layer_of = [&](int) { return view.rays.shape[0] - 1; };
const auto& rays = view.rays;
const int width = view.width;
#include "aim_packet.cuh"
#include "embree_packet.cuh"
for (int y = 0; y < rows; ++y) {
    int* out = wp::address(face_out, instant, top + y, left);
    for (int x = 0; x < columns; ++x) out[x] = faces[SIDE * y + x];
}
