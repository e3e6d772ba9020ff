#if !defined(__CUDA_ARCH__)
const int64_t slot = counters.data[0]++;
if (slot < (int64_t)keys.shape[0]) keys.data[slot] = key;
#endif
