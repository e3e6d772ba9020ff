# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
# mypy: disable-error-code="no-untyped-def,valid-type"
"""Kernels of event cameras in one world or many: the scan of all pixels, and keys in order.

The law of a pixel is a function that gets the arrays of one world: that of ideal pixels is in `event_scan`,
that of others in `event_noise_scan`. A kernel for single frames on CUDA is in `event_frame_scan`.

Every world has keys and counters of its own, and no block of threads takes pixels of two, so a block finds
room for its events in its world with one atomic operation. Nothing here depends on other worlds.

Keys are sorted within each world, by one block each: how many there are is known only to the device, and a
sort of all worlds together would have to be launched over all the room there is.
"""

import functools
from typing import Any

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.sensors.event_cut import take_apart
from neurosim_core.sensors.event_levels import quiet_range
from neurosim_core.sensors.event_noise_model import Memory, PixelModel
from neurosim_core.sensors.event_noise_scan import make_pixel_scan
from neurosim_core.sensors.event_scan import (
    BLOCK_SIZE,
    CLOSE,
    LIMIT,
    OPEN,
    scan_pixel,
    write_key,
)

wp.set_module_options({"enable_backward": False})

ALL = wp.constant(0)
COUNT = wp.constant(1)
AGAIN = wp.constant(2)
"""What a scan is for: all worlds; those with too many events, to count these by row; the same with fewer
rows."""

TILE_SIZE = wp.constant(256)
"""Pixels that a thread of `screen` takes."""
SECTION = wp.constant(64)
"""Worlds whose events are added up first: of N worlds no thread reads more than N / 64 + 64 counts."""

_US = wp.constant(wp.int64(1000))


@wp.struct
class Stack:
    """What the pixels of one camera see in a step, and what comes of it. Shapes begin with [world]."""

    log_radiance: wp.array3d[wp.float32]  # [world, frame, pixel]
    stamps: wp.array2d[wp.int64]  # Of the state and of each frame, from the origin [ns], [world, frame + 1]
    origin_us: wp.array[wp.int64]  # Origin of the keys' time since the reset of the world [us]
    since_reset_ns: wp.array[wp.int64]
    """The same from the reset of the pixels on, which noise counts from [ns]."""
    row_limit: wp.array2d[wp.int32]  # Rows whose events are kept, [world, frame]
    overflow: wp.array[wp.int32]  # 1: the world has more events than fit
    table: wp.array3d[wp.int32]  # Events of the worlds that have too many, [world, frame, row]; zeros before
    keys: wp.array2d[wp.int64]  # [world, capacity]
    counters: wp.array2d[wp.int64]  # As in `event_scan.scan_pixel`, [world, 3]
    dropped: wp.array[wp.int32]  # Events that were lost in the step


