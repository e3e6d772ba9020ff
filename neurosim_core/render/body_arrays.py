# mypy: disable-error-code="index,attr-defined,misc,call-overload,assignment,operator,arg-type"
"""Moving bodies as the ray caster keeps them: a tree for each in its frame, and where the camera is in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.refine import RefinedMesh
from neurosim_core.scene.bodies import Body, BodyPoses
from neurosim_core.scene.scene import Material

wp.set_module_options({"enable_backward": False})

_SPHERE_MARGIN = 1.01
"""Float32 finds a sphere to 1e-6 of its distance: none is missed up to a distance of 10,000 radii."""


@wp.struct
class BodyData:
    """The arrays of bodies that the kernel reads; empty without bodies."""

    mesh: wp.array[wp.uint64]  # Trees, each in the frame O of its body, shape [B]
    first_face: wp.array[int]  # First face of each body in the arrays of `SceneData`, shape [B]
    corner_normal: wp.array[wp.vec3]
    """Shading normals in O, on the front of the face, of all bodies one after another, shape [3F]."""
    shading: wp.uint64  # What of the scene casts shadows on bodies; 0 if nothing does
    p_OC: wp.array2d[wp.vec3]  # Position of the camera [m], shape [K, B]
    q_OC: wp.array2d[wp.quat]  # Orientation of the camera, shape [K, B]
    sphere_C: wp.array2d[wp.vec4]  # Centre and radius of a sphere around the body [m], shape [K, B]


@dataclass(frozen=True, kw_only=True, eq=False)
class JoinedBodies:
    """The faces of all bodies one after another, each in the frame of its body."""

    mesh: RefinedMesh
    material: NDArray[np.int32]
    """Of each face, counted on from the materials of the scene, shape [F]."""
    instance: NDArray[np.int32]
    """Of each face, counted on from the instances of the scene, shape [F]."""
    materials: tuple[Material, ...]
    first_face: tuple[int, ...]
    """First face of each body, and the number of all, shape [B + 1]."""


def join_bodies(bodies: Sequence[Body], *, material_count: int, instance_count: int) -> JoinedBodies:
    """Put the faces of bodies, if any, one after another, behind the materials and instances of the scene."""
    solids = [body.solid for body in bodies]
    vertex = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    material = material_count + np.cumsum([0, *(len(solid.materials) for solid in solids)])
    face = np.cumsum([0, *(len(solid.faces) for solid in solids)])

    def joined(rows: Sequence[NDArray[np.generic]], width: int, dtype: type) -> NDArray[np.generic]:
        shape = (0, width) if width > 1 else (0,)
        return np.concatenate([np.zeros(shape, dtype), *rows]).astype(dtype)

    faces = joined([s.faces + first for s, first in zip(solids, vertex, strict=False)], 3, np.int32)
    return JoinedBodies(
        mesh=RefinedMesh(
            vertices=joined([s.vertices for s in solids], 3, np.float32),
            normals=joined([s.normals for s in solids], 3, np.float32),
            uv=joined([s.uv for s in solids], 2, np.float32),
            faces=faces,
            origin=np.arange(len(faces), dtype=np.int32),
        ),
        material=joined(
            [s.face_material + first for s, first in zip(solids, material, strict=False)], 1, np.int32
        ),
        instance=np.repeat(np.arange(len(solids), dtype=np.int32) + instance_count, np.diff(face)),
        materials=tuple(m for solid in solids for m in solid.materials),
        first_face=tuple(face.tolist()),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyArrays:
    """Bodies on a device, shared by all cameras."""

    bodies: tuple[Body, ...]
    meshes: tuple[wp.Mesh, ...]
    shading: wp.Mesh | None
    """What of the scene casts shadows on bodies."""
    mesh: wp.array[wp.uint64]
    first_face: wp.array[int]
    corner_normal: wp.array[wp.vec3]
    sphere: wp.array[wp.vec4]
    """Centre in O and radius of a sphere around each body [m], shape [B]."""


def upload_bodies(
    bodies: Sequence[Body],
    joined: JoinedBodies,
    *,
    scene_face_count: int,
    shading: wp.Mesh | None,
    device: str,
) -> BodyArrays:
    """Bring bodies to a device and build their trees; `shading` of the scene casts shadows on them."""
    meshes = tuple(
        wp.Mesh(
            wp.array(body.solid.vertices, dtype=wp.vec3, device=device),
            wp.array(body.solid.faces.reshape(-1), dtype=int, device=device),
            bvh_constructor="sah",
            bvh_leaf_size=1 if wp.get_device(device).is_cuda else 4,
        )
        for body in bodies
    )
    first = scene_face_count + np.array(joined.first_face[:-1], dtype=np.int32)
    sphere = np.array([[*body.center_m, _SPHERE_MARGIN * body.radius_m] for body in bodies], dtype=np.float32)
    return BodyArrays(
        bodies=tuple(bodies),
        meshes=meshes,
        shading=shading,
        mesh=wp.array(np.array([mesh.id for mesh in meshes], np.uint64), dtype=wp.uint64, device=device),
        first_face=wp.array(first, dtype=int, device=device),
        corner_normal=wp.array(joined.mesh.corner_normals.reshape(-1, 3), dtype=wp.vec3, device=device),
        sphere=wp.array(sphere, dtype=wp.vec4, device=device),
    )


def make_body_data(arrays: BodyArrays | None, instant_count: int, device: str) -> BodyData:
    """Allocate what the kernel reads of bodies for K instants; nothing without bodies."""
    data = BodyData()
    if arrays is not None:
        shape = (instant_count, len(arrays.bodies))
        data.mesh, data.first_face = arrays.mesh, arrays.first_face
        data.corner_normal = arrays.corner_normal
        data.shading = wp.uint64(0) if arrays.shading is None else arrays.shading.id
        data.p_OC = wp.zeros(shape, dtype=wp.vec3, device=device)
        data.q_OC = wp.zeros(shape, dtype=wp.quat, device=device)
        data.sphere_C = wp.zeros(shape, dtype=wp.vec4, device=device)
    return data


@wp.kernel
def _place_camera(
    # Model:
    sphere: wp.array[wp.vec4],
    # In:
    p_WO: wp.array2d[wp.vec3d],
    q_WO: wp.array2d[wp.quatd],
    p_WC: wp.array[wp.vec3],
    q_WC: wp.array[wp.quat],
    # Out:
    p_OC_out: wp.array2d[wp.vec3],
    q_OC_out: wp.array2d[wp.quat],
    sphere_C_out: wp.array2d[wp.vec4],
) -> None:
    instant, body = wp.tid()
    q_OW = wp.quat_inverse(q_WO[instant, body])
    p_OC = wp.quat_rotate(q_OW, wp.vec3d(p_WC[instant]) - p_WO[instant, body])
    q_OC = q_OW * wp.quatd(q_WC[instant])
    ball = sphere[body]
    center = wp.vec3d(wp.float64(ball[0]), wp.float64(ball[1]), wp.float64(ball[2]))
    center_C = wp.vec3(wp.quat_rotate_inv(q_OC, center - p_OC))
    p_OC_out[instant, body] = wp.vec3(p_OC)
    q_OC_out[instant, body] = wp.quat(q_OC)
    sphere_C_out[instant, body] = wp.vec4(center_C[0], center_C[1], center_C[2], ball[3])


def place_camera(
    arrays: BodyArrays,
    poses: BodyPoses,
    p_WC: wp.array[wp.vec3],
    q_WC: wp.array[wp.quat],
    *,
    instant_count: int,
    data: BodyData,
) -> None:
    """Write where the camera is in the frames of the bodies at the first `instant_count` of K instants.

    Computed in float64 and rounded once: a body far from the origin of the world is seen as sharply.
    Positions [m] and orientations have shape [K]; the arrays [K, B] of `data` are overwritten.
    """
    wp.launch(
        _place_camera,
        dim=(instant_count, len(arrays.bodies)),
        inputs=[arrays.sphere, poses.p_WO, poses.q_WO, p_WC, q_WC],
        outputs=[data.p_OC, data.q_OC, data.sphere_C],
        device=arrays.mesh.device,
    )
