# mypy: disable-error-code="index,arg-type,operator,call-overload,assignment,no-untyped-def,return-value"
"""The scan of an event pixel that is not ideal, made to measure: only the terms that are asked for.

The signal of a pixel, its log radiance through the photoreceptor plus what its reference has leaked, is known
in closed form between frames. Events are taken one after the other, at the time at which the signal reaches a
level, or at which noise fires; so refractory time and noise act at their own times, wherever frames lie.

What each term does is described in `event_noise_model`.
"""

import functools
from typing import Any

import warp as wp

from neurosim_core.sensors.event_levels import COLUMN_SHIFT, key_after, level_at, quiet_range
from neurosim_core.sensors.event_noise_model import CAUSE, CAUSE_BITS, CAUSES, Memory, PixelModel
from neurosim_core.sensors.event_noise_pixel import (
    NEVER,
    NoisyPixel,
    draw_noise,
    jittered,
    light_of,
    make_see,
    mean_light,
    measured_polarity,
    noise_polarity,
    signal_terms,
    wait_ns,
)
from neurosim_core.sensors.event_scan import LIMIT, PUT, call_up, write_key
from neurosim_core.sensors.event_signal import (
    Crossing,
    Signal,
    curve_at,
    curve_crossing,
    first_passage,
    line_at,
    line_crossing,
    reached,
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


@wp.func
def _digital(model: PixelModel, sample: wp.float32) -> wp.float64:
    """Return light in units of white / 255."""
    light = _FULL_SCALE / model.white_radiance * wp.exp(wp.float64(sample))
    return wp.clamp(light, _FAINTEST, _BRIGHTEST)


@functools.cache
def make_pixel_scan(terms: frozenset[str]) -> Any:
    """Return the function that takes a pixel with only the given terms over a stack of frames.

    Its parameters are those of the kernel of `event_kernels.make_noisy_scan`, of one world and one pixel.
    """
    signals = signal_terms(terms)
    see, changed = make_see(signals), len(signals) > 0
    spread = "spread" in terms
    jitter = "jitter" in terms
    low_pass = "low_pass" in terms
    refractory = "refractory" in terms
    leak = "leak" in terms
    light_leak = "light_leak" in terms
    measured = "measured" in terms
    spontaneous = "spontaneous" in terms
    stochastic = "stochastic" in terms
    cause = CAUSE in terms
    resets = refractory or spontaneous or jitter
    value_at = curve_at if low_pass else line_at
    find_crossing = curve_crossing if low_pass else line_crossing

    @wp.func
    def range_of(state: NoisyPixel) -> wp.vec2:
        return quiet_range(state.reference, state.up - state.fold, state.down, state.on, state.off)

    @wp.func
    def next_noise(model: PixelModel, pixel: wp.int32, state: NoisyPixel) -> NoisyPixel:
        state.noise_count += 1
        wait = wait_ns(state.shot_rate + state.hot_rate, draw_noise(model, pixel, state)[0])
        state.next_ns = wp.min(state.next_ns + wait, NEVER)
        return state

    @wp.func
    def release(signal: Signal, time_ns: wp.float64, state: NoisyPixel) -> NoisyPixel:
        """Let the reference be the signal at a time."""
        if wp.static(stochastic):
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
        pixel: wp.int32,
        row: wp.int32,
        place: wp.int64,
        time_shift: wp.int32,
        signal: Signal,
        drift: wp.float64,
        deviation: wp.float64,
        first_light: wp.float64,
        light_slope: wp.float64,
        leak_slope: wp.float64,
        start_ns: wp.int64,
        since_ns: wp.int64,
        frame: wp.int32,
        row_limit: wp.int32,
        tabulate: wp.bool,
        state: NoisyPixel,
        quiet: wp.vec2,
        table: wp.array2d[wp.int32],
        keys: wp.array[wp.int64],
        counters: wp.array[wp.int64],
    ) -> NoisyPixel:
        """Take a pixel over one piece of the signal, event by event."""
        now = signal.begin
        draw = wp.int64(0)
        while now < signal.end:
            if wp.static(refractory):
                if state.held_ns > signal.end:
                    break
                if state.held_ns >= _ZERO:
                    now = wp.max(now, state.held_ns)
                    state = release(signal, now, state)
                    quiet = range_of(state)
            end = signal.end
            noisy = wp.bool(False)
            if wp.static(spontaneous):
                while wp.float64(state.next_ns - since_ns) <= now:  # in reset
                    state = next_noise(model, pixel, state)
                noise_ns = wp.float64(state.next_ns - since_ns)
                if noise_ns <= end:
                    end = noise_ns
                    noisy = wp.bool(True)

            crossing = Crossing()
            if wp.static(stochastic):
                ratio = wp.min(state.on, state.off) / wp.max(deviation, wp.float64(1e-30))
                longest_ns = ratio * ratio / wp.float64(16.0)
                if end - now > longest_ns:
                    end = wp.min(now + wp.max(longest_ns, _ONE), end)
                    noisy = wp.bool(False)
                step = (since_ns << _DRAW_BITS) + draw
                draw += wp.int64(1)
                crossing = first_passage(
                    model.seed,
                    model.step_stream,
                    model.touch_stream,
                    step,
                    pixel,
                    state.voltage,
                    state.on,
                    state.off,
                    drift,
                    deviation,
                    now,
                    end,
                )
                state.voltage = crossing.voltage
            else:
                lower = level_at(state.reference, state.up - state.fold, state.down + 1, state.on, state.off)
                upper = level_at(state.reference, state.up - state.fold + 1, state.down, state.on, state.off)
                crossing = find_crossing(signal, now, end, quiet, lower, upper)

            polarity = crossing.polarity
            origin = _SIGNAL + wp.int64(0)
            reset = wp.bool(False)
            if polarity >= 0:
                now = crossing.time_ns
            else:
                now = end
                if wp.static(spontaneous):  # noqa: SIM102, one of them is for the compiler
                    if noisy:
                        light = first_light + light_slope * now
                        uniform = draw_noise(model, pixel, state)[1]
                        if wp.static(measured):
                            polarity = measured_polarity(model, pixel, state, light, uniform)
                        else:
                            polarity = noise_polarity(model, state, light, uniform)
                        if wp.static(cause):
                            is_hot = uniform * (state.shot_rate + state.hot_rate) < state.hot_rate
                            origin = wp.where(is_hot, _HOT, _SHOT)
                        state = next_noise(model, pixel, state)
                        reset = wp.bool(True)
            if polarity >= 0:
                if tabulate:
                    wp.atomic_add(table, frame, row, 1)
                elif row < row_limit:
                    where = place
                    if wp.static(cause):
                        if origin == _SIGNAL:
                            upwards = wp.float64(2 * polarity - 1)
                            if wp.static(leak):  # noqa: SIM102
                                if polarity == 1 and leak_slope > light_slope:
                                    origin = _LEAK
                            if wp.static(stochastic):  # noqa: SIM102
                                if deviation * deviation > upwards * drift:
                                    origin = _NOISE
                        where = place | (origin << COLUMN_SHIFT)
                    key = key_after(now, start_ns, where, time_shift, polarity)
                    write_key(PUT, key, keys, counters)
                if not reset:
                    state.up += polarity
                    state.down += 1 - polarity
                if wp.static(jitter):
                    if not reset:
                        state.reference = level_at(
                            state.reference, state.up - state.fold, state.down, state.on, state.off
                        )
                        state.up = state.fold
                        state.down = 0
                    state.event_count += 1
                    state = jittered(model, pixel, state)
                if wp.static(refractory):  # noqa: SIM102
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
        width: wp.int32,
        row_shift: wp.int32,
        time_shift: wp.int32,
        pixel: wp.int32,
        log_radiance: wp.array2d[wp.float32],
        stamps: wp.array[wp.int64],
        since_reset_ns: wp.int64,
        frame_count: wp.int32,
        row_limit: wp.array[wp.int32],
        base: wp.array[wp.float32],
        last: wp.array[wp.float32],
        crossed: wp.array[wp.vec2i],
        before: Memory,
        tabulate: wp.bool,
        last_out: wp.array[wp.float32],
        crossed_out: wp.array[wp.vec2i],
        after: Memory,
        keys_out: wp.array[wp.int64],
        counters_out: wp.array[wp.int64],
        table_out: wp.array2d[wp.int32],
    ):
        """Take one pixel from its state before a stack to that after it."""
        call_up(log_radiance, pixel, frame_count)
        row = pixel // width
        column = wp.int64(pixel - row * width)
        if wp.static(cause):
            column = column << wp.int64(CAUSE_BITS)
        place = (wp.int64(row) << wp.int64(row_shift)) | (column << COLUMN_SHIFT)
        state = NoisyPixel()
        state.on = model.threshold_on
        state.off = model.threshold_off
        if wp.static(spread):
            state.on = model.thresholds[pixel][0]
            state.off = model.thresholds[pixel][1]
        state.steady = wp.vec2d(state.on, state.off)
        if wp.static(stochastic):
            state.on = state.on / model.threshold_on
            state.off = state.off / model.threshold_off
            state.voltage = before.voltage[pixel]
        state.reference = wp.float64(base[pixel])
        if wp.static(changed):
            state.reference = see(model, pixel, wp.int64(0), base[pixel])
        if wp.static(resets):
            state.reference = before.reference[pixel]
        state.up = crossed[pixel][0]
        state.down = crossed[pixel][1]
        if wp.static(jitter):
            state.fold = state.up  # levels count from the last one crossed
            state.event_count = before.event_count[pixel]
            state = jittered(model, pixel, state)
        state.held_ns = -_ONE
        if wp.static(refractory):
            state.held_ns = before.held_ns[pixel]
        if wp.static(spontaneous):
            state.next_ns = before.next_ns[pixel]
            state.noise_count = before.noise_count[pixel]
            state.shot_rate = model.rates[pixel][0]
            state.hot_rate = model.rates[pixel][1]
        filtered = _ZERO
        if wp.static(low_pass):
            filtered = before.filtered[pixel]
        exposure_ns = _ZERO
        if wp.static(light_leak):
            exposure_ns = before.exposure_ns[pixel]
        sample_before = last[pixel]
        seen_last = wp.float64(sample_before)
        if wp.static(changed):
            seen_last = see(model, pixel, stamps[0] + since_reset_ns, sample_before)
        end_light = _ZERO
        if wp.static(light_leak):
            end_light = light_of(model, sample_before)
        dn_end = _ZERO
        if wp.static(stochastic):
            dn_end = _digital(model, sample_before)
        invalid_count = wp.int32(0)
        invalid_first = wp.int32(0)
        quiet = range_of(state)

        for frame in range(frame_count):
            sample = log_radiance[frame, pixel]
            if wp.abs(sample) <= LIMIT:
                start_ns = stamps[frame]
                since_ns = start_ns + since_reset_ns
                span_ns = wp.float64(stamps[frame + 1] - start_ns)
                light = wp.float64(sample_before)
                light_slope = (wp.float64(sample) - light) / span_ns
                seen = seen_last  # as light, where the pixel sees its logarithm
                seen_last = wp.float64(sample)
                if wp.static(changed):
                    seen_last = see(model, pixel, stamps[frame + 1] + since_reset_ns, sample)
                seen_slope = (seen_last - seen) / span_ns
                leaked = _ZERO
                leak_slope = _ZERO
                if wp.static(leak):
                    cycles = model.leak[pixel][1] + model.leak[pixel][0] * wp.float64(since_ns)
                    leak_slope = model.leak[pixel][0] * state.steady[0]
                    if wp.static(light_leak):
                        cycles += model.leak[pixel][0] * model.leak_growth * exposure_ns
                        begin_light = end_light
                        end_light = light_of(model, sample)
                        brightness = mean_light(model, sample_before, sample, begin_light, end_light)
                        leak_slope *= _ONE + model.leak_growth * brightness
                        exposure_ns += brightness * span_ns
                    whole = wp.floor(cycles)
                    leaked = (cycles - whole) * state.steady[0]
                    if wp.int32(whole) != state.fold:
                        if wp.static(jitter):  # a cycle is worth a threshold without jitter
                            state.reference -= wp.float64(wp.int32(whole) - state.fold) * state.steady[0]
                            state.up = state.up - state.fold + wp.int32(whole)
                        state.fold = wp.int32(whole)
                        quiet = range_of(state)
                drift = _ZERO
                deviation = _ZERO
                if wp.static(stochastic):
                    dn_begin = dn_end
                    dn_end = _digital(model, sample)
                    dn = (dn_begin + dn_end) / _TWO
                    drift = model.k1 * wp.log((dn_end + model.k2) / (dn_begin + model.k2)) / span_ns
                    drift += model.k4 + model.k5 * dn
                    deviation = model.k3 * wp.sqrt(dn) / (dn + model.k2) + model.k6

                pieces = wp.int32(1)
                if wp.static(low_pass):
                    rise = wp.max(wp.abs(wp.float64(sample) - light), wp.abs(seen_last - seen))
                    pieces = wp.min(1 + wp.int32(rise / _PIECE), _PIECE_COUNT_MAX)
                for piece in range(pieces):
                    signal = Signal()
                    signal.begin = span_ns * (wp.float64(piece) / wp.float64(pieces))
                    signal.end = span_ns * (wp.float64(piece + 1) / wp.float64(pieces))
                    busy = wp.bool(True)
                    if wp.static(low_pass):
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
                        if wp.static(refractory):
                            busy = busy or state.held_ns >= _ZERO
                        if wp.static(spontaneous):
                            busy = busy or wp.float64(state.next_ns - since_ns) <= signal.end
                    elif wp.static(not stochastic):
                        signal.start = seen + leaked
                        signal.last = seen_last + leaked + leak_slope * span_ns
                        busy = reached(signal.last, quiet) >= 0
                        if wp.static(refractory):
                            busy = busy or state.held_ns >= _ZERO
                        if wp.static(spontaneous):
                            busy = busy or wp.float64(state.next_ns - since_ns) <= span_ns
                    if busy:
                        state = react(
                            model,
                            pixel,
                            row,
                            place,
                            time_shift,
                            signal,
                            drift,
                            deviation,
                            light,
                            light_slope,
                            leak_slope,
                            start_ns,
                            since_ns,
                            frame,
                            row_limit[frame],
                            tabulate,
                            state,
                            quiet,
                            table_out,
                            keys_out,
                            counters_out,
                        )
                        quiet = range_of(state)
                if wp.static(refractory):  # noqa: SIM102
                    if state.held_ns >= _ZERO:
                        state.held_ns = wp.max(state.held_ns - span_ns, _ZERO)
                sample_before = sample
            else:
                if invalid_count == 0:
                    invalid_first = frame
                invalid_count += 1

        if not tabulate:
            last_out[pixel] = sample_before
            crossed_out[pixel] = wp.vec2i(state.up, state.down)
            if wp.static(resets):
                after.reference[pixel] = state.reference
            if wp.static(jitter):
                after.event_count[pixel] = state.event_count
            if wp.static(low_pass):
                after.filtered[pixel] = filtered
            if wp.static(light_leak):
                after.exposure_ns[pixel] = exposure_ns
            if wp.static(refractory):
                after.held_ns[pixel] = state.held_ns
            if wp.static(spontaneous):
                after.next_ns[pixel] = state.next_ns
                after.noise_count[pixel] = state.noise_count
            if wp.static(stochastic):
                after.voltage[pixel] = state.voltage
            if invalid_count > 0:
                pixel_count = base.shape[0]
                flat = wp.int64(invalid_first) * wp.int64(pixel_count) + wp.int64(pixel)
                wp.atomic_add(counters_out, 1, wp.int64(invalid_count))
                wp.atomic_max(counters_out, 2, wp.int64(frame_count) * wp.int64(pixel_count) - flat)

    return scan_pixel
