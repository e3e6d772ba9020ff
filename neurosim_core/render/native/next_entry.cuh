// CUDA: the next number that a counter gives to a warp, all threads of which call it.
int next = 0;
#ifdef __CUDA_ARCH__
if ((threadIdx.x & 31) == 0) next = atomicAdd(&count.data[counter], 1);
__syncwarp();
next = __shfl_sync(0xffffffffu, next, 0);
#endif
return next;
