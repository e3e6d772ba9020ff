// Lists the faces of the scene, as they were before they were cut for baked light, that the first rays hit in the 4 x 4 pixels at
// `top`, `left` and in a ring of one pixel around them, at a border of the picture in 6 x 6 pixels: `seen` [seen_count], with a part
// of each that was hit, `part_hit`, and `sky`, whether some rays hit nothing. More than MOST, or a moving body: `listed` is false.
const wp::Mesh mesh = wp::mesh_get(scene.mesh);
int seen[MOST], part_hit[MOST], seen_count = 0;
for (int& face : seen) face = -1;
bool sky = false, listed = true;
auto is_listed = [&](int face) {
    int found = 0;
    for (const int other : seen) found |= other == face; // all of them: a few vector instructions
    return found != 0;
};
auto list_face = [&](int face, int part) {
    listed &= seen_count < MOST;
    if (!listed) return;
    seen[seen_count] = face;
    part_hit[seen_count++] = part;
};
const int upper = wp::max(wp::min(top - 1, height - 6), 0), leftmost = wp::max(wp::min(left - 1, width - 6), 0);
for (int y = upper; y < wp::min(upper + 6, height); ++y) {
    const int* const row = wp::address(faces, instant, y);
    const int* const above = y > upper ? row - width : row;
    for (int x = leftmost; x < wp::min(leftmost + 6, width); ++x) {
        const int part = row[x];
        if ((x > leftmost && part == row[x - 1]) || (y > upper && part == above[x])) continue;
        if (part < 0) sky = true;
        else if (part >= mesh.num_tris) listed = false;
        else if (const int face = scene.whole_of_face.data[part]; !is_listed(face)) list_face(face, part);
    }
}
