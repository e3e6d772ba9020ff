"""The topology of a mesh: edges, plane surfaces, shading normals, corners."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.triangles import corner_columns, cross, dot, face_vectors

if TYPE_CHECKING:
    from neurosim_core.scene.scene import Scene

CREASE_RAD = 0.7
"""Edges whose faces differ by more than this stay sharp [rad]; 40 degrees."""
_BLOCK = 8192
"""Faces at a time: what is computed of them stays in the cache of a core."""
_PLANE_COSINE = 1.0 - 1e-5  # normals of a plane surface differ by less than a quarter of a degree
_WELD_M = 1e-5
"""Vertices this close are one corner [m]."""
_FLAT_COSINE = np.cos(0.02)


def connected_components(
    count: int, one: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[int, NDArray[np.int64]]:
    """Return the number of connected components of a graph, and that of each node.

    To import SciPy's sparse matrices takes 0.25 s. Components are numbered in the order of their first nodes.

    Args:
        count: Number of nodes.
        one: A node that each edge joins, shape [E].
        other: The other node that it joins, shape [E].
    """
    root = np.arange(count)
    while True:
        one, other = root.take(one), root.take(other)
        apart = one != other
        one, other = one[apart], other[apart]
        if len(one) == 0:
            break
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while not np.array_equal(up := root.take(root), root):
            root = up
    first = root == np.arange(count)
    return int(first.sum()), (np.cumsum(first) - 1).take(root)


def _weld(positions: NDArray[Any], group: NDArray[np.int64] | int = 0) -> NDArray[np.int64]:
    """Return a number for each place [V, 3], to float32, and group of vertices, shape [V]."""
    bits = (positions + np.float32(0.0)).astype(np.float32).view(np.int32).astype(np.int64)  # + 0: no -0
    x, y, z = bits.T
    plan, rest = x << 32 | (y & 0xFFFFFFFF), z << 31 | group
    order = np.lexsort((rest, plan))
    point = np.zeros(len(positions), dtype=np.int64)
    point[order[1:]] = np.cumsum((np.diff(plan[order]) != 0) | (np.diff(rest[order]) != 0))
    return point


def _edge_pairs(
    one: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of edges with the same ends, whichever is named first, of the numbers of these, [E]."""
    key = np.minimum(one, other) << 32 | np.maximum(one, other)
    order = np.argsort(key, kind="stable")
    ordered = key.take(order)
    shared = np.flatnonzero(ordered[1:] == ordered[:-1])
    return order.take(shared), order.take(shared + 1)


