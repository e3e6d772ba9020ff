#include "sample_points.cuh"
return wp::vec2(points[0][sample], points[1][sample]);
