# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
"""The scan of ideal pixels over a stack of frames, which writes the keys of their events.

Levels, the tie rule and keys are in `event_levels`. Between stacks a pixel holds its last sample and how many
levels it has crossed. Pixels that are not ideal have a scan of their own, made to measure, in
`event_noise_scan`; a scan of single frames on CUDA is in `event_frame_scan`.

Every world has keys and counters of its own, and no block of threads takes pixels of two, so a block finds
room for its events in its world with one atomic operation. Nothing here depends on other worlds.
"""

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.sensors.event_levels import (
    KeyLayout,
    fall,
    key_of_level,
    levels_from,
    place_of,
    quiet_range,
    reach_down,
    reach_up,
    rise,
)

wp.set_module_options({"enable_backward": False})

BLOCK_SIZE = wp.constant(256)
"""Threads of a block on CUDA."""
STEPS_MAX = wp.constant(wp.int32(4))
"""Levels that are found one by one; few samples cross more, and theirs are found at once."""
LOG_RADIANCE_MAX = 1.0e3
"""Larger magnitudes are refused like non-finite values: exp(1000) is no radiance."""
LIMIT = wp.constant(wp.float32(LOG_RADIANCE_MAX))

OPEN = wp.constant(0)
PUT = wp.constant(1)
CLOSE = wp.constant(2)
READ = wp.constant(3)
START = wp.constant(4)

ALL = wp.constant(0)
COUNT = wp.constant(1)
AGAIN = wp.constant(2)
"""What a scan is for: all worlds; those with too many events, to count these by row; the same with fewer
rows."""

TILE_SIZE = wp.constant(256)
"""Pixels that a thread of `screen` takes."""


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
    keys: wp.array2d[wp.int64]
    """Shape [slot, capacity]; slots are worlds, or parts of the pixels of a single world."""
    counters: wp.array2d[wp.int64]
    """Shape [slot, >= 3], zeros before: where the next key goes, which counts events kept (written or not);
    invalid samples; and the flat index of the first of these in the stack, as frame_count * pixel_count minus
    it."""
    dropped: wp.array[wp.int32]  # Events that were lost in the step


@wp.struct
class PixelState:
    """The state of pixels between two stacks, shape [world, pixel]; of what no term has, [world, 0]."""

    base: wp.array2d[wp.float32]  # Log radiance of the reset
    last: wp.array2d[wp.float32]  # Last sample
    crossed: wp.array2d[wp.vec2i]  # Levels crossed upwards and downwards
    # Of pixels that are not ideal:
    reference: wp.array2d[wp.float64]
    """What `base` is to an ideal pixel; changes at resets (refractory, spontaneous) and events (jitter)."""
    event_count: wp.array2d[wp.int32]  # Events since the reset, which number the draws of thresholds
    filtered: wp.array2d[wp.float64]  # Output of the photoreceptor
    exposure_ns: wp.array2d[wp.float64]  # Light since the reset, in units of white, times time
    held_ns: wp.array2d[wp.float64]  # Time in reset that is left; negative: not in reset
    next_ns: wp.array2d[wp.int64]  # Time of the next noise event that may be, since the reset
    noise_count: wp.array2d[wp.int32]  # Its number
    voltage: wp.array2d[wp.float64]  # Of the Brownian motion, in thresholds


@wp.struct
class Extent:
    """The input of a launch of the scan, and its purpose."""

    first_world: wp.int32
    world_count: wp.int32
    first_pixel: wp.int32
    first_slot: wp.int32  # Of the keys and counters of the first world of all
    end_pixel: wp.int32  # Threads at or past it, which fill the last block on CUDA, have no pixel
    frame_count: wp.int32
    part: wp.int32  # ALL, COUNT or AGAIN


@wp.func_native(read_native(__file__, "write_key"))
def write_key(step: wp.int32, key: wp.int64, keys: wp.array[wp.int64], counters: wp.array[wp.int64]) -> None:
    """Append a key (step PUT) and count it, also where there is no room for it.

    Every thread of a block comes here once before with OPEN, and once after with CLOSE.
    """
    ...


@wp.func_native(read_native(__file__, "append"))
def _append(key: wp.int64, keys: wp.array[wp.int64], counters: wp.array[wp.int64]) -> None:
    """Append a key and count it."""
    ...


@wp.func_native(read_native(__file__, "keep_crossing"))
def keep_crossing(
    step: wp.int32,
    frame: wp.int32,
    event_count: wp.int32,
    last: wp.float32,
    up: wp.int32,
    down: wp.int32,
    place: wp.int32,
    index: wp.int32,
    counters: wp.array[wp.int64],
) -> wp.int64:
    """Keep what a pixel crosses in a frame (step PUT), for its whole block to turn into keys; only on CUDA.

    Few threads cross levels, some in many frames, and the others would wait for them. The frames of a round
    are kept together.

    Every thread of a block comes here before with OPEN, and after with CLOSE, which counts the events and
    returns how many crossings are kept. Then READ returns a word of one: the frame of the round and the
    thread; `last`, `up` and `down` as they were before; the number of its first event, and of its events.
    START returns the place of event 0. PUT returns 0 where there is no room, as always on a CPU.
    """
    ...


