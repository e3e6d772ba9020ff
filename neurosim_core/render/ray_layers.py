"""Rays through the pixels of a camera: through their centres, and through several points of each.

Those that were asked for last are kept, for the renderers of several batches in flight.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.render.camera import Lens
from neurosim_core.render.lighting import spread_order

_CELLS = 4


def _rays_through(
    lens: Lens, points: Iterable[Any], sample_count: int, fill_factor: float
) -> Iterator[NDArray[np.float32]]:
    """Yield rays through points of the sensitive area of each pixel, shape [H, W, 4]."""
    spread = lens.ray_spread()[..., None] * np.float32(np.sqrt(fill_factor / sample_count))
    for point in points:
        column, row = 0.5 + np.sqrt(fill_factor) * (np.asarray(point) - 0.5)
        yield np.concatenate([lens.ray_table((column, row)), spread], axis=-1)


@functools.lru_cache(maxsize=1)
def ray_layers(lens: Lens, sample_count: int, fill_factor: float = 1.0) -> NDArray[np.float32]:
    """Return rays through the centres of pixels and, for n > 1 samples, through n points spread over them.

    The points are a lattice over a share of the pixel's area around its centre: along rows and along columns
    each n-th of a pixel has one of the n.

    Returns:
        Direction in C and spread [rad], shape [1 or 1 + n, H * W, 4].
    """
    points = [(0.5, 0.5)]
    if sample_count > 1:
        columns, rows = np.arange(sample_count), spread_order(sample_count)
        points += list(zip((columns + 0.5) / sample_count, (rows + 0.5) / sample_count, strict=True))
    layers = np.stack(list(_rays_through(lens, points, sample_count, fill_factor)))
    return layers.reshape(len(points), -1, 4)


@functools.lru_cache(maxsize=1)
def first_rays(lens: Lens, fill_factor: float = 1.0) -> NDArray[np.float32]:
    """Return the rays of the first pass, shape [H * W, 4].

    They go through the centres of 4 x 4 cells of the pixels. Four adjacent rows of a column use all columns
    of cells, and four adjacent columns of a row use all rows of cells.
    """
    pixels = [(row, col) for row in range(_CELLS) for col in range(_CELLS)]  # the others repeat these
    cells = [
        ((row + 2 * (col & 1) + (col >> 1)) % _CELLS, (col + 2 * (row & 1) + (row >> 1)) % _CELLS)
        for row, col in pixels
    ]
    rays = np.empty((lens.height, lens.width, 4), dtype=np.float32)
    points = (np.array(cells) + 0.5) / _CELLS
    for (row, col), through in zip(pixels, _rays_through(lens, points, 1, fill_factor), strict=True):
        rays[row::_CELLS, col::_CELLS] = through[row::_CELLS, col::_CELLS]
    return rays.reshape(-1, 4)


@functools.lru_cache(maxsize=1)
def pixel_rays(lens: Lens, fill_factor: float = 1.0) -> NDArray[np.float32]:
    """Return, of each pixel, the ray through its centre and its change across columns and rows.

    Returns:
        Direction in C and spread [rad]; difference of the directions at the right and the left border of the
        sensitive area, and of those at its lower and upper border; shape [3, H * W, 4].
    """
    points = ((0.5, 0.5), (1.0, 0.5), (0.0, 0.5), (0.5, 1.0), (0.5, 0.0))
    center, right, left, lower, upper = _rays_through(lens, points, 1, fill_factor)
    return np.stack([center, right - left, lower - upper]).reshape(3, -1, 4)
