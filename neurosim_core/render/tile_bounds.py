"""The bounds of the rays of a tile of pixels: slopes, widened by an angle that covers rounding.

Frustums and the sides of tiles hold all rays of a tile by an angle of 1e-5 rad to spare. What that has to
cover is the rounding of rays and of the camera's axes when they are rotated (5e-7 rad each), and of a
triangle's corners along the sides (1e-6 of the distance): 2e-6 rad together, wherever in the picture,
because all of it is measured as angles. Bounds are kept as slopes x / z, and a slope is an angle only
short of 90 degrees from the axis: lenses are taken up to a slope of 100 (89.4 degrees), where the 1e-5
rad move a bound by two thousandths of itself at most, and are refused beyond. A triangle whose plane
contains the ray to within rounding is the one exception: Woop's test can hit it outside of its edges, and
where that is outside of the frustum, too, the tree finds it and a list does not.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurosim_core.render.candidate_data import TILE

_BORDER_RAD = 1.0e-5
"""By how much the rays of a tile are taken to reach beyond their border [rad]."""
_SLOPE_MAX = 100.0
"""Largest |x / z| and |y / z| of a ray: 89.4 degrees from the axis."""


def looks_forward(rays: NDArray[np.float32]) -> bool:
    """Return whether `tile_bounds` takes the rays of a lens."""
    x, y, z = np.moveaxis(rays[..., :3].astype(np.float64), -1, 0)
    return bool((z > 0.0).all() and (np.maximum(np.abs(x), np.abs(y)) <= _SLOPE_MAX * z).all())


def tile_bounds(rays: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return the least and largest x / z and y / z of the rays of each tile, shape [tile, 4], row by row.

    They are widened by 1e-5 rad, more than rounding. A ray that reaches z = 1 after the length L, and a plane
    x = (s + ds) z where it has the slope s, are ds / (L sqrt(1 + s^2)) apart [rad]. Rays are in C, shape
    [layer, H * W, 3 or more].

    Raises:
        ValueError: A ray does not look forward (z <= 0), or is too close to 90 degrees from the axis: |x / z|
            or |y / z| is above 100.
    """
    directions = rays[..., :3].astype(np.float64).reshape(-1, height, width, 3)
    if not (directions[..., 2] > 0.0).all():
        raise ValueError("candidate lists need rays that look forward, and some of this lens do not (z <= 0)")
    slopes = directions[..., :2] / directions[..., 2:]
    steepest = float(np.abs(slopes).max())
    if steepest > _SLOPE_MAX:
        raise ValueError(
            f"candidate lists need rays with |x / z| and |y / z| up to {_SLOPE_MAX:g} "
            f"({math.degrees(math.atan(_SLOPE_MAX)):.1f} deg from the axis), and this lens has "
            f"{steepest:.4g}: take a narrower lens, or set render.candidate_lists to null"
        )
    length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
    widened = _BORDER_RAD * length * np.sqrt(1.0 + slopes**2)
    lowest, highest = slopes - widened, slopes + widened
    bounds = []
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            part = np.s_[:, top : top + TILE, left : left + TILE]
            low, high = lowest[part].min(axis=(0, 1, 2)), highest[part].max(axis=(0, 1, 2))
            bounds.append((low[0], high[0], low[1], high[1]))
    return np.array(bounds, dtype=np.float32)
