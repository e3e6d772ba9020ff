const float* sample = log_radiance.data + pixel;
const size_t stride = log_radiance.shape[1];
#if defined(__CUDA_ARCH__)
// the loads of eight frames are under way together; beyond the end the last frame stands in
constexpr int SIZE = 8;
for (int begin = first / SIZE * SIZE; begin < end; begin += SIZE) {
    float value[SIZE];
    const float* at = sample + begin * stride;
#pragma unroll
    for (int i = 0; i < SIZE; ++i) {
        value[i] = *at;
        if (begin + i + 1 < end) at += stride;
    }
    unsigned active = 0;
#pragma unroll
    for (int i = 0; i < SIZE; ++i) active |= (value[i] > low && value[i] < high ? 0u : 1u) << i;
    if (begin < first) active &= ~0u << (first - begin);
    if (active != 0) return wp::min(begin + __ffs(active) - 1, end);
}
return end;
#else
int frame = first;
while (frame < end && sample[frame * stride] > low && sample[frame * stride] < high) ++frame;
return frame;
#endif
