#if defined(__CUDA_ARCH__)
return first + 8 < frame_count ? first + 8 : frame_count;
#else
return frame_count;
#endif
