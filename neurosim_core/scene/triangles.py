"""Vectors of many triangles, a column for each axis: NumPy takes several times as long over rows of three."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def corner_columns(vertices: NDArray[Any], faces: NDArray[Any]) -> NDArray[Any]:
    """Return the corners of faces [F, 3], shape [axis, corner, F]."""
    columns, corners = np.ascontiguousarray(vertices.T), np.ascontiguousarray(faces.T)
    return columns.take(corners, axis=1)


def dot(a: Sequence[NDArray[Any]] | NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return the scalar products of vectors, shape [axis, ...] -> [...]."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def cross(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return the vector products of vectors, shape [axis, ...]."""
    return np.stack([a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))])


def face_vectors(corners: NDArray[Any]) -> NDArray[Any]:
    """Return normals of triangles [axis, corner, F], as long as twice their areas, shape [axis, F]."""
    first = corners[:, 0]
    return cross(corners[:, 1] - first, corners[:, 2] - first)


def double_areas(corners: NDArray[Any]) -> NDArray[Any]:
    """Return twice the areas of triangles [axis, corner, F], shape [F]."""
    normal = face_vectors(corners)
    return np.sqrt(dot(normal, normal))
