# mypy: disable-error-code="index,arg-type,operator,call-overload,assignment,no-untyped-def,return-value"
# mypy: disable-error-code="attr-defined,misc"
"""The scan of an event pixel with noise; a kernel has only the terms that the settings switch on.

The signal of a pixel, its log radiance through the photoreceptor plus what its reference has leaked, is known
in closed form between frames. Events are taken one after the other, at the time at which the signal reaches a
level, or at which noise fires; so refractory time and noise act at their own times, wherever frames lie.

What each term does is described in `event_noise_model`.
"""

import functools
from typing import Any

import warp as wp

from neurosim_core.sensors.event_levels import SUB_BITS, KeyLayout, key_after, level_at, place_of
from neurosim_core.sensors.event_noise_model import CAUSE, CAUSES, PixelModel
from neurosim_core.sensors.event_noise_pixel import (
    NEVER,
    Crossing,
    Interval,
    NoisyPixel,
    Signal,
    curve_at,
    curve_crossing,
    draw_noise,
    first_passage,
    jittered,
    levels_of,
    light_of,
    line_at,
    line_crossing,
    make_see,
    mean_light,
    measured_polarity,
    noise_polarity,
    range_of,
    reached,
    signal_terms,
    wait_ns,
)
from neurosim_core.sensors.event_scan import (
    ALL,
    CLOSE,
    COUNT,
    LIMIT,
    OPEN,
    PUT,
    Extent,
    PixelState,
    Stack,
    note_invalid,
    prefetch_samples,
    write_key,
)

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_SIGNAL, _LEAK, _SHOT, _HOT, _NOISE = (wp.constant(wp.int64(number)) for number in range(len(CAUSES)))
_PIECE = wp.constant(wp.float64(0.125))
"""Change of log radiance over which tau is held constant."""
_PIECE_COUNT_MAX = wp.constant(1024)
_DARKEST = wp.constant(wp.float64(1e-9))
"""Least share of the photoreceptor's bandwidth, so that it has a time constant without light."""
_FULL_SCALE = wp.constant(wp.float64(255.0))
_FAINTEST = wp.constant(wp.float64(1e-12))
_BRIGHTEST = wp.constant(wp.float64(255e3))
"""Most light that a voltage is driven by, 1000 times white."""
_DRAW_BITS = wp.constant(wp.int64(12))
_CAUSE_SHIFT = wp.constant(wp.int64(SUB_BITS))


@wp.func
def _digital(model: PixelModel, sample: wp.float32) -> wp.float64:
    """Return light in units of white / 255."""
    light = _FULL_SCALE / model.white_radiance * wp.exp(wp.float64(sample))
    return wp.clamp(light, _FAINTEST, _BRIGHTEST)


