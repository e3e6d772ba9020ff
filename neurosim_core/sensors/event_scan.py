# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
"""The scan of an ideal pixel over a stack of frames, which writes the keys of its events.

What a pixel does with its samples is in `scan_pixel`, once; levels, the tie rule and keys are in
`event_levels`. Between stacks a pixel holds its last sample and how many levels it has crossed. The kernels
are in `event_kernels`.

Pixels that are not ideal have a scan of their own, made to measure, in `event_noise_scan`.
"""

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.sensors.event_levels import (
    fall,
    key_of_level,
    place_of,
    reach_down,
    reach_up,
    rise,
)

wp.set_module_options({"enable_backward": False})

BLOCK_SIZE = wp.constant(256)
"""Threads of a block on CUDA."""
SINGLY = wp.constant(wp.int32(4))
"""Levels that are found one by one; few samples cross more, and theirs are found at once."""
LOG_RADIANCE_MAX = 1.0e3
"""Larger magnitudes are refused like non-finite values: exp(1000) is no radiance."""
LIMIT = wp.constant(wp.float32(LOG_RADIANCE_MAX))

OPEN = wp.constant(0)
PUT = wp.constant(1)
CLOSE = wp.constant(2)
READ = wp.constant(3)
START = wp.constant(4)


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


@wp.func_native(read_native(__file__, "next_loud"))
def _next_loud(
    log_radiance: wp.array2d[wp.float32],
    pixel: wp.int32,
    first: wp.int32,
    end: wp.int32,
    low: wp.float32,
    high: wp.float32,
) -> wp.int32:
    """Return the first frame of a round from `first` on whose sample leaves (low, high), or its end."""
    ...


@wp.func_native(read_native(__file__, "call_up"))
def call_up(log_radiance: wp.array2d[wp.float32], pixel: wp.int32, frame_count: wp.int32) -> None:
    """Have the samples of a pixel come near, on CUDA, before they are read one after the other."""
    ...


