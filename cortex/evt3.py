"""Events as evt3, the encoding of Prophesee's event cameras, exactly and without a loop over events.

Words of 16 bits, of which the upper four say what the others are: the high or the low half of a time of 24
bits [us], a row, or a column with a polarity. The time wraps every 16.8 s, so that encoder and decoder keep
state from packet to packet. The ROS 2 bridge sends it, and RAW files are made of it.

Reference: Prophesee, "EVT 3.0 format".
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Buffer = bytes | bytearray | memoryview
Bytes = NDArray[np.uint8]
Code = NDArray[np.uint8]
Words = NDArray[np.uint16]

_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH = 0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x8
_KNOWN = {_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH, 0x7, 0xA, 0xE, 0xF}
"""All words that there are; the last four are triggers and what sensors say of themselves, not events."""
_EPOCH_BITS = 24
_EPOCHS_MAX = 256
"""On a live stream, time that goes further ahead than this many wraps of 16.8 s has been set anew."""
_WRAP = np.array([_TIME_HIGH << 12 | 0xFFF, _TIME_HIGH << 12], np.uint16)
"""The last and the first value of the high half of a time."""
_JITTER = 10
"""A high half that is smaller by no more than this came late, it did not wrap; as other decoders have it."""
EVT3_SIZE_MAX = 2048


class EventCodecError(ValueError):
    """Events that the encoding cannot hold, or bytes that are not of the encoding."""


class EventColumns(NamedTuple):
    """Events, sorted by time."""

    t: NDArray[np.int64]
    """Time [us], shape [n]; of mono [ns]."""
    x: NDArray[np.uint16]
    """Column [px], shape [n]."""
    y: NDArray[np.uint16]
    """Row [px], shape [n]."""
    polarity: NDArray[np.uint8]
    """1: brighter, 0: darker, shape [n]."""


class Evt3Encoder:
    """Encodes the packets of one camera as evt3, one after the other.

    A packet begins with a time and a row, so that it can be read without the one before. From there on each
    half of a time and a row is written where it changes, 2 bytes each, and 2 bytes for each event. Events of
    one time, row and polarity that lie close together become vectors of 12 columns where that is shorter.
    Where time wraps, the last and the first value of its high half are written, so that a decoder notices it
    even after a silence of any length up to an hour.

    Args:
        begin_us: Time from which on wraps are written [us]; None: that of the first packet.
        epochs_max: Most wraps that are written for one silence; a longer one sets time anew.
    """

    def __init__(self, *, begin_us: int | None = None, epochs_max: int = _EPOCHS_MAX) -> None:
        self._epochs_max = epochs_max
        self._epoch = None if begin_us is None else begin_us >> _EPOCH_BITS
        self._kept: dict[str, NDArray[Any]] = {}

    def encode(self, events: EventColumns, *, width: int, height: int, end_us: int) -> Bytes:
        """Return a packet, in which time is written before the first event.

        Args:
            events: What to write, with times in microseconds.
            width: Of the sensor [px].
            height: Of the sensor [px].
            end_us: Time of a packet without events [us].

        Raises:
            EventCodecError: The sensor has more than 2048 columns or rows, an event is outside of it or has
                another polarity, or times decrease.
        """
        if width > EVT3_SIZE_MAX or height > EVT3_SIZE_MAX:
            raise EventCodecError(f"evt3 holds at most 2048 x 2048 pixels, not {width} x {height}; use mono")
        check_events(events, width, height)
        times = events.t if len(events.t) else np.array([end_us], np.int64)
        first, last = int(times[0]) >> _EPOCH_BITS, int(times[-1]) >> _EPOCH_BITS
        since = self._wraps(first - (first if self._epoch is None else self._epoch))
        self._epoch = last
        words = np.array([_TIME_LOW << 12 | end_us & 0xFFF], np.uint16)
        if len(events.t):
            words, at_y = self._words(events)
        if first != last:  # events before which time wraps, as often as it does
            epochs = np.diff(times >> _EPOCH_BITS, prepend=first)
            which = np.flatnonzero(epochs)
            wraps = np.repeat(which, [self._wraps(int(each)) for each in epochs[which]])
            words = np.insert(words, np.repeat(at_y[wraps] - 2, 2), np.tile(_WRAP, len(wraps)))
        out = np.empty(2 * since + 1 + len(words), "<u2")
        out[: 2 * since] = np.tile(_WRAP, since)
        out[2 * since] = _TIME_HIGH << 12 | int(times[0]) >> 12 & 0xFFF
        out[2 * since + 1 :] = words
        return out.view(np.uint8)

    def _wraps(self, epochs: int) -> int:
        """Return how often time has wrapped, which a decoder is told; 0 if it was set anew."""
        return epochs if 0 <= epochs <= self._epochs_max else 0

    def _words(self, events: EventColumns) -> tuple[Words, NDArray[np.intp]]:
        """Return the words after the first one, and where the row of each event is, or would be.

        Large arrays are kept from packet to packet: to get new memory takes longer than what is done here.
        """
        t_us, x, y, polarity = events
        n = len(t_us)
        low, column = self._room("low", n, np.uint16), self._room("column", n, np.uint16)
        np.copyto(low, t_us, casting="unsafe")
        new_low = _changes(low, self._room("new_low", n, np.bool_))
        new_row = _changes(y, self._room("new_row", n, np.bool_))
        np.copyto(column, polarity)
        column <<= 11
        column |= x
        new_high = np.zeros(0, np.intp)
        if int(t_us[0]) >> 12 != int(t_us[-1]) >> 12:
            new_high = np.flatnonzero(np.diff(t_us >> 12)) + 1
            new_low[new_high] = True  # some decoders take the low half for 0 after a new high one
        count = self._room("count", n, np.uint8)
        np.add(new_low.view(np.uint8), new_row.view(np.uint8), out=count)
        vectors = self._vectors(column, count)
        count += np.uint8(1)
        count[new_high] += np.uint8(1)
        if vectors is not None:
            groups, members, windows, bits = vectors
            count[members] -= np.uint8(1)
            count[windows] += np.uint8(1)
            count[groups] += np.uint8(1)
        at_x = np.cumsum(count, dtype=np.intp, out=self._room("at_x", n, np.intp))
        at_x -= 1
        at_y = np.subtract(at_x, new_row, out=self._room("at_y", n, np.intp))
        if vectors is not None:
            at_y[groups] -= 1
        low &= np.uint16(0xFFF)
        low |= np.uint16(_TIME_LOW << 12)
        out = self._room("out", int(at_x[-1]) + 1, np.uint16)  # what is not to be there is written over
        out[at_y] = y
        timed = np.flatnonzero(new_low)
        out[at_y[timed] - 1] = low[timed]
        out[at_y[new_high] - 2] = t_us[new_high] >> 12 & 0xFFF | _TIME_HIGH << 12
        column |= np.uint16(_ADDR_X << 12)
        out[at_x] = column
        if vectors is not None:
            out[at_x[groups] - 1] = column[groups] & 0xFFF | _BASE_X << 12
            out[at_x[windows]] = bits
        return out, at_y

    def _vectors(self, column: Words, apart: NDArray[np.uint8]) -> tuple[NDArray[np.intp], ...] | None:
        """Find groups of events that are shorter as vectors: neighbours at most 11 columns apart.

        `apart` is 0 where an event has time and row of the one before.

        Returns:
            First events of groups, whose columns are the bases; all events of groups; first events of
            vectors; the words of these.
        """
        n = len(column)
        gap = np.subtract(column[1:], column[:-1], out=self._room("gap", n - 1, np.uint16))
        gap -= np.uint16(1)
        near = self._room("near", n + 2, np.bool_)  # to the event before; none is at the ends
        near[0] = near[n:] = False
        np.less(gap, 11, out=near[1:n])
        near[:n] &= np.equal(apart, 0, out=self._room("same", n, np.bool_))
        both = np.logical_and(near[1:-1], near[2:], out=self._room("both", n, np.bool_))
        begins = np.flatnonzero(both[:-1] & ~near[:-3]) if n > 1 else np.zeros(0, np.intp)
        if not len(begins):  # no group of three and more
            return None
        ends = np.flatnonzero(both[:-1] & ~near[3:]) + 2
        keep = (column[ends] - column[begins]) // np.uint16(12) + 2 < ends - begins + 1
        begins, sizes = begins[keep], (ends - begins + 1)[keep]  # a base and vectors against one word each
        if not len(begins):
            return None
        first = np.cumsum(sizes) - sizes
        members = np.repeat(begins - first, sizes) + np.arange(int(sizes.sum()))
        step = column[members] - np.repeat(column[begins], sizes)
        is_window = _changes(step // np.uint16(12), np.empty(len(step), bool))
        is_window[first] = True
        starts = np.flatnonzero(is_window)
        bits = np.bitwise_or.reduceat(np.uint16(1) << step % np.uint16(12), starts)
        return begins, members, members[starts], (bits | np.uint16(_VECT_12 << 12)).astype(np.intp)

    def _room(self, name: str, count: int, dtype: Any) -> NDArray[Any]:
        """Return an array that is kept under a name; its content is of the packet before."""
        kept = self._kept.get(name)
        if kept is None or len(kept) < count:
            kept = self._kept[name] = np.empty(count * 5 // 4 + 64, dtype)
        return kept[:count]


class Evt3Decoder:
    """Decodes the packets of one camera, one after the other; also what sensors of Prophesee write.

    Args:
        start_us: Time of the first event, known to 8 s [us]: 24 bits do not say how often time has wrapped
            before. None: it has not.
    """

    def __init__(self, *, start_us: int | None = None) -> None:
        self._start_us = start_us
        self._is_timed = False
        self._high = 0
        self._low = 0
        self._y = 0
        self._base_x = 0
        self._base_polarity = 0

    def decode(self, data: Buffer | Bytes, *, width: int, height: int) -> EventColumns:
        """Return the events of a packet; of those before the first time, and outside of the sensor, nothing.

        Args:
            data: Words of 16 bits, little endian.
            width: Of the sensor [px].
            height: Of the sensor [px].

        Raises:
            EventCodecError: It is half a word too long, or has a word that evt3 does not know.
        """
        words = read_words(data, "<u2", "evt3")
        code: Code = (words >> 12).astype(np.uint8)
        value: Words = words & np.uint16(0xFFF)
        used = set(np.flatnonzero(np.bincount(code, minlength=16)).tolist())
        if not used <= _KNOWN:
            odd = ", ".join(f"0x{each:X}" for each in sorted(used - _KNOWN))
            raise EventCodecError(f"evt3 has no words that begin with {odd}")

        where, x, polarity = self._columns(code, value, used)
        y, self._y = hold_value(code == _ADDR_Y, value & 0x7FF, self._y, where)
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
        high, self._high = hold_value(is_high, highs, self._high, where, selected=True)
        low, self._low = hold_value(is_low, value, self._low, where)
        return high << 12 | low, begin

    def _columns(
        self, code: Code, value: Words, used: set[int]
    ) -> tuple[NDArray[np.intp], NDArray[Any], NDArray[Any]]:
        where = np.flatnonzero(code == _ADDR_X)
        x, polarity = value[where] & 0x7FF, value[where] >> 11
        if not used & {_BASE_X, _VECT_12, _VECT_8}:
            return where, x, polarity
        is_base = code == _BASE_X
        length = np.where(code == _VECT_12, 12, 0) + np.where(code == _VECT_8, 8, 0)
        passed = np.cumsum(length) - length  # columns that vectors before this word have stepped over
        vectors = np.flatnonzero(length)
        base, last_base = hold_value(is_base, (value & 0x7FF) - passed, self._base_x, vectors)
        sign, self._base_polarity = hold_value(is_base, value >> 11, self._base_polarity, vectors)
        self._base_x = last_base + int(length.sum())
        bits = np.where(length[vectors] == 8, value[vectors] & 0xFF, value[vectors])
        row, bit = np.nonzero(bits[:, None] >> np.arange(12) & 1)
        where = np.concatenate([where, vectors[row]])
        order = np.argsort(where, kind="stable")
        x = np.concatenate([x, (base + passed[vectors])[row] + bit])[order]
        return where[order], x, np.concatenate([polarity, sign[row]])[order]


def check_events(events: EventColumns, width: int, height: int) -> None:
    """Refuse events outside of the sensor, of another polarity, or not sorted by time.

    Raises:
        EventCodecError: There are such events.
    """
    t_us, x, y, polarity = events
    check_pixels(x, y, polarity, width, height)
    if not len(t_us) == len(x):
        raise EventCodecError(f"there are {len(t_us)} times for {len(x)} events")
    if (t_us[1:] < t_us[:-1]).any():
        raise EventCodecError("events are not sorted by time")


def check_pixels(
    x: NDArray[np.uint16], y: NDArray[np.uint16], polarity: NDArray[np.uint8], width: int, height: int
) -> None:
    """Refuse events outside of the sensor, or of another polarity.

    Raises:
        EventCodecError: There are such events.
    """
    if not len(x) == len(y) == len(polarity):
        raise EventCodecError(f"there are {len(x)} columns, {len(y)} rows and {len(polarity)} polarities")
    if len(x) and (x.max() >= width or y.max() >= height):
        raise EventCodecError(
            f"an event in column {x.max()} or row {y.max()} of a sensor with {width} x {height}"
        )
    if len(x) and polarity.max() > 1:
        raise EventCodecError(f"polarity is 0 or 1, got {polarity.max()}")


def _changes(values: NDArray[Any], out: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find out which elements differ from the one before; the first does."""
    out[0] = True
    np.not_equal(values[1:], values[:-1], out=out[1:])
    return out


def read_words(data: Any, dtype: str, encoding: str) -> NDArray[Any]:
    """Return bytes as words.

    Raises:
        EventCodecError: There is a part of a word.
    """
    view = memoryview(data).cast("B")
    size = np.dtype(dtype).itemsize
    if len(view) % size:
        raise EventCodecError(f"{encoding} consists of words of {size} bytes, got {len(view)} bytes")
    return np.frombuffer(view, dtype)


def hold_value(
    mask: NDArray[np.bool_],
    values: NDArray[Any],
    initial: int,
    where: NDArray[np.intp],
    *,
    selected: bool = False,
) -> tuple[NDArray[np.int64], int]:
    """Hold a value, of all words that set it, until the next one; return it at some words, and the last one.

    Args:
        mask: Which words set it.
        values: What they set it to; of all words, or, if `selected`, of those only.
        initial: Value before the first one.
        where: Words at which the value is asked for.
        selected: See `values`.
    """
    set_to = values if selected else values[mask]
    table = np.concatenate([[initial], set_to.astype(np.int64)])
    return table[np.cumsum(mask, dtype=np.int32)[where]], int(table[-1])
