// `points` [2][SAMPLES]: a Hammersley set around the centre of a pixel of width 1, one in each of SAMPLES rows and columns.
constexpr unsigned ALL_POINTS = (unsigned)((1ull << SAMPLES) - 1);
constexpr auto reversed_bits = [](int sample) {
    int reversed = 0;
    for (int bit = 1; bit < SAMPLES; bit *= 2) reversed = 2 * reversed + sample / bit % 2;
    return reversed;
};
float points[2][SAMPLES];
for (int sample = 0; sample < SAMPLES; ++sample) {
    points[0][sample] = ((float)sample + 0.5f) / SAMPLES - 0.5f;
    points[1][sample] = ((float)reversed_bits(sample) + 0.5f) / SAMPLES - 0.5f;
}
auto count_bits = [](unsigned bits) {
#ifdef __CUDA_ARCH__
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
};
auto lowest_of = [&](unsigned bits) { return count_bits(~bits & (bits - 1u)); }; // place of the lowest bit that is set
// Returns the number of the points whose bits are set, and their mean: columns count the points, rows their bits in reverse.
auto mean_of = [&](unsigned bits, float& x, float& y) {
    int column = 0, row = 0;
    for (int bit = 1; bit < SAMPLES; bit *= 2) {
        unsigned having = 0;
        for (int sample = 0; sample < SAMPLES; ++sample) having |= (unsigned)(sample / bit % 2) << sample;
        const int number = count_bits(bits & having);
        column += bit * number;
        row += SAMPLES / 2 / bit * number;
    }
    const float number = (float)count_bits(bits), share = 1.0f / (SAMPLES * wp::max(number, 1.0f));
    x = ((float)column + 0.5f * number) * share - 0.5f;
    y = ((float)row + 0.5f * number) * share - 0.5f;
    return number;
};
