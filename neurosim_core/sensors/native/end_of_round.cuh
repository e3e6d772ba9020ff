#if defined(__CUDA_ARCH__)
return first + 32 < frame_count ? first + 32 : frame_count;
#else
return frame_count;
#endif
