// CUDA: the sum over each 8 threads of a warp, all of which call it.
wp::vec3 sum = value;
#ifdef __CUDA_ARCH__
for (int channel = 0; channel < 3; ++channel)
    for (int step = 4; step > 0; step >>= 1) sum[channel] += __shfl_xor_sync(0xffffffffu, sum[channel], step);
#endif
return sum;
