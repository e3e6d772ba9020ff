// CUDA: the part of a layer to shade in a direction; see `part_of` in `cover_lanes.cuh`.
int found = own;
#ifdef __CUDA_ARCH__
const int* group = (const int*)__cvta_shared_to_generic((size_t)(unsigned)coverage[6]);
const int surface = group[2 * MOST + layer], part = group[3 * MOST + layer];
if (own >= 0 && scene.whole_surface.data[scene.whole_of_face.data[own]] == surface) return own;
if (part >= 0) return part;
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
#include "edge_functions.cuh"
#include "nearest_part.cuh"
found = nearest_part(-1 - part, toward);
#endif
return found;
