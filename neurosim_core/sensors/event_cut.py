# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
"""Kernels for the keys of events between the scan and the packets: windows, origins, columns."""

import warp as wp

from neurosim_core.sensors.event_levels import COLUMN_SHIFT

wp.set_module_options({"enable_backward": False})

COLUMN_TYPES = (wp.int64, wp.uint16, wp.uint16, wp.uint8)
"""Types of the times, columns, rows and polarities of events."""
COLUMN_OFFSETS = (0, 8, 10, 12)
"""Where each of them begins in a block of memory with room for one event."""
EVENT_BYTES = 13

# places in the header of a cut
COUNT = wp.constant(0)
ROOM = wp.constant(1)
ORIGIN_US = wp.constant(2)

_US = wp.constant(wp.int64(1000))
_NOTHING = wp.constant(wp.int64((1 << 63) - 1))
"""Key that sorts behind all others."""


@wp.func
def mark(key: wp.int64, stamps: wp.array[wp.int64], stamp_count: wp.int32, time_shift: wp.int32) -> wp.int64:
    """Return a key with `late` set if it comes after a stamp within its microsecond; see `prepare`."""
    time_us = key >> wp.int64(time_shift)
    low = wp.int32(0)
    high = stamp_count
    while low < high:
        middle = (low + high) // 2
        if stamps[middle] // _US < time_us:
            low = middle + 1
        else:
            high = middle
    if low < stamp_count:
        end_ns = stamps[low]
        sub_ns = key & wp.int64(1023)
        if end_ns // _US == time_us and sub_ns > end_ns - time_us * _US:
            return key | (wp.int64(1) << wp.int64(time_shift - 1))
    return key


@wp.kernel
def prepare(
    # In:
    header: wp.array[wp.int64],
    bounds: wp.array[wp.int64],
    window_count: wp.int32,
    time_shift: wp.int32,
    # In/out:
    keys: wp.array[wp.int64],
) -> None:
    """Set `late` on keys that come after the end of a window within its microsecond; threads are the room.

    Keys beyond the count get to sort behind all others. `bounds` are the ends of windows from the keys' time
    origin [ns], at least 1 us apart; the rest of `header` is for `decode_windows`.
    """
    event = wp.tid()
    if wp.int64(event) < header[COUNT]:
        keys[event] = mark(keys[event], bounds, window_count, time_shift)
    else:
        keys[event] = _NOTHING


@wp.func
def move_origin(key: wp.int64, step_us: wp.int64, time_shift: wp.int32) -> wp.int64:
    """Return a key with a time origin that is later, and without `late`."""
    return (key & ~(wp.int64(1) << wp.int64(time_shift - 1))) - (step_us << wp.int64(time_shift))


@wp.kernel
def carry_over(
    # In:
    keys: wp.array[wp.int64],
    first: wp.int32,
    count: wp.int32,
    origin_step_us: wp.int64,
    time_shift: wp.int32,
    # Out:
    keys_out: wp.array[wp.int64],
    first_out: wp.int32,
) -> None:
    """Copy keys, from and to a position, with a time origin that is later, and clear `late`."""
    event = wp.tid()
    if event < count:
        keys_out[first_out + event] = move_origin(keys[first + event], origin_step_us, time_shift)


@wp.func
def _bound_of(end_ns: wp.int64, time_shift: wp.int32) -> wp.int64:
    """Return the least key that may come after a window which ends then."""
    return ((end_ns // _US) << wp.int64(time_shift)) | (wp.int64(1) << wp.int64(time_shift - 1))


@wp.func
def count_until(
    end_ns: wp.int64, keys: wp.array[wp.int64], key_count: wp.int32, time_shift: wp.int32
) -> wp.int32:
    """Return how many of the sorted keys are in a window that ends then, or before it; see `find_ends`."""
    bound = _bound_of(end_ns, time_shift)
    low = wp.int32(0)
    high = key_count
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < bound:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def find_ends(
    # In:
    keys: wp.array[wp.int64],
    key_count: wp.int32,
    stamps: wp.array[wp.int64],
    time_shift: wp.int32,
    # Out:
    end_out: wp.array[wp.int32],
) -> None:
    """Find the first key after each window, in sorted keys that `prepare` has seen; see there."""
    window = wp.tid()
    end_out[window] = count_until(stamps[window], keys, key_count, time_shift)


@wp.struct
class Event:
    """What a key says."""

    time_us: wp.int64  # From the keys' time origin
    x: wp.uint16
    y: wp.uint16
    polarity: wp.uint8


@wp.func
def take_apart(key: wp.int64, row_shift: wp.int32, time_shift: wp.int32) -> Event:
    """Return what a key says; parameters as for `decode`."""
    one = wp.int64(1)
    row_mask = (one << wp.int64(time_shift - 1 - row_shift)) - one
    column_mask = (one << (wp.int64(row_shift) - COLUMN_SHIFT)) - one
    found = Event()
    found.time_us = key >> wp.int64(time_shift)
    found.x = wp.uint16((key >> COLUMN_SHIFT) & column_mask)
    found.y = wp.uint16((key >> wp.int64(row_shift)) & row_mask)
    found.polarity = wp.uint8((key >> wp.int64(10)) & one)
    return found


@wp.kernel
def decode(
    # In:
    keys: wp.array[wp.int64],
    time_origin_us: wp.int64,
    row_shift: wp.int32,
    time_shift: wp.int32,
    # Out:
    t_out: wp.array[wp.int64],
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    polarity_out: wp.array[wp.uint8],
) -> None:
    """Take keys apart into time [us], column, row and polarity, arrays of shape [event]."""
    event = wp.tid()
    found = take_apart(keys[event], row_shift, time_shift)
    t_out[event] = time_origin_us + found.time_us
    x_out[event] = found.x
    y_out[event] = found.y
    polarity_out[event] = found.polarity


@wp.kernel
def decode_windows(
    # In:
    header: wp.array[wp.int64],
    bounds: wp.array[wp.int64],
    window_count: wp.int32,
    keys: wp.array[wp.int64],
    row_shift: wp.int32,
    time_shift: wp.int32,
    # Out:
    columns_8: wp.array[wp.int64],
    columns_2: wp.array[wp.uint16],
    columns_1: wp.array[wp.uint8],
    end_out: wp.array[wp.int32],
) -> None:
    """Do what `find_ends` and `decode` do, for at least one key; threads are the room.

    `header` holds how many keys there are; for how many the columns have room, an even number; the origin of
    their time [us]. The columns are one block of memory, given as three types, one after the other in it.
    """
    event = wp.tid()
    count = wp.int32(header[COUNT])
    if event < count:
        room = wp.int32(header[ROOM])
        found = take_apart(keys[event], row_shift, time_shift)
        columns_8[event] = header[ORIGIN_US] + found.time_us
        columns_2[4 * room + event] = found.x
        columns_2[5 * room + event] = found.y
        columns_1[12 * room + event] = found.polarity
        for window in range(window_count):
            bound = _bound_of(bounds[window], time_shift)
            inside = keys[event] < bound
            if inside and (event == count - 1 or keys[event + 1] >= bound):
                end_out[window] = event + 1
            if event == 0 and not inside:
                end_out[window] = 0
