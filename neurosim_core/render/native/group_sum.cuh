// CUDA: of the 16 threads of a block of 4 x 4 pixels, the sum of the first 8 to even threads, of the last 8 to odd ones.
wp::vec3 sum = value;
#ifdef __CUDA_ARCH__
const unsigned mask = 0xffffu << (threadIdx.x & 16);
for (int channel = 0; channel < 3; ++channel) {
    for (int step = 4; step > 0; step >>= 1) sum[channel] += __shfl_xor_sync(mask, sum[channel], step);
    sum[channel] = __shfl_sync(mask, sum[channel], 8 * (threadIdx.x & 1), 16);
}
#endif
return sum;
