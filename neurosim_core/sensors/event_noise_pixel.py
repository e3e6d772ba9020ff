# mypy: disable-error-code="index,arg-type,operator,call-overload,assignment,attr-defined,misc,return-value"
# mypy: disable-error-code="type-var,no-untyped-def"
"""One event pixel that is not ideal: how it begins, when its signal reaches a level, when noise fires it.

What each term does is described in `event_noise_model`, and a pixel is scanned in `event_noise_scan`. Times
without a unit in their type are nanoseconds since the frame before.
"""

import functools
from collections.abc import Iterable
from typing import Any

import warp as wp

from neurosim_core.random import normal2, random_bits, uniform2
from neurosim_core.registry import find
from neurosim_core.sensors.event_levels import Levels, levels_from, quiet_range
from neurosim_core.sensors.event_noise_model import CAUSE, TERMS, PixelModel, SignalTerm
from neurosim_core.sensors.event_scan import PixelState

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_NEWTON_STEPS_MAX = wp.constant(64)
_NEWTON_NS = wp.constant(wp.float64(1e-4))
NEVER = wp.constant(wp.int64(2**62))
_GLARE = wp.constant(wp.float64(6.9))
"""Logarithm of the most light that leaks, in units of white: 1000."""


@wp.struct
class NoisyPixel:
    """One pixel in registers."""

    on: wp.float64
    off: wp.float64
    steady: wp.vec2d  # thresholds ON and OFF without jitter
    event_count: wp.int32
    reference: wp.float64
    up: wp.int32
    down: wp.int32
    fold: wp.int32  # whole cycles of leak: they count against `up`
    held_ns: wp.float64  # end of reset, since the frame before
    next_ns: wp.int64
    noise_count: wp.int32
    shot_rate: wp.float64
    hot_rate: wp.float64
    voltage: wp.float64


@wp.func
def levels_of(state: NoisyPixel) -> Levels:
    """Return the levels of a pixel, of which it has crossed `up - fold` upwards and `down` downwards."""
    return levels_from(state.reference, state.on, state.off)


@wp.func
def range_of(state: NoisyPixel) -> wp.vec2:
    """Return the values of the signal that reach the level below and the level above."""
    return quiet_range(levels_of(state), state.up - state.fold, state.down)


@wp.func
def jittered(model: PixelModel, index: wp.int32, state: NoisyPixel) -> NoisyPixel:
    """Draw the thresholds until the next event; the first are those of the pixel: it may have leaked."""
    if state.event_count > 0:
        normal = normal2(random_bits(model.seed, model.jitter_stream, wp.int64(state.event_count), index))
        state.on = wp.max(state.steady[0] + model.jitter[0] * normal[0], model.jitter_least)
        state.off = wp.max(state.steady[1] + model.jitter[1] * normal[1], model.jitter_least)
    return state


@wp.func
def _linear_in_the_dark(
    term: SignalTerm, seed: wp.uint64, pixel: wp.int32, since_reset_ns: wp.int64, log_radiance: wp.float64
) -> wp.float64:
    """Return what a pixel sees of log radiance: a line below some light, with the same value there."""
    if term.numbers[0] > _ZERO:
        radiance = wp.exp(log_radiance)
        if radiance < term.numbers[0]:
            rise = term.numbers[2] * (radiance / term.numbers[0] - _ONE)
            return wp.float64(wp.float32(term.numbers[1] + rise))
    return log_radiance


def signal_terms(terms: Iterable[str]) -> tuple[tuple[str, Any], ...]:
    """Return the name and the device function of each term that changes what pixels see, in their order."""
    others = sorted(set(terms) - {*TERMS, CAUSE})
    first = [("lin_log", _linear_in_the_dark)] if "lin_log" in terms else []
    return (*first, *((name, find("noise", name).signal) for name in others))


@functools.cache
def make_see(signals: tuple[tuple[str, Any], ...]) -> Any:
    """Return the function from log radiance to what pixels with some `signal_terms` see."""
    functions = tuple(function for _, function in signals)

    @wp.func
    def see(
        model: PixelModel, pixel: wp.int32, since_reset_ns: wp.int64, log_radiance: wp.float32
    ) -> wp.float64:
        seen = wp.float64(log_radiance)
        for index in range(wp.static(len(functions))):
            seen = wp.static(functions[index])(model.signals[index], model.seed, pixel, since_reset_ns, seen)
        return seen

    return see


@wp.func
def wait_ns(rate: wp.float64, uniform: wp.float64) -> wp.int64:
    """Return an exponential waiting time, at least 1 ns."""
    if rate <= _ZERO:
        return NEVER
    return wp.max(wp.int64(wp.ceil(wp.min(-wp.log(uniform) / rate, wp.float64(1e18)))), wp.int64(1))


