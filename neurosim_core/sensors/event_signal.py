# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,assignment,return-value"
"""When the signal of an event pixel reaches a level, and when a voltage with noise touches a threshold.

Times are nanoseconds since the frame before. The law of these signals is described in `event_noise_model`.
"""

import warp as wp

from neurosim_core.random import normal2, random_bits, uniform2

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_NEWTON_STEPS_MAX = wp.constant(64)
_NEWTON_NS = wp.constant(wp.float64(1e-4))


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
    seed: wp.uint64,
    step_stream: wp.uint32,
    touch_stream: wp.uint32,
    step: wp.int64,
    pixel: wp.int32,
    voltage: wp.float64,
    on: wp.float64,
    off: wp.float64,
    drift: wp.float64,
    deviation: wp.float64,
    now: wp.float64,
    end: wp.float64,
) -> Crossing:
    """Move the voltage from now to the end [ns], or to where it first touches +on or -off, it is between.

    Drift is per ns, deviation per root ns; no other piece of the pixel has the same `step`.
    """
    span_ns = end - now
    variance = deviation * deviation * span_ns
    normal = normal2(random_bits(seed, step_stream, step, pixel))
    arrival = voltage + drift * span_ns + wp.sqrt(variance) * normal[0]
    touch_on = _touch(on - voltage, on - arrival, variance)
    touch_off = _touch(voltage + off, arrival + off, variance)
    crossing = Crossing()
    crossing.polarity = -1
    crossing.voltage = arrival
    touch = wp.vec2d(_ONE, _ONE)
    if touch_on + touch_off > _ZERO:
        touch = uniform2(random_bits(seed, touch_stream, step, pixel))
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
