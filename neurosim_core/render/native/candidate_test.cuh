using namespace wp;
constexpr float EDGE = 4.0e-6f, TIE = 2.0e-4f, SIDE = 4.0e-3f, SURE = 1.0f - TIE;
// A triangle: edge functions u, v, w and normal n, such that n . ray is one over the distance and the edge
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
// The sides of a tile at an instant, which are planes, and its corners, which are rays.
struct Tile {
    vec3 border[4], corner[4];
};
auto bound = [&](int side, const quat& q, Tile& to) {
    const vec3 x = quat_rotate(q, vec3(1.0f, 0.0f, 0.0f)), y = quat_rotate(q, vec3(0.0f, 1.0f, 0.0f)),
               z = quat_rotate(q, vec3(0.0f, 0.0f, 1.0f));
    const float slope = bounds[side];
    to.border[side] = normalize((side % 2 ? -1.0f : 1.0f) * ((side < 2 ? x : y) - slope * z));
    to.corner[side] = normalize(bounds[side % 2] * x + bounds[2 + side / 2] * y + z);
};
auto prepare = [&](int face, const vec3& origin, const Tile& tile, Face& to) {
    const vec3 a = mesh.points[mesh.indices[3 * face]] - origin;
    const vec3 b = mesh.points[mesh.indices[3 * face + 1]] - origin;
    const vec3 c = mesh.points[mesh.indices[3 * face + 2]] - origin;
    const float size = wp::sqrt(wp::max(dot(a, a), wp::max(dot(b, b), dot(c, c))));
    for (const vec3& side : tile.border)
        if (wp::max(dot(side, a), wp::max(dot(side, b), dot(side, c))) < -1.0e-6f * size) return false;
    const vec3 ab = b - a, bc = c - b, ca = a - c;
    const float ab2 = dot(ab, ab), bc2 = dot(bc, bc), ca2 = dot(ca, ca);
    to.face = face;
    to.u = cross(b, bc);
    to.v = cross(c, ca);
    to.w = cross(a, ab);
    to.n = cross(ca, ab);
    to.slack = EDGE * size * wp::sqrt(wp::max(ab2, wp::max(bc2, ca2)));
    const float volume = dot(a, to.n);
    if (wp::abs(volume) < SIDE * size * wp::sqrt(ab2 * ca2)) {
        to.slack = -wp::max(to.slack, 1.0e-30f);
        return true;
    }
    const float scale = 1.0f / volume;
    to.u = scale * to.u;
    to.v = scale * to.v;
    to.w = scale * to.w;
    to.n = scale * to.n;
    to.slack *= wp::abs(scale);
    float u = -FLT_MAX, v = -FLT_MAX, w = -FLT_MAX;
    for (const vec3& corner : tile.corner) {
        u = wp::max(u, dot(to.u, corner));
        v = wp::max(v, dot(to.v, corner));
        w = wp::max(w, dot(to.w, corner));
    }
    return wp::min(u, wp::min(v, w)) >= -to.slack;
};
// The best so far, the runner-up, and the nearest that may or may not be hit: one over the distance.
auto along = [](const vec3& n, float x, float y, float z) {
#ifdef __CUDA_ARCH__
    return fmaf(n[0], x, fmaf(n[1], y, n[2] * z));
#else
    return n[0] * x + n[1] * y + n[2] * z;
#endif
};
auto test = [&](const Face& face, float x, float y, float z, float& best, float& next, float& unsure,
                int& which) {
    const float u = along(face.u, x, y, z), v = along(face.v, x, y, z), w = along(face.w, x, y, z);
    const float low = wp::min(u, wp::min(v, w));
    if (face.slack < 0.0f) {
        const bool missed = low < face.slack && wp::max(u, wp::max(v, w)) > -face.slack;
        unsure = missed ? unsure : FLT_MAX;
    } else {
        const float inverse = along(face.n, x, y, z);
        const float maybe = low > -face.slack ? wp::max(inverse, FLT_MIN) : 0.0f;
        const float hit = low > face.slack ? inverse : 0.0f;
        unsure = wp::max(unsure, low > face.slack ? 0.0f : maybe);
        next = wp::max(next, wp::min(hit, best));
        which = hit > best ? face.face : which;
        best = wp::max(best, hit);
    }
};
auto decide = [&](float best, float next, float unsure, int which) {
    if (best == 0.0f) return unsure == 0.0f && reach >= far_m ? -1 : UNRESOLVED;
    const bool sure = wp::max(next, unsure) < SURE * best && best * reach > 1.0f + TIE;
    return sure ? which : UNRESOLVED;
};
