"""Proof that a path keeps its clearance everywhere, not only at samples.

A part of a path that begins at a and ends at b, L apart, stays within e of the straight motion from a to b, e
being the largest distance between its Bernstein control points and theirs (a convex hull). If the nearest
obstacle is Da from a and Db from b, then every point a + s (b - a) is at least

    sqrt(min over s in [0, 1] of (1 - s) Da^2 + s Db^2 - s (1 - s) L^2)

from every obstacle (see `scene.freespace`), and the curve at most e less. Where that proves too little a part
is halved: L^2 and e fall to a quarter. Distances at the ends are exact, from the triangles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.freespace import FreeSpace
from neurosim_core.trajectory.feasibility import bernstein_matrix
from neurosim_core.trajectory.path import restriction

Array = NDArray[np.float64]

_PART_M = 0.15
"""About how long parts are at first."""
_HALVINGS_MAX = 12


def prove_clearance(coefficients: Array, space: FreeSpace, clearance_m: float) -> NDArray[np.bool_]:
    """Prove that polynomial pieces keep a clearance, and return for each whether it is proven, shape [S].

    A piece fails if some point of it is too near something (the bounds of the scene count), or if it comes so
    close to the limit (about 1e-5 m) that 12 halvings prove nothing. Positions [m] are coefficients in rising
    powers of normalised time, shape [S, 3, degree + 1].
    """
    degree = coefficients.shape[2] - 1
    convert = bernstein_matrix(degree)
    spare = 1e-6 * (1.0 + float(np.abs(space.bounds_m).max()))  # distances come in float32
    extent = np.abs(coefficients[:, :, 1:]).sum(axis=2).max(axis=1)
    parts = np.clip(np.ceil(extent / _PART_M), 1, 64).astype(np.int64)
    piece = np.repeat(np.arange(len(coefficients)), parts)
    first = np.cumsum(parts) - parts
    length = 1.0 / parts[piece]
    start = (np.arange(len(piece)) - first[piece]) * length
    holds = np.ones(len(coefficients), dtype=bool)
    straight = np.linspace(0.0, 1.0, degree + 1)[:, None]
    for halving in range(_HALVINGS_MAX + 1):
        hull = np.einsum(
            "pbj,paj->pba", convert @ restriction(start, length, degree), coefficients[piece], optimize=True
        )
        a, b = hull[:, 0], hull[:, -1]
        room = space.clearance(np.concatenate([a, b])) - spare
        room_a, room_b = room[: len(a)], room[len(a) :]
        excess = np.linalg.norm(hull - (a[:, None] + straight * (b - a)[:, None]), axis=2).max(axis=1)
        bound = segment_clearance(room_a, room_b, np.linalg.norm(b - a, axis=1)) - excess
        good = bound >= clearance_m
        bad = ~good & (np.minimum(room_a, room_b) < clearance_m)
        holds[piece[bad]] = False
        open_ = ~good & holds[piece]
        if not open_.any():
            break
        if halving == _HALVINGS_MAX:
            holds[piece[open_]] = False
            break
        half = 0.5 * length[open_]
        start = np.stack([start[open_], start[open_] + half], axis=1).reshape(-1)
        length, piece = np.repeat(half, 2), np.repeat(piece[open_], 2)
    return holds


def segment_clearance(room_a: Array, room_b: Array, length: Array) -> Array:
    """Return a lower bound of the distance to obstacles on segments, from those at their ends [m]."""
    a2, b2, l2 = np.maximum(room_a, 0.0) ** 2, np.maximum(room_b, 0.0) ** 2, length**2
    s = np.clip(np.divide(l2 + a2 - b2, 2.0 * l2, out=np.zeros_like(l2), where=l2 > 0.0), 0.0, 1.0)
    squared = (1.0 - s) * a2 + s * b2 - s * (1.0 - s) * l2
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))
