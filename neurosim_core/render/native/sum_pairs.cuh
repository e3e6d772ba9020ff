// CUDA: adds the light of those of `count` pairs that are among the 32 of a step, one by one: so the sum does not depend on
// how the pairs of a pixel are split into steps. All threads of a warp call it.
wp::vec3 sum = total;
#ifdef __CUDA_ARCH__
#include "pixel_block.cuh"
const Block& block = *(const Block*)__cvta_shared_to_generic((size_t)(unsigned)place);
__syncwarp();
#pragma unroll 1
for (int pair = wp::max(first, 32 * step); pair < wp::min(first + count, 32 * step + 32); ++pair)
    for (int channel = 0; channel < 3; ++channel) sum[channel] += block.light[channel][pair % 32];
__syncwarp();
#endif
return sum;