@wp.func
def draw_noise(model: PixelModel, index: wp.int32, state: NoisyPixel) -> wp.vec2d:
    """Return two uniform numbers for the wait for a noise event and for what becomes of it."""
    return uniform2(random_bits(model.seed, model.spontaneous_stream, wp.int64(state.noise_count), index))


@wp.func
def noise_polarity(
    model: PixelModel, state: NoisyPixel, log_radiance: wp.float64, uniform: wp.float64
) -> wp.int32:
    """Return the polarity of a noise event that may be; -1: at this light it is none."""
    place = uniform * (state.shot_rate + state.hot_rate)
    if place < state.hot_rate:
        return wp.where(place < state.hot_rate * model.hot_on_fraction, 1, 0)
    place -= state.hot_rate
    light = wp.min(wp.exp(log_radiance) / model.white_radiance, _ONE)
    rate = state.shot_rate * (_ONE + (model.bright_factor - _ONE) * light)
    if place >= rate:
        return -1
    share = model.shot_on_fraction
    if model.shot_by_threshold:
        on = share * model.threshold_on / state.steady[0]
        share = on / (on + (_ONE - share) * model.threshold_off / state.steady[1])
    return wp.where(place < rate * share, 1, 0)


@wp.func
def measured_polarity(
    model: PixelModel, pixel: wp.int32, state: NoisyPixel, log_radiance: wp.float64, uniform: wp.float64
) -> wp.int32:
    """Do what `noise_polarity` does, at rates that were measured in several lights."""
    if model.noise_light.shape[0] == 0:
        return noise_polarity(model, state, log_radiance, uniform)
    place = uniform * (state.shot_rate + state.hot_rate)
    if place < state.hot_rate:
        return wp.where(place < state.hot_rate * model.hot_on_fraction, 1, 0)
    place -= state.hot_rate
    brightest = model.noise_light.shape[0] - 1
    level = wp.int32(0)
    while level < brightest and log_radiance >= model.noise_light[level + 1]:
        level += 1
    above = wp.min(level + 1, brightest)
    share = _ZERO
    if above > level:
        step = model.noise_light[above] - model.noise_light[level]
        share = wp.clamp((log_radiance - model.noise_light[level]) / step, _ZERO, _ONE)
    dim = model.noise_rates[level, pixel]
    bright = model.noise_rates[above, pixel]
    on = wp.float64(dim[0]) + share * (wp.float64(bright[0]) - wp.float64(dim[0]))
    off = wp.float64(dim[1]) + share * (wp.float64(bright[1]) - wp.float64(dim[1]))
    if place >= on + off:
        return -1
    return wp.where(place < on, 1, 0)


@wp.func
def light_of(model: PixelModel, log_radiance: wp.float32) -> wp.float64:
    """Return light in units of white, at most 1000."""
    return wp.exp(wp.min(wp.float64(log_radiance) - model.log_white, _GLARE))


@wp.func
def mean_light(
    model: PixelModel, first: wp.float32, last: wp.float32, begin: wp.float64, end: wp.float64
) -> wp.float64:
    """Return the mean of light whose logarithm goes linearly from first to last, from what it is there."""
    rise = wp.min(wp.float64(last) - model.log_white, _GLARE)
    rise -= wp.min(wp.float64(first) - model.log_white, _GLARE)
    if wp.abs(rise) < wp.float64(1e-6):
        return wp.float64(0.5) * (begin + end)
    return (end - begin) / rise


@wp.struct
class Signal:
    """A piece of signal: start + slope u + decay (exp(-u / tau) - 1), u = t - begin, t in (begin, end]."""

    begin: wp.float64
    end: wp.float64
    start: wp.float64
    slope: wp.float64
    decay: wp.float64
    tau: wp.float64
    last: wp.float64  # Value at the end


@wp.struct
class Interval:
    """What drives a pixel between two frames; of terms that are not compiled in it is 0."""

    frame: wp.int32  # Number of the later one in the stack
    start_ns: wp.int64  # Stamp of the earlier one, from the origin of the keys
    since_ns: wp.int64  # The same since the reset
    light: wp.float64  # Log radiance there
    light_slope: wp.float64  # Per ns
    leak_slope: wp.float64  # By which the reference falls, per ns
    drift: wp.float64  # Of the voltage, per ns
    deviation: wp.float64  # Of the voltage, per root ns


@wp.struct
class Crossing:
    """An event found in a piece, or none."""

    time_ns: wp.float64
    polarity: wp.int32  # -1: none
    voltage: wp.float64


