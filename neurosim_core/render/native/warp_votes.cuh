// CUDA: a bit for each thread of a warp, all of which call it.
int votes = vote;
#ifdef __CUDA_ARCH__
votes = (int)__ballot_sync(0xffffffffu, vote);
#endif
return votes;
