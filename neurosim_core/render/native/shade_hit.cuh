// The light that a ray receives from the face that it hits; the program of packets (`shade_lanes.cuh`), for one ray.
constexpr int N = 1;
const float spread[N] = {spread_rad}, ts[N] = {hit.t}, slope[2][N] = {};
float us[N] = {hit.u}, vs[N] = {hit.v};
const float ray[3][N] = {{direction[0]}, {direction[1]}, {direction[2]}};
const float normal[3][N] = {{hit.normal[0]}, {hit.normal[1]}, {hit.normal[2]}};
const int faces[N] = {hit.face};
#include "shade_lanes.cuh"
return wp::vec3(radiance[0][0], radiance[1][0], radiance[2][0]);
