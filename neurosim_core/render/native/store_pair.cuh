// CUDA: keeps the light of a pair for `sum_pairs.cuh`.
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
Block& block = *(Block*)__cvta_shared_to_generic((size_t)(unsigned)place);
for (int channel = 0; channel < 3; ++channel) block.light[channel][pair % 32] = light[channel];
#endif
