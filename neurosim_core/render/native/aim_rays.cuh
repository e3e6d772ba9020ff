// CPU: `aim_rays` writes rays of 16 lanes in W, x, y, z and spread, to `out` [4][16]. `ray_of`(lane) points to the ray of a
// lane, null: none, all 0, and `turn`(lane, x, y, z) takes it to W.
#include "transpose_quads.cuh"
auto aim_rays = [&](auto ray_of, auto& out) {
    auto quad_of = [&](int lane) {
        const wp::vec4* const from = ray_of(lane);
        Quad quad = 0.0f;
        if (from) __builtin_memcpy(&quad, from, sizeof(quad));
        return quad;
    };
    float* const rows[4] = {out[0], out[1], out[2], out[3]};
    transpose_quads(quad_of, rows);
    for (int lane = 0; lane < 16; ++lane) {
        const wp::vec3 turned = turn(lane, out[0][lane], out[1][lane], out[2][lane]);
        for (int axis = 0; axis < 3; ++axis) out[axis][lane] = turned[axis];
    }
};