@functools.cache
def make_noisy_scan(terms: frozenset[str]) -> Any:
    """Return the kernel that does what `event_scan.scan` does, for pixels with the given terms.

    In place of thresholds it takes a `PixelModel` of each world; `EventCameraConfig.terms` has them.
    """
    signals = signal_terms(terms)
    see, changed = make_see(signals), len(signals) > 0
    cause = CAUSE in terms
    resets = not terms.isdisjoint({"refractory", "spontaneous", "jitter"})
    value_at = curve_at if "low_pass" in terms else line_at
    find_crossing = curve_crossing if "low_pass" in terms else line_crossing

    @wp.func
    def next_noise(model: PixelModel, pixel: wp.int32, state: NoisyPixel) -> NoisyPixel:
        state.noise_count += 1
        wait = wait_ns(state.shot_rate + state.hot_rate, draw_noise(model, pixel, state)[0])
        state.next_ns = wp.min(state.next_ns + wait, NEVER)
        return state

    @wp.func
    def release(signal: Signal, time_ns: wp.float64, state: NoisyPixel) -> NoisyPixel:
        """Let the reference be the signal at a time."""
        if wp.static("stochastic" in terms):
            state.voltage = _ZERO
        else:
            state.reference = value_at(signal, time_ns)
            state.up = state.fold
            state.down = 0
        state.held_ns = -_ONE
        return state

    @wp.func
    def react(
        model: PixelModel,
        layout: KeyLayout,
        world: wp.int32,
        slot: wp.int32,
        pixel: wp.int32,
        interval: Interval,
        signal: Signal,
        tabulate: wp.bool,
        state: NoisyPixel,
        quiet: wp.vec2,
        stack: Stack,
    ) -> NoisyPixel:
        """Take a pixel over one piece of the signal, event by event."""
        now = signal.begin
        draw = wp.int64(0)
        while now < signal.end:
            if wp.static("refractory" in terms):
                if state.held_ns > signal.end:
                    break
                if state.held_ns >= _ZERO:
                    now = wp.max(now, state.held_ns)
                    state = release(signal, now, state)
                    quiet = range_of(state)
            end = signal.end
            noisy = wp.bool(False)
            if wp.static("spontaneous" in terms):
                while wp.float64(state.next_ns - interval.since_ns) <= now:  # in reset
                    state = next_noise(model, pixel, state)
                noise_ns = wp.float64(state.next_ns - interval.since_ns)
                if noise_ns <= end:
                    end = noise_ns
                    noisy = wp.bool(True)

            crossing = Crossing()
            if wp.static("stochastic" in terms):
                ratio = wp.min(state.on, state.off) / wp.max(interval.deviation, wp.float64(1e-30))
                longest_ns = ratio * ratio / wp.float64(16.0)
                if end - now > longest_ns:
                    end = wp.min(now + wp.max(longest_ns, _ONE), end)
                    noisy = wp.bool(False)
                step = (interval.since_ns << _DRAW_BITS) + draw
                draw += wp.int64(1)
                crossing = first_passage(model, step, pixel, state, interval, now, end)
                state.voltage = crossing.voltage
            else:
                levels = levels_of(state)
                lower = level_at(levels, state.up - state.fold, state.down + 1)
                upper = level_at(levels, state.up - state.fold + 1, state.down)
                crossing = find_crossing(signal, now, end, quiet, lower, upper)

            polarity = crossing.polarity
            origin = _SIGNAL + wp.int64(0)
            reset = wp.bool(False)
            if polarity >= 0:
                now = crossing.time_ns
            else:
                now = end
                if wp.static("spontaneous" in terms):  # noqa: SIM102, one of them is for the compiler
                    if noisy:
                        light = interval.light + interval.light_slope * now
                        uniform = draw_noise(model, pixel, state)[1]
                        if wp.static("measured" in terms):
                            polarity = measured_polarity(model, pixel, state, light, uniform)
                        else:
                            polarity = noise_polarity(model, state, light, uniform)
                        if wp.static(cause):
                            is_hot = uniform * (state.shot_rate + state.hot_rate) < state.hot_rate
                            origin = wp.where(is_hot, _HOT, _SHOT)
                        state = next_noise(model, pixel, state)
                        reset = wp.bool(True)
            if polarity >= 0:
                row = pixel // layout.width
                if tabulate:
                    wp.atomic_add(stack.table, world, interval.frame, row, 1)
                elif row < stack.row_limit[world, interval.frame]:
                    place = place_of(pixel, row, layout)
                    if wp.static(cause):
                        if origin == _SIGNAL:
                            upwards = wp.float64(2 * polarity - 1)
                            if wp.static("leak" in terms):  # noqa: SIM102
                                if polarity == 1 and interval.leak_slope > interval.light_slope:
                                    origin = _LEAK
                            if wp.static("stochastic" in terms):  # noqa: SIM102
                                if interval.deviation * interval.deviation > upwards * interval.drift:
                                    origin = _NOISE
                        place |= origin << _CAUSE_SHIFT
                    key = key_after(now, interval.start_ns, place, layout.time_shift, polarity)
                    write_key(PUT, key, stack.keys[slot], stack.counters[slot])
                if not reset:
                    state.up += polarity
                    state.down += 1 - polarity
                if wp.static("jitter" in terms):
                    if not reset:
                        state.reference = level_at(levels_of(state), state.up - state.fold, state.down)
                        state.up = state.fold
                        state.down = 0
                    state.event_count += 1
                    state = jittered(model, pixel, state)
                if wp.static("refractory" in terms):  # noqa: SIM102
                    if model.refractory_ns > _ZERO:
                        state.held_ns = now + model.refractory_ns
                        reset = wp.bool(False)
                if reset:
                    state = release(signal, now, state)
                quiet = range_of(state)
        return state

    @wp.func
    def scan_pixel(
        model: PixelModel,
        layout: KeyLayout,
        world: wp.int32,
        slot: wp.int32,
        pixel: wp.int32,
        frame_count: wp.int32,
        tabulate: wp.bool,
        before: PixelState,
        stack: Stack,
        after: PixelState,
    ):
        """Take one pixel from its state before a stack to that after it."""
        log_radiance = stack.log_radiance[world]
        stamps = stack.stamps[world]
        since_reset_ns = stack.since_reset_ns[world]
        prefetch_samples(log_radiance, pixel, frame_count)
        base = before.base[world, pixel]
        state = NoisyPixel()
        state.on = model.threshold_on
        state.off = model.threshold_off
        if wp.static("spread" in terms):
            state.on = model.thresholds[pixel][0]
            state.off = model.thresholds[pixel][1]
        state.steady = wp.vec2d(state.on, state.off)
        if wp.static("stochastic" in terms):
            state.on = state.on / model.threshold_on
            state.off = state.off / model.threshold_off
            state.voltage = before.voltage[world, pixel]
        state.reference = wp.float64(base)
        if wp.static(changed):
            state.reference = see(model, pixel, wp.int64(0), base)
        if wp.static(resets):
            state.reference = before.reference[world, pixel]
        crossed = before.crossed[world, pixel]
        state.up = crossed[0]
        state.down = crossed[1]
        if wp.static("jitter" in terms):
            state.fold = state.up  # levels count from the last one crossed
            state.event_count = before.event_count[world, pixel]
            state = jittered(model, pixel, state)
        state.held_ns = -_ONE
        if wp.static("refractory" in terms):
            state.held_ns = before.held_ns[world, pixel]
        if wp.static("spontaneous" in terms):
            state.next_ns = before.next_ns[world, pixel]
            state.noise_count = before.noise_count[world, pixel]
            state.shot_rate = model.rates[pixel][0]
            state.hot_rate = model.rates[pixel][1]
        filtered = _ZERO
        if wp.static("low_pass" in terms):
            filtered = before.filtered[world, pixel]
        exposure_ns = _ZERO
        if wp.static("light_leak" in terms):
            exposure_ns = before.exposure_ns[world, pixel]
        sample_before = before.last[world, pixel]
        seen_last = wp.float64(sample_before)
        if wp.static(changed):
            seen_last = see(model, pixel, stamps[0] + since_reset_ns, sample_before)
        end_light = _ZERO
        if wp.static("light_leak" in terms):
            end_light = light_of(model, sample_before)
        dn_end = _ZERO
        if wp.static("stochastic" in terms):
            dn_end = _digital(model, sample_before)
        invalid_count = wp.int32(0)
        invalid_first = wp.int32(0)
        quiet = range_of(state)

        for frame in range(frame_count):
            sample = log_radiance[frame, pixel]
            if wp.abs(sample) <= LIMIT:
                interval = Interval()
                interval.frame = frame
                interval.start_ns = stamps[frame]
                interval.since_ns = stamps[frame] + since_reset_ns
                since_ns = interval.since_ns
                span_ns = wp.float64(stamps[frame + 1] - stamps[frame])
                light = wp.float64(sample_before)
                light_slope = (wp.float64(sample) - light) / span_ns
                interval.light = light
                interval.light_slope = light_slope
                seen = seen_last  # as light, where the pixel sees its logarithm
                seen_last = wp.float64(sample)
                if wp.static(changed):
                    seen_last = see(model, pixel, stamps[frame + 1] + since_reset_ns, sample)
                seen_slope = (seen_last - seen) / span_ns
                leaked = _ZERO
                leak_slope = _ZERO
                if wp.static("leak" in terms):
                    cycles = model.leak[pixel][1] + model.leak[pixel][0] * wp.float64(since_ns)
                    leak_slope = model.leak[pixel][0] * state.steady[0]
                    if wp.static("light_leak" in terms):
                        cycles += model.leak[pixel][0] * model.leak_growth * exposure_ns
                        begin_light = end_light
                        end_light = light_of(model, sample)
                        brightness = mean_light(model, sample_before, sample, begin_light, end_light)
                        leak_slope *= _ONE + model.leak_growth * brightness
                        exposure_ns += brightness * span_ns
                    interval.leak_slope = leak_slope
                    whole = wp.floor(cycles)
                    leaked = (cycles - whole) * state.steady[0]
                    if wp.int32(whole) != state.fold:
                        if wp.static("jitter" in terms):  # a cycle is worth a threshold without jitter
                            state.reference -= wp.float64(wp.int32(whole) - state.fold) * state.steady[0]
                            state.up = state.up - state.fold + wp.int32(whole)
                        state.fold = wp.int32(whole)
                        quiet = range_of(state)
                if wp.static("stochastic" in terms):
                    dn_begin = dn_end
                    dn_end = _digital(model, sample)
                    dn = (dn_begin + dn_end) / _TWO
                    drift = model.k1 * wp.log((dn_end + model.k2) / (dn_begin + model.k2)) / span_ns
                    drift += model.k4 + model.k5 * dn
                    interval.drift = drift
                    interval.deviation = model.k3 * wp.sqrt(dn) / (dn + model.k2) + model.k6

                pieces = wp.int32(1)
                if wp.static("low_pass" in terms):
                    rise = wp.max(wp.abs(wp.float64(sample) - light), wp.abs(seen_last - seen))
                    pieces = wp.min(1 + wp.int32(rise / _PIECE), _PIECE_COUNT_MAX)
                for piece in range(pieces):
                    signal = Signal()
                    signal.begin = span_ns * (wp.float64(piece) / wp.float64(pieces))
                    signal.end = span_ns * (wp.float64(piece + 1) / wp.float64(pieces))
                    busy = wp.bool(True)
                    if wp.static("low_pass" in terms):
                        length_ns = signal.end - signal.begin
                        seen_begin = seen + seen_slope * signal.begin
                        middle = light + light_slope * signal.begin + light_slope * length_ns / _TWO
                        share = (wp.exp(middle) + model.dark_radiance) / (
                            model.white_radiance + model.dark_radiance
                        )
                        signal.tau = _ONE / (model.corner_per_ns * wp.clamp(share, _DARKEST, _ONE))
                        decay = filtered - seen_begin + seen_slope * signal.tau
                        gain = wp.exp(-length_ns / signal.tau) - _ONE
                        signal.start = filtered + leaked + leak_slope * signal.begin
                        signal.slope = seen_slope + leak_slope
                        signal.decay = decay
                        filtered += seen_slope * length_ns + decay * gain
                        signal.last = filtered + leaked + leak_slope * signal.end
                        steepness = signal.slope - decay / signal.tau
                        turns = steepness * (steepness - decay / signal.tau * gain) < _ZERO
                        busy = turns or reached(signal.last, quiet) >= 0
                        if wp.static("refractory" in terms):
                            busy = busy or state.held_ns >= _ZERO
                        if wp.static("spontaneous" in terms):
                            busy = busy or wp.float64(state.next_ns - since_ns) <= signal.end
                    elif wp.static("stochastic" not in terms):
                        signal.start = seen + leaked
                        signal.last = seen_last + leaked + leak_slope * span_ns
                        busy = reached(signal.last, quiet) >= 0
                        if wp.static("refractory" in terms):
                            busy = busy or state.held_ns >= _ZERO
                        if wp.static("spontaneous" in terms):
                            busy = busy or wp.float64(state.next_ns - since_ns) <= span_ns
                    if busy:
                        state = react(
                            model, layout, world, slot, pixel, interval, signal, tabulate, state, quiet, stack
                        )
                        quiet = range_of(state)
                if wp.static("refractory" in terms):  # noqa: SIM102
                    if state.held_ns >= _ZERO:
                        state.held_ns = wp.max(state.held_ns - span_ns, _ZERO)
                sample_before = sample
            else:
                if invalid_count == 0:
                    invalid_first = frame
                invalid_count += 1

        if not tabulate:
            after.last[world, pixel] = sample_before
            after.crossed[world, pixel] = wp.vec2i(state.up, state.down)
            if wp.static(resets):
                after.reference[world, pixel] = state.reference
            if wp.static("jitter" in terms):
                after.event_count[world, pixel] = state.event_count
            if wp.static("low_pass" in terms):
                after.filtered[world, pixel] = filtered
            if wp.static("light_leak" in terms):
                after.exposure_ns[world, pixel] = exposure_ns
            if wp.static("refractory" in terms):
                after.held_ns[world, pixel] = state.held_ns
            if wp.static("spontaneous" in terms):
                after.next_ns[world, pixel] = state.next_ns
                after.noise_count[world, pixel] = state.noise_count
            if wp.static("stochastic" in terms):
                after.voltage[world, pixel] = state.voltage
            pixel_count = before.base.shape[1]
            note_invalid(invalid_count, invalid_first, frame_count, pixel, pixel_count, stack.counters[slot])

    @wp.kernel(
        module=wp.get_module(f"{__name__}.{'_'.join(sorted(terms)) or 'ideal'}"), enable_backward=False
    )
    def scan(
        # Model:
        models: wp.array[PixelModel],
        layout: KeyLayout,
        # In:
        extent: Extent,
        before: PixelState,
        # In/out:
        stack: Stack,
        # Out:
        after: PixelState,
    ):
        index, thread = wp.tid()
        world = extent.first_world + index
        pixel = extent.first_pixel + thread
        if extent.part != ALL and stack.overflow[world] == 0:
            return
        slot = extent.first_slot + world
        keys = stack.keys[slot]
        counters = stack.counters[slot]
        write_key(OPEN, wp.int64(0), keys, counters)
        if pixel < extent.end_pixel:
            tabulate = extent.part == COUNT
            scan_pixel(
                models[world], layout, world, slot, pixel, extent.frame_count, tabulate, before, stack, after
            )
        write_key(CLOSE, wp.int64(0), keys, counters)

    return scan
