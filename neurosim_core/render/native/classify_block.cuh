// CUDA: what the first rays show in a block of 4 x 4 pixels, whose threads are 16 of a warp, and in the ring around it: the
// same place as in `list_seen_faces.cuh`. 0: one surface; 1: several; 2: the sky; 3: a moving body. All threads of a warp call it.
const int instant = at.instant, top = at.top, left = at.left, height = view.height, width = view.width;
int kind = 0;
#ifdef __CUDA_ARCH__
const int lane = threadIdx.x % 16, shift = threadIdx.x & 16;
const int face_count = wp::mesh_get(scene.mesh).num_tris;
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
const int* const first_row = faces.data + (size_t)instant * height * width;
int surfaces[3];
bool several = false, body = false, inside[3];
#pragma unroll
for (int turn = 0; turn < 3; ++turn) {
    const int place = 16 * turn + lane, y = upper + place / 6, x = leftmost + place % 6;
    inside[turn] = place < 36 && y < height && x < width;
    const int part = inside[turn] ? first_row[y * width + x] : -1;
    surfaces[turn] = part >= 0 && part < face_count ? scene.face_surface.data[part] : -1;
    body |= part >= face_count;
}
const int reference = __shfl_sync(0xffffffffu, surfaces[0], 0, 16);
#pragma unroll
for (int turn = 0; turn < 3; ++turn) several |= inside[turn] && surfaces[turn] != reference;
const unsigned severals = __ballot_sync(0xffffffffu, several), bodies = __ballot_sync(0xffffffffu, body);
kind = (severals >> shift) & 0xffffu ? 1 : reference < 0 ? 2 : 0;
if ((bodies >> shift) & 0xffffu) kind = 3;
#endif
return kind;
