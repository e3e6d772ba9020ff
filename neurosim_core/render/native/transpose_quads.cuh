// CPU: `transpose` writes the x, y, z and w of 16 quads side by side, `quads` [4][4 quads], to rows of 16.
using Quads = float __attribute__((ext_vector_type(16)));
auto transpose = [](const Quads (&quads)[4], float* const (&out)[4]) {
    const Quads halves[4] = {
        __builtin_shufflevector(quads[0], quads[1], 0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29),
        __builtin_shufflevector(quads[2], quads[3], 0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29),
        __builtin_shufflevector(quads[0], quads[1], 2, 6, 10, 14, 18, 22, 26, 30, 3, 7, 11, 15, 19, 23, 27, 31),
        __builtin_shufflevector(quads[2], quads[3], 2, 6, 10, 14, 18, 22, 26, 30, 3, 7, 11, 15, 19, 23, 27, 31)};
    for (int half = 0; half < 4; half += 2) {
        const Quads first = __builtin_shufflevector(halves[half], halves[half + 1], 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
        const Quads second = __builtin_shufflevector(halves[half], halves[half + 1], 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
        __builtin_memcpy(out[half], &first, sizeof(first));
        __builtin_memcpy(out[half + 1], &second, sizeof(second));
    }
};
