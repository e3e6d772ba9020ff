// Logarithms of a positive float. On a CPU their errors are below 1 and 2 ulp, and loops over lanes become vector instructions.
auto logarithm = [](float x) {
#ifdef __CUDA_ARCH__
    return logf(x);
#else
    constexpr int LEAST = 0x3f3504f3; // bits of the square root of 1/2: x is a power of two times 1 + f, which is at least this
    const int above = __builtin_bit_cast(int, x) - LEAST;
    const float f = __builtin_bit_cast(float, (above & 0x7fffff) + LEAST) - 1.0f;
    const float s = f / (2.0f + f), square = s * s; // log(1 + f) = 2 artanh(s)
    const float rest = 2.0f * square * (1.0f / 3 + square * (1.0f / 5 + square * (1.0f / 7 + square * (1.0f / 9))));
    return (float)(above >> 23) * 0.693147181f + (f - s * (f - rest));
#endif
};
auto binary_logarithm = [&](float x) {
#ifdef __CUDA_ARCH__
    return log2f(x);
#else
    return logarithm(x) * 1.44269504f;
#endif
};
