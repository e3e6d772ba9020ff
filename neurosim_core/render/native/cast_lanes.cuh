alignas(64) float ray[3][16];
for (int axis = 0; axis < 3; ++axis)
    for (int lane = 0; lane < 16; ++lane) ray[axis][lane] = rays.data[lane][axis];
const uint64_t embree_intersect = intersect, embree_scene = scene;
#include "embree_packet.cuh"
for (int lane = 0; lane < 16; ++lane) {
    face_out.data[lane] = faces[lane];
    t_out.data[lane] = ts[lane];
    u_out.data[lane] = us[lane];
    v_out.data[lane] = vs[lane];
    normal_out.data[lane] = wp::vec3(normal[0][lane], normal[1][lane], normal[2][lane]);
}