@wp.func
def line_at(signal: Signal, time_ns: wp.float64) -> wp.float64:
    """Return the signal of an infinitely fast photoreceptor, a line."""
    if time_ns >= signal.end:
        return signal.last
    share = (time_ns - signal.begin) / (signal.end - signal.begin)
    return signal.start + (signal.last - signal.start) * share


@wp.func
def curve_at(signal: Signal, time_ns: wp.float64) -> wp.float64:
    """Return the signal of a photoreceptor with a time constant."""
    if time_ns >= signal.end:
        return signal.last
    elapsed = time_ns - signal.begin
    return signal.start + signal.slope * elapsed + signal.decay * (wp.exp(-elapsed / signal.tau) - _ONE)


@wp.func
def reached(value: wp.float64, quiet: wp.vec2) -> wp.int32:
    """Return the polarity of the event of a signal that came to a value; -1: none."""
    if value >= wp.float64(quiet[1]):
        return 1
    if value <= wp.float64(quiet[0]):
        return 0
    return -1


@wp.func
def line_crossing(
    signal: Signal, now: wp.float64, end: wp.float64, quiet: wp.vec2, lower: wp.float64, upper: wp.float64
) -> Crossing:
    """Find the first level that a line reaches in (now, end]."""
    crossing = Crossing()
    crossing.polarity = reached(line_at(signal, end), quiet)
    if crossing.polarity >= 0:
        level = wp.where(crossing.polarity == 1, upper, lower)
        rise = signal.last - signal.start
        time_ns = now
        if rise != _ZERO:
            # the same operations as for an ideal pixel, whose events are these to the bit
            fraction = wp.min((level - signal.start) / rise, _ONE)
            time_ns = signal.begin + (signal.end - signal.begin) * fraction
        crossing.time_ns = wp.clamp(time_ns, now, end)
    return crossing


@wp.func
def _curve_root(signal: Signal, begin: wp.float64, end: wp.float64, level: wp.float64) -> wp.float64:
    """Return when the signal, monotone in (begin, end], reaches a level; the end if that is by rounding.

    Newton's method from the end where the curve lies on the side of its bend, from where it cannot overshoot.
    """
    at_begin = curve_at(signal, begin) - level
    at_end = curve_at(signal, end) - level
    if at_begin == _ZERO or at_begin * at_end > _ZERO:
        return wp.where(at_begin == _ZERO, begin, end)
    time_ns = wp.where(at_end * signal.decay > _ZERO, end, begin)
    value = wp.where(at_end * signal.decay > _ZERO, at_end, at_begin)
    if signal.decay == _ZERO:
        value = at_begin
        time_ns = begin
    for _step in range(_NEWTON_STEPS_MAX):
        steepness = signal.slope - signal.decay / signal.tau * wp.exp(-(time_ns - signal.begin) / signal.tau)
        if steepness == _ZERO:
            break
        before = time_ns
        time_ns = wp.clamp(time_ns - value / steepness, begin, end)
        elapsed = time_ns - signal.begin
        value = signal.start + signal.slope * elapsed - level
        value += signal.decay * (wp.exp(-elapsed / signal.tau) - _ONE)
        if wp.abs(time_ns - before) <= _NEWTON_NS:
            break
    return time_ns


@wp.func
def curve_crossing(
    signal: Signal, now: wp.float64, end: wp.float64, quiet: wp.vec2, lower: wp.float64, upper: wp.float64
) -> Crossing:
    """Find the first level that the photoreceptor's output reaches in (now, end].

    It turns at most once, where its derivative is zero; before and after that it is monotone.
    """
    crossing = Crossing()
    crossing.polarity = -1
    middle = now
    if signal.slope * signal.decay > _ZERO:
        ratio = signal.decay / (signal.tau * signal.slope)
        if ratio > _ONE:
            turn = signal.begin + signal.tau * wp.log(ratio)
            if turn > now and turn < end:
                middle = turn
    if middle > now:
        crossing.polarity = reached(curve_at(signal, middle), quiet)
        if crossing.polarity >= 0:
            level = wp.where(crossing.polarity == 1, upper, lower)
            crossing.time_ns = _curve_root(signal, now, middle, level)
            return crossing
    crossing.polarity = reached(curve_at(signal, end), quiet)
    if crossing.polarity >= 0:
        level = wp.where(crossing.polarity == 1, upper, lower)
        crossing.time_ns = _curve_root(signal, middle, end, level)
    return crossing


@wp.func
def _inverse_gaussian(
    mean: wp.float64, shape: wp.float64, normal: wp.float64, uniform: wp.float64
) -> wp.float64:
    """Return an inverse Gaussian number made of a normal and a uniform one (Michael, Schucany, Haas)."""
    a = mean * normal * normal / (_TWO * shape)
    factor = _ONE + a + wp.sqrt(a * (a + _TWO))
    small = mean / factor
    return wp.where(uniform * (mean + small) <= mean, small, mean * factor)


