// CPU: `transpose_quads` writes the four values `quad_of`(lane) of 16 lanes to four rows of 16, `out`, by way of registers.
using Quad = float __attribute__((ext_vector_type(4)));
auto transpose_quads = [](auto quad_of, const auto& out) {
    using Quads = float __attribute__((ext_vector_type(16)));
    Quads quads[4], halves[4]; // of four lanes side by side; then of the first two and of the last two values
    for (int group = 0; group < 4; ++group) {
        Quad own[4];
        for (int lane = 0; lane < 4; ++lane) own[lane] = quad_of(4 * group + lane);
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
        __builtin_memcpy(out[term], &rows[0], sizeof(Quads));
        __builtin_memcpy(out[term + 1], &rows[1], sizeof(Quads));
    }
};
