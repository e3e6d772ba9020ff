auto origin_of = [&](int axis, int lane) { return origin.data[lane][axis]; };
#include "cast_lanes.cuh"
