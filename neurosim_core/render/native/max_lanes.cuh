#ifdef __CUDA_ARCH__
const unsigned mask = ((1u << LANES) - 1) << (threadIdx.x & 31 & ~(LANES - 1));
for (int step = LANES / 2; step > 0; step >>= 1) value = fmaxf(value, __shfl_xor_sync(mask, value, step));
#endif
return value;
