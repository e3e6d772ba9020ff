# mypy: disable-error-code="index,arg-type,operator,call-overload,assignment,attr-defined,misc,return-value"
# mypy: disable-error-code="type-var,no-untyped-def"
"""One event pixel that is not ideal as it begins, and its noise events: when they come, of which polarity.

What each term does is described in `event_noise_model`, and a pixel is scanned in `event_noise_scan`.
"""

import functools
from collections.abc import Iterable
from typing import Any

import warp as wp

from neurosim_core.random import normal2, random_bits, uniform2
from neurosim_core.registry import find
from neurosim_core.sensors.event_noise_model import CAUSE, TERMS, Memory, PixelModel
from neurosim_core.sensors.event_terms import SignalTerm

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
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


@functools.cache
def make_begin(signals: tuple[tuple[str, Any], ...]) -> Any:
    """Return the kernel that begins what pixels with some `signal_terms` remember."""
    see = make_see(signals)
    module = wp.get_module(".".join((__name__, *(name for name, _ in signals))))

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        # Model:
        models: wp.array[PixelModel],
        phase_stream: wp.uint32,
        random_phase: wp.array[wp.bool],
        # In:
        mask: wp.array[wp.int32],
        base: wp.array2d[wp.float32],
        # Out:
        memory_out: wp.array[Memory],
    ):
        """Let the memory of pixels begin anew in some worlds with what they see; threads: [world, pixel]."""
        world, pixel = wp.tid()
        if mask[world] == 0:
            return
        model = models[world]
        memory = memory_out[world]
        seen = see(model, pixel, wp.int64(0), base[world, pixel])
        if memory.reference.shape[0] > 0:
            memory.reference[pixel] = seen
        if memory.event_count.shape[0] > 0:
            memory.event_count[pixel] = 0
        if memory.filtered.shape[0] > 0:
            memory.filtered[pixel] = seen
        if memory.exposure_ns.shape[0] > 0:
            memory.exposure_ns[pixel] = _ZERO
        if memory.held_ns.shape[0] > 0:
            memory.held_ns[pixel] = -_ONE
        if memory.next_ns.shape[0] > 0:
            rate = model.rates[pixel][0] + model.rates[pixel][1]
            memory.next_ns[pixel] = wait_ns(rate, draw_noise(model, pixel, NoisyPixel())[0])
            memory.noise_count[pixel] = 0
        if memory.voltage.shape[0] > 0:
            voltage = _ZERO
            if random_phase[world]:
                voltage = uniform2(random_bits(model.seed, phase_stream, wp.int64(0), pixel))[0]
                if model.thresholds.shape[0] > 0:
                    voltage *= model.thresholds[pixel][0] / model.threshold_on
            memory.voltage[pixel] = voltage

    return begin


make_begin(())  # before the module is loaded
