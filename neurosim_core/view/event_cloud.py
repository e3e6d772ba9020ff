"""The events of the last moments as points in x, y and time."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import EventArrays
from neurosim_core.view.pictures import OFF_SRGB, ON_SRGB

_WINDOWS = 5
_POINTS_MAX = 4000


class EventCloud:
    """Keeps the last windows of one event camera, thinned out to a number of points."""

    def __init__(self, *, width: int, window_ns: int) -> None:
        self._depth_px = float(width)  # of all windows together: a cube, about
        self._window_ns = window_ns
        self._windows: deque[EventArrays] = deque(maxlen=_WINDOWS)

    def add(self, events: EventArrays, end_ns: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Add a window; return all points and their colours.

        Every n-th event is kept, so that a window has at most its share of the points.

        Returns:
            Positions, shape [n, 3]: x to the right [px], time (now is 0), y up [px]; sRGB, shape [n, 3].
        """
        step = max(1, -(-len(events.t) * _WINDOWS // _POINTS_MAX))
        self._windows.append(events.rows(slice(None, None, step)))
        px_per_us = self._depth_px / (_WINDOWS * self._window_ns * 1e-3)
        parts = [
            np.stack([kept.x, (kept.t - end_ns // 1000) * px_per_us, -kept.y.astype(np.float64)], axis=1)
            for kept in self._windows
        ]
        polarity = np.concatenate([kept.polarity for kept in self._windows])
        colors = np.where(polarity[:, None] > 0, np.array(ON_SRGB), np.array(OFF_SRGB))
        return np.concatenate(parts).astype(np.float32), colors.astype(np.uint8)
