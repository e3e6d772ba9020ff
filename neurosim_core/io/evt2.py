"""Events as EVT2, an encoding of Prophesee's event cameras: one word of 32 bits for each event.

The upper four bits of a word say what it is: an event (0 darker, 1 brighter) with the low 6 bits of its time
[us], its column and its row (11 bits each), or the high 28 bits of the time. Time wraps every 4.8 h.

Reference: Prophesee, "EVT 2.0 format".
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.evt3 import EventCodecError
from neurosim_core.io.event_file import events_of
from neurosim_core.packets import EventArrays

_ON, _TIME_HIGH, _TRIGGER, _OTHERS, _CONTINUED = 0x1, 0x8, 0xA, 0xE, 0xF
_KNOWN = {0x0, _ON, _TIME_HIGH, _TRIGGER, _OTHERS, _CONTINUED}
_HIGH_BITS = 28
_HIGH_MAX = (1 << _HIGH_BITS) - 1
_LOW_BITS = 6


class Evt2Encoder:
    """Encodes blocks of events, one after the other; time is counted from 0."""

    def __init__(self) -> None:
        self._high = -1

    def encode(self, events: EventArrays) -> NDArray[np.uint8]:
        """Return the words of sorted events that lie on the sensor, none before 0."""
        t, x, y, polarity = events
        if not len(t):
            return np.zeros(0, np.uint8)
        high = t >> _LOW_BITS
        before = np.concatenate([[self._high], high[:-1]])
        wrapped = np.maximum((high >> _HIGH_BITS) - np.maximum(before, 0) // (_HIGH_MAX + 1), 0)
        count = 1 + (high != before) + 2 * wrapped
        end = np.cumsum(count)
        words = np.empty(int(end[-1]), "<u4")
        words[end - 1] = (
            polarity.astype(np.uint32) << 28
            | (t & 0x3F).astype(np.uint32) << 22
            | x.astype(np.uint32) << 11
            | y
        )
        new = np.flatnonzero(high != before)
        words[end[new] - 2] = _TIME_HIGH << 28 | (high[new] & _HIGH_MAX).astype(np.uint32)
        for index in np.flatnonzero(wrapped):  # each wrap is told by the last and the first high half
            begin = int(end[index] - count[index])
            words[begin : begin + 2 * int(wrapped[index])] = np.tile(
                np.array([_TIME_HIGH << 28 | _HIGH_MAX, _TIME_HIGH << 28], np.uint32), int(wrapped[index])
            )
        self._high = int(high[-1])
        return words.view(np.uint8)


class Evt2Decoder:
    """Decodes blocks of words, one after the other."""

    def __init__(self) -> None:
        self._high: int | None = None

    def decode(self, data: Any) -> EventArrays:
        """Return the events of some words; those before the first time are left out."""
        words = np.frombuffer(data, "<u4")
        code = words >> 28
        used = set(np.flatnonzero(np.bincount(code, minlength=16)).tolist())
        if not used <= _KNOWN:
            odd = ", ".join(f"0x{kind:X}" for kind in sorted(used - _KNOWN))
            raise EventCodecError(f"evt2 has no words that begin with {odd}")
        is_high = code == _TIME_HIGH
        highs = (words[is_high] & _HIGH_MAX).astype(np.int64)
        initial = -1 if self._high is None else self._high
        steps = np.diff(highs, prepend=max(initial, 0) & _HIGH_MAX)
        highs += (max(initial, 0) >> _HIGH_BITS) + np.cumsum(steps < -(_HIGH_MAX // 2)) << _HIGH_BITS
        table = np.concatenate([[initial], highs])
        is_event = code <= _ON
        where = np.flatnonzero(is_event)
        high = table[np.cumsum(is_high)[where]]
        if self._high is None and len(where) and high[0] < 0:
            where, high = where[high >= 0], high[high >= 0]
        if len(highs):
            self._high = int(highs[-1])
        events = words[where]
        t = high << _LOW_BITS | events >> 22 & 0x3F
        return events_of(t, events >> 11 & 0x7FF, events & 0x7FF, events >> 28)
