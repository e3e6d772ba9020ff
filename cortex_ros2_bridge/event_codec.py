"""Events as bytes: encodings of event_camera_msgs/EventPacket, and the records of dvs_msgs/EventArray.

mono is one word of 64 bits for each event, with a time of its own in nanoseconds. libcaer and libcaer_cmp
come from the driver of iniVation's cameras, and are only read. `cortex.evt3` is the other encoding. Nothing
here loops over events in Python.

Reference: the README of event_camera_msgs; polarity.h of libcaer; event_camera_codecs, for libcaer_cmp.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.evt3 import Buffer, Bytes, EventCodecError, EventColumns, check_events, hold_value, read_words

_MONO_SPAN_MAX_US = (2**32 - 1) // 1000


def encode_mono(events: EventColumns, *, width: int, height: int, base_us: int) -> Bytes:
    """Return events as words of 64 bits: polarity, row (15), column (16), nanoseconds after `base_us` (32).

    Raises:
        EventCodecError: The sensor has too many rows, an event is outside of it or has another polarity, or
            times decrease or reach over more than 4.29 s.
    """
    if width > 2**16 or height > 2**15:
        raise EventCodecError(f"mono holds at most 65536 x 32768 pixels, not {width} x {height}")
    t_us, x, y, polarity = events
    count = len(t_us)
    check_events(events, width, height)
    if count and not 0 <= int(t_us[0]) - base_us <= int(t_us[-1]) - base_us <= _MONO_SPAN_MAX_US:
        raise EventCodecError(
            f"mono holds times from its base to 4.29 s later, got {t_us[0]} to {t_us[-1]} us for {base_us} us"
        )
    out = np.empty(8 * count, np.uint8)
    quarters = out.view("<u2").reshape(count, 4)
    after_ns = (t_us - base_us).astype(np.uint32)
    after_ns *= np.uint32(1000)
    out.view("<u4").reshape(count, 2)[:, 0] = after_ns
    quarters[:, 2] = x
    row = polarity.astype(np.uint16)
    row <<= 15
    row |= y
    quarters[:, 3] = row
    return out


def decode_mono(data: Buffer | Bytes, *, base_ns: int) -> EventColumns:
    """Return the events of a packet with a `time_base`, with times in nanoseconds.

    Raises:
        EventCodecError: It does not consist of words of 8 bytes.
    """
    words = read_words(data, "<u8", "mono")
    quarters = words.view("<u2").reshape(len(words), 4)
    t = (words & 0xFFFFFFFF).astype(np.int64) + base_ns
    row = quarters[:, 3]
    return EventColumns(t, quarters[:, 2].copy(), row & np.uint16(0x7FFF), (row >> 15).astype(np.uint8))


def decode_libcaer(data: Buffer | Bytes, *, base_ns: int) -> EventColumns:
    """Return the events of a packet with a `time_base`, with times in nanoseconds.

    A word is a column (15 bits), a row (15), a polarity, a flag, and a time of 31 bits [us] that may wrap.

    Raises:
        EventCodecError: It does not consist of words of 8 bytes.
    """
    pixel, time_us = read_words(data, "<u8", "libcaer").view("<u4").reshape(-1, 2).T
    t_us = time_us.astype(np.int64)
    t_us[1:] += np.cumsum(t_us[1:] < t_us[:-1]) << 31
    x, y = (pixel >> 17).astype(np.uint16), (pixel >> 2 & 0x7FFF).astype(np.uint16)
    return EventColumns(t_us * 1000 + base_ns, x, y, (pixel >> 1 & 1).astype(np.uint8))


_TIME_HIGH, _TIME_LOW, _ADDR_X, _ADDR_Y, _BASE_Y, _VECT_8 = range(6)


def decode_libcaer_cmp(data: Buffer | Bytes, *, base_ns: int, width: int, height: int) -> EventColumns:
    """Return the events of a packet with a `time_base` that are on the sensor, with times in nanoseconds.

    The upper 4 bits of a word of 16 say what the others are: the high or the low half of a time of 24 bits
    since `time_base` [us], a column, a row and a polarity, which make an event; or a first row and a
    polarity, and then bits that tell which of the next eight rows have an event.

    Raises:
        EventCodecError: It is half a word too long, has a word that is none of these, or an event without a
            column.
    """
    words = read_words(data, "<u2", "libcaer_cmp")
    code, value = words >> 12, words & 0xFFF
    if (code > _VECT_8).any():
        raise EventCodecError(f"libcaer_cmp has no words that begin with 0x{code.max():X}")
    where = np.flatnonzero((code == _ADDR_Y) | (code == _VECT_8))
    is_vector, own = code[where] == _VECT_8, value[where]
    passed = np.cumsum(8 * (code == _VECT_8))  # rows that vectors up to this word have stepped over
    base, _ = hold_value(code == _BASE_Y, (value & 0x7FF) - passed, 0, where)
    sign, _ = hold_value(code == _BASE_Y, value >> 11, 0, where)
    high, _ = hold_value(code == _TIME_HIGH, value, 0, where)
    low, _ = hold_value(code == _TIME_LOW, value, 0, where)
    x, _ = hold_value(code == _ADDR_X, value & 0x7FF, -1, where)
    if (x < 0).any():
        raise EventCodecError("a packet of libcaer_cmp has an event before its first column")
    row, bit = np.nonzero(np.where(is_vector, own & 0xFF, 1)[:, None] >> np.arange(8) & 1)
    y = np.where(is_vector, base + passed[where] - 8, own & 0x7FF)[row] + bit
    polarity = np.where(is_vector, sign, own >> 11)[row].astype(np.uint8)
    t = ((high << 12 | low) * 1000 + base_ns)[row]
    inside = (x[row] < width) & (y < height)
    places = x[row][inside].astype(np.uint16), y[inside].astype(np.uint16)
    return EventColumns(t[inside], *places, polarity[inside])


DVS_RECORD = np.dtype(
    {
        "names": ["x", "y", "sec", "nanosec", "polarity"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
"""A dvs_msgs/Event in an array, in CDR, from the second one on; the first has no gap before its time."""
DVS_RECORD_ROS1 = np.dtype(
    [("x", "<u2"), ("y", "<u2"), ("sec", "<u4"), ("nanosec", "<u4"), ("polarity", "u1")]
)
"""The same as ROS 1 serialises it: without gaps."""


def read_dvs(data: Buffer, *, ros1: bool = False) -> tuple[tuple[int, int], EventColumns]:
    """Return width and height of the sensor, and the events of a dvs_msgs/EventArray.

    Args:
        data: The message in little-endian CDR; whole microseconds are kept of its times.
        ros1: It is serialised as by ROS 1 instead.

    Raises:
        EventCodecError: It is cut off, or big endian.
    """
    view = memoryview(data).cast("B")
    if not ros1 and bytes(view[:2]) != b"\0\1":
        raise EventCodecError("a dvs_msgs/EventArray that is not little-endian CDR")
    try:
        (length,) = struct.unpack_from("<I", view, 12)  # of the frame's name; CDR ends and pads it
        begin = 16 + (length if ros1 else length + 3 & -4)
        height, width, count = struct.unpack_from("<III", view, begin)
        rows = view[begin + 12 :]
        records = np.frombuffer(rows, DVS_RECORD_ROS1, count=count) if ros1 else _records(rows, count)
    except (struct.error, ValueError) as error:
        raise EventCodecError(f"{len(view)} bytes are no dvs_msgs/EventArray: {error}") from error
    t = records["sec"].astype(np.int64) * 1_000_000 + records["nanosec"] // 1000
    return (width, height), EventColumns(t, *(records[name].copy() for name in ("x", "y", "polarity")))


def _records(view: memoryview, count: int) -> NDArray[Any]:
    size = 16 * count - 3 if count else 0
    if len(view) < size:  # before memory is taken for what a damaged count claims
        raise ValueError(f"{count} events need more")
    records = np.zeros(count, DVS_RECORD)
    if count:
        records[0] = struct.unpack_from("<HHiIB", view)
        padded = bytes(view[14:size]) + bytes(3)
        records[1:] = np.frombuffer(padded, DVS_RECORD, count=count - 1)
    return records
