"""Events as bytes: mono of event_camera_msgs/EventPacket, and the records of dvs_msgs/EventArray.

mono is one word of 64 bits for each event, with a time of its own in nanoseconds; `cortex.evt3` is the other
encoding of EventPacket. Nothing here loops over events in Python.

Reference: the README of event_camera_msgs.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.evt3 import Buffer, Bytes, EventCodecError, EventColumns, check_events, read_words

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
