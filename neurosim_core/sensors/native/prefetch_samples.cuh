#if defined(__CUDA_ARCH__)
for (int frame = 0; frame < frame_count; ++frame) {
    const float* sample = log_radiance.data + (size_t)frame * log_radiance.shape[1] + pixel;
    asm volatile("prefetch.global.L1 [%0];" ::"l"(sample));
}
#endif
