using namespace wp;
const Mesh mesh = mesh_get(id);
const BVH& bvh = mesh.bvh;
auto number = [&](int node) {
    return bvh.node_lowers[node].b ? -1 - (int)bvh.node_lowers[node].i : node - first;
};
if (node == 0) root.data[0] = number(*bvh.root);
if (node >= bvh.num_nodes) return;
const BVHPackedNodeHalf low = bvh.node_lowers[node], high = bvh.node_uppers[node];
const int left = low.i, right = high.i;
if (low.b) {
    for (int place = left; place < right; ++place) {
        const int face = bvh.primitive_indices[place];
        const int beside[3] = {face, place + 1 == right, 0};
        for (int corner = 0; corner < 3; ++corner) {
            const vec3 p = mesh.points[mesh.indices[3 * face + corner]];
            triangles.data[3 * place + corner] = vec4(p[0], p[1], p[2], __int_as_float(beside[corner]));
        }
    }
    return;
}
const BVHPackedNodeHalf a = bvh.node_lowers[left], b = bvh.node_uppers[left], c = bvh.node_lowers[right],
                        d = bvh.node_uppers[right];
auto less = [](float x) { return x - wp::max(1.2e-7f * wp::abs(x), 1.0e-11f); };
auto more = [](float x) { return x + wp::max(1.2e-7f * wp::abs(x), 1.0e-11f); };
vec4* rows = nodes.data + 4 * (node - first);
rows[0] = vec4(less(a.x), more(b.x), less(a.y), more(b.y));
rows[1] = vec4(less(c.x), more(d.x), less(c.y), more(d.y));
rows[2] = vec4(less(a.z), more(b.z), less(c.z), more(d.z));
rows[3] = vec4(__int_as_float(number(left)), __int_as_float(number(right)), 0.0f, 0.0f);
