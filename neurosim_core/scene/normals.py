"""Shading normals of a mesh that has none: smooth over gentle edges, sharp over creases."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.components import connected_components
from neurosim_core.scene.triangles import cross, dot

_BLOCK = 8192
"""Faces at a time: what is computed of them stays in the cache of a core."""
CREASE_RAD = 0.7
"""Edges whose faces differ by more than this stay sharp [rad]; 40 degrees."""


def edge_keys(one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number for each edge, whichever end is named first, of the numbers of its ends, below 2^31."""
    return np.minimum(one, other) << 32 | np.maximum(one, other)


def weld(positions: NDArray[Any], group: NDArray[np.int64] | int = 0) -> NDArray[np.int64]:
    """Return a number for each place [V, 3], to float32, and group of vertices, shape [V]."""
    bits = (positions + np.float32(0.0)).astype(np.float32).view(np.int32).astype(np.int64)  # + 0: no -0
    x, y, z = bits.T
    plan, rest = x << 32 | (y & 0xFFFFFFFF), z << 31 | group
    order = np.lexsort((rest, plan))
    point = np.zeros(len(positions), dtype=np.int64)
    point[order[1:]] = np.cumsum((np.diff(plan[order]) != 0) | (np.diff(rest[order]) != 0))
    return point


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
    point = weld(positions, group)
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

    # half-edges c -> c + 1 of each face; the two of one edge become neighbours when sorted by their ends
    head = np.arange(1, faces.size + 1)
    head[2::3] -= 3
    at = point.take(faces).reshape(-1)
    edge_key = edge_keys(at, at[head])
    sorted_edges = np.argsort(edge_key, kind="stable")
    ordered = edge_key.take(sorted_edges)
    shared = np.flatnonzero(ordered[1:] == ordered[:-1])
    first, second = sorted_edges.take(shared), sorted_edges.take(shared + 1)
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