@wp.func
def _touch(near: wp.float64, far: wp.float64, variance: wp.float64) -> wp.float64:
    """Return the probability that a Brownian bridge touches a threshold; 0 below 4e-18.

    Its begin is `near` > 0 from the threshold, its end `far` (<= 0: beyond).
    """
    if far <= _ZERO:
        return _ONE
    exponent = _TWO * near * far
    if exponent >= wp.float64(40.0) * variance:
        return _ZERO
    return wp.exp(-exponent / variance)


@wp.func
def first_passage(
    model: PixelModel,
    step: wp.int64,
    pixel: wp.int32,
    state: NoisyPixel,
    interval: Interval,
    now: wp.float64,
    end: wp.float64,
) -> Crossing:
    """Move the voltage from now to the end [ns], or to where it first touches a threshold, it is between.

    No other piece of the pixel has the same `step`.
    """
    voltage = state.voltage
    on = state.on
    off = state.off
    deviation = interval.deviation
    span_ns = end - now
    variance = deviation * deviation * span_ns
    normal = normal2(random_bits(model.seed, model.step_stream, step, pixel))
    arrival = voltage + interval.drift * span_ns + wp.sqrt(variance) * normal[0]
    touch_on = _touch(on - voltage, on - arrival, variance)
    touch_off = _touch(voltage + off, arrival + off, variance)
    crossing = Crossing()
    crossing.polarity = -1
    crossing.voltage = arrival
    touch = wp.vec2d(_ONE, _ONE)
    if touch_on + touch_off > _ZERO:
        touch = uniform2(random_bits(model.seed, model.touch_stream, step, pixel))
    if arrival >= on:
        crossing.polarity = wp.where(touch[0] < touch_off, 0, 1)
    elif arrival <= -off:
        crossing.polarity = wp.where(touch[0] < touch_on, 1, 0)
    elif touch[0] < touch_on:
        crossing.polarity = 1
    elif touch[0] < touch_on + touch_off:
        crossing.polarity = 0
    if crossing.polarity >= 0:
        near = wp.where(crossing.polarity == 1, on - voltage, voltage + off)
        far = wp.abs(wp.where(crossing.polarity == 1, on - arrival, arrival + off))
        ratio = near / wp.max(far, wp.float64(1e-12) * near)
        if variance > _ZERO:
            ratio = _inverse_gaussian(ratio, near * near / variance, normal[1], touch[1])
        crossing.time_ns = wp.clamp(now + span_ns * (ratio / (_ONE + ratio)), now, end)
        crossing.voltage = _ZERO
    return crossing


@functools.cache
def make_begin(signals: tuple[tuple[str, Any], ...]) -> Any:
    """Return the kernel that begins what pixels with some `signal_terms` remember."""
    see = make_see(signals)
    module = wp.get_module(".".join((__name__, *(name for name, _ in signals))))

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        # Model:
        models: wp.array[PixelModel],
        # In:
        mask: wp.array[wp.int32],
        # In/out:
        state: PixelState,
    ):
        """Let what pixels remember begin anew in some worlds with what they see; threads: [world, pixel]."""
        world, pixel = wp.tid()
        if mask[world] == 0:
            return
        model = models[world]
        seen = see(model, pixel, wp.int64(0), state.base[world, pixel])
        if state.reference.shape[1] > 0:
            state.reference[world, pixel] = seen
        if state.event_count.shape[1] > 0:
            state.event_count[world, pixel] = 0
        if state.filtered.shape[1] > 0:
            state.filtered[world, pixel] = seen
        if state.exposure_ns.shape[1] > 0:
            state.exposure_ns[world, pixel] = _ZERO
        if state.held_ns.shape[1] > 0:
            state.held_ns[world, pixel] = -_ONE
        if state.next_ns.shape[1] > 0:
            rate = model.rates[pixel][0] + model.rates[pixel][1]
            state.next_ns[world, pixel] = wait_ns(rate, draw_noise(model, pixel, NoisyPixel())[0])
            state.noise_count[world, pixel] = 0
        if state.voltage.shape[1] > 0:
            voltage = _ZERO
            if model.random_phase:
                voltage = uniform2(random_bits(model.seed, model.phase_stream, wp.int64(0), pixel))[0]
                if model.thresholds.shape[0] > 0:
                    voltage *= model.thresholds[pixel][0] / model.threshold_on
            state.voltage[world, pixel] = voltage

    return begin


make_begin(())  # before the module is loaded
