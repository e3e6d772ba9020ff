#if defined(__CUDA_ARCH__)
constexpr int SIZE = 1024;
__shared__ int words[6][SIZE];
__shared__ unsigned kept_count, total; // of 64 bits together they would be added in a loop
__shared__ unsigned long long start;
if (step == 1) {
    const unsigned index = atomicAdd(&kept_count, 1u);
    if (index >= SIZE) return 0;
    words[0][index] = ((frame & 31) << 8) | threadIdx.x;
    words[1][index] = __float_as_int(last);
    words[2][index] = up;
    words[3][index] = down;
    words[4][index] = (int)atomicAdd(&total, (unsigned)event_count);
    words[5][index] = event_count;
    return 1;
}
if (step == 3) return words[place][index];
if (step == 4) return (int64_t)start;
__syncthreads();
if (step == 0) {
    if (threadIdx.x == 0) kept_count = total = 0;
} else if (threadIdx.x == 0 && total > 0) {
    start = atomicAdd((unsigned long long*)counters.data, (unsigned long long)total);
}
__syncthreads();
return (int64_t)(kept_count < SIZE ? kept_count : SIZE);
#else
return 0;
#endif
