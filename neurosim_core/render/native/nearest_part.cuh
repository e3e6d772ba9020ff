// Returns the part of a face before the cuts that is in a direction from a position.
auto nearest_part = [&](int face, const wp::vec3& from, const wp::vec3& direction) {
    int found = scene.whole_first.data[face];
    const int end = scene.whole_first.data[face + 1];
    if (end - found == 1) return found;
    constexpr float WITHIN = 1e-3f; // no other part is as far around the direction
    float most = -1e30f;
    for (int part = found; part < end && most < WITHIN; ++part) {
        const int* index = &mesh.indices[3 * (size_t)part];
        const wp::vec3 a = mesh.points[index[0]] - from, b = mesh.points[index[1]] - from, c = mesh.points[index[2]] - from;
        const float at[3] = {wp::dot(wp::cross(b, c), direction), wp::dot(wp::cross(c, a), direction),
                             wp::dot(wp::cross(a, b), direction)};
        const float share = 1.0f / (at[0] + at[1] + at[2]), least = wp::min(wp::min(at[0] * share, at[1] * share), at[2] * share);
        if (least > most) {
            most = least;
            found = part;
        }
    }
    return found;
};
