using namespace wp;
const Mesh mesh = mesh_get(id);
const vec3 a = mesh.points[mesh.indices[3 * face]], b = mesh.points[mesh.indices[3 * face + 1]],
           c = mesh.points[mesh.indices[3 * face + 2]];
float t, u, v, sign;
if (intersect_ray_tri_woop(origin, ray, a, b, c, t, u, v, sign, (vec3*)nullptr) && t >= 0.0f)
    return vec3(t, u, v);
return vec3(-1.0f, 0.0f, 0.0f);
