#include "sample_points.cuh"
return wp::vec2(points[0][ray], points[1][ray]);
