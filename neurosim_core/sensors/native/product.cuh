#if defined(__CUDA_ARCH__)
return __dmul_rn(a, b);
#else
return a * b;
#endif
