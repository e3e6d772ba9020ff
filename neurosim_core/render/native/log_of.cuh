#include "logarithm.cuh"
return BINARY ? binary_logarithm(x) : logarithm(x);