def connect_faces(scene: Scene) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return which faces share edges, and which are parts of one surface.

    Vertices at one place are one. Of several faces at an edge each has one of the others.

    Returns:
        The face beyond the edge opposite each corner, -1: none, shape [3 F]. The surface of each face, shape
        [F]: a surface is plane, has one material, and its texture coordinates are continuous.
    """
    mesh, material = scene, scene.face_material
    count = len(mesh.faces)
    corner = _weld(mesh.vertices).take(mesh.faces)
    first, last = np.roll(corner, -1, axis=1).reshape(-1), np.roll(corner, 1, axis=1).reshape(-1)
    one, other = _edge_pairs(first, last)
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


def smooth_normals(
    positions: NDArray[np.float64], faces: NDArray[np.int64], group: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the normal of each corner of each face, shared where the surface is smooth.

    Corners that meet at one position are joined when a chain of faces leads from one to the other over edges
    that are no creases; joined corners get the mean of their faces' normals, weighted by the corners' angles
    (Thürmer and Wüthrich 1998), so the result does not depend on how a surface is cut into triangles.
    Vertices at equal positions are one, as at a texture seam; the objects that `group` tells apart are not
    smoothed into each other; of no face is the area zero.

    Returns:
        Unit normals, shape [N, 3], and for each corner the index of its normal, shape [F, 3].
    """
    if len(faces) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    point = _weld(positions, group)
    face_normal, angle = np.empty((2, 3, len(faces)))
    columns = np.ascontiguousarray(positions.T)
    for begin in range(0, len(faces), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        corner = columns.take(faces[block].T, axis=1)
        edge = np.roll(corner, -1, axis=1) - corner
        normal = cross(edge[:, 0], edge[:, 1])
        face_normal[:, block] = normal / np.sqrt(dot(normal, normal))
        direction = edge / np.sqrt(dot(edge, edge))
        angle[:, block] = np.arccos(np.clip(-dot(direction, np.roll(direction, 1, axis=1)), -1.0, 1.0))

    # half-edges c -> c + 1 of each face, and the pairs that share an edge
    head = np.arange(1, faces.size + 1)
    head[2::3] -= 3
    at = point.take(faces).reshape(-1)
    first, second = _edge_pairs(at, at[head])
    one, other = (face_normal.take(corners // 3, axis=1) for corners in (first, second))
    gentle = dot(one, other) > np.cos(CREASE_RAD)
    first, second = first[gentle], second[gentle]
    same = at[first] == at[second]  # else the faces run along the edge in opposite senses, as they should
    joined_a = np.concatenate([first, head[first]])
    joined_b = np.concatenate([np.where(same, second, head[second]), np.where(same, head[second], second)])
    count, label = connected_components(faces.size, joined_a, joined_b)
    weights = ((angle * axis).T.reshape(-1) for axis in face_normal)
    total = np.stack([np.bincount(label, weights=weight, minlength=count) for weight in weights])
    length = np.sqrt(dot(total, total))
    return (total / np.where(length > 0.0, length, 1.0)).T, label.reshape(-1, 3)


def find_corners(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    groups: NDArray[np.int32] | None = None,
    *,
    crease_rad: float,
    turn_rad: float,
) -> NDArray[np.float32]:
    """Return the corners of a mesh, in the order of their coordinates [m], shape [C, 3].

    An edge is *sharp* if it has one face or more than two, if its faces belong to two groups, or if their
    normals differ by more than `crease_rad`. A vertex is a corner if sharp edges leave it in directions that
    are not on one line, by `turn_rad`. A vertex inside a plane or on its straight rim is none, though the
    triangles there may share no edges. Vertices [V, 3] may be split where texture coordinates differ;
    `groups` say what each face belongs to, shape [F]; None: all to the same.
    """
    _, first, weld = np.unique(
        np.rint(vertices[faces.reshape(-1)] / _WELD_M).astype(np.int64),
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    points = vertices[faces.reshape(-1)][first].astype(np.float64)
    corner = weld.reshape(-1, 3)
    a, b, c = points[corner].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    whole = area > 0.0
    corner, normal = corner[whole], normal[whole] / area[whole, None]
    group = np.zeros(len(corner), np.int32) if groups is None else groups[whole]
    ends = _sharp_edges(points, corner, group, np.cos(crease_rad))
    along = points[ends[:, 1]] - points[ends[:, 0]]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    spread = np.zeros((len(points), 3, 3))
    for end in (0, 1):
        np.add.at(spread, ends[:, end], along[:, :, None] * along[:, None, :])
    second = np.linalg.eigvalsh(spread)[:, 1]  # of two edges: 1 - |cosine| of the angle between them
    found = (second > 1.0 - np.cos(turn_rad)) & ~_in_planes(points, corner, normal, group)
    return np.asarray(points[found], np.float32)


def _sharp_edges(
    points: NDArray[np.float64], corner: NDArray[np.int64], group: NDArray[np.int32], crease_cosine: float
) -> NDArray[np.int64]:
    """Return the ends of sharp edges, shape [E, 2]."""
    sides = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    apex = corner[:, [2, 0, 1]].T.reshape(-1)
    face_group = np.tile(group, 3)
    edges, edge, count = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.reshape(-1), kind="stable")
    last = np.cumsum(count) - 1
    one, other = order[last - count + 1], order[last]
    # each face continues the other where their apexes are on opposite sides of the edge, however it is wound
    start = points[edges[:, 0]]
    along = points[edges[:, 1]] - start
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    away = []
    for side in (one, other):
        to_apex = points[apex[side]] - start
        across = to_apex - (to_apex * along).sum(axis=1, keepdims=True) * along
        away.append(across / np.linalg.norm(across, axis=1, keepdims=True))
    bent = (away[0] * away[1]).sum(axis=1) > -crease_cosine
    sharp = (count != 2) | bent | (face_group[one] != face_group[other])
    return np.asarray(edges[sharp])


def _in_planes(
    points: NDArray[np.float64],
    corner: NDArray[np.int64],
    normal: NDArray[np.float64],
    group: NDArray[np.int32],
) -> NDArray[np.bool_]:
    """Return which points have faces of one plane and one group all around or half around, shape [V]."""
    around = np.zeros(len(points))
    for k in range(3):
        one = points[corner[:, (k + 1) % 3]] - points[corner[:, k]]
        other = points[corner[:, (k + 2) % 3]] - points[corner[:, k]]
        angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(axis=1))
        np.add.at(around, corner[:, k], angle)
    point, face = corner.reshape(-1), np.repeat(np.arange(len(corner)), 3)
    some = np.zeros(len(points), np.int64)
    some[point] = face  # any of the faces of a point
    agrees = (np.abs((normal[face] * normal[some[point]]).sum(axis=1)) > _FLAT_COSINE) & (
        group[face] == group[some[point]]
    )
    flat = np.ones(len(points), np.bool_)
    np.logical_and.at(flat, point, agrees)
    halves = around / np.pi
    return np.asarray(flat & (np.minimum(np.abs(halves - 1.0), np.abs(halves - 2.0)) < 0.02))
