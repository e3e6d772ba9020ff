// Lists the faces of the scene, as they were before they were cut for baked light, that the first rays hit in the
// 4 x 4 pixels at `top`, `left` and in a ring of one pixel around them, at a border of the picture in
// 6 x 6 pixels: `seen` [seen_count], with a part of each that was
// hit, `part_hit`, and `sky`, whether some rays hit nothing. More than MOST, or a moving body: `listed` is false.
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
int seen[MOST], part_hit[MOST], seen_count = 0, previous = -2;
#ifndef __CUDA_ARCH__
for (int& face : seen) face = -1;
#endif
bool sky = false, listed = true;
auto is_listed = [&](int face) {
#ifdef __CUDA_ARCH__
    for (int entry = 0; entry < seen_count; ++entry)
        if (seen[entry] == face) return true;
    return false;
#else // all of them: a few vector instructions
    int found = 0;
    for (const int other : seen) found |= other == face;
    return found != 0;
#endif
};
auto list_face = [&](int face, int part) {
    listed &= seen_count < MOST;
    if (!listed) return;
    seen[seen_count] = face;
    part_hit[seen_count++] = part;
};
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
for (int y = upper; y < wp::min(upper + 6, height); ++y) {
    const int* row_faces = wp::address(faces, instant, y);
    for (int x = leftmost; x < wp::min(leftmost + 6, width); ++x) {
        const int part = row_faces[x];
        if (part == previous) continue;
        previous = part;
        if (part < 0) sky = true;
        else if (part >= mesh.num_tris) listed = false;
        else if (const int face = scene.whole_of_face.data[part]; !is_listed(face)) list_face(face, part);
    }
}