@wp.func
def _read_word(place: wp.int32, index: wp.int32, counters: wp.array[wp.int64]) -> wp.int32:
    return wp.int32(keep_crossing(READ, 0, 0, wp.float32(0.0), 0, 0, place, index, counters))


@wp.func_native(read_native(__file__, "end_of_round"))
def _end_of_round(first: wp.int32, frame_count: wp.int32) -> wp.int32:
    """Return where the frames end that a block scans before it writes their events; 32 on CUDA."""
    ...


@wp.func_native(read_native(__file__, "next_active_frame"))
def _next_active_frame(
    log_radiance: wp.array2d[wp.float32],
    pixel: wp.int32,
    first: wp.int32,
    end: wp.int32,
    low: wp.float32,
    high: wp.float32,
) -> wp.int32:
    """Return the first frame of a round from `first` on whose sample leaves (low, high), or its end."""
    ...


@wp.func_native(read_native(__file__, "prefetch_samples"))
def prefetch_samples(log_radiance: wp.array2d[wp.float32], pixel: wp.int32, frame_count: wp.int32) -> None:
    """Have the samples of a pixel come near, on CUDA, before they are read one after the other."""
    ...


@wp.func_native(read_native(__file__, "count_quiet_frames"))
def _count_quiet_frames(
    begin: wp.int32,
    end: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    frame_count: wp.int32,
    low_32: wp.array[wp.float32],
    high_32: wp.array[wp.float32],
    quiet_count_out: wp.array[wp.int32],
) -> None:
    """Count for at most 256 pixels the frames before the first that leaves (low, high)."""
    ...


@wp.func
def note_invalid(
    count: wp.int32,
    first_frame: wp.int32,
    frame_count: wp.int32,
    pixel: wp.int32,
    pixel_count: wp.int32,
    counters: wp.array[wp.int64],
) -> None:
    """Count the samples of a pixel that cannot be used, and keep where the first of all is; see `Stack`."""
    if count > 0:
        flat = wp.int64(first_frame) * wp.int64(pixel_count) + wp.int64(pixel)
        wp.atomic_add(counters, 1, wp.int64(count))
        wp.atomic_max(counters, 2, wp.int64(frame_count) * wp.int64(pixel_count) - flat)


@wp.kernel
def screen(
    # Model:
    thresholds: wp.array[wp.vec2d],
    # In:
    extent: Extent,
    stack: Stack,
    before: PixelState,
    # Out:
    low_out: wp.array2d[wp.float32],
    high_out: wp.array2d[wp.float32],
    quiet_count_out: wp.array2d[wp.int32],
) -> None:
    """Count the frames of each pixel before the first that may fire; threads are [world, tile].

    This is what makes the scan fast on a CPU: a pixel's own samples lie far apart in memory. It changes no
    event. The quiet range of each pixel is left in `low_out` and `high_out`.
    """
    index, tile = wp.tid()
    world = extent.first_world + index
    begin = extent.first_pixel + tile * TILE_SIZE
    end = wp.min(begin + TILE_SIZE, extent.end_pixel)
    on = thresholds[world][0]
    off = thresholds[world][1]
    for pixel in range(begin, end):
        crossed = before.crossed[world, pixel]
        levels = levels_from(wp.float64(before.base[world, pixel]), on, off)
        quiet = quiet_range(levels, crossed[0], crossed[1])
        low_out[world, pixel] = quiet[0]
        high_out[world, pixel] = quiet[1]
    _count_quiet_frames(
        begin,
        end,
        stack.log_radiance[world],
        extent.frame_count,
        low_out[world],
        high_out[world],
        quiet_count_out[world],
    )


