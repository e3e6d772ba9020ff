"""Halls with boxes, in which tasks fly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def hall_settings(
    size_m: Sequence[float], boxes: Sequence[Sequence[float]], *, seed: int, inside_m: Sequence[float]
) -> dict[str, Any]:
    """Return settings of a hall as a scene.

    `size_m`: length, width and height [m]. `boxes`: middle [m], size [m] and yaw [rad] of each, in W, [n, 7].
    `inside_m`: a free point [m].
    """
    rows = np.asarray(boxes, dtype=np.float64).tolist()
    settings = [{"position_m": row[:3], "size_m": row[3:6], "yaw_rad": row[6]} for row in rows]
    return {"kind": "hall", "size_m": size_m, "boxes": settings, "seed": seed, "inside_m": inside_m}
