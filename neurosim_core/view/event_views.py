"""What is shown of one event camera: windows of events as pictures, as a surface, and as points.

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
from neurosim_core.view.rerun_sdk import import_rerun
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
    """What is shown of one event camera."""

    def __init__(self, *, width: int, height: int, window_ns: int, compress: bool) -> None:
        self._size = {"width": width, "height": height}
        self._compress = compress
        self._window = EventWindow(length_ns=window_ns)
        self._surface = EventSurface(**self._size, tau_ns=round(_TAU_WINDOWS * window_ns))
        self._cloud = EventCloud(width=width, window_ns=window_ns)

    def colors(self) -> dict[str, Any]:
        """Return the colours of classes that the pictures need, by their names."""
        shares = [f"{100 * shade // _SHADES} %" for shade in range(1, _SHADES + 1)]
        named = {"image": class_colors(PALETTE, _COUNTS), "surface": class_colors(SURFACE_PALETTE, shares)}
        return {} if self._compress else named

    def add(self, packet: Events) -> Iterator[tuple[int, EventArrays, NDArray[np.uint8]]]:
        """Add a packet; yield the end [ns], the events, and the surface of each window that it completes."""
        arrays = packet.numpy()
        for end_ns, events in self._window.add(arrays, start_ns=packet.start_ns, stamp_ns=packet.stamp_ns):
            yield end_ns, events, self._surface.add(events, end_ns)

    def pictures(self, events: EventArrays, surface: NDArray[np.uint8]) -> dict[str, Any]:
        """Return the pictures of a window, by their names."""
        classes = event_classes(events, **self._size)
        return {
            "image": encode_classes(classes, PALETTE, compress=self._compress),
            "surface": encode_classes(surface, SURFACE_PALETTE, compress=self._compress),
        }

    def points(self, events: EventArrays, end_ns: int) -> Any:
        """Add a window to the points in x, y and time, and return all of them."""
        points, colors = self._cloud.add(events, end_ns)
        return import_rerun().Points3D(points, colors=colors)


class EventSurface:
    """The last event of each pixel of an event camera, which fades by exp(-age / tau)."""

    def __init__(self, *, width: int, height: int, tau_ns: int) -> None:
        self._shape = (height, width)
        self._tau_us = tau_ns * 1e-3
        self._last_us = np.full(height * width, -np.inf)
        self._polarity = np.zeros(height * width, dtype=np.uint8)

    def add(self, events: EventArrays, end_ns: int) -> NDArray[np.uint8]:
        """Add events in the order of time; return classes of `SURFACE_PALETTE` at a stamp, shape [H, W]."""
        pixel = events.y.astype(np.int64) * self._shape[1] + events.x
        self._last_us[pixel] = events.t  # of equal indices the last assignment stays
        self._polarity[pixel] = events.polarity
        age_us = end_ns // 1000 - self._last_us
        age_us[age_us < 0] = np.inf  # time has begun again
        shade = np.round(_SHADES * np.exp(-age_us / self._tau_us)).astype(np.uint8)
        classes: NDArray[np.uint8] = np.where(shade, shade + _SHADES * self._polarity, 0).astype(np.uint8)
        return classes.reshape(self._shape)


class EventCloud:
    """Keeps the last windows of one event camera, thinned out to a number of points."""

    def __init__(self, *, width: int, window_ns: int) -> None:
        self._depth_px = float(width)  # of all windows together: a cube, about
        self._window_ns = window_ns
        self._windows: deque[EventArrays] = deque(maxlen=_WINDOWS)

    def add(self, events: EventArrays, end_ns: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Add a window; return all points and their colours.

        Every n-th event is kept, so that a window has at most its share of the points. Returns positions,
        shape [n, 3]: x to the right [px], time (now is 0), y up [px]; sRGB, shape [n, 3].
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
