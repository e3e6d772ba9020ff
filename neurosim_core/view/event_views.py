"""Views of one event camera: windows of events as pictures, as a surface, and as points.

In a surface the last event of a pixel fades by exp(-age / tau), on black: brighter orange, darker blue.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import EventArrays, Events
from neurosim_core.view.pictures import OFF_SRGB, ON_SRGB, PALETTE, EventWindow, event_classes
from neurosim_core.view.rerun_shapes import class_colors, encode_classes

_WINDOWS = 5
_POINTS_MAX = 4000
_TAU_WINDOWS = 2.5
_COUNTS = ("1 event", "2 events", "3 events", "4 or more events")
_SHADES = 8
SURFACE_PALETTE = np.array(
    [(0, 0, 0)]
    + [
        [round(part * shade / _SHADES) for part in color]
        for color in ((90, 170, 255), (255, 170, 60))
        for shade in range(1, _SHADES + 1)
    ],
    dtype=np.uint8,
)
"""sRGB colour of each class of a surface, shape [17, 3]: 0 no event, 1-8 last event darker, 9-16
brighter, older first."""


class EventViews:
    """The views of one event camera: its windows, the last event of each pixel, and the last windows."""

    def __init__(self, *, width: int, height: int, window_ns: int, compress: bool) -> None:
        self._size = {"width": width, "height": height}
        self._compress = compress
        self._window_ns = window_ns
        self._window = EventWindow(length_ns=window_ns)
        self._last_us = np.full(height * width, -np.inf)
        self._polarity = np.zeros(height * width, dtype=np.uint8)
        self._windows: deque[EventArrays] = deque(maxlen=_WINDOWS)

    def colors(self) -> dict[str, Any]:
        """Return the colours of classes that the pictures need, by their names."""
        shares = [f"{100 * shade // _SHADES} %" for shade in range(1, _SHADES + 1)]
        named = {"image": class_colors(PALETTE, _COUNTS), "surface": class_colors(SURFACE_PALETTE, shares)}
        return {} if self._compress else named

    def add(self, packet: Events) -> Iterator[tuple[int, EventArrays, NDArray[np.uint8]]]:
        """Add a packet; yield the end [ns], the events, and the surface of each window that it completes."""
        arrays = packet.numpy()
        for end_ns, events in self._window.add(arrays, start_ns=packet.start_ns, stamp_ns=packet.stamp_ns):
            yield end_ns, events, self.surface(events, end_ns)

    def pictures(self, events: EventArrays, surface: NDArray[np.uint8]) -> dict[str, Any]:
        """Return the pictures of a window, by their names."""
        classes = event_classes(events, **self._size)
        return {
            "image": encode_classes(classes, PALETTE, compress=self._compress),
            "surface": encode_classes(surface, SURFACE_PALETTE, compress=self._compress),
        }

    def surface(self, events: EventArrays, end_ns: int) -> NDArray[np.uint8]:
        """Add events in the order of time; return classes of `SURFACE_PALETTE` at a stamp, shape [H, W]."""
        pixel = events.y.astype(np.int64) * self._size["width"] + events.x
        self._last_us[pixel] = events.t  # of equal indices the last assignment stays
        self._polarity[pixel] = events.polarity
        age_us = end_ns // 1000 - self._last_us
        age_us[age_us < 0] = np.inf  # time has begun again
        tau_us = 1e-3 * round(_TAU_WINDOWS * self._window_ns)
        shade = np.round(_SHADES * np.exp(-age_us / tau_us)).astype(np.uint8)
        classes: NDArray[np.uint8] = np.where(shade, shade + _SHADES * self._polarity, 0).astype(np.uint8)
        return classes.reshape(self._size["height"], self._size["width"])

    def points(self, events: EventArrays, end_ns: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Add a window; return the points of the last windows in x, y and time, and their colours.

        Every n-th event is kept, so that a window has at most its share of the points. Returns positions,
        shape [n, 3]: x to the right [px], time (now is 0), y up [px]; sRGB, shape [n, 3]. All windows
        together are as deep as the camera is wide: a cube, about.
        """
        step = max(1, -(-len(events.t) * _WINDOWS // _POINTS_MAX))
        self._windows.append(events.rows(slice(None, None, step)))
        px_per_us = float(self._size["width"]) / (_WINDOWS * self._window_ns * 1e-3)
        parts = [
            np.stack([kept.x, (kept.t - end_ns // 1000) * px_per_us, -kept.y.astype(np.float64)], axis=1)
            for kept in self._windows
        ]
        polarity = np.concatenate([kept.polarity for kept in self._windows])
        colors = np.where(polarity[:, None] > 0, np.array(ON_SRGB), np.array(OFF_SRGB))
        return np.concatenate(parts).astype(np.float32), colors.astype(np.uint8)
