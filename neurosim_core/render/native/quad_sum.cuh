// CUDA: the sum over each 4 threads of a warp, in their order; all threads of the warp call it.
wp::vec3 sum = before;
#ifdef __CUDA_ARCH__
for (int from = 0; from < 4; ++from)
    for (int channel = 0; channel < 3; ++channel) sum[channel] += __shfl_sync(0xffffffffu, value[channel], from, 4);
#endif
return sum;
