# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
"""The scan of one frame by ideal pixels, on CUDA: where frames come one by one, there is no stack to hide in.

Each thread looks at four pixels. Those of a block that fire, few of them, gather in shared memory, and its
threads take one each; so nobody waits for a neighbour, and the block finds room for all its events at once.
The law of a pixel is that of `event_scan`.
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
    reach_up,
    rise,
)
from neurosim_core.sensors.event_scan import (
    BLOCK_SIZE,
    CLOSE,
    LIMIT,
    OPEN,
    PUT,
    READ,
    PixelState,
    Stack,
    note_invalid,
)

wp.set_module_options({"enable_backward": False})

PIXELS_PER_THREAD = wp.constant(4)


@wp.func_native(read_native(__file__, "active_pixels"))
def _active_pixels(step: wp.int32, value: wp.int32) -> wp.int32:
    """Gather pixels of a block: all threads OPEN, some PUT one, all CLOSE, which counts; READ returns one."""
    ...


@wp.func_native(read_native(__file__, "reserve_keys"))
def _reserve_keys(count: wp.int32, counters: wp.array[wp.int64]) -> wp.int64:
    """Count events, and return where those of this thread go; all threads of a block come here together."""
    ...


@wp.kernel(launch_bounds=(BLOCK_SIZE, 4))
def scan_frame(
    # Model:
    thresholds: wp.array[wp.vec2d],
    layout: KeyLayout,
    # In:
    before: PixelState,
    # In/out:
    stack: Stack,
    # Out:
    after: PixelState,
) -> None:
    """Do what `event_scan.scan` does with one frame, all rows of which are kept.

    Threads are [world, pixel / 4], whole blocks to a world.
    """
    world, thread = wp.tid()
    lane = thread % BLOCK_SIZE
    first = thread // BLOCK_SIZE * BLOCK_SIZE * PIXELS_PER_THREAD + lane
    pixel_count = before.base.shape[1]
    levels = levels_from(wp.float64(0.0), thresholds[world][0], thresholds[world][1])
    samples = wp.vec4()
    starts = wp.vec4()
    ups = wp.vec4i()
    downs = wp.vec4i()
    for part in range(PIXELS_PER_THREAD):  # all loads are under way together
        pixel = wp.min(first + part * BLOCK_SIZE, pixel_count - 1)
        crossed = before.crossed[world, pixel]
        samples[part] = stack.log_radiance[world, 0, pixel]
        starts[part] = before.base[world, pixel]
        ups[part] = crossed[0]
        downs[part] = crossed[1]
    _active_pixels(OPEN, 0)
    for part in range(PIXELS_PER_THREAD):
        pixel = first + part * BLOCK_SIZE
        if pixel < pixel_count:
            after.last[world, pixel] = samples[part]
            after.crossed[world, pixel] = wp.vec2i(ups[part], downs[part])
            levels.base = wp.float64(starts[part])
            quiet = quiet_range(levels, ups[part], downs[part])
            if not (samples[part] > quiet[0] and samples[part] < quiet[1]):
                _active_pixels(PUT, pixel)
    active_count = _active_pixels(CLOSE, 0)

    begin = wp.int32(0)
    while begin < active_count:
        index = begin + lane
        found = wp.int32(0)
        pixel = wp.int32(0)
        levels.base = wp.float64(0.0)
        up = wp.int32(0)
        down = wp.int32(0)
        sample = wp.float32(0.0)
        sample_before = wp.float32(0.0)
        if index < active_count:
            pixel = _active_pixels(READ, index)
            levels.base = wp.float64(before.base[world, pixel])
            crossed = before.crossed[world, pixel]
            up = crossed[0]
            down = crossed[1]
            sample = stack.log_radiance[world, 0, pixel]
            sample_before = before.last[world, pixel]
            if not wp.abs(sample) <= LIMIT:
                after.last[world, pixel] = sample_before
                note_invalid(1, 0, 1, pixel, pixel_count, stack.counters[world])
            elif sample >= reach_up(levels, up, down):
                risen = rise(sample, levels, up, down)
                found = risen - up
                after.crossed[world, pixel] = wp.vec2i(risen, down)
            else:
                fallen = fall(sample, levels, up, down)
                found = fallen - down
                after.crossed[world, pixel] = wp.vec2i(up, fallen)
        slot = _reserve_keys(found, stack.counters[world])
        place = place_of(pixel, pixel // layout.width, layout)
        start_ns = stack.stamps[world, 0]
        end_ns = stack.stamps[world, 1]
        for event in range(found):
            if slot + wp.int64(event) < wp.int64(stack.keys.shape[1]):
                stack.keys[world, wp.int32(slot) + event] = key_of_level(
                    event, levels, up, down, sample_before, sample, start_ns, end_ns, place, layout.time_shift
                )
        begin += BLOCK_SIZE
