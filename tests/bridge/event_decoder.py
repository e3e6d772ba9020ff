"""Decoders of evt3 and mono, as event cameras and the bridge write them: the oracle for its encoders."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex_ros2_bridge.event_codec import EventCodecError, EventColumns

Code = NDArray[np.uint8]
Words = NDArray[np.uint16]

_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH = 0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x8
_KNOWN = {_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH, 0x7, 0xA, 0xE, 0xF}
"""All words that there are; the last four are triggers and what sensors say of themselves, not events."""
_EPOCH_BITS = 24
_JITTER = 10
"""A high half that is smaller by no more than this came late, it did not wrap; as other decoders have it."""


class Evt3Decoder:
    """Decodes the packets of one camera, one after the other; also what sensors of Prophesee write."""

    def __init__(self, *, start_us: int | None = None) -> None:
        """Begin before the first packet.

        Args:
            start_us: Time of its first event, known to 8 s [us]: 24 bits do not say how often time has
                wrapped before. None: it has not.
        """
        self._start_us = start_us
        self._is_timed = False
        self._high = 0
        self._low = 0
        self._y = 0
        self._base_x = 0
        self._base_polarity = 0

    def decode(self, data: Any, *, width: int, height: int) -> EventColumns:
        """Return the events of a packet; of those before the first time, and outside of the sensor, nothing.

        Args:
            data: Words of 16 bits, little endian.
            width: Of the sensor [px].
            height: Of the sensor [px].

        Raises:
            EventCodecError: It is half a word too long, or has a word that evt3 does not know.
        """
        words = _words(data, "<u2", "evt3")
        code: Code = (words >> 12).astype(np.uint8)
        value: Words = words & np.uint16(0xFFF)
        used = set(np.flatnonzero(np.bincount(code, minlength=16)).tolist())
        if not used <= _KNOWN:
            odd = ", ".join(f"0x{each:X}" for each in sorted(used - _KNOWN))
            raise EventCodecError(f"evt3 has no words that begin with {odd}")

        where, x, polarity = self._columns(code, value, used)
        y, self._y = _hold(code == _ADDR_Y, value & 0x7FF, self._y, where)
        t, begin = self._times(code, value, where)
        usable = (where >= begin) & (x < width) & (y < height)
        columns = EventColumns(t, x.astype(np.uint16), y.astype(np.uint16), polarity.astype(np.uint8))
        if usable.all():
            return columns
        return EventColumns(t[usable], columns.x[usable], columns.y[usable], columns.polarity[usable])

    def _times(self, code: Code, value: Words, where: NDArray[np.intp]) -> tuple[NDArray[np.int64], int]:
        """Return the time at some words [us], and the first word at which time is known."""
        is_high, is_low = code == _TIME_HIGH, code == _TIME_LOW
        highs = value[is_high].astype(np.int64)
        before = np.concatenate([[self._high & 0xFFF], highs[:-1]])[: len(highs)]
        highs += (self._high >> 12) + np.cumsum(highs < before - _JITTER) << 12
        begin = 0
        if not self._is_timed:
            begin = len(code)
            lows = np.flatnonzero(is_low)
            if len(highs):
                lows = lows[lows > np.flatnonzero(is_high)[0]]
                if len(lows):
                    begin, self._is_timed = int(lows[0]), True
                    if self._start_us is not None:
                        seen = int(highs[np.count_nonzero(is_high[:begin]) - 1] << 12 | value[begin])
                        highs += (self._start_us - seen + (1 << 23) >> _EPOCH_BITS) << 12
        high, self._high = _hold(is_high, highs, self._high, where, selected=True)
        low, self._low = _hold(is_low, value, self._low, where)
        return high << 12 | low, begin

    def _columns(
        self, code: Code, value: Words, used: set[int]
    ) -> tuple[NDArray[np.intp], NDArray[Any], NDArray[Any]]:
        """Return the word, the column and the polarity of each event."""
        where = np.flatnonzero(code == _ADDR_X)
        x, polarity = value[where] & 0x7FF, value[where] >> 11
        if not used & {_BASE_X, _VECT_12, _VECT_8}:
            return where, x, polarity
        is_base = code == _BASE_X
        length = np.where(code == _VECT_12, 12, 0) + np.where(code == _VECT_8, 8, 0)
        passed = np.cumsum(length) - length  # columns that vectors before this word have stepped over
        vectors = np.flatnonzero(length)
        base, last_base = _hold(is_base, (value & 0x7FF) - passed, self._base_x, vectors)
        sign, self._base_polarity = _hold(is_base, value >> 11, self._base_polarity, vectors)
        self._base_x = last_base + int(length.sum())
        bits = np.where(length[vectors] == 8, value[vectors] & 0xFF, value[vectors])
        row, bit = np.nonzero(bits[:, None] >> np.arange(12) & 1)
        where = np.concatenate([where, vectors[row]])
        order = np.argsort(where, kind="stable")
        x = np.concatenate([x, (base + passed[vectors])[row] + bit])[order]
        return where[order], x, np.concatenate([polarity, sign[row]])[order]


def decode_mono(data: Any, *, base_ns: int) -> EventColumns:
    """Return the events of a packet, with times in nanoseconds.

    Args:
        data: Words of 64 bits, little endian.
        base_ns: The packet's `time_base` [ns].

    Raises:
        EventCodecError: It does not consist of words of 8 bytes.
    """
    words = _words(data, "<u8", "mono")
    quarters = words.view("<u2").reshape(len(words), 4)
    t = (words & 0xFFFFFFFF).astype(np.int64) + base_ns
    row = quarters[:, 3]
    return EventColumns(t, quarters[:, 2].copy(), row & np.uint16(0x7FFF), (row >> 15).astype(np.uint8))


def _words(data: Any, dtype: str, encoding: str) -> NDArray[Any]:
    view = memoryview(data).cast("B")
    size = np.dtype(dtype).itemsize
    if len(view) % size:
        raise EventCodecError(f"{encoding} consists of words of {size} bytes, got {len(view)} bytes")
    return np.frombuffer(view, dtype)


def _hold(
    mask: NDArray[np.bool_],
    values: NDArray[Any],
    initial: int,
    where: NDArray[np.intp],
    *,
    selected: bool = False,
) -> tuple[NDArray[np.int64], int]:
    """Hold a value until the next one.

    Args:
        mask: Which words set it.
        values: What they set it to; of all words, or, if `selected`, of those only.
        initial: Value before the first one.
        where: Words at which the value is asked for.
        selected: See `values`.

    Returns:
        The values there, and the last one.
    """
    set_to = values if selected else values[mask]
    table = np.concatenate([[initial], set_to.astype(np.int64)])
    return table[np.cumsum(mask, dtype=np.int32)[where]], int(table[-1])
