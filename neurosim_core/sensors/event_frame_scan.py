# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
"""The scan of one frame by ideal pixels, on CUDA: where frames come one by one, there is no stack to hide in.

Each thread looks at four pixels. Those of a block that fire, few of them, gather in shared memory, and its
threads take one each; so nobody waits for a neighbour, and the block finds room for all its events at once.
The law of a pixel is that of `event_scan`.
"""

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.sensors.event_kernels import Stack
from neurosim_core.sensors.event_levels import fall, key_of_level, place_of, quiet_range, reach_up, rise
from neurosim_core.sensors.event_scan import BLOCK_SIZE, CLOSE, LIMIT, OPEN, PUT, READ

wp.set_module_options({"enable_backward": False})

PIXELS_PER_THREAD = wp.constant(4)


@wp.func_native(read_native(__file__, "loud_pixels"))
def _loud_pixels(step: wp.int32, value: wp.int32) -> wp.int32:
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
    width: wp.int32,
    row_shift: wp.int32,
    time_shift: wp.int32,
    # In:
    base: wp.array2d[wp.float32],
    last: wp.array2d[wp.float32],
    crossed: wp.array2d[wp.vec2i],
    # In/out:
    stack: Stack,
    # Out:
    last_out: wp.array2d[wp.float32],
    crossed_out: wp.array2d[wp.vec2i],
) -> None:
    """Do what `event_kernels.scan` does with one frame, all rows of which are kept.

    Threads are [world, pixel / 4], whole blocks to a world.
    """
    world, thread = wp.tid()
    lane = thread % BLOCK_SIZE
    first = thread // BLOCK_SIZE * BLOCK_SIZE * PIXELS_PER_THREAD + lane
    pixel_count = base.shape[1]
    threshold_on = thresholds[world][0]
    threshold_off = thresholds[world][1]
    samples = wp.vec4()
    starts = wp.vec4()
    ups = wp.vec4i()
    downs = wp.vec4i()
    for part in range(PIXELS_PER_THREAD):  # all loads are under way together
        pixel = wp.min(first + part * BLOCK_SIZE, pixel_count - 1)
        before = crossed[world, pixel]
        samples[part] = stack.log_radiance[world, 0, pixel]
        starts[part] = base[world, pixel]
        ups[part] = before[0]
        downs[part] = before[1]
    _loud_pixels(OPEN, 0)
    for part in range(PIXELS_PER_THREAD):
        pixel = first + part * BLOCK_SIZE
        if pixel < pixel_count:
            last_out[world, pixel] = samples[part]
            crossed_out[world, pixel] = wp.vec2i(ups[part], downs[part])
            quiet = quiet_range(wp.float64(starts[part]), ups[part], downs[part], threshold_on, threshold_off)
            if not (samples[part] > quiet[0] and samples[part] < quiet[1]):
                _loud_pixels(PUT, pixel)
    loud_count = _loud_pixels(CLOSE, 0)

    begin = wp.int32(0)
    while begin < loud_count:
        index = begin + lane
        found = wp.int32(0)
        pixel = wp.int32(0)
        level_0 = wp.float64(0.0)
        up = wp.int32(0)
        down = wp.int32(0)
        sample = wp.float32(0.0)
        sample_before = wp.float32(0.0)
        if index < loud_count:
            pixel = _loud_pixels(READ, index)
            level_0 = wp.float64(base[world, pixel])
            before = crossed[world, pixel]
            up = before[0]
            down = before[1]
            sample = stack.log_radiance[world, 0, pixel]
            sample_before = last[world, pixel]
            if not wp.abs(sample) <= LIMIT:
                last_out[world, pixel] = sample_before
                wp.atomic_add(stack.counters, world, 1, wp.int64(1))
                wp.atomic_max(stack.counters, world, 2, wp.int64(pixel_count) - wp.int64(pixel))
            elif sample >= reach_up(level_0, up, down, threshold_on, threshold_off):
                risen = rise(sample, level_0, up, down, threshold_on, threshold_off)
                found = risen - up
                crossed_out[world, pixel] = wp.vec2i(risen, down)
            else:
                fallen = fall(sample, level_0, up, down, threshold_on, threshold_off)
                found = fallen - down
                crossed_out[world, pixel] = wp.vec2i(up, fallen)
        slot = _reserve_keys(found, stack.counters[world])
        place = place_of(pixel, pixel // width, width, row_shift)
        for event in range(found):
            if slot + wp.int64(event) < wp.int64(stack.keys.shape[1]):
                stack.keys[world, wp.int32(slot) + event] = key_of_level(
                    event,
                    level_0,
                    up,
                    down,
                    threshold_on,
                    threshold_off,
                    sample_before,
                    sample,
                    stack.stamps[world, 0],
                    stack.stamps[world, 1],
                    place,
                    time_shift,
                )
        begin += BLOCK_SIZE