@wp.func
def _write_kept(
    index: wp.int32,
    first_pixel: wp.int32,
    first_frame: wp.int32,
    world: wp.int32,
    slot: wp.int32,
    thresholds: wp.vec2d,
    layout: KeyLayout,
    base: wp.array2d[wp.float32],
    stack: Stack,
) -> None:
    """Write the keys of what a pixel of the block has crossed in a frame, as far as there is room."""
    counters = stack.counters[slot]
    word = _read_word(0, index, counters)
    pixel = first_pixel + (word & 255)
    frame = first_frame + (word >> 8)
    last = wp.cast(_read_word(1, index, counters), wp.float32)
    up = _read_word(2, index, counters)
    down = _read_word(3, index, counters)
    offset = wp.int64(_read_word(4, index, counters)) & wp.int64(0xFFFFFFFF)
    place_of_first = keep_crossing(START, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters) + offset
    sample = stack.log_radiance[world, frame, pixel]
    levels = levels_from(wp.float64(base[world, pixel]), thresholds[0], thresholds[1])
    place = place_of(pixel, pixel // layout.width, layout)
    start_ns = stack.stamps[world, frame]
    end_ns = stack.stamps[world, frame + 1]
    for event in range(_read_word(5, index, counters)):
        if place_of_first + wp.int64(event) < wp.int64(stack.keys.shape[1]):
            stack.keys[slot, wp.int32(place_of_first) + event] = key_of_level(
                event, levels, up, down, last, sample, start_ns, end_ns, place, layout.time_shift
            )


@wp.kernel(launch_bounds=(BLOCK_SIZE, 4))  # blocks of a multiprocessor: fastest on an H200
def scan(
    # Model:
    thresholds: wp.array[wp.vec2d],
    layout: KeyLayout,
    # In:
    extent: Extent,
    quiet_count: wp.array2d[wp.int32],
    before: PixelState,
    # In/out:
    stack: Stack,
    # Out:
    after: PixelState,
) -> None:
    """Take ideal pixels over the frames of a step; threads are [world, pixel], whole blocks to a world.

    All threads of a block come to what they do together. `quiet_count` is the number of frames at the start
    that are known to be quiet, shape [world, pixel]. With the part COUNT events are only counted, in the
    table of the stack.
    """
    index, thread = wp.tid()
    world = extent.first_world + index
    if extent.part != ALL and stack.overflow[world] == 0:
        return
    tabulate = extent.part == COUNT
    pixel = extent.first_pixel + thread
    lane = thread % BLOCK_SIZE
    alive = pixel < extent.end_pixel
    frame_count = extent.frame_count
    log_radiance = stack.log_radiance[world]
    stamps = stack.stamps[world]
    slot = extent.first_slot + world
    counters = stack.counters[slot]
    keys = stack.keys[slot]
    levels = levels_from(wp.float64(0.0), thresholds[world][0], thresholds[world][1])
    row = wp.int32(0)
    up = wp.int32(0)
    down = wp.int32(0)
    low = wp.float32(0.0)
    high = wp.float32(0.0)
    sample_before = wp.float32(0.0)
    seen = wp.int32(0)  # the frames that `sample_before` knows of
    frame = wp.int32(0)
    invalid_count = wp.int32(0)
    invalid_first = wp.int32(0)
    if alive:
        crossed = before.crossed[world, pixel]
        up = crossed[0]
        down = crossed[1]
        frame = quiet_count[world, pixel]
        if frame < frame_count:
            levels.base = wp.float64(before.base[world, pixel])
            sample_before = before.last[world, pixel]
            row = pixel // layout.width
            low = reach_down(levels, up, down)
            high = reach_up(levels, up, down)

    begin = wp.int32(0)
    while begin < frame_count:
        end = _end_of_round(begin, frame_count)
        keep_crossing(OPEN, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters)
        if alive:
            frame = _next_active_frame(log_radiance, pixel, wp.max(frame, begin), end, low, high)
            while frame < end:
                if frame > seen:
                    sample_before = log_radiance[frame - 1, pixel]
                sample = log_radiance[frame, pixel]
                if wp.abs(sample) <= LIMIT:
                    up_before = up
                    down_before = down
                    turn = wp.int32(0)
                    while turn <= STEPS_MAX and (sample >= high or sample <= low):
                        if turn == STEPS_MAX and sample >= high:
                            up = rise(sample, levels, up, down)
                        elif turn == STEPS_MAX:
                            down = fall(sample, levels, up, down)
                        elif sample >= high:
                            up += 1
                        else:
                            down += 1
                        low = reach_down(levels, up, down)
                        high = reach_up(levels, up, down)
                        turn += 1
                    found = up - up_before + down - down_before
                    if tabulate:
                        wp.atomic_add(stack.table, world, frame, row, found)
                    elif row < stack.row_limit[world, frame]:
                        kept = keep_crossing(
                            PUT, frame, found, sample_before, up_before, down_before, 0, 0, counters
                        )
                        if kept == wp.int64(0):
                            place = place_of(pixel, row, layout)
                            for event in range(found):
                                key = key_of_level(
                                    event,
                                    levels,
                                    up_before,
                                    down_before,
                                    sample_before,
                                    sample,
                                    stamps[frame],
                                    stamps[frame + 1],
                                    place,
                                    layout.time_shift,
                                )
                                _append(key, keys, counters)
                    sample_before = sample
                else:
                    if invalid_count == 0:
                        invalid_first = frame
                    invalid_count += 1
                seen = frame + 1
                frame = _next_active_frame(log_radiance, pixel, seen, end, low, high)
        kept_count = wp.int32(keep_crossing(CLOSE, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters))
        for kept_index in range(lane, kept_count, BLOCK_SIZE):
            _write_kept(
                kept_index, pixel - lane, begin, world, slot, thresholds[world], layout, before.base, stack
            )
        if alive and seen < end:
            sample_before = log_radiance[end - 1, pixel]
            seen = end
        begin = end

    if alive and not tabulate:
        after.last[world, pixel] = sample_before
        after.crossed[world, pixel] = wp.vec2i(up, down)
        note_invalid(invalid_count, invalid_first, frame_count, pixel, before.base.shape[1], counters)
