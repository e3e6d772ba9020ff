constexpr float NEARER = 1.0f + 4e-6f; // faces that coincide are in the order of their list, whatever the rounding
constexpr float OVERLAP = 1e-5f; // of a triangle's size: no point falls between two that share an edge
// Functions of a direction whose values are the weights of a triangle's corners over the distance to its plane along it.
auto functions_of = [&](const wp::vec3& a, const wp::vec3& b, const wp::vec3& c, auto& function) {
    const wp::vec3 normals[3] = {wp::cross(b, c), wp::cross(c, a), wp::cross(a, b)};
    const float volume = wp::dot(a, normals[0]);
    const float scale = wp::abs(volume) > 1e-30f ? 1.0f / volume : 0.0f; // all 0 for a triangle that is seen edge-on
    for (int side = 0; side < 3; ++side)
        for (int axis = 0; axis < 3; ++axis) function[side][axis] = normals[side][axis] * scale;
    return volume;
};
// Whether the face beyond an edge does not lie on the same side of it as the face itself, as seen from `origin`.
auto is_beyond = [&](int face, const auto& function) {
    float least = 0.0f, largest = 0.0f;
    for (int tip = 0; tip < 3; ++tip) {
        const wp::vec3 toward = scene.whole_corner.data[3 * face + tip] - origin;
        const float at = function[0] * toward[0] + function[1] * toward[1] + function[2] * toward[2];
        least = wp::min(least, at);
        largest = wp::max(largest, at);
    }
    return -least > largest;
};
