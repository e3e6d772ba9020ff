#if defined(__CUDA_ARCH__)
__shared__ unsigned total;
__shared__ unsigned long long start;
__syncthreads();
if (threadIdx.x == 0) total = 0;
__syncthreads();
const int lane = threadIdx.x & 31;
unsigned until = (unsigned)count;
for (int step = 1; step < 32; step *= 2) {
    const unsigned before = __shfl_up_sync(~0u, until, step);
    if (lane >= step) until += before;
}
unsigned warp_start = 0;
if (lane == 31 && until > 0) warp_start = atomicAdd(&total, until);
warp_start = __shfl_sync(~0u, warp_start, 31);
__syncthreads();
if (threadIdx.x == 0 && total > 0) start = atomicAdd((unsigned long long*)counters.data, (unsigned long long)total);
__syncthreads();
return (int64_t)(start + warp_start + until - (unsigned)count);
#else
return 0;
#endif
