#include "read_rows.cuh"
constexpr int DEPTH = 32; // of the trees that Warp builds
constexpr float SPARE = 1.0000005f;
#ifdef __CUDA_ARCH__
auto least = [](float a, float b) { return fminf(a, b); };
auto most = [](float a, float b) { return fmaxf(a, b); };
#else
auto least = [](float a, float b) { return a < b ? a : b; };
auto most = [](float a, float b) { return a > b ? a : b; };
#endif
const float ox = origin[0], oy = origin[1], oz = origin[2], all = ox + oy + oz + ray[0] + ray[1] + ray[2];
if (!(all - all == 0.0f)) // no comparison below would keep such a ray from any box
    return vec4(far_m, 0.0f, 0.0f, __int_as_float(-1));

// Woop's test: z is the axis that the ray goes along most; x and y are such that the ray goes up along z
const int axis = longest_axis(vec3(wp::abs(ray[0]), wp::abs(ray[1]), wp::abs(ray[2])));
auto turn = [&](float x, float y, float z, float& s, float& t) {
    s = axis == 0 ? y : axis == 1 ? z : x;
    t = axis == 0 ? z : axis == 1 ? x : y;
    return axis == 0 ? x : axis == 1 ? y : z;
};
float along_s, along_t;
const float along = turn(ray[0], ray[1], ray[2], along_s, along_t);
const bool flip = along < 0.0f;
const float sx = (flip ? along_t : along_s) / along, sy = (flip ? along_s : along_t) / along,
            sz = 1.0f / along;
auto shear = [&](const Row& corner, float& x, float& y, float& z) {
    float s, t;
    z = turn(corner.x - ox, corner.y - oy, corner.z - oz, s, t);
    x = (flip ? t : s) - sx * z;
    y = (flip ? s : t) - sy * z;
};
float best = far_m, best_u = 0.0f, best_v = 0.0f;
int best_face = -1;
auto test_leaf = [&](int place) {
    for (bool more = true; more; ++place) {
        const Row a = row(tree.triangles, 3 * place), b = row(tree.triangles, 3 * place + 1),
                  c = row(tree.triangles, 3 * place + 2);
        const int face = __float_as_int(a.w);
        more = __float_as_int(b.w) == 0;
        float ax, ay, az, bx, by, bz, cx, cy, cz;
        shear(a, ax, ay, az);
        shear(b, bx, by, bz);
        shear(c, cx, cy, cz);
        float u = diff_product(cx, by, cy, bx), v = diff_product(ax, cy, ay, cx),
              w = diff_product(bx, ay, by, ax);
        if (u == 0.0f || v == 0.0f || w == 0.0f) {
            u = (float)((double)cx * (double)by - (double)cy * (double)bx);
            v = (float)((double)ax * (double)cy - (double)ay * (double)cx);
            w = (float)((double)bx * (double)ay - (double)by * (double)ax);
        }
        if ((u < 0.0f || v < 0.0f || w < 0.0f) && (u > 0.0f || v > 0.0f || w > 0.0f)) continue;
        const float det = u + v + w;
        if (det == 0.0f) continue;
        const float inverse = 1.0f / det;
        const float t = (u * (sz * az) + v * (sz * bz) + w * (sz * cz)) * inverse;
        if (t >= 0.0f && (t < best || (t == best && face < best_face))) {
            best = t;
            best_u = u * inverse;
            best_v = v * inverse;
            best_face = face;
        }
    }
};

// no direction is too small, so that no product below is 0 times infinity
auto invert = [](float x) { return 1.0f / (wp::abs(x) < 1.0e-20f ? 1.0e-20f : x); };
const float rx = invert(ray[0]), ry = invert(ray[1]), rz = invert(ray[2]);
auto intersects = [&](float x0, float x1, float y0, float y1, float z0, float z1, float& near) {
    const float a = (x0 - ox) * rx, b = (x1 - ox) * rx, c = (y0 - oy) * ry, d = (y1 - oy) * ry,
                e = (z0 - oz) * rz, f = (z1 - oz) * rz;
    near = most(most(least(a, b), least(c, d)), most(least(e, f), 0.0f));
    return near <= SPARE * least(least(most(a, b), most(c, d)), least(most(e, f), best));
};
// `continue`, and not one place that takes the next node, is a third faster: threads of a warp part there
int waiting[DEPTH], depth = 0, node = tree.root;
while (true) {
    if (node < 0) {
        test_leaf(-1 - node);
        if (depth == 0) break;
        node = waiting[--depth];
        continue;
    }
    const Row a = row(tree.nodes, 4 * node), b = row(tree.nodes, 4 * node + 1),
              c = row(tree.nodes, 4 * node + 2), d = row(tree.nodes, 4 * node + 3);
    const int first = __float_as_int(d.x), second = __float_as_int(d.y);
    float near_first, near_second;
    const bool intersects_first = intersects(a.x, a.y, a.z, a.w, c.x, c.y, near_first);
    const bool intersects_second = intersects(b.x, b.y, b.z, b.w, c.z, c.w, near_second);
    if (intersects_first && intersects_second) {
        const bool swap = near_second < near_first;
        waiting[depth++] = swap ? first : second;
        node = swap ? second : first;
    } else if (intersects_first || intersects_second) {
        node = intersects_first ? first : second;
    } else {
        if (depth == 0) break;
        node = waiting[--depth];
    }
}
return vec4(best, best_u, best_v, __int_as_float(best_face));
