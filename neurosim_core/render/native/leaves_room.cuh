// CUDA: whether a block is one of those that end early, so that a multiprocessor is free for others; the first ones go on.
#ifdef __CUDA_ARCH__
unsigned processor;
asm volatile("mov.u32 %0, %%smid;" : "=r"(processor));
return processor == 0u && blockIdx.x >= gridDim.x / BLOCKS;
#else
return false;
#endif
