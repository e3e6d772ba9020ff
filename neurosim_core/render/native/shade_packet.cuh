alignas(64) float ray[3][N], normal[3][N], spread[N], ts[N], us[N], vs[N];
alignas(64) int faces[N];
for (int lane = 0; lane < N; ++lane) {
    faces[lane] = hit_face.data[lane];
    ts[lane] = hit_t.data[lane];
    us[lane] = hit_u.data[lane];
    vs[lane] = hit_v.data[lane];
    spread[lane] = spreads.data[lane];
    for (int axis = 0; axis < 3; ++axis) {
        ray[axis][lane] = rays.data[lane][axis];
        normal[axis][lane] = normals.data[lane][axis];
    }
}
constexpr float slope[2][N] = {};
#include "shade_lanes.cuh"
for (int lane = 0; lane < N; ++lane)
    for (int channel = 0; channel < 3; ++channel) total.data[lane][channel] += radiance[channel][lane];
