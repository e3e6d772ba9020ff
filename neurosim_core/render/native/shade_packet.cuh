alignas(64) float ray[3][N], normal[3][N], spread[N], ts[N], us[N], vs[N];
alignas(64) int faces[N];
for (int lane = 0; lane < N; ++lane) {
    faces[lane] = hits.data[lane].face;
    ts[lane] = hits.data[lane].t;
    us[lane] = hits.data[lane].u;
    vs[lane] = hits.data[lane].v;
    spread[lane] = spreads.data[lane];
    for (int axis = 0; axis < 3; ++axis) {
        ray[axis][lane] = rays.data[lane][axis];
        normal[axis][lane] = hits.data[lane].normal[axis];
    }
}
constexpr float slope[2][N] = {};
#include "shade_lanes.cuh"
for (int lane = 0; lane < N; ++lane)
    for (int channel = 0; channel < 3; ++channel) total.data[lane][channel] += radiance[channel][lane];
