#if defined(__CUDA_ARCH__)
const int64_t slot = (int64_t)atomicAdd((unsigned long long*)counters.data, 1ull);
#else
const int64_t slot = counters.data[0]++;
#endif
if (slot < (int64_t)keys.shape[0]) keys.data[slot] = key;
