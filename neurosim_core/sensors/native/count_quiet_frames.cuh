#if defined(__CUDA_ARCH__)
// not used there, and arrays on the stack take the compiler two seconds
for (int pixel = begin; pixel < end; ++pixel) {
    const float* sample = log_radiance.data + pixel;
    int quiet_count = 0;
    while (quiet_count < frame_count && *sample > low_32.data[pixel] && *sample < high_32.data[pixel]) {
        ++quiet_count;
        sample += log_radiance.shape[1];
    }
    quiet_count_out.data[pixel] = quiet_count;
}
#else
// frame by frame, so that memory is read in order and the inner loop becomes vector instructions
constexpr int SIZE = 256;
const int count = end - begin < SIZE ? end - begin : SIZE;
int alive[SIZE];
int quiet_count[SIZE];
for (int i = 0; i < count; ++i) {
    alive[i] = 1;
    quiet_count[i] = 0;
}
const float* __restrict__ low = low_32.data + begin;
const float* __restrict__ high = high_32.data + begin;
for (int frame = 0; frame < frame_count; ++frame) {
    const float* __restrict__ sample = log_radiance.data + (size_t)frame * log_radiance.shape[1] + begin;
    int any = 0;
    for (int i = 0; i < count; ++i) {
        alive[i] &= (sample[i] > low[i]) & (sample[i] < high[i]);
        quiet_count[i] += alive[i];
        any |= alive[i];
    }
    if (!any) break;
}
for (int i = 0; i < count; ++i) quiet_count_out.data[begin + i] = quiet_count[i];
#endif
