"""Shading normals of a mesh that has none: smooth over gentle edges, sharp over creases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.components import connected_components

CREASE_RAD = 0.7
"""Edges whose faces differ by more than this stay sharp [rad]; 40 degrees."""


def edge_keys(one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number for each edge, whichever end is named first, of the numbers of its ends, below 2^31."""
    return np.minimum(one, other) << 32 | np.maximum(one, other)


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
    keys = np.empty((4, len(positions)), dtype=np.int64)
    keys[:3] = np.ascontiguousarray(positions.T + 0.0).view(np.int64)  # + 0.0 makes -0.0 equal to 0.0
    keys[3] = group
    order = np.lexsort(keys)
    new = np.ones(len(positions), dtype=np.int64)
    new[1:] = (np.diff(keys[:, order], axis=1) != 0).any(axis=0)
    point = np.empty(len(positions), dtype=np.int64)
    point[order] = np.cumsum(new) - 1

    corner = positions.take(faces, axis=0)
    edge = np.roll(corner, -1, axis=1) - corner
    face_normal = np.cross(edge[:, 0], edge[:, 1])
    face_normal /= np.linalg.norm(face_normal, axis=1, keepdims=True)
    direction = edge / np.linalg.norm(edge, axis=2, keepdims=True)
    cosine = -np.einsum("fcx,fcx->fc", direction, np.roll(direction, 1, axis=1))
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))

    # half-edges c -> c + 1 of each face; the two of one edge become neighbours when sorted by their ends
    tail = np.arange(faces.size)
    head = tail + 1 - 3 * (tail % 3 == 2)
    at = point.take(faces).reshape(-1)
    edge_key = edge_keys(at, at[head])
    sorted_edges = np.argsort(edge_key, kind="stable")
    first, second = sorted_edges[:-1], sorted_edges[1:]
    gentle = edge_key[first] == edge_key[second]
    sides = (face_normal.take(corners // 3, axis=0) for corners in (first, second))
    gentle &= np.einsum("ex,ex->e", *sides) > np.cos(CREASE_RAD)
    first, second = first[gentle], second[gentle]
    same = at[first] == at[second]  # else the faces run along the edge in opposite senses, as they should
    joined_a = np.concatenate([first, head[first]])
    joined_b = np.concatenate([np.where(same, second, head[second]), np.where(same, head[second], second)])
    count, label = connected_components(faces.size, joined_a, joined_b)
    weighted = (angle[:, :, None] * face_normal[:, None, :]).reshape(-1, 3)
    total = np.empty((count, 3))
    for axis in range(3):
        total[:, axis] = np.bincount(label, weights=weighted[:, axis], minlength=count)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total /= np.where(length > 0.0, length, 1.0)
    return total, label.reshape(-1, 3)
