using namespace wp;
#ifdef __CUDA_ARCH__
// one atomic for a warp, whose pixels stay side by side
const unsigned mask = __ballot_sync(0xffffffffu, marked), lane = threadIdx.x & 31;
int place = 0;
if (mask && lane == 0) place = atomicAdd(candidates.unresolved_count.data, __popc(mask));
place = __shfl_sync(0xffffffffu, place, 0) + __popc(mask & ((1u << lane) - 1));
#else
const int place = marked ? __atomic_fetch_add(candidates.unresolved_count.data, 1, __ATOMIC_RELAXED) : 0;
#endif
if (marked && place < candidates.unresolved.shape[0]) candidates.unresolved.data[place] = index;
