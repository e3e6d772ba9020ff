// CPU: `aim_rays` writes rays of 16 lanes in W, x, y, z and spread, to `out` [4][16]. `ray_of`(lane) points to the ray of a
// lane, null: none, all 0, and `turn`(lane, x, y, z) takes it to W.
auto aim_rays = [&](auto ray_of, auto& out) {
    using Quad = float __attribute__((ext_vector_type(4)));
    using Quads = float __attribute__((ext_vector_type(16)));
    Quads quads[4], halves[4]; // of four lanes side by side; then of x and y, z and spread: transposed in registers
    for (int group = 0; group < 4; ++group) {
        Quad own[4];
        for (int lane = 0; lane < 4; ++lane) {
            const wp::vec4* const from = ray_of(4 * group + lane);
            own[lane] = 0.0f;
            if (from) __builtin_memcpy(&own[lane], from, sizeof(Quad));
        }
        quads[group] = __builtin_shufflevector(__builtin_shufflevector(own[0], own[1], 0, 1, 2, 3, 4, 5, 6, 7),
                                               __builtin_shufflevector(own[2], own[3], 0, 1, 2, 3, 4, 5, 6, 7),
                                               0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    }
    for (int half = 0; half < 2; ++half) {
        const Quads &first = quads[2 * half], &second = quads[2 * half + 1];
        halves[half] = __builtin_shufflevector(first, second, 0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29);
        halves[half + 2] = __builtin_shufflevector(first, second, 2, 6, 10, 14, 18, 22, 26, 30, 3, 7, 11, 15, 19, 23, 27, 31);
    }
    for (int term = 0; term < 4; term += 2) {
        const Quads &first = halves[term], &second = halves[term + 1];
        const Quads rows[2] = {
            __builtin_shufflevector(first, second, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23),
            __builtin_shufflevector(first, second, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31)};
        __builtin_memcpy(out[term], rows, sizeof(rows));
    }
    for (int lane = 0; lane < 16; ++lane) {
        const wp::vec3 turned = turn(lane, out[0][lane], out[1][lane], out[2][lane]);
        for (int axis = 0; axis < 3; ++axis) out[axis][lane] = turned[axis];
    }
};
