"""Which faces of a mesh meet at edges, and which are parts of one plane surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.components import connected_components
from neurosim_core.scene.normals import edge_keys, weld
from neurosim_core.scene.triangles import corner_columns, dot, face_vectors

if TYPE_CHECKING:
    from neurosim_core.scene.scene import Scene

_PLANE_COSINE = 1.0 - 1e-5  # normals of a plane surface differ by less than a quarter of a degree


def connect_faces(scene: Scene) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return which faces share edges, and which are parts of one surface.

    Vertices at one place are one. Of several faces at an edge each has one of the others.

    Returns:
        The face beyond the edge opposite each corner, -1: none, shape [3 F]. The surface of each face, shape
        [F]: a surface is plane, has one material, and its texture coordinates are continuous.
    """
    mesh, material = scene, scene.face_material
    count = len(mesh.faces)
    corner = weld(mesh.vertices).take(mesh.faces)
    first, last = np.roll(corner, -1, axis=1).reshape(-1), np.roll(corner, 1, axis=1).reshape(-1)
    key = edge_keys(first, last)
    order = np.argsort(key, kind="stable")
    same = key[order[1:]] == key[order[:-1]]
    one, other = order[:-1][same], order[1:][same]
    neighbor = np.full(3 * count, -1, dtype=np.int32)
    neighbor[other], neighbor[one] = one // 3, other // 3

    normal = face_vectors(corner_columns(mesh.vertices, mesh.faces)).astype(np.float64)
    normal /= np.maximum(np.sqrt(dot(normal, normal)), 1e-30)
    uv = mesh.uv.take(mesh.faces, axis=0)  # of the ends of each edge, the one of the lower number first:
    ends = np.roll(uv, -1, axis=1).reshape(-1, 2), np.roll(uv, 1, axis=1).reshape(-1, 2)
    turned = (first > last)[:, None]
    joined = material[one // 3] == material[other // 3]
    for end in (np.where(turned, *ends[::-1]), np.where(turned, *ends)):
        u, v = (end.take(one, axis=0) == end.take(other, axis=0)).T
        joined &= u & v
    sides = (normal.take(edges // 3, axis=1) for edges in (one, other))
    joined &= dot(*sides) > _PLANE_COSINE
    _, surface = connected_components(count, one[joined] // 3, other[joined] // 3)
    return neighbor, surface.astype(np.int32)
