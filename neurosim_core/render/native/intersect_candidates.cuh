#include "list_of_tile.cuh"
#include "candidate_test.cuh"
float best[GROUP] = {}, next[GROUP] = {};
int which[GROUP];
for (int k = 0; k < GROUP; ++k) which[k] = UNRESOLVED;
const float x = ray_C[0] / ray_C[2], y = ray_C[1] / ray_C[2];
#ifdef __CUDA_ARCH__
constexpr int EACH = 64 / GROUP;
__shared__ Axes axes[GROUP];
__shared__ Face tested[PARTS][GROUP][EACH];
__shared__ int tested_count[2][PARTS][GROUP][2]; // of those seen from the side, which are the last ones
__shared__ float part_y[PARTS][2];
const int lane = threadIdx.x, own = lane % GROUP, warp = lane / 32;
const vec3 origin = p_WC.data[first + wp::min(own, instants - 1)];
float low = y, high = y; // of the rays of the warp
for (int step = 16; step > 0; step /= 2) {
    low = fminf(low, __shfl_xor_sync(0xffffffffu, low, step));
    high = fmaxf(high, __shfl_xor_sync(0xffffffffu, high, step));
}
__syncthreads();
if (lane % 32 == 0) {
    part_y[warp][0] = low - BORDER_RAD * longest * longest;
    part_y[warp][1] = high + BORDER_RAD * longest * longest;
}
if (lane < GROUP) axes[own] = axes_of(q_WC.data[first + wp::min(own, instants - 1)]);
if (lane < 2 * PARTS * GROUP) (&tested_count[0][0][0][0])[lane] = 0;
for (int place = 0, turn = 0; place < count; place += EACH, turn ^= 1) {
    __syncthreads();
    if (lane < 2 * PARTS * GROUP) (&tested_count[turn ^ 1][0][0][0])[lane] = 0;
    const int k = place + lane / GROUP;
    Face face;
    const int parts = k < count && own < instants ? prepare(faces.data[begin + k], origin, axes[own], part_y, face) : 0;
    for (int part = 0; part < PARTS; ++part)
        if ((parts >> part) & 1) {
            const bool from_side = face.slack < 0.0f;
            const int count = atomicAdd(&tested_count[turn][part][own][from_side], 1);
            tested[part][own][from_side ? EACH - 1 - count : count] = face;
        }
    __syncthreads();
#pragma unroll
    for (int k = 0; k < GROUP; ++k) {
        const auto& number = tested_count[turn][warp][k];
        for (int j = 0; j < number[0]; ++j) test(tested[warp][k][j], x, y, best[k], next[k], which[k]);
        for (int j = 0; j < number[1]; ++j) test_from_side(tested[warp][k][EACH - 1 - j], x, y, next[k]);
    }
}
#else
const float part_y[PARTS][2] = {{bounds[2], bounds[3]}};
for (int k = 0; k < instants; ++k) {
    const Axes axes = axes_of(q_WC.data[first + k]);
    for (int j = 0; j < count; ++j)
        if (Face face; prepare(faces.data[begin + j], p_WC.data[first + k], axes, part_y, face)) {
            if (face.slack < 0.0f) test_from_side(face, x, y, next[k]);
            else test(face, x, y, best[k], next[k], which[k]);
        }
}
#endif
vec_t<GROUP, int> found;
for (int k = 0; k < GROUP; ++k) found[k] = count < 0 ? UNRESOLVED : decide(best[k], next[k], which[k], ray_C[2]);
return found;
