using namespace wp;
const BVH bvh = mesh_get(id).bvh;
if (node >= bvh.num_nodes || bvh.node_lowers[node].b) return;
atomic_min(&bounds.data[0], node);
atomic_max(&bounds.data[1], node);
