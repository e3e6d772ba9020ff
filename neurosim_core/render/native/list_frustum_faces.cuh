#include "read_rows.cuh"
constexpr int ROOM = 1024, THREADS = 64;
const vec3 normal[6] = {frustum.x - frustum.slope_high[0] * frustum.z,
                        frustum.slope_low[0] * frustum.z - frustum.x,
                        frustum.y - frustum.slope_high[1] * frustum.z,
                        frustum.slope_low[1] * frustum.z - frustum.y,
                        frustum.z,
                        -frustum.z};
const float offset[6] = {frustum.foot_high[0], -frustum.foot_low[0], frustum.foot_high[1],
                         -frustum.foot_low[1], frustum.far,          -frustum.near};
auto box_outside = [&](const vec3& lower, const vec3& upper) {
    const vec3 middle = 0.5f * (lower + upper) - frustum.origin, half = 0.5f * (upper - lower);
    bool outside = false;
    for (int k = 0; k < 6; ++k) {
        const vec3& n = normal[k];
        const float radius = wp::abs(n[0]) * half[0] + wp::abs(n[1]) * half[1] + wp::abs(n[2]) * half[2];
        outside |= dot(n, middle) - radius > offset[k];
    }
    return outside;
};
auto face_outside = [&](const Row& p, const Row& q, const Row& r) {
    const vec3 a = vec3(p.x, p.y, p.z) - frustum.origin, b = vec3(q.x, q.y, q.z) - frustum.origin,
               c = vec3(r.x, r.y, r.z) - frustum.origin;
    bool outside = false;
    for (int k = 0; k < 6; ++k) {
        const vec3& n = normal[k];
        outside |= dot(n, a) > offset[k] && dot(n, b) > offset[k] && dot(n, c) > offset[k];
    }
    return outside;
};
auto visit = [&](int node, auto&& list, auto&& push) {
    if (node < 0) {
        bool more = true;
        for (int place = -1 - node; more; ++place) {
            const Row a = row(tree.triangles, 3 * place), b = row(tree.triangles, 3 * place + 1),
                      c = row(tree.triangles, 3 * place + 2);
            if (!face_outside(a, b, c)) list(__float_as_int(a.w));
            more = __float_as_int(b.w) == 0;
        }
        return;
    }
    const Row a = row(tree.nodes, 4 * node), b = row(tree.nodes, 4 * node + 1),
              c = row(tree.nodes, 4 * node + 2), d = row(tree.nodes, 4 * node + 3);
    if (!box_outside(vec3(a.x, a.z, c.x), vec3(a.y, a.w, c.y))) push(__float_as_int(d.x));
    if (!box_outside(vec3(b.x, b.z, c.z), vec3(b.y, b.w, c.w))) push(__float_as_int(d.y));
};
#ifdef __CUDA_ARCH__
__shared__ int stack[ROOM];
__shared__ int height, found;
const int thread = threadIdx.x;
__syncthreads();
if (thread == 0) {
    stack[0] = tree.root;
    height = 1;
    found = 0;
}
__syncthreads();
while (height > 0 && height <= ROOM - THREADS && found <= limit) {
    const int taken = wp::min(height, THREADS), rest = height - taken;
    const int node = thread < taken ? stack[rest + thread] : 0;
    __syncthreads();
    if (thread == 0) height = rest;
    __syncthreads();
    if (thread < taken)
        visit(
            node,
            [&](int face) {
                const int place = atomicAdd(&found, 1);
                if (place < limit) faces_out.data[begin + place] = face;
            },
            [&](int child) { stack[atomicAdd(&height, 1)] = child; });
    __syncthreads();
}
const int left = height, count = found;
#else
int stack[ROOM], left = 1, count = 0;
stack[0] = tree.root;
while (left > 0 && left <= ROOM - THREADS && count <= limit)
    visit(
        stack[--left],
        [&](int face) {
            if (count++ < limit) faces_out.data[begin + count - 1] = face;
        },
        [&](int child) { stack[left++] = child; });
#endif
return left > 0 || count > limit ? -1 : count;
