"""Corners of triangle meshes: where edges of the geometry meet, whatever triangles it is cut into."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_WELD_M = 1e-5
"""Vertices this close are one [m]."""
_FLAT_COSINE = np.cos(0.02)


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
