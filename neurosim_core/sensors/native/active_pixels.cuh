#if defined(__CUDA_ARCH__)
// the pixels of a block that fire, one behind the other
__shared__ int pixels[1024];
__shared__ unsigned count;
if (step == 1) {
    const unsigned mask = __activemask(), lane = threadIdx.x & 31, leader = __ffs(mask) - 1;
    unsigned first = 0;
    if (lane == leader) first = atomicAdd(&count, (unsigned)__popc(mask));
    first = __shfl_sync(mask, first, leader);
    pixels[first + __popc(mask & ((1u << lane) - 1u))] = value;
    return 0;
}
if (step == 3) return pixels[value];
if (step == 0) {
    if (threadIdx.x == 0) count = 0;
    __syncthreads();
    return 0;
}
__syncthreads();
return (int)count;
#else
return 0;
#endif
