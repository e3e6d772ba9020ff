auto origin_of = [&](int axis, int lane) { return origins.data[lane][axis]; };
#include "cast_lanes.cuh"
