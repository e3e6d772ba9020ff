# mypy: disable-error-code="index,attr-defined,arg-type,assignment,call-overload,no-untyped-def,empty-body"
# ruff: noqa: UP018, RUF046  (typed literals have a meaning in kernels)
"""Intersection of a ray with the scene, with a face of a candidate list, and with moving bodies."""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

from functools import cache

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.kernel_data import FAR_M, UNRESOLVED, BodyData, Hit, SceneData
from neurosim_core.render.ray_tree import intersect_tree

UNFUSED = {"fuse_fp": False}
"""Products and sums are rounded one by one: so pixels have the same bits whichever kernel renders them."""


@wp.func_native(read_native(__file__, "intersect_face"))
def intersect_face(id: wp.uint64, face: int, origin: wp.vec3, ray: wp.vec3) -> wp.vec3:
    """Return t [m], u and v of a ray and a triangle, with the bits of `wp.mesh_query_ray`; t = -1: no hit."""
    ...


@wp.func
def intersect_scene(scene: SceneData, origin: wp.vec3, ray: wp.vec3) -> Hit:
    """Return the first hit of a ray with what stands still; the ray traverses the tree."""
    found = intersect_tree(scene.tree, origin, ray, FAR_M)
    hit = Hit()
    hit.face = wp.cast(found[3], int)
    if hit.face >= 0:
        hit.t = found[0]
        hit.u = found[1]
        hit.v = found[2]
        hit.normal = scene.face_normal[hit.face]
    return hit


@wp.func
def intersect_candidate(scene: SceneData, origin: wp.vec3, ray: wp.vec3, face: int) -> Hit:
    """Return the hit of a ray with the face that a candidate list gives; -1 and UNRESOLVED are passed on."""
    hit = Hit()
    hit.face = face
    if face >= 0:
        found = intersect_face(scene.mesh, face, origin, ray)
        if found[0] >= 0.0:
            hit.t = found[0]
            hit.u = found[1]
            hit.v = found[2]
            hit.normal = scene.face_normal[face]
        else:
            hit.face = UNRESOLVED
    return hit


@wp.func
def intersect_bodies(bodies: BodyData, instant: int, ray_C: wp.vec3, q_WC: wp.quat, hit: Hit):
    """Return the nearer of `hit` and the first hit with a body, and the index of that body, -1: none.

    The ray traverses the tree of each body whose bounding sphere it passes, in the frame of the body and no
    further than the nearest hit so far.
    """
    nearest = Hit()
    nearest.face = hit.face
    nearest.t = wp.where(hit.face >= 0, hit.t, FAR_M)
    nearest.u = hit.u
    nearest.v = hit.v
    nearest.normal = hit.normal
    nearest_body = int(-1)
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
                nearest_body = body
    return nearest, nearest_body


@cache
def _normal_kernel() -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED)
    def write_normals(mesh: wp.uint64, normal_out: wp.array[wp.vec3]) -> None:
        face = wp.tid()
        normal_out[face] = wp.mesh_eval_face_normal(mesh, face)

    return write_normals


def face_normals(mesh: wp.Mesh) -> wp.array[wp.vec3]:
    """Return the unit normal of each face's front, with the bits of `wp.mesh_query_ray`."""
    normals = wp.empty(mesh.indices.shape[0] // 3, dtype=wp.vec3, device=mesh.device)
    wp.launch(_normal_kernel(), dim=normals.shape[0], inputs=[mesh.id], outputs=[normals], device=mesh.device)
    return normals
