# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
"""Kernels around the scan of event cameras: how a step begins, its limits, keys in order, windows, columns.

Of many worlds, keys are sorted within each world, by one block each: how many there are is known only to the
device, and a sort of all worlds together would have to be launched over all the room there is.
"""

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.sensors.event_levels import COLUMN_SHIFT, KeyLayout
from neurosim_core.sensors.event_scan import LIMIT, PixelState, Stack, note_invalid

wp.set_module_options({"enable_backward": False})

COLUMN_TYPES = (wp.int64, wp.uint16, wp.uint16, wp.uint8)
"""Types of the times, columns, rows and polarities of events."""
COLUMN_OFFSETS = (0, 8, 10, 12)
"""Where each of them begins in a block of memory with room for one event."""
EVENT_BYTES = 13

# places in the header of a cut
_KEY_COUNT = wp.constant(0)
_ROOM = wp.constant(1)
_ORIGIN_US = wp.constant(2)

SECTION = wp.constant(64)
"""Worlds whose events are added up first: of N worlds no thread reads more than N / 64 + 64 counts."""

_US = wp.constant(wp.int64(1000))
_NOTHING = wp.constant(wp.int64((1 << 63) - 1))
"""Key that sorts behind all others."""


@wp.kernel
def begin_step(
    # In:
    clock_ns: wp.array[wp.int64],
    offsets_ns: wp.array[wp.int64],
    # In/out:
    stack: Stack,
) -> None:
    """Set the stamps of a world, of offsets from its clock; forget counts and limits of the step before."""
    world = wp.tid()
    origin_us = (clock_ns[world] + offsets_ns[0]) // _US
    stack.origin_us[world] = origin_us
    stack.since_reset_ns[world] = origin_us * _US
    for frame in range(offsets_ns.shape[0]):
        stack.stamps[world, frame] = clock_ns[world] + offsets_ns[frame] - origin_us * _US
    for counter in range(3):
        stack.counters[world, counter] = wp.int64(0)
    stack.dropped[world] = 0
    if stack.overflow[world] != 0:
        stack.overflow[world] = 0
        for frame in range(stack.row_limit.shape[1]):
            stack.row_limit[world, frame] = stack.table.shape[2]


@wp.kernel
def begin_frame(
    # In:
    start_ns: wp.int64,
    stamp_ns: wp.int64,
    # In/out:
    stack: Stack,
) -> None:
    """Set the stamps of a world that sees one frame: those of the frame before and of this one [ns]."""
    world = wp.tid()
    origin_us = start_ns // _US
    stack.origin_us[world] = origin_us
    stack.since_reset_ns[world] = origin_us * _US
    stack.stamps[world, 0] = start_ns - origin_us * _US
    stack.stamps[world, 1] = stamp_ns - origin_us * _US


@wp.kernel
def move_counters(
    # In/out:
    counters: wp.array2d[wp.int64],
    # Out:
    counters_out: wp.array2d[wp.int64],
) -> None:
    """Copy the counters of each world, to memory of the host for example, and begin to count anew."""
    world = wp.tid()
    for counter in range(3):
        counters_out[world, counter] = counters[world, counter]
        counters[world, counter] = wp.int64(0)


@wp.kernel
def begin_pixels(
    # In:
    mask: wp.array[wp.int32],
    log_radiance: wp.array3d[wp.float32],
    # Out:
    state_out: PixelState,
    # In/out:
    counters: wp.array2d[wp.int64],
) -> None:
    """Let the pixels of some worlds take frame 0 as their reference; threads are [world, pixel].

    A value that is not finite, or beyond +-1000, is counted, and 0 is the reference in its place; counters
    are as those of a step with one frame.
    """
    world, pixel = wp.tid()
    if mask[world] != 0:
        value = log_radiance[world, 0, pixel]
        if not wp.abs(value) <= LIMIT:
            value = wp.float32(0.0)
            note_invalid(1, 0, 1, pixel, state_out.base.shape[1], counters[world])
        state_out.base[world, pixel] = value
        state_out.last[world, pixel] = value
        state_out.crossed[world, pixel] = wp.vec2i(0, 0)


@wp.kernel
def find_overflow(
    # Model:
    capacity: wp.int32,
    event_count_max: wp.array[wp.int32],
    # In/out:
    stack: Stack,
) -> None:
    """Mark the worlds that have more events than may be in a step, and clear their table."""
    world = wp.tid()
    if stack.counters[world, 0] > wp.int64(wp.min(capacity, event_count_max[world])):
        stack.overflow[world] = 1
        for frame in range(stack.table.shape[1]):
            for row in range(stack.table.shape[2]):
                stack.table[world, frame, row] = 0


@wp.kernel
def limit_rows(
    # Model:
    frame_capacity: wp.int32,
    event_count_max: wp.array[wp.int32],
    # In/out:
    stack: Stack,
) -> None:
    """Keep of each frame the rows from the top that fit, as `EventCamera` does; clear the counters."""
    world = wp.tid()
    if stack.overflow[world] == 0:
        return
    most = wp.min(frame_capacity, event_count_max[world])
    lost = wp.int32(0)
    for frame in range(stack.table.shape[1]):
        kept = wp.int32(0)
        limit = wp.int32(0)
        full = wp.bool(False)
        for row in range(stack.table.shape[2]):
            count = stack.table[world, frame, row]
            full = full or kept + count > most
            if full:
                lost += count
            else:
                kept += count
                limit += 1
        stack.row_limit[world, frame] = limit
    stack.dropped[world] = lost
    for counter in range(3):
        stack.counters[world, counter] = wp.int64(0)


