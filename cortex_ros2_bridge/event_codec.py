"""Events as bytes: the encodings of event_camera_msgs/EventPacket, and the records of dvs_msgs/EventArray.

evt3 is what event cameras of Prophesee send: words of 16 bits, of which the upper four say what the others
are: the high or the low half of a time of 24 bits [us], a row, or a column with a polarity. The time wraps
every 16.8 s, so that an encoder keeps state from packet to packet. mono is one word of 64 bits for
each event, with a time of its own in nanoseconds. Nothing here loops over events in Python.

Reference: Prophesee, "EVT 3.0 format"; the README of event_camera_msgs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Allocate = Callable[[int], Bytes]
"""Returns so many bytes to write to, or a few more, at an address that is a multiple of 4."""

_ADDR_X, _BASE_X, _VECT_12, _TIME_LOW, _TIME_HIGH = 0x2, 0x3, 0x4, 0x6, 0x8
_EPOCH_BITS = 24
_EPOCHS_MAX = 256
"""Time that goes further ahead than this many wraps of 16.8 s has been set anew."""
_WRAP = np.array([_TIME_HIGH << 12 | 0xFFF, _TIME_HIGH << 12], np.uint16)
"""The last and the first value of the high half of a time."""
_EVT3_SIZE_MAX = 2048
_MONO_SPAN_MAX_US = (2**32 - 1) // 1000
_DVS_SPAN_US = 2**32 - 10**6


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
    """

    def __init__(self) -> None:
        self._epoch: int | None = None
        self._kept: dict[str, NDArray[Any]] = {}

    def encode(
        self,
        events: EventColumns,
        *,
        width: int,
        height: int,
        end_us: int,
        allocate: Allocate | None = None,
    ) -> Bytes:
        """Return a packet, in which time is written before the first event.

        Args:
            events: With times in microseconds.
            width: Of the sensor [px].
            height: Of the sensor [px].
            end_us: Time of a packet without events [us].
            allocate: Makes room for the packet; None: a new array.

        Raises:
            EventCodecError: The sensor has more than 2048 columns or rows, an event is outside of it or has
                another polarity, or times decrease.
        """
        if width > _EVT3_SIZE_MAX or height > _EVT3_SIZE_MAX:
            raise EventCodecError(f"evt3 holds at most 2048 x 2048 pixels, not {width} x {height}; use mono")
        _check(events, width, height)
        allocate = _new_bytes if allocate is None else allocate
        times = events.t if len(events.t) else np.array([end_us], np.int64)
        first, last = int(times[0]) >> _EPOCH_BITS, int(times[-1]) >> _EPOCH_BITS
        since = _wraps(first - (first if self._epoch is None else self._epoch))
        self._epoch = last
        if len(events.t):
            places = self._places(events)
            count = int(places.x[-1]) + 1
        else:
            count = 1
        wraps = np.zeros(0, np.intp)
        if first != last:  # events before which time wraps, as often as it does
            epochs = np.diff(times >> _EPOCH_BITS, prepend=first)
            which = np.flatnonzero(epochs)
            wraps = np.repeat(which, [_wraps(int(each)) for each in epochs[which]])
        size = 2 * (count + 1 + 2 * (since + len(wraps)))
        out = allocate(size)[:size].view("<u2")
        if since:
            out[: 2 * since] = np.tile(_WRAP, since)
        out[2 * since] = _TIME_HIGH << 12 | int(times[0]) >> 12 & 0xFFF
        rest = out[2 * since + 1 :]
        if not len(events.t):
            rest[0] = _TIME_LOW << 12 | end_us & 0xFFF
        elif len(wraps):
            words = np.empty(count, np.uint16)
            places.write(words)
            rest[:] = np.insert(words, np.repeat(places.begin(wraps), 2), np.tile(_WRAP, len(wraps)))
        else:
            places.write(rest)
        return out.view(np.uint8)

    def _places(self, events: EventColumns) -> _Places:
        """Find out which words each event needs, and where they are written.

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
            count[vectors.members] -= np.uint8(1)
            count[vectors.windows] += np.uint8(1)
            count[vectors.groups] += np.uint8(1)
        at_x = np.cumsum(count, dtype=np.intp, out=self._room("at_x", n, np.intp))
        at_x -= 1
        at_y = np.subtract(at_x, new_row, out=self._room("at_y", n, np.intp))
        if vectors is not None:
            at_y[vectors.groups] -= 1
        low &= np.uint16(0xFFF)
        low |= np.uint16(_TIME_LOW << 12)
        high = (t_us[new_high] >> 12 & 0xFFF | _TIME_HIGH << 12).astype(np.uint16)
        return _Places(at_x, at_y, column, y, low, np.flatnonzero(new_low), high, new_high, vectors)

    def _vectors(self, column: Words, apart: NDArray[np.uint8]) -> _Vectors | None:
        """Find groups of events that are shorter as vectors: neighbours at most 11 columns apart.

        Args:
            column: Column and polarity of each event.
            apart: 0 where an event has time and row of the one before.
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
        return _Vectors(begins, members, members[starts], bits | np.uint16(_VECT_12 << 12))

    def _room(self, name: str, count: int, dtype: Any) -> NDArray[Any]:
        """Return an array that is kept under a name; its content is of the packet before."""
        kept = self._kept.get(name)
        if kept is None or len(kept) < count:
            kept = self._kept[name] = np.empty(count * 5 // 4 + 64, dtype)
        return kept[:count]


def encode_mono(
    events: EventColumns,
    *,
    width: int,
    height: int,
    base_us: int,
    allocate: Allocate | None = None,
) -> Bytes:
    """Return events as words of 64 bits: polarity, row (15), column (16), nanoseconds after `base_us` (32).

    Args:
        events: With times in microseconds.
        width: Of the sensor [px].
        height: Of the sensor [px].
        base_us: Time not after that of the first event [us].
        allocate: Makes room for the events; None: a new array.

    Raises:
        EventCodecError: The sensor has too many rows, an event is outside of it or has another polarity, or
            times decrease or reach over more than 4.29 s.
    """
    if width > 2**16 or height > 2**15:
        raise EventCodecError(f"mono holds at most 65536 x 32768 pixels, not {width} x {height}")
    t_us, x, y, polarity = events
    count = len(t_us)
    _check(events, width, height)
    if count and not 0 <= int(t_us[0]) - base_us <= int(t_us[-1]) - base_us <= _MONO_SPAN_MAX_US:
        raise EventCodecError(
            f"mono holds times from its base to 4.29 s later, got {t_us[0]} to {t_us[-1]} us for {base_us} us"
        )
    out = (_new_bytes if allocate is None else allocate)(8 * count)
    quarters = out.view("<u2").reshape(count, 4)
    after_ns = _after(t_us, base_us)
    after_ns *= np.uint32(1000)
    out.view("<u4").reshape(count, 2)[:, 0] = after_ns
    quarters[:, 2] = x
    row = polarity.astype(np.uint16)
    row <<= 15
    row |= y
    quarters[:, 3] = row
    return out


DVS_RECORD = np.dtype(
    {
        "names": ["x", "y", "sec", "nanosec", "polarity"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
"""A dvs_msgs/Event in an array, in CDR, from the second one on; the first has no gap before its time."""


def dvs_size(count: int) -> int:
    """Return how many bytes the records of so many events take in an array, in CDR."""
    return 16 * count - 3 if count else 0


def write_dvs(
    out: Bytes,
    events: EventColumns,
    *,
    width: int,
    height: int,
) -> None:
    """Write events as the records of a dvs_msgs/EventArray.

    Args:
        out: Bytes to write to, `dvs_size` of them and 3 more, from a multiple of 4 on in the message.
        events: With times in microseconds.
        width: Of the sensor [px].
        height: Of the sensor [px].

    Raises:
        EventCodecError: An event is outside of the sensor or has another polarity; times decrease, reach over
            more than 71 minutes, or have seconds of more than 32 bits.
    """
    t_us, x, y, polarity = events
    _check(events, width, height)
    out[:] = 0
    if not len(t_us):
        return
    first, last = int(t_us[0]), int(t_us[-1])
    if not -(2**31) <= first // 1_000_000 <= last // 1_000_000 < 2**31 or last - first >= _DVS_SPAN_US:
        raise EventCodecError(f"dvs_msgs cannot hold times from {first} to {last} us")
    begin = first // 1_000_000
    nanosecond = _after(t_us, begin * 1_000_000)
    second = nanosecond // np.uint32(1_000_000)
    nanosecond -= second * np.uint32(1_000_000)
    nanosecond *= np.uint32(1000)
    second += np.uint32(begin & 0xFFFFFFFF)
    # The first record lacks 2 bytes before its time; the others lie 16 apart.
    records = np.frombuffer(out.data, DVS_RECORD, count=len(t_us) - 1, offset=14)
    records["x"], records["y"] = x[1:], y[1:]
    records["sec"], records["nanosec"] = second[1:].view(np.int32), nanosecond[1:]
    records["polarity"] = polarity[1:]
    head = np.frombuffer(
        out.data, [("x", "<u2"), ("y", "<u2"), ("sec", "<i4"), ("ns", "<u4"), ("p", "u1")], 1
    )
    head[0] = (x[0], y[0], begin, nanosecond[0], polarity[0])


class EventPicture:
    """Draws the events of some time on white: a pixel's last one decides; brighter: blue, darker: red."""

    COLORS = np.array([[255, 255, 255], [220, 30, 30], [30, 60, 220]], np.uint8)
    """Red, green, blue of a pixel without events, that became darker, that became brighter."""

    def __init__(self, *, width: int, height: int) -> None:
        self.width = width
        self.height = height
        self._last = np.zeros((height, width), np.uint8)

    def add(self, x: NDArray[np.uint16], y: NDArray[np.uint16], polarity: NDArray[np.uint8]) -> None:
        """Draw events, in the order of their times.

        Raises:
            EventCodecError: An event is outside of the picture, or has another polarity than 0 and 1.
        """
        _check_pixels(x, y, polarity, self.width, self.height)
        pixel = y.astype(np.intp)
        pixel *= self.width
        pixel += x
        self._last.reshape(-1)[pixel] = polarity + np.uint8(1)

    def take(self) -> NDArray[np.uint8]:
        """Return the picture, shape [height, width, 3], and begin a new one."""
        picture: NDArray[np.uint8] = self.COLORS.take(self._last, axis=0)
        self._last[:] = 0
        return picture


def _check(events: EventColumns, width: int, height: int) -> None:
    t_us, x, y, polarity = events
    _check_pixels(x, y, polarity, width, height)
    if not len(t_us) == len(x):
        raise EventCodecError(f"there are {len(t_us)} times for {len(x)} events")
    if (t_us[1:] < t_us[:-1]).any():
        raise EventCodecError("events are not sorted by time")


def _check_pixels(
    x: NDArray[np.uint16], y: NDArray[np.uint16], polarity: NDArray[np.uint8], width: int, height: int
) -> None:
    if not len(x) == len(y) == len(polarity):
        raise EventCodecError(f"there are {len(x)} columns, {len(y)} rows and {len(polarity)} polarities")
    if len(x) and (x.max() >= width or y.max() >= height):
        raise EventCodecError(
            f"an event in column {x.max()} or row {y.max()} of a sensor with {width} x {height}"
        )
    if len(x) and polarity.max() > 1:
        raise EventCodecError(f"polarity is 0 or 1, got {polarity.max()}")


def _after(t_us: NDArray[np.int64], begin_us: int) -> NDArray[np.uint32]:
    """Return times after another one, none by 71 minutes or more [us]: in half the memory of int64."""
    after = t_us.astype(np.uint32)
    after -= np.uint32(begin_us & 0xFFFFFFFF)
    return after


class _Vectors(NamedTuple):
    """Events that become vectors, by their numbers."""

    groups: NDArray[np.intp]
    """First events of groups: their columns are the bases."""
    members: NDArray[np.intp]
    """All events of groups."""
    windows: NDArray[np.intp]
    """First events of vectors."""
    bits: Words
    """The words of these vectors."""


class _Places(NamedTuple):
    """The words of a packet, after its first one, and where they are."""

    x: NDArray[np.intp]
    """Of columns, and of vectors; of an event without a word, of the one before."""
    y: NDArray[np.intp]
    """Of rows; where none is written, of a word that comes after it."""
    column: Words
    """Column and polarity of each event."""
    row: Words
    low: Words
    """Words of the low half of each time."""
    new_low: NDArray[np.intp]
    """Events before which one is written."""
    high: Words
    """Words of high halves."""
    new_high: NDArray[np.intp]
    vectors: _Vectors | None

    def begin(self, events: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the place of the first word of some events that have a high half."""
        return self.y[events] - 2

    def write(self, out: Words) -> None:
        """Write all words; what is not to be there is written over."""
        out[self.y] = self.row
        out[self.y[self.new_low] - 1] = self.low[self.new_low]
        out[self.y[self.new_high] - 2] = self.high
        out[self.x] = self.column | np.uint16(_ADDR_X << 12)
        if self.vectors is not None:
            groups = self.vectors.groups
            out[self.x[groups] - 1] = self.column[groups] & 0xFFF | _BASE_X << 12
            out[self.x[self.vectors.windows]] = self.vectors.bits


def _wraps(epochs: int) -> int:
    """Return how often time has wrapped, which a decoder is told; 0 if it was set anew."""
    return epochs if 0 <= epochs <= _EPOCHS_MAX else 0


def _changes(values: NDArray[Any], out: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find out which elements differ from the one before; the first does."""
    out[0] = True
    np.not_equal(values[1:], values[:-1], out=out[1:])
    return out


def _new_bytes(size: int) -> Bytes:
    return np.empty(size, np.uint8)
