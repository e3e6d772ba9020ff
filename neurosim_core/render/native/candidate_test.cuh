using namespace wp;
constexpr float EDGE = 5.0e-6f, TIE = 2.0e-4f, SIDE = 4.0e-3f, SURE = 1.0f - TIE, BORDER_RAD = 1.0e-5f;
// A triangle: edge functions u, v, w and normal n, in C, such that n . ray is one over the distance and the edge
// functions are positive inside. A triangle seen nearly from the side is not scaled, and its slack is < 0.
struct Face {
    vec3 u;
    float slack;
    vec3 v;
    int face;
    vec3 w;
    float unused;
    vec3 n;
    float unused_too;
};
const Mesh mesh = mesh_get(id);
// The pixels of a tile are tested in PARTS, whose rays have y / z within `part_y`. Rays are taken with z = 1.
#ifdef __CUDA_ARCH__
constexpr int PARTS = 2; // of the warps of a block
#else
constexpr int PARTS = 1;
#endif
struct Axes { // of the camera, in W
    vec3 x, y, z;
};
auto axes_of = [](const quat& q) {
    return Axes{quat_rotate(q, vec3(1.0f, 0.0f, 0.0f)), quat_rotate(q, vec3(0.0f, 1.0f, 0.0f)), quat_rotate(q, vec3(0.0f, 0.0f, 1.0f))};
};
auto plus_product = [](float x, float y, float z) { // x + y z
#ifdef __CUDA_ARCH__
    return fmaf(y, z, x);
#else
    return x + y * z;
#endif
};
auto in_camera = [&](const Axes& axes, const vec3& v) {
    auto along = [&](const vec3& axis) { return plus_product(plus_product(axis[0] * v[0], axis[1], v[1]), axis[2], v[2]); };
    return vec3(along(axes.x), along(axes.y), along(axes.z));
};
const float across = wp::max(bounds[0] * bounds[0], bounds[1] * bounds[1]), down = wp::max(bounds[2] * bounds[2], bounds[3] * bounds[3]);
const float longest = wp::sqrt(1.0f + across + down); // ray of the tile
// Prepares a face; returns a bit for each part that it may reach.
auto prepare = [&](int face, const vec3& origin, const Axes& axes, const auto& part_y, Face& to) {
    const vec3 a = mesh.points[mesh.indices[3 * face]] - origin;
    const vec3 b = mesh.points[mesh.indices[3 * face + 1]] - origin;
    const vec3 c = mesh.points[mesh.indices[3 * face + 2]] - origin;
    const vec3 corner[3] = {in_camera(axes, a), in_camera(axes, b), in_camera(axes, c)};
    auto beside = [&](int tip, int axis, float slope) { return plus_product(corner[tip][axis], -slope, corner[tip][2]); };
    auto least = [&](int axis, float slope) {
        return wp::min(beside(0, axis, slope), wp::min(beside(1, axis, slope), beside(2, axis, slope)));
    };
    auto most = [&](int axis, float slope) {
        return wp::max(beside(0, axis, slope), wp::max(beside(1, axis, slope), beside(2, axis, slope)));
    };
    int parts = 0;
    if (most(0, bounds[0]) < 0.0f || least(0, bounds[1]) > 0.0f) return parts;
    for (int part = 0; part < PARTS; ++part)
        if (most(1, part_y[part][0]) >= 0.0f && least(1, part_y[part][1]) <= 0.0f) parts |= 1 << part;
    const vec3 ab = b - a, bc = c - b, ca = a - c;
    const float ab2 = dot(ab, ab), bc2 = dot(bc, bc), ca2 = dot(ca, ca);
    const vec3 normal = cross(ca, ab);
    const float volume = dot(a, normal);
    const float size2 = wp::max(dot(a, a), wp::max(dot(b, b), dot(c, c))), edge2 = wp::max(ab2, wp::max(bc2, ca2));
    const bool seen_from_side = volume * volume <= SIDE * SIDE * size2 * (ab2 * ca2);
    const float scale = seen_from_side ? 1.0f : 1.0f / volume;
    to.face = face;
    to.u = scale * in_camera(axes, cross(b, bc));
    to.v = scale * in_camera(axes, cross(c, ca));
    to.w = scale * in_camera(axes, cross(a, ab));
    to.n = scale * in_camera(axes, normal);
    to.slack = EDGE * wp::sqrt(size2 * edge2) * wp::abs(scale) * longest;
    if (seen_from_side) {
        to.slack = -wp::max(to.slack, 1.0e-30f);
        return parts;
    }
    auto largest = [&](const vec3& f, int part) {
        return wp::max(f[0] * bounds[0], f[0] * bounds[1]) + wp::max(f[1] * part_y[part][0], f[1] * part_y[part][1]) + f[2];
    };
    for (int part = 0; part < PARTS; ++part)
        if (wp::min(largest(to.u, part), wp::min(largest(to.v, part), largest(to.w, part))) < -to.slack) parts &= ~(1 << part);
    return parts;
};
// The nearest for certain, and the nearest other that may be hit: one over the distance.
auto along = [&](const vec3& n, float x, float y) { return plus_product(plus_product(n[2], n[1], y), n[0], x); };
auto lowest = [&](const Face& face, float x, float y, float& highest) {
    const float u = along(face.u, x, y), v = along(face.v, x, y), w = along(face.w, x, y);
    highest = wp::max(u, wp::max(v, w));
    return wp::min(u, wp::min(v, w));
};
auto test = [&](const Face& face, float x, float y, float& best, float& next, int& which) {
    float highest;
    const float low = lowest(face, x, y, highest), inverse = along(face.n, x, y);
    const bool inside = low > face.slack, nearest = inside && inverse > best;
    const float maybe = low > -face.slack ? wp::max(inverse, FLT_MIN) : 0.0f;
    next = wp::max(next, inside ? wp::min(inverse, best) : maybe);
    which = nearest ? face.face : which;
    best = nearest ? inverse : best;
};
auto test_from_side = [&](const Face& face, float x, float y, float& next) {
    float highest;
    const float low = lowest(face, x, y, highest);
    next = low < face.slack && highest > -face.slack ? next : FLT_MAX;
};
// `z`: of the ray of unit length.
auto decide = [&](float best, float next, int which, float z) {
    if (best == 0.0f) return next == 0.0f && reach >= far_m ? -1 : UNRESOLVED;
    const bool sure = next < SURE * best && best * z * reach > 1.0f + TIE;
    return sure ? which : UNRESOLVED;
};
