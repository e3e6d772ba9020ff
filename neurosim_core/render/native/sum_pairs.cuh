// CUDA: the light of `count` pairs. All threads of a warp call it.
wp::vec3 sum(0.0f, 0.0f, 0.0f);
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
const Block& block = *(const Block*)__cvta_shared_to_generic((size_t)(unsigned)place);
__syncwarp();
for (int pair = first; pair < first + count; ++pair)
    for (int channel = 0; channel < 3; ++channel) sum[channel] += block.pair[channel][pair];
#endif
return sum;
