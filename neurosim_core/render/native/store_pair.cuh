// CUDA: the light of a pair takes its place.
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
Block& block = *(Block*)__cvta_shared_to_generic((size_t)(unsigned)place);
for (int channel = 0; channel < 3; ++channel) block.pair[channel][pair] = light[channel];
#endif
