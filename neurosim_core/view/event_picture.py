"""Pictures of events, as people draw them: brighter is red, darker is blue, nothing is white.

The last event of a pixel chooses the hue, the number of its events the strength: a pixel with n events has
covered 1 - 0.4^n of the white, up to n = 4. So one event is clearly seen, and a pixel that fired often stands
out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import EventArrays

BACKGROUND_SRGB = (255, 255, 255)
ON_SRGB = (200, 16, 32)
OFF_SRGB = (24, 60, 190)
_STRENGTHS = tuple(1.0 - 0.4**n for n in range(1, 5))


def _palette() -> NDArray[np.uint8]:
    white = np.array(BACKGROUND_SRGB, dtype=np.float64)
    rows = [white]
    for color in (OFF_SRGB, ON_SRGB):
        rows += [white + strength * (np.array(color) - white) for strength in _STRENGTHS]
    return np.round(np.stack(rows)).astype(np.uint8)


PALETTE = _palette()
"""sRGB colour of each class, shape [9, 3]: 0 no event, 1-4 last event darker, 5-8 brighter, by count."""


def event_classes(events: EventArrays, *, width: int, height: int) -> NDArray[np.uint8]:
    """Draw events as class numbers of `PALETTE`.

    Args:
        events: Events in the order of time; those of one pixel must lie inside the picture.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].

    Returns:
        Classes, shape [H, W].
    """
    pixel = events.y.astype(np.int64) * width + events.x
    count = np.bincount(pixel, minlength=width * height)
    last = np.zeros(width * height, dtype=np.uint8)
    last[pixel] = events.polarity  # of equal indices the last assignment stays
    classes = np.minimum(count, len(_STRENGTHS)) + len(_STRENGTHS) * last
    return classes.astype(np.uint8).reshape(height, width)


def event_picture(events: EventArrays, *, width: int, height: int) -> NDArray[np.uint8]:
    """Draw events as an sRGB picture, shape [H, W, 3]. Arguments as for `event_classes`."""
    return PALETTE[event_classes(events, width=width, height=height)]


class EventWindow:
    """Collects the packets of one event camera and cuts them into windows of equal length.

    Memory is bounded by the events of one window and one packet. A packet that does not continue the current
    window (after a loss or a reset) begins a new one; what was collected for the old one is let go.
    """

    def __init__(self, *, length_ns: int) -> None:
        """Make an empty collector.

        Args:
            length_ns: Length of a window [ns]; window k covers (k length, (k + 1) length].
        """
        self._length_ns = length_ns
        self._parts: list[EventArrays] = []
        self._end_ns: int | None = None

    def add(self, events: EventArrays, *, start_ns: int, stamp_ns: int) -> list[tuple[int, EventArrays]]:
        """Add the events of a packet; return each window that it completes, as (end [ns], events).

        Args:
            events: Events of the packet; copied.
            start_ns: Start of the packet's window [ns].
            stamp_ns: End of the packet's window [ns].
        """
        if self._end_ns is None or not self._end_ns - self._length_ns <= start_ns < self._end_ns:
            self._end_ns = (start_ns // self._length_ns + 1) * self._length_ns
            self._parts = []
        done: list[tuple[int, EventArrays]] = []
        while stamp_ns >= self._end_ns:
            cut = int(np.searchsorted(events.t, self._end_ns // 1000, side="right"))
            self._parts.append(cut_events(events, slice(0, cut)))
            done.append((self._end_ns, join_events(self._parts)))
            self._parts = []
            events = cut_events(events, slice(cut, None))
            self._end_ns += self._length_ns
        if len(events.t):
            self._parts.append(join_events([events]))
        return done


def cut_events(events: EventArrays, span: slice) -> EventArrays:
    """Return a range of events, as views."""
    return EventArrays(events.t[span], events.x[span], events.y[span], events.polarity[span])


def join_events(parts: Sequence[EventArrays]) -> EventArrays:
    """Return the events of all parts, one after the other, as new arrays."""
    return EventArrays(
        t=np.concatenate([part.t for part in parts]),
        x=np.concatenate([part.x for part in parts]),
        y=np.concatenate([part.y for part in parts]),
        polarity=np.concatenate([part.polarity for part in parts]),
    )
