# mypy: disable-error-code="index,attr-defined,misc,call-overload,assignment,operator,arg-type"
"""Moving bodies as the ray caster keeps them: a tree for each in its frame, and where the camera is in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.render.kernel_data import BodyData
from neurosim_core.render.ray_tree import make_mesh
from neurosim_core.scene.bodies import Body, BodyPoses
from neurosim_core.scene.scene import RefinedMesh

wp.set_module_options({"enable_backward": False})

_SPHERE_MARGIN = 1.01
"""Float32 finds a sphere to 1e-6 of its distance: none is missed up to a distance of 10,000 radii."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyArrays:
    """Bodies on a device, shared by all cameras."""

    bodies: tuple[Body, ...]
    meshes: tuple[wp.Mesh, ...]
    shading: wp.Mesh | None
    """The part of the scene that casts shadows on bodies."""
    data: BodyData
    """Without the arrays of instants."""


def upload_bodies(
    bodies: Sequence[Body],
    refined: Sequence[RefinedMesh],
    *,
    scene_face_count: int,
    shading: wp.Mesh | None,
    device: str,
) -> BodyArrays:
    """Bring bodies to a device and build their trees; `shading` of the scene casts shadows on them."""
    meshes = tuple(make_mesh(body.solid.vertices, body.solid.faces, device) for body in bodies)
    first = scene_face_count + np.cumsum([0, *(len(mesh.faces) for mesh in refined[:-1])])
    normals = np.concatenate([mesh.corner_normals.reshape(-1, 3) for mesh in refined])
    sphere = np.array([[*body.center_m, _SPHERE_MARGIN * body.radius_m] for body in bodies], dtype=np.float32)
    data = BodyData()
    data.mesh = wp.array(np.array([mesh.id for mesh in meshes], np.uint64), dtype=wp.uint64, device=device)
    data.first_face = wp.array(first, dtype=int, device=device)
    data.corner_normal = wp.array(normals, dtype=wp.vec3, device=device)
    data.sphere = wp.array(sphere, dtype=wp.vec4, device=device)
    data.shading = wp.uint64(0) if shading is None else shading.id
    return BodyArrays(bodies=tuple(bodies), meshes=meshes, shading=shading, data=data)


def make_body_data(arrays: BodyArrays | None, instant_count: int, device: str) -> BodyData:
    """Allocate what the kernel reads of bodies for K instants; nothing without bodies."""
    data = BodyData()
    if arrays is not None:
        data.assign(arrays.data)
        shape = (instant_count, len(arrays.bodies))
        data.p_OC = wp.zeros(shape, dtype=wp.vec3, device=device)
        data.q_OC = wp.zeros(shape, dtype=wp.quat, device=device)
        data.sphere_C = wp.zeros(shape, dtype=wp.vec4, device=device)
    return data


@wp.kernel
def _place_camera(
    # In:
    p_WO: wp.array2d[wp.vec3d],
    q_WO: wp.array2d[wp.quatd],
    p_WC: wp.array[wp.vec3],
    q_WC: wp.array[wp.quat],
    # In/out:
    bodies: BodyData,
) -> None:
    instant, body = wp.tid()
    q_OW = wp.quat_inverse(q_WO[instant, body])
    p_OC = wp.quat_rotate(q_OW, wp.vec3d(p_WC[instant]) - p_WO[instant, body])
    q_OC = q_OW * wp.quatd(q_WC[instant])
    ball = bodies.sphere[body]
    center = wp.vec3d(wp.float64(ball[0]), wp.float64(ball[1]), wp.float64(ball[2]))
    center_C = wp.vec3(wp.quat_rotate_inv(q_OC, center - p_OC))
    bodies.p_OC[instant, body] = wp.vec3(p_OC)
    bodies.q_OC[instant, body] = wp.quat(q_OC)
    bodies.sphere_C[instant, body] = wp.vec4(center_C[0], center_C[1], center_C[2], ball[3])


def place_camera(
    bodies: BodyData, poses: BodyPoses, p_WC: Any, q_WC: Any, *, instant_count: int, device: str
) -> None:
    """Write where the camera is in the frames of the bodies at the first `instant_count` of K instants.

    Computed in float64 and rounded once: a body far from the origin of the world is seen as sharply.
    Positions [m], vec3, and orientations, quat, have shape [K]; of `bodies` the arrays [K, B] are written.
    """
    dim, inputs = (instant_count, bodies.mesh.shape[0]), [poses.p_WO, poses.q_WO, p_WC, q_WC]
    wp.launch(_place_camera, dim=dim, inputs=inputs, outputs=[bodies], device=device)
