# mypy: disable-error-code="index,attr-defined,no-any-return,arg-type,assignment,call-overload"
# mypy: disable-error-code="no-untyped-def,empty-body"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: UP018, RUF046  (typed literals have a meaning in kernels)
"""What a ray hits first: of the scene, of the triangles of a list, of the bodies that move through it."""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

from functools import cache

import warp as wp

from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.ray_tree import walk_tree
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.walk_data import ASK

FAR_M = wp.constant(1.0e9)
"""Beyond this distance rays hit nothing [m]."""
UNFUSED = {"fuse_fp": False}
"""Products and sums are rounded one by one: so pixels have the same bits whichever kernel renders them."""


@wp.struct
class Hit:
    """What a ray hits first."""

    face: int
    """-1: nothing, and the rest has no meaning."""
    t: float
    """Distance along the ray [m]."""
    u: float
    """Weight of the first corner."""
    v: float
    """Weight of the second corner."""
    normal: wp.vec3
    """Unit normal of the face's front."""


@wp.func_native("""
    using namespace wp;
    const Mesh mesh = mesh_get(id);
    const vec3 a = mesh.points[mesh.indices[3 * face]], b = mesh.points[mesh.indices[3 * face + 1]],
               c = mesh.points[mesh.indices[3 * face + 2]];
    float t, u, v, sign;
    if (intersect_ray_tri_woop(origin, ray, a, b, c, t, u, v, sign, (vec3*)nullptr) && t >= 0.0f)
        return vec3(t, u, v);
    return vec3(-1.0f, 0.0f, 0.0f);
""")
def meet_face(id: wp.uint64, face: int, origin: wp.vec3, ray: wp.vec3) -> wp.vec3:
    """Return t [m], u and v where a ray meets a triangle, as `wp.mesh_query_ray` does; t = -1: nowhere."""
    ...


@wp.func
def meet_scene(scene: SceneData, origin: wp.vec3, ray: wp.vec3) -> Hit:
    """Return what a ray hits first that stands still; it walks through the tree by itself."""
    met = walk_tree(scene.tree, origin, ray, FAR_M)
    hit = Hit()
    hit.face = wp.cast(met[3], int)
    if hit.face >= 0:
        hit.t = met[0]
        hit.u = met[1]
        hit.v = met[2]
        hit.normal = scene.face_normal[hit.face]
    return hit


@wp.func
def meet_listed(scene: SceneData, origin: wp.vec3, ray: wp.vec3, face: int) -> Hit:
    """Return where a ray hits the face that a walk found, -1: nothing; ASK, also as the answer: who knows."""
    hit = Hit()
    hit.face = face
    if face >= 0:
        met = meet_face(scene.mesh, face, origin, ray)
        if met[0] >= 0.0:
            hit.t = met[0]
            hit.u = met[1]
            hit.v = met[2]
            hit.normal = scene.face_normal[face]
        else:
            hit.face = ASK
    return hit


@wp.func
def meet_bodies(bodies: BodyData, instant: int, ray_C: wp.vec3, q_WC: wp.quat, hit: Hit):
    """Return what a ray hits first, `hit` or a point of a body, and which body, -1: none.

    Of each body whose sphere the ray passes, the tree is asked in the frame of the body, no further than the
    nearest hit so far.
    """
    nearest = Hit()
    nearest.face = hit.face
    nearest.t = wp.where(hit.face >= 0, hit.t, FAR_M)
    nearest.u = hit.u
    nearest.v = hit.v
    nearest.normal = hit.normal
    met = int(-1)
    for body in range(bodies.mesh.shape[0]):
        sphere = bodies.sphere_C[instant, body]
        center = wp.vec3(sphere[0], sphere[1], sphere[2])
        radius = sphere[3]
        along = wp.dot(center, ray_C)
        beside = center - along * ray_C
        if along > -radius and along - radius < nearest.t and wp.dot(beside, beside) < radius * radius:
            q_OC = bodies.q_OC[instant, body]
            ray_O = wp.quat_rotate(q_OC, ray_C)
            query = wp.mesh_query_ray(bodies.mesh[body], bodies.p_OC[instant, body], ray_O, nearest.t)
            if query.result:
                nearest.face = bodies.first_face[body] + query.face
                nearest.t = query.t
                nearest.u = query.u
                nearest.v = query.v
                nearest.normal = wp.quat_rotate(q_WC, wp.quat_rotate_inv(q_OC, query.normal))
                met = body
    return nearest, met


@cache
def _normal_kernel() -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED)
    def write_normals(mesh: wp.uint64, normal_out: wp.array[wp.vec3]) -> None:
        face = wp.tid()
        normal_out[face] = wp.mesh_eval_face_normal(mesh, face)

    return write_normals


def face_normals(mesh: wp.Mesh) -> wp.array[wp.vec3]:
    """Return the unit normal of each face's front, with the bits that `wp.mesh_query_ray` gives."""
    normals = wp.empty(mesh.indices.shape[0] // 3, dtype=wp.vec3, device=mesh.device)
    wp.launch(_normal_kernel(), dim=normals.shape[0], inputs=[mesh.id], outputs=[normals], device=mesh.device)
    return normals
