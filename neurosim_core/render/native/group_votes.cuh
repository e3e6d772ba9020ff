// CUDA: a bit for each of the 16 threads of a block of 4 x 4 pixels.
int votes = vote;
#ifdef __CUDA_ARCH__
const int shift = threadIdx.x & 16;
votes = (__ballot_sync(0xffffu << shift, vote) >> shift) & 0xffffu;
#endif
return votes;
