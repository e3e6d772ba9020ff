#ifdef __CUDA_ARCH__
__shared__ float parts[2];
for (int step = 16; step > 0; step >>= 1) value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, step));
__syncthreads();
if ((threadIdx.x & 31) == 0) parts[threadIdx.x >> 5] = value;
__syncthreads();
value = fmaxf(parts[0], parts[1]);
#endif
return value;