@wp.kernel
def add_up_sections(
    # In:
    counters: wp.array2d[wp.int64],
    # Out:
    sections_out: wp.array[wp.int64],
) -> None:
    """Add up the events of `SECTION` worlds; threads are the sections."""
    section = wp.tid()
    total = wp.int64(0)
    for world in range(section * SECTION, wp.min((section + 1) * SECTION, counters.shape[0])):
        total += counters[world, 0]
    sections_out[section] = total


@wp.kernel
def add_up(
    # In:
    counters: wp.array2d[wp.int64],
    sections: wp.array[wp.int64],
    # Out:
    offsets_out: wp.array[wp.int32],
    counts_out: wp.array[wp.int32],
) -> None:
    """Write where each world begins among the events of all, and how many it has; thread N is the end."""
    world = wp.tid()
    before = wp.int64(0)
    for section in range(world // SECTION):
        before += sections[section]
    for other in range(world // SECTION * SECTION, world):
        before += counters[other, 0]
    offsets_out[world] = wp.int32(before)
    if world < counts_out.shape[0]:
        counts_out[world] = wp.int32(counters[world, 0])


@wp.func_native(read_native(__file__, "sort_block"))
def _sort_block(keys: wp.array[wp.int64], count: wp.int32) -> None:
    """Sort the first `count` keys; all threads of a block come here together."""
    ...


@wp.kernel
def sort_keys(
    # In:
    counters: wp.array2d[wp.int64],
    # In/out:
    keys: wp.array2d[wp.int64],
) -> None:
    """Sort the keys of each world; threads are [world, lane], one block to a world, on a CPU one thread."""
    world, _lane = wp.tid()
    _sort_block(keys[world], wp.int32(counters[world, 0]))


@wp.struct
class Event:
    """What a key says."""

    time_us: wp.int64  # From the keys' time origin
    x: wp.uint16
    y: wp.uint16
    polarity: wp.uint8


@wp.func
def decode_key(key: wp.int64, layout: KeyLayout) -> Event:
    """Return what a key says."""
    one = wp.int64(1)
    row_mask = (one << wp.int64(layout.time_shift - 1 - layout.row_shift)) - one
    column_mask = (one << (wp.int64(layout.row_shift) - COLUMN_SHIFT)) - one
    found = Event()
    found.time_us = key >> wp.int64(layout.time_shift)
    found.x = wp.uint16((key >> COLUMN_SHIFT) & column_mask)
    found.y = wp.uint16((key >> wp.int64(layout.row_shift)) & row_mask)
    found.polarity = wp.uint8((key >> wp.int64(10)) & one)
    return found


@wp.kernel
def decode(
    # Model:
    layout: KeyLayout,
    lane_count: wp.int32,
    # In:
    origin_us: wp.int64,
    stack: Stack,
    offsets: wp.array[wp.int32],
    # Out:
    t_out: wp.array[wp.int64],
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    polarity_out: wp.array[wp.uint8],
) -> None:
    """Take the keys of all worlds apart, world after world; threads are [world, lane].

    Times are from `origin_us` before the origins of the worlds.
    """
    world, lane = wp.tid()
    first = offsets[world]
    for index in range(lane, offsets[world + 1] - first, lane_count):
        event = first + index
        found = decode_key(stack.keys[world, index], layout)
        t_out[event] = origin_us + stack.origin_us[world] + found.time_us
        x_out[event] = found.x
        y_out[event] = found.y
        polarity_out[event] = found.polarity


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
    if wp.int64(event) < header[_KEY_COUNT]:
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
def _first_window_after(
    key: wp.int64, bounds: wp.array[wp.int64], count: wp.int32, shift: wp.int32
) -> wp.int32:
    """Return the first of the windows that may hold a key, or come after it."""
    low = wp.int32(0)
    high = count
    while low < high:
        middle = (low + high) // 2
        if key < _bound_of(bounds[middle], shift):
            high = middle
        else:
            low = middle + 1
    return low


@wp.kernel
def decode_windows(
    # In:
    header: wp.array[wp.int64],
    bounds: wp.array[wp.int64],
    window_count: wp.int32,
    keys: wp.array[wp.int64],
    layout: KeyLayout,
    # Out:
    t_out: wp.array[wp.int64],
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    polarity_out: wp.array[wp.uint8],
    end_out: wp.array[wp.int32],
) -> None:
    """Write what sorted keys that `prepare` has seen say, and the index of the first one after each window.

    Threads are the room. `header` holds how many keys there are, at least one; the room of columns; the
    origin of their time [us]. With a room, an even number, the columns are one block of memory, given as the
    types that are in it, one after the other; with 0 each is an array of its own.
    """
    event = wp.tid()
    count = wp.int32(header[_KEY_COUNT])
    if event < count:
        room = wp.int32(header[_ROOM])
        key = keys[event]
        found = decode_key(key, layout)
        t_out[event] = header[_ORIGIN_US] + found.time_us
        x_out[4 * room + event] = found.x
        y_out[5 * room + event] = found.y
        polarity_out[12 * room + event] = found.polarity
        first = wp.int32(0)  # of the windows that end at this event
        if event > 0:
            first = _first_window_after(keys[event - 1], bounds, window_count, layout.time_shift)
        end = _first_window_after(key, bounds, window_count, layout.time_shift)
        for window in range(first, end):
            end_out[window] = event
        if event == count - 1:
            for window in range(end, window_count):
                end_out[window] = count
