// CUDA: the sum of the values of the 16 threads of a block of 4 x 4 pixels, the same for each of them.
wp::vec3 sum = value;
#ifdef __CUDA_ARCH__
const unsigned mask = 0xffffu << (threadIdx.x & 16);
for (int step = 8; step > 0; step >>= 1)
    for (int channel = 0; channel < 3; ++channel) sum[channel] += __shfl_xor_sync(mask, sum[channel], step);
#endif
return sum;
