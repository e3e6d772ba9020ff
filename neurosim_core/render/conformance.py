"""Does a renderer see what the simulator means? Checks for any renderer, foreign ones included.

They need no scene that is known: one view of it must agree with another through the poses and the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.renderer import make_renderer, take_picture

Array = NDArray[np.float64]

_MOVES: Sequence[tuple[str, tuple[float, float, float], tuple[float, float, float]]] = (
    ("forward", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0)),
    ("to the right", (0.1, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ("down", (0.0, 0.1, 0.0), (0.0, 0.0, 0.0)),
    ("and turned to the right", (0.0, 0.0, 0.0), (0.0, 0.15, 0.0)),
    ("and pitched up", (0.0, 0.0, 0.0), (0.15, 0.0, 0.0)),
    ("and rolled", (0.0, 0.0, 0.0), (0.0, 0.0, 0.3)),
)
"""Name, translation in C [m] and rotation vector in C [rad] of second views."""
_RELATIVE_MAX = 0.01
"""Largest median error of depth against what the other view says: half a pixel on a slanted wall."""
_SHARE_MIN = 0.05
"""Least share of pixels that a comparison needs."""


def check_renderer(
    scene: Any, lens: PinholeConfig, *, position: ArrayLike, orientation: ArrayLike
) -> list[str]:
    """Return what is wrong with a renderer of depth and rgb; nothing if it conforms.

    Args:
        scene: What `upload_scene` returned.
        lens: A pinhole.
        position: p_WC [m], shape [3]: a place from which most of what is seen is between 0.5 and 20 m away.
        orientation: q_WC of the optical frame (x right, y down, z forward), xyzw, shape [4].
    """
    renderer = make_renderer(scene, lens, outputs=["depth", "rgb"], instant_count=1)

    def look(pose: tuple[Array, Rotation]) -> tuple[Array, NDArray[np.uint8]]:
        pictures = take_picture(renderer, pose[0], pose[1].as_quat(), outputs=("depth", "rgb"))
        return pictures["depth"].astype(np.float64), pictures["rgb"]

    begin = np.asarray(position, dtype=np.float64), Rotation.from_quat(np.asarray(orientation, np.float64))
    depth, rgb = look(begin)
    complaints = []
    again, rgb_again = look(begin)
    if not (np.array_equal(depth, again) and np.array_equal(rgb, rgb_again)):
        complaints.append("the same pose gives other frames the second time")
    if not np.isfinite(depth).any() or float(np.nanmin(np.where(np.isfinite(depth), depth, np.nan))) <= 0.0:
        return [*complaints, "depth is nowhere finite and positive: give another pose"]
    pixels = _pixel_points(depth, lens)
    for name, shift_m, turn_rad in _MOVES:
        moved = begin[0] + begin[1].apply(shift_m), begin[1] * Rotation.from_rotvec(turn_rad)
        error = _disagreement(pixels, begin, moved, look(moved)[0], lens)
        if error is None:
            complaints.append(f"moved {name}: too little of the first view is seen in the second")
        elif error > _RELATIVE_MAX:
            complaints.append(
                f"moved {name}: depth differs by {100.0 * error:.1f} % in the median from the first view's "
                "(planar z, not the length of rays; x right, y down, z forward; pixel centres at +0.5?)"
            )
    return complaints


def _pixel_points(depth: Array, lens: PinholeConfig) -> Array:
    """Return what pixels away from edges see, in C, shape [n, 3]."""
    fx, fy, cx, cy = lens.intrinsics()
    rows, cols = np.indices(depth.shape) + 0.5
    with np.errstate(invalid="ignore"):
        steps = [np.abs(depth - np.roll(depth, shift, axis)) for axis in (0, 1) for shift in (-1, 1)]
    smooth = np.isfinite(depth) & (np.max(steps, axis=0) < 0.02 * depth)
    smooth[[0, -1]], smooth[:, [0, -1]] = False, False
    z = depth[smooth]
    return np.stack([(cols[smooth] - cx) / fx * z, (rows[smooth] - cy) / fy * z, z], axis=1)


def _disagreement(
    points: Array,
    first: tuple[Array, Rotation],
    second: tuple[Array, Rotation],
    depth: Array,
    lens: PinholeConfig,
) -> float | None:
    """Return the median relative error of depth in the second view where it sees what the first saw."""
    fx, fy, cx, cy = lens.intrinsics()
    p_C = second[1].inv().apply(first[1].apply(points) + first[0] - second[0])
    p_C = p_C[p_C[:, 2] > 0.05]
    cols = np.floor(fx * p_C[:, 0] / p_C[:, 2] + cx).astype(int)
    rows = np.floor(fy * p_C[:, 1] / p_C[:, 2] + cy).astype(int)
    inside = (cols >= 0) & (cols < lens.width) & (rows >= 0) & (rows < lens.height)
    if inside.sum() < _SHARE_MIN * depth.size:
        return None
    seen, expected = depth[rows[inside], cols[inside]], p_C[inside, 2]
    return float(np.median(np.abs(seen - expected) / expected))
