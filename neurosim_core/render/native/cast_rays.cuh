auto origin_of = [&](int axis, int lane) { return origins.data[lane][axis]; };
alignas(64) float ray[3][16];
for (int axis = 0; axis < 3; ++axis)
    for (int lane = 0; lane < 16; ++lane) ray[axis][lane] = rays.data[lane][axis];
const uint64_t embree_intersect = intersect, embree_scene = scene;
#include "embree_packet.cuh"
for (int lane = 0; lane < 16; ++lane) {
    auto& hit = hit_out.data[lane];
    hit.face = faces[lane];
    hit.t = ts[lane];
    hit.u = us[lane];
    hit.v = vs[lane];
    hit.normal = wp::vec3(normal[0][lane], normal[1][lane], normal[2][lane]);
}