@wp.kernel
def begin_step(
    # In:
    clock_ns: wp.array[wp.int64],
    offsets_ns: wp.array[wp.int64],
    # In/out:
    stack: Stack,
) -> None:
    """Set the stamps of a world (`WorldFrameSensor.find`); forget counts and limits of the step before."""
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
def hand_over_counters(
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


@wp.func_native(read_native(__file__, "count_lead"))
def _count_lead(
    begin: wp.int32,
    end: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    frame_count: wp.int32,
    low_32: wp.array[wp.float32],
    high_32: wp.array[wp.float32],
    lead_out: wp.array[wp.int32],
) -> None:
    """Count for at most 256 pixels the frames before the first that leaves (low, high)."""
    ...


@wp.kernel
def screen(
    # Model:
    thresholds: wp.array[wp.vec2d],
    # In:
    first_world: wp.int32,
    first_pixel: wp.int32,
    end_pixel: wp.int32,
    frame_count: wp.int32,
    stack: Stack,
    base: wp.array2d[wp.float32],
    crossed: wp.array2d[wp.vec2i],
    # Out:
    low_out: wp.array2d[wp.float32],
    high_out: wp.array2d[wp.float32],
    lead_out: wp.array2d[wp.int32],
) -> None:
    """Count the frames of each pixel before the first that may fire; threads are [world, tile].

    This is what makes the scan fast on a CPU: a pixel's own samples lie far apart in memory. It changes no
    event. The quiet range of each pixel is left in `low_out` and `high_out`.
    """
    index, tile = wp.tid()
    world = first_world + index
    begin = first_pixel + tile * TILE_SIZE
    end = wp.min(begin + TILE_SIZE, end_pixel)
    on = thresholds[world][0]
    off = thresholds[world][1]
    for pixel in range(begin, end):
        before = crossed[world, pixel]
        quiet = quiet_range(wp.float64(base[world, pixel]), before[0], before[1], on, off)
        low_out[world, pixel] = quiet[0]
        high_out[world, pixel] = quiet[1]
    _count_lead(
        begin,
        end,
        stack.log_radiance[world],
        frame_count,
        low_out[world],
        high_out[world],
        lead_out[world],
    )


@wp.kernel(launch_bounds=(BLOCK_SIZE, 4))  # blocks of a multiprocessor: fastest on an H200
def scan(
    # Model:
    thresholds: wp.array[wp.vec2d],
    width: wp.int32,
    row_shift: wp.int32,
    time_shift: wp.int32,
    # In:
    first_world: wp.int32,
    first_pixel: wp.int32,
    end_pixel: wp.int32,
    frame_count: wp.int32,
    part: wp.int32,
    lead: wp.array2d[wp.int32],
    base: wp.array2d[wp.float32],
    last: wp.array2d[wp.float32],
    crossed: wp.array2d[wp.vec2i],
    # In/out:
    stack: Stack,
    # Out:
    last_out: wp.array2d[wp.float32],
    crossed_out: wp.array2d[wp.vec2i],
) -> None:
    """Take ideal pixels over the frames of a step; threads are [world, pixel], whole blocks to a world.

    Threads begin at a world and a pixel; those at or past `end_pixel` (they fill the last CUDA block) have no
    pixel. `part` is ALL, COUNT or AGAIN; the others are those of `scan_pixel`.
    """
    index, thread = wp.tid()
    world = first_world + index
    if part != ALL and stack.overflow[world] == 0:
        return
    scan_pixel(
        thresholds[world][0],
        thresholds[world][1],
        width,
        row_shift,
        time_shift,
        first_pixel + thread,
        end_pixel,
        thread % BLOCK_SIZE,
        stack.log_radiance[world],
        stack.stamps[world],
        frame_count,
        lead[world],
        stack.row_limit[world],
        base[world],
        last[world],
        crossed[world],
        part == COUNT,
        last_out[world],
        crossed_out[world],
        stack.keys[world],
        stack.counters[world],
        stack.table[world],
    )


@functools.cache
def make_noisy_scan(terms: frozenset[str]) -> Any:
    """Return the kernel that does the same for pixels with the given terms (`event_noise_model.terms_of`).

    In place of thresholds it takes a `PixelModel` of each world, and a `Memory` of each before and after.
    """
    scan_noisy = make_pixel_scan(terms)

    @wp.kernel(
        module=wp.get_module(f"{__name__}.{'_'.join(sorted(terms)) or 'ideal'}"), enable_backward=False
    )
    def scan(
        # Model:
        models: wp.array[PixelModel],
        width: wp.int32,
        row_shift: wp.int32,
        time_shift: wp.int32,
        # In:
        first_world: wp.int32,
        first_pixel: wp.int32,
        end_pixel: wp.int32,
        frame_count: wp.int32,
        part: wp.int32,
        base: wp.array2d[wp.float32],
        last: wp.array2d[wp.float32],
        crossed: wp.array2d[wp.vec2i],
        before: wp.array[Memory],
        # In/out:
        stack: Stack,
        # Out:
        last_out: wp.array2d[wp.float32],
        crossed_out: wp.array2d[wp.vec2i],
        after: wp.array[Memory],
    ):
        index, thread = wp.tid()
        world = first_world + index
        pixel = first_pixel + thread
        if part != ALL and stack.overflow[world] == 0:
            return
        keys = stack.keys[world]
        counters = stack.counters[world]
        write_key(OPEN, wp.int64(0), keys, counters)
        if pixel < end_pixel:
            scan_noisy(
                models[world],
                width,
                row_shift,
                time_shift,
                pixel,
                stack.log_radiance[world],
                stack.stamps[world],
                stack.since_reset_ns[world],
                frame_count,
                stack.row_limit[world],
                base[world],
                last[world],
                crossed[world],
                before[world],
                part == COUNT,
                last_out[world],
                crossed_out[world],
                after[world],
                keys,
                counters,
                stack.table[world],
            )
        write_key(CLOSE, wp.int64(0), keys, counters)

    return scan


@wp.kernel
def begin_pixels(
    # In:
    mask: wp.array[wp.int32],
    log_radiance: wp.array3d[wp.float32],
    # Out:
    base_out: wp.array2d[wp.float32],
    last_out: wp.array2d[wp.float32],
    crossed_out: wp.array2d[wp.vec2i],
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
            wp.atomic_add(counters, world, 1, wp.int64(1))
            wp.atomic_max(counters, world, 2, wp.int64(base_out.shape[1]) - wp.int64(pixel))
        base_out[world, pixel] = value
        last_out[world, pixel] = value
        crossed_out[world, pixel] = wp.vec2i(0, 0)


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


@wp.kernel
def decode(
    # Model:
    row_shift: wp.int32,
    time_shift: wp.int32,
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
        found = take_apart(stack.keys[world, index], row_shift, time_shift)
        t_out[event] = origin_us + stack.origin_us[world] + found.time_us
        x_out[event] = found.x
        y_out[event] = found.y
        polarity_out[event] = found.polarity
