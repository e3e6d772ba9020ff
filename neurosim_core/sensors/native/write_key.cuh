#if defined(__CUDA_ARCH__)
// keys gather in shared memory, and one atomic per block finds their place; what does not fit goes alone
constexpr unsigned SIZE = 1536;
__shared__ int64_t gathered[SIZE];
__shared__ unsigned gathered_count;
__shared__ unsigned long long block_start;
unsigned long long* total = (unsigned long long*)counters.data;
if (step == 1) {
    const unsigned place = atomicAdd(&gathered_count, 1u);
    if (place < SIZE) {
        gathered[place] = key;
    } else {
        const unsigned long long slot = atomicAdd(total, 1ull);
        if (slot < (unsigned long long)keys.shape[0]) keys.data[slot] = key;
    }
    return;
}
if (step == 0) {
    if (threadIdx.x == 0) gathered_count = 0;
    __syncthreads();
    return;
}
__syncthreads();
const unsigned count = gathered_count < SIZE ? gathered_count : SIZE;
if (threadIdx.x == 0 && count > 0) block_start = atomicAdd(total, (unsigned long long)count);
__syncthreads();
for (unsigned place = threadIdx.x; place < count; place += blockDim.x) {
    const unsigned long long slot = block_start + place;
    if (slot < (unsigned long long)keys.shape[0]) keys.data[slot] = gathered[place];
}
#else
if (step != 1) return;
const int64_t slot = counters.data[0]++;
if (slot < (int64_t)keys.shape[0]) keys.data[slot] = key;
#endif
