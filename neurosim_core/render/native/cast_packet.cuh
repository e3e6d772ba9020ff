auto origin_of = [&](int axis, int) { return origin[axis]; };
#include "cast_lanes.cuh"
