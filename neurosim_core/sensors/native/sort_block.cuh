// Bitonic, all comparators upwards, the first of each merge mirrored: keys beyond the end would be the
// largest and never move, so any number can be sorted in place.
#if defined(__CUDA_ARCH__)
constexpr int SIZE = 4096;
__shared__ int64_t shared[SIZE];
const int lane = threadIdx.x, lanes = blockDim.x;
int64_t* key = keys.data;
if (count <= SIZE) {
    key = shared;
    for (int i = lane; i < count; i += lanes) key[i] = keys.data[i];
}
#define NEUROSIM_BARRIER __syncthreads()
#else
const int lane = 0, lanes = 1;
int64_t* key = keys.data;
#define NEUROSIM_BARRIER
#endif
for (int log_size = 1; (1 << (log_size - 1)) < count; ++log_size) {
    const int size = 1 << log_size, half = size >> 1;
    const int pair_count = ((count + size - 1) >> log_size) << (log_size - 1);
    NEUROSIM_BARRIER;
    for (int pair = lane; pair < pair_count; pair += lanes) {
        const int begin = (pair >> (log_size - 1)) << log_size, place = pair & (half - 1);
        const int low = begin + place, high = begin + size - 1 - place;
        if (high < count && key[low] > key[high]) {
            const int64_t larger = key[low];
            key[low] = key[high];
            key[high] = larger;
        }
    }
    for (int log_stride = log_size - 2; log_stride >= 0; --log_stride) {
        const int stride = 1 << log_stride;
        NEUROSIM_BARRIER;
        for (int pair = lane; pair < pair_count; pair += lanes) {
            const int low = ((pair >> log_stride) << (log_stride + 1)) + (pair & (stride - 1));
            const int high = low + stride;
            if (high < count && key[low] > key[high]) {
                const int64_t larger = key[low];
                key[low] = key[high];
                key[high] = larger;
            }
        }
    }
}
NEUROSIM_BARRIER;
#undef NEUROSIM_BARRIER
#if defined(__CUDA_ARCH__)
if (count <= SIZE) {
    for (int i = lane; i < count; i += lanes) keys.data[i] = key[i];
}
#endif
