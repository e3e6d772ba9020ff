#include "candidate_test.cuh"
float best[GROUP] = {}, next[GROUP] = {}, unsure[GROUP] = {};
int which[GROUP];
vec3 ray[GROUP];
for (int k = 0; k < GROUP; ++k) {
    which[k] = UNRESOLVED;
    ray[k] = quat_rotate(q_WC.data[first + wp::min(k, instants - 1)], ray_C);
}
#ifdef __CUDA_ARCH__
constexpr int EACH = 64 / GROUP;
__shared__ Tile tiles[GROUP];
__shared__ Face tested[GROUP][EACH];
__shared__ int tested_count[2][GROUP];
const int lane = threadIdx.x, own = lane % GROUP;
const vec3 origin = p_WC.data[first + wp::min(own, instants - 1)];
__syncthreads();
if (lane < 4 * GROUP) bound(lane / GROUP, q_WC.data[first + wp::min(own, instants - 1)], tiles[own]);
if (lane < GROUP) tested_count[0][lane] = 0;
for (int place = 0, turn = 0; place < count; place += EACH, turn ^= 1) {
    __syncthreads();
    if (lane < GROUP) tested_count[turn ^ 1][lane] = 0;
    const int k = place + lane / GROUP;
    Face face;
    if (k < count && own < instants && prepare(faces.data[begin + k], origin, tiles[own], face))
        tested[own][atomicAdd(&tested_count[turn][own], 1)] = face;
    __syncthreads();
#pragma unroll
    for (int k = 0; k < GROUP; ++k)
        for (int j = 0; j < tested_count[turn][k]; ++j)
            test(tested[k][j], ray[k][0], ray[k][1], ray[k][2], best[k], next[k], unsure[k], which[k]);
}
#else
for (int k = 0; k < instants; ++k) {
    Tile tile;
    for (int side = 0; side < 4; ++side) bound(side, q_WC.data[first + k], tile);
    for (int j = 0; j < count; ++j)
        if (Face face; prepare(faces.data[begin + j], p_WC.data[first + k], tile, face))
            test(face, ray[k][0], ray[k][1], ray[k][2], best[k], next[k], unsure[k], which[k]);
}
#endif
vec_t<GROUP, int> found;
for (int k = 0; k < GROUP; ++k)
    found[k] = count < 0 ? UNRESOLVED : decide(best[k], next[k], unsure[k], which[k]);
return found;
