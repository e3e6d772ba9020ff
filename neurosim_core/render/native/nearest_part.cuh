// Returns the part of a face before the cuts that is in a direction.
auto nearest_part = [&](int face, const wp::vec3& direction) {
    int found = scene.whole_first.data[face];
    float most = -1e30f;
    for (int part = scene.whole_first.data[face]; part < scene.whole_first.data[face + 1]; ++part) {
        const int* index = &mesh.indices[3 * (size_t)part];
        float function[3][3], least = 1e30f, near = 0.0f;
        functions_of(mesh.points[index[0]] - origin, mesh.points[index[1]] - origin, mesh.points[index[2]] - origin, function);
        for (int side = 0; side < 3; ++side) {
            const float at = function[side][0] * direction[0] + function[side][1] * direction[1] + function[side][2] * direction[2];
            least = wp::min(least, at);
            near += at;
        }
        if (least / near > most) {
            most = least / near;
            found = part;
        }
    }
    return found;
};
