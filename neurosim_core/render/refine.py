"""Triangles of a scene, split until light that is linear between their corners is fine enough."""

from __future__ import annotations

import logging
import math

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.scene import RefinedMesh, Scene
from neurosim_core.scene.triangles import corner_columns, dot

log = logging.getLogger(__name__)

ADDED_COUNT_MAX = 4_000_000
"""Most faces that are added."""


def refine(scene: Scene, edge_max_m: float | None, *, added_count_max: int = ADDED_COUNT_MAX) -> RefinedMesh:
    """Split edges of triangles in halves until none is longer than `edge_max_m`; None: leave all as they are.

    Where that would add more than `added_count_max` faces, `edge_max_m` grows by factors of sqrt(2) until it
    does not, and a warning is logged. A face takes about 230 bytes.

    Whether an edge is split, and where, depends on nothing but its two ends, so faces that share an edge
    (also with vertices of their own at the same places) split it alike: no cracks, no T-junctions. Area is
    preserved. What `Scene.refined` has is returned as it is.
    """
    if edge_max_m in scene.refined:
        return scene.refined[edge_max_m]
    edge_m = edge_max_m
    while (mesh := refine_within(scene, edge_m, added_count_max)) is None:
        assert edge_m is not None
        edge_m *= math.sqrt(2.0)
    if edge_m != edge_max_m:
        log.warning(
            "baked light: the scene is so large that triangles have edges of up to %.3g m instead of %g m "
            "(render.lighting.edge_max_m), or they would be more than %d; shadows are as coarse",
            edge_m,
            edge_max_m,
            len(scene.faces) + added_count_max,
        )
    return mesh


def refine_within(
    scene: Scene, edge_max_m: float | None, added_count_max: int = ADDED_COUNT_MAX
) -> RefinedMesh | None:
    """Return what `refine` returns; None if more faces are added than allowed."""
    vertices, normals, uv = scene.vertices, scene.normals, scene.uv
    faces, origin = scene.faces, np.arange(len(scene.faces), dtype=np.int32)
    short: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = []
    while edge_max_m is not None and len(faces):
        tips = corner_columns(vertices, faces)
        sides = np.roll(tips, -1, axis=1) - tips  # side k goes from corner k to corner k + 1
        long = (dot(sides, sides) > np.float32(edge_max_m**2)).T
        split = long[:, 0] | long[:, 1] | long[:, 2]
        added_count_max -= int(long.sum())
        if added_count_max < 0:
            return None
        short.append((faces[~split], origin[~split]))
        chosen, chosen_long = faces[split], long[split]
        one, other = (ends[chosen_long].astype(np.int64) for ends in (chosen, chosen[:, (1, 2, 0)]))
        ends = np.minimum(one, other) * len(vertices) + np.maximum(one, other)
        keys, index = np.unique(ends, return_inverse=True)
        first, second = keys // len(vertices), keys % len(vertices)
        middle = np.full(chosen.shape, -1, dtype=np.int32)
        middle[chosen_long] = len(vertices) + index
        halves = np.float32(0.5) * (normals[first] + normals[second])
        length = np.linalg.norm(halves, axis=1, keepdims=True)
        halves = np.where(length > 1e-3, halves / np.maximum(length, 1e-3), normals[first])
        vertices = np.concatenate([vertices, np.float32(0.5) * (vertices[first] + vertices[second])])
        normals = np.concatenate([normals, halves])
        uv = np.concatenate([uv, np.float32(0.5) * (uv[first] + uv[second])])
        faces, parents = _split_faces(vertices, chosen, middle)
        origin = origin[split][parents]
    faces, origin = (np.concatenate(each) for each in zip(*short, (faces, origin), strict=True))
    order = np.argsort(origin, kind="stable")  # parts of a face stay together: neighbours in space and memory
    return RefinedMesh(vertices=vertices, normals=normals, uv=uv, faces=faces[order], origin=origin[order])


def _split_faces(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], middle: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the parts of faces [F, 3] and the row each comes from.

    `middle` [F, 3] is the vertex in the middle of side k (from corner k to k + 1), -1 where it is not split.
    """
    parts: list[NDArray[np.int32]] = []
    parents: list[NDArray[np.int64]] = []

    def add(rows: NDArray[np.int64], *corners: NDArray[np.int32]) -> None:
        parts.append(np.stack(corners, axis=1))
        parents.append(rows)

    count = (middle >= 0).sum(axis=1)
    rows = np.flatnonzero(count == 3)
    (a, b, c), (ab, bc, ca) = faces[rows].T, middle[rows].T
    for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)):
        add(rows, *corners)
    # Turned so that with one split side it is a-b, with two the whole side is c-a.
    for turn in range(3):
        turned, turned_middle = np.roll(faces, -turn, axis=1), np.roll(middle, -turn, axis=1)
        rows = np.flatnonzero((count == 1) & (turned_middle[:, 0] >= 0))
        (a, b, c), ab = turned[rows].T, turned_middle[rows, 0]
        add(rows, a, ab, c)
        add(rows, ab, b, c)
        rows = np.flatnonzero((count == 2) & (turned_middle[:, 2] < 0))
        (a, b, c), (ab, bc) = turned[rows].T, turned_middle[rows, :2].T
        add(rows, ab, b, bc)
        # The rest is a quadrangle a, ab, bc, c: cut along its shorter diagonal.
        first, second = vertices[a] - vertices[bc], vertices[ab] - vertices[c]
        from_a = np.linalg.norm(first, axis=1) <= np.linalg.norm(second, axis=1)
        add(rows[from_a], a[from_a], ab[from_a], bc[from_a])
        add(rows[from_a], a[from_a], bc[from_a], c[from_a])
        add(rows[~from_a], a[~from_a], ab[~from_a], c[~from_a])
        add(rows[~from_a], ab[~from_a], bc[~from_a], c[~from_a])
    return np.concatenate(parts), np.concatenate(parents)