@wp.func
def _write_kept(
    index: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    width: wp.int32,
    row_shift: wp.int32,
    time_shift: wp.int32,
    first_pixel: wp.int32,
    first_frame: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    stamps: wp.array[wp.int64],
    base: wp.array[wp.float32],
    keys_out: wp.array[wp.int64],
    counters_out: wp.array[wp.int64],
) -> None:
    """Write the keys of what a pixel of the block has crossed in a frame, as far as there is room."""
    word = _read_word(0, index, counters_out)
    pixel = first_pixel + (word & 255)
    frame = first_frame + (word >> 8)
    last = wp.cast(_read_word(1, index, counters_out), wp.float32)
    up = _read_word(2, index, counters_out)
    down = _read_word(3, index, counters_out)
    offset = wp.int64(_read_word(4, index, counters_out)) & wp.int64(0xFFFFFFFF)
    slot = keep_crossing(START, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters_out) + offset
    sample = log_radiance[frame, pixel]
    level_0 = wp.float64(base[pixel])
    place = place_of(pixel, pixel // width, width, row_shift)
    for event in range(_read_word(5, index, counters_out)):
        if slot + wp.int64(event) < wp.int64(keys_out.shape[0]):
            keys_out[wp.int32(slot) + event] = key_of_level(
                event,
                level_0,
                up,
                down,
                threshold_on,
                threshold_off,
                last,
                sample,
                stamps[frame],
                stamps[frame + 1],
                place,
                time_shift,
            )


@wp.func
def scan_pixel(
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    width: wp.int32,
    row_shift: wp.int32,
    time_shift: wp.int32,
    pixel: wp.int32,
    end_pixel: wp.int32,
    lane: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    stamps: wp.array[wp.int64],
    frame_count: wp.int32,
    lead: wp.array[wp.int32],
    row_limit: wp.array[wp.int32],
    base: wp.array[wp.float32],
    last: wp.array[wp.float32],
    crossed: wp.array[wp.vec2i],
    tabulate: wp.bool,
    last_out: wp.array[wp.float32],
    crossed_out: wp.array[wp.vec2i],
    keys_out: wp.array[wp.int64],
    counters_out: wp.array[wp.int64],
    table_out: wp.array2d[wp.int32],
) -> None:
    """Take one pixel from its state before a stack to that after it.

    All threads of a block come here together, also those whose pixel is past the end; `lane` is the number of
    the thread in it. Shapes: frames [frame, pixel], contiguous; stamps [frame + 1], of the state and of each
    frame, from the origin [ns]; `lead`, the frames at the start that are known to be quiet, and the states of
    pixels [pixel]; `row_limit`, the rows whose events are kept [frame]. With `tabulate` events are only
    counted, in a table [frame, row] of zeros. Counters: where the next key goes, which counts events kept
    (written or not); invalid samples; and the flat index of the first of these in the stack, as frame_count *
    pixel_count minus it: zero both before.
    """
    alive = pixel < end_pixel
    base_32 = wp.float32(0.0)
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
        before = crossed[pixel]
        up = before[0]
        down = before[1]
        frame = lead[pixel]
        if frame < frame_count:
            base_32 = base[pixel]
            sample_before = last[pixel]
            row = pixel // width
            low = reach_down(wp.float64(base_32), up, down, threshold_on, threshold_off)
            high = reach_up(wp.float64(base_32), up, down, threshold_on, threshold_off)

    begin = wp.int32(0)
    while begin < frame_count:
        end = _end_of_round(begin, frame_count)
        keep_crossing(OPEN, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters_out)
        if alive:
            frame = _next_loud(log_radiance, pixel, wp.max(frame, begin), end, low, high)
            while frame < end:
                if frame > seen:
                    sample_before = log_radiance[frame - 1, pixel]
                sample = log_radiance[frame, pixel]
                if wp.abs(sample) <= LIMIT:
                    level_0 = wp.float64(base_32)
                    up_before = up
                    down_before = down
                    turn = wp.int32(0)
                    while turn <= SINGLY and (sample >= high or sample <= low):
                        if turn == SINGLY and sample >= high:
                            up = rise(sample, level_0, up, down, threshold_on, threshold_off)
                        elif turn == SINGLY:
                            down = fall(sample, level_0, up, down, threshold_on, threshold_off)
                        elif sample >= high:
                            up += 1
                        else:
                            down += 1
                        low = reach_down(level_0, up, down, threshold_on, threshold_off)
                        high = reach_up(level_0, up, down, threshold_on, threshold_off)
                        turn += 1
                    found = up - up_before + down - down_before
                    if tabulate:
                        wp.atomic_add(table_out, frame, row, found)
                    elif row < row_limit[frame]:
                        kept = keep_crossing(
                            PUT, frame, found, sample_before, up_before, down_before, 0, 0, counters_out
                        )
                        if kept == wp.int64(0):
                            place = place_of(pixel, row, width, row_shift)
                            for event in range(found):
                                key = key_of_level(
                                    event,
                                    level_0,
                                    up_before,
                                    down_before,
                                    threshold_on,
                                    threshold_off,
                                    sample_before,
                                    sample,
                                    stamps[frame],
                                    stamps[frame + 1],
                                    place,
                                    time_shift,
                                )
                                _append(key, keys_out, counters_out)
                    sample_before = sample
                else:
                    if invalid_count == 0:
                        invalid_first = frame
                    invalid_count += 1
                seen = frame + 1
                frame = _next_loud(log_radiance, pixel, seen, end, low, high)
        kept_count = wp.int32(keep_crossing(CLOSE, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters_out))
        for index in range(lane, kept_count, BLOCK_SIZE):
            _write_kept(
                index,
                threshold_on,
                threshold_off,
                width,
                row_shift,
                time_shift,
                pixel - lane,
                begin,
                log_radiance,
                stamps,
                base,
                keys_out,
                counters_out,
            )
        if alive and seen < end:
            sample_before = log_radiance[end - 1, pixel]
            seen = end
        begin = end

    if alive and not tabulate:
        last_out[pixel] = sample_before
        crossed_out[pixel] = wp.vec2i(up, down)
        if invalid_count > 0:
            pixel_count = base.shape[0]
            flat = wp.int64(invalid_first) * wp.int64(pixel_count) + wp.int64(pixel)
            wp.atomic_add(counters_out, 1, wp.int64(invalid_count))
            wp.atomic_max(counters_out, 2, wp.int64(frame_count) * wp.int64(pixel_count) - flat)
