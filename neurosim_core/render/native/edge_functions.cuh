constexpr float NEARER = 1.0f + 4e-6f; // faces that coincide are in the order of their list, whatever the rounding
constexpr float OVERLAP = 1e-5f; // of a triangle's size: no point falls between two that share an edge
// Rounded by itself where products and sums are fused, too: so an edge has the same function on a CPU and on CUDA.
auto product = [](float x, float y) {
#ifdef __CUDA_ARCH__
    return __fmul_rn(x, y);
#else
    return x * y;
#endif
};
// Functions of a direction whose values are the weights of a triangle's corners over the distance to its plane along it.
auto functions_of = [&](const wp::vec3& a, const wp::vec3& b, const wp::vec3& c, auto& function) {
    auto cross = [&](const wp::vec3& x, const wp::vec3& y) {
        return wp::vec3(product(x[1], y[2]) - product(x[2], y[1]), product(x[2], y[0]) - product(x[0], y[2]),
                        product(x[0], y[1]) - product(x[1], y[0]));
    };
    const wp::vec3 normals[3] = {cross(b, c), cross(c, a), cross(a, b)};
    const float volume = product(a[0], normals[0][0]) + product(a[1], normals[0][1]) + product(a[2], normals[0][2]);
    const float scale = wp::abs(volume) > 1e-30f ? 1.0f / volume : 0.0f; // all 0 for a triangle that is seen edge-on
    for (int side = 0; side < 3; ++side)
        for (int axis = 0; axis < 3; ++axis) function[side][axis] = product(normals[side][axis], scale);
    return volume;
};
// Turns values of the three functions, value(side, term), into those seen from a position that is `shift` away: to each a part of
// their sum is added, for the edges lie in the plane that the sum is the nearness of. `along_shift`: their values along `shift`.
auto shift_values = [](auto value, const auto& along_shift) {
    const float share = 1.0f / (1.0f - (along_shift[0] + along_shift[1] + along_shift[2]));
    for (int term = 0; term < 3; ++term) {
        const float sum = value(0, term) + value(1, term) + value(2, term);
        for (int side = 0; side < 3; ++side) value(side, term) += share * along_shift[side] * sum;
    }
};
// Whether the face beyond an edge does not lie on the same side of it as the face itself, as seen from `origin`.
auto is_beyond = [&](int face, const auto& function) {
    float least = 0.0f, largest = 0.0f;
    for (int tip = 0; tip < 3; ++tip) {
        const wp::vec3 toward = scene.whole_corner.data[3 * face + tip] - origin;
        const float at = product(function[0], toward[0]) + product(function[1], toward[1]) + product(function[2], toward[2]);
        least = wp::min(least, at);
        largest = wp::max(largest, at);
    }
    return -least > largest;
};
