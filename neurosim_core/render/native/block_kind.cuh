// Returns what the first rays hit in the 4 x 4 pixels at `top`, `left` and in the ring around them, as in `list_seen_faces.cuh`.
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
const int part_here = *wp::address(faces, instant, top, left), surface_here = scene.face_surface.data[wp::max(part_here, 0)];
using Four = int __attribute__((ext_vector_type(4)));
Four other_faces = width < 6;
for (int y = 0; y < 6; ++y) {
    const int* const row = wp::address(faces, instant, wp::min(upper + y, height - 1), leftmost);
    if (width < 6) continue;
    Four first, last;
    __builtin_memcpy(&first, row, sizeof(Four));
    __builtin_memcpy(&last, row + 2, sizeof(Four));
    other_faces |= (first ^ part_here) | (last ^ part_here);
}
if (__builtin_reduce_or(other_faces) == 0) return part_here < 0 ? SKY : ONE_SURFACE;
int other_surface = 0, hit = 0, missed = 0;
for (int y = 0; y < 6; ++y) {
    const int* const row = wp::address(faces, instant, wp::min(upper + y, height - 1));
    for (int x = 0; x < 6; ++x) {
        const int part = row[wp::min(leftmost + x, width - 1)];
        missed |= part;
        hit |= ~part;
        const volatile int& surface = scene.face_surface.data[wp::max(part, 0)]; // volatile: a vector gather takes longer
        other_surface |= surface ^ surface_here;
    }
}
return hit >= 0 ? SKY : other_surface || missed < 0 ? SEVERAL : ONE_SURFACE;
