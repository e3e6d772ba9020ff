// CUDA: the layer of the first point in `left`, the bits of all points that show it, how many they are and their mean.
wp::vec_t<5, float> found;
#ifdef __CUDA_ARCH__
const int first = __ffs(left) - 1;
const unsigned layer = ((unsigned)coverage[2 + first / 4] >> (8 * (first % 4))) & 255u;
unsigned shown = 0;
#pragma unroll
for (int word = 0; word < 4; ++word) {
    const unsigned equal = __vcmpeq4((unsigned)coverage[2 + word], 0x01010101u * layer) & 0x08040201u;
    shown |= ((equal | equal >> 8 | equal >> 16 | equal >> 24) & 15u) << (4 * word);
}
float x = 0.0f, y = 0.0f;
#pragma unroll
for (int sample = 0; sample < SAMPLES; ++sample) {
    const int reversed = (sample & 1) << 3 | (sample & 2) << 1 | (sample & 4) >> 1 | (sample & 8) >> 3;
    const float shows = (shown >> sample) & 1u ? 1.0f : 0.0f;
    x += shows * (((float)sample + 0.5f) / SAMPLES - 0.5f);
    y += shows * (((float)reversed + 0.5f) / SAMPLES - 0.5f);
}
const float number = (float)__popc(shown);
found[0] = (float)layer;
found[1] = (float)shown;
found[2] = number;
found[3] = x / number;
found[4] = y / number;
#endif
return found;
