# mypy: disable-error-code="index,arg-type,call-overload,assignment,no-untyped-def,attr-defined"
"""The pixels of an event camera that are not ideal: their parameters, as drawn.

What each term does is described in `event_noise_model`, and a pixel is scanned in `event_noise_scan`.

Every number is addressed by seed, name of the sensor, pixel, and the number of the event or the stamp of the
frame; numbers in time also by the stamp of the reset, so that noise does not come again after a gap. None
depends on how frames are split into calls, nor on threads.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.random import normal2, random_bits, stream_id, uniform2
from neurosim_core.sensors.event_config import EventCameraConfig, MeasuredNoiseConfig
from neurosim_core.sensors.event_noise_model import PixelModel, SignalTerm
from neurosim_core.sensors.event_noise_pixel import signal_terms

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))


@wp.struct
class _Spread:
    """The spread from pixel to pixel of constant parameters, times in ns."""

    seed: wp.uint64
    threshold_stream: wp.uint32
    leak_stream: wp.uint32
    leak_phase_stream: wp.uint32
    shot_stream: wp.uint32
    hot_stream: wp.uint32
    threshold: wp.vec2d  # Standard deviations ON, OFF
    threshold_least: wp.float64
    leak_rate: wp.float64
    leak_decades: wp.float64
    shot_rate: wp.float64
    shot_decades: wp.float64
    hot_fraction: wp.float64
    hot_rate: wp.float64
    measured: wp.array[wp.vec3d]  # Of each light: median rates ON and OFF, decades; or
    sampled: wp.array2d[wp.vec2]  # rates of pixels that were measured, shape [light, pixel]


@wp.func
def _spread_rate(rate: wp.float64, decades: wp.float64, normal: wp.float64) -> wp.float64:
    return rate * wp.exp(wp.log(wp.float64(10.0)) * decades * normal)


@wp.kernel
def _draw_pixels(
    # Model:
    spread: _Spread,
    # In/out:
    model: PixelModel,
) -> None:
    """Draw what stays in a pixel, of the terms whose arrays are not empty."""
    pixel = wp.tid()
    first = wp.int64(0)
    if model.thresholds.shape[0] > 0:
        normal = normal2(random_bits(spread.seed, spread.threshold_stream, first, pixel))
        value = wp.vec2d(model.threshold_on, model.threshold_off) + wp.cw_mul(spread.threshold, normal)
        least = spread.threshold_least
        model.thresholds[pixel] = wp.vec2d(wp.max(value[0], least), wp.max(value[1], least))
    if model.leak.shape[0] > 0:
        normal = normal2(random_bits(spread.seed, spread.leak_stream, first, pixel))
        phase = _ZERO
        if spread.leak_rate != _ZERO:
            phase = uniform2(random_bits(spread.seed, spread.leak_phase_stream, first, pixel))[0]
        rate = _spread_rate(spread.leak_rate, spread.leak_decades, normal[0])
        model.leak[pixel] = wp.vec2d(rate, phase)
    if model.rates.shape[0] > 0:
        bits = random_bits(spread.seed, spread.shot_stream, first, pixel)
        shot = _spread_rate(spread.shot_rate, spread.shot_decades, normal2(bits)[0])
        if model.shot_by_threshold and model.thresholds.shape[0] > 0:
            steady = model.thresholds[pixel]
            on = model.shot_on_fraction * model.threshold_on / steady[0]
            off = (wp.float64(1.0) - model.shot_on_fraction) * model.threshold_off / steady[1]
            shot *= on + off
        if model.noise_rates.shape[0] > 0:
            shot = _ZERO
        for level in range(model.noise_rates.shape[0]):
            rates = wp.vec2()
            if spread.sampled.shape[0] > 0:
                place = uniform2(bits)[0] * wp.float64(spread.sampled.shape[1])
                rates = spread.sampled[level, wp.int32(place)]
            else:
                median = spread.measured[level]
                factor = _spread_rate(wp.float64(1.0), median[2], normal2(bits)[0])
                rates = wp.vec2(wp.float32(median[0] * factor), wp.float32(median[1] * factor))
            model.noise_rates[level, pixel] = rates
            shot = wp.max(shot, wp.float64(rates[0]) + wp.float64(rates[1]))
        hot = uniform2(random_bits(spread.seed, spread.hot_stream, first, pixel))[0] < spread.hot_fraction
        model.rates[pixel] = wp.vec2d(shot, wp.where(hot, spread.hot_rate, _ZERO))


def _read_noise(config: MeasuredNoiseConfig) -> tuple[Any, Any, Any]:
    """Return light [lux], shape [L], medians and spread by light, [L, 3], and rates of pixels, [L, P, 2].

    Rates are per ns; one of the two is empty.

    Raises:
        ValueError: The file is not of this form.
    """
    if config.file is None:
        levels = config.levels
        medians = [(1e-9 * level.on_hz, 1e-9 * level.off_hz, level.spread_decades) for level in levels]
        return np.array([level.lux for level in levels]), np.array(medians), np.zeros((0, 0, 2), np.float32)
    with np.load(config.file) as table:
        if missing := {"lux", "on_hz", "off_hz"} - set(table):
            raise ValueError(
                f"{config.file} must hold lux, on_hz and off_hz; {', '.join(missing)} is missing"
            )
        lux, on_hz, off_hz = (np.asarray(table[name], dtype=float) for name in ("lux", "on_hz", "off_hz"))
    rates = 1e-9 * np.stack([on_hz, off_hz], axis=-1) if on_hz.shape == off_hz.shape else np.zeros(0)
    if rates.ndim != 3 or rates.size == 0 or lux.shape != rates.shape[:1]:
        shapes = f"lux {lux.shape}, on_hz {on_hz.shape}, off_hz {off_hz.shape}"
        raise ValueError(f"{config.file} must hold lux [L], on_hz [L, P] and off_hz [L, P], got {shapes}")
    bad = not (np.isfinite(rates).all() and (rates >= 0.0).all() and (rates <= 1e-3).all())
    if bad or not ((lux > 0.0).all() and (np.diff(lux) > 0.0).all()):
        raise ValueError(f"{config.file}: lux must rise from above 0, rates must be within 0 and 1e6 Hz")
    return lux, np.zeros((0, 3)), rates.astype(np.float32)


def make_model(
    config: EventCameraConfig, *, pixel_count: int, seed: int, sensor: str, device: Any, terms: Sequence[str]
) -> PixelModel:
    """Return what the scan reads of pixels that stays; numbers in time are those of a reset at `seed`.

    Args:
        config: The pixels.
        pixel_count: How many there are.
        seed: What is drawn depends on it.
        sensor: Likewise: cameras with different names have independent noise.
        device: Warp device.
        terms: What is compiled in; there may be some that the configuration does not ask for.
    """

    def array(dtype: Any, *needed_by: str) -> Any:
        return wp.zeros(pixel_count if set(needed_by) & set(terms) else 0, dtype=dtype, device=device)

    def stream(use: str) -> int:
        return stream_id(f"{sensor}/events/{use}")

    model = PixelModel()
    model.threshold_on = config.threshold_on
    model.threshold_off = config.threshold_off
    model.white_radiance = config.white_radiance
    model.log_white = math.log(config.white_radiance)
    model.refractory_ns = 1e9 * config.refractory_s
    if (jitter := config.threshold_jitter) is not None:
        model.jitter, model.jitter_least = wp.vec2d(jitter.sigma_on, jitter.sigma_off), jitter.minimum
    model.signals = _make_signals(config, seed, stream, terms, device)
    if config.low_pass is not None:
        model.corner_per_ns = 2e-9 * math.pi * config.low_pass.cutoff_hz
        model.dark_radiance = config.low_pass.dark_radiance
    elif "low_pass" in terms:
        model.corner_per_ns = 1e9
    if (stochastic := config.stochastic) is not None:
        model.k1, model.k2 = stochastic.k1, stochastic.k2
        model.k3, model.k6 = (k / math.sqrt(1e3) for k in (stochastic.k3, stochastic.k6))
        model.k4, model.k5 = (k / 1e3 for k in (stochastic.k4, stochastic.k5))
        model.random_phase = stochastic.random_phase
    model.seed = seed
    model.spontaneous_stream = stream("noise")
    model.step_stream = stream("voltage")
    model.touch_stream = stream("passage")
    model.jitter_stream = stream("jitter")
    model.phase_stream = stream("phase")
    model.thresholds = array(wp.vec2d, "spread")
    model.leak = array(wp.vec2d, "leak")
    model.rates = array(wp.vec2d, "spontaneous")
    _draw(config, model, seed, stream, terms, pixel_count, device)
    return model


def _draw(
    config: EventCameraConfig,
    model: PixelModel,
    seed: int,
    stream: Callable[[str], int],
    terms: Sequence[str],
    pixel_count: int,
    device: Any,
) -> None:
    """Draw what differs from pixel to pixel."""
    spread = _Spread()
    spread.seed = seed
    spread.threshold_stream, spread.shot_stream, spread.hot_stream = map(stream, ("threshold", "shot", "hot"))
    spread.leak_stream, spread.leak_phase_stream = stream("leak"), stream("leak_phase")
    if (mismatch := config.threshold_spread) is not None:
        spread.threshold = wp.vec2d(mismatch.sigma_on, mismatch.sigma_off)
        spread.threshold_least = mismatch.minimum
    if (leak := config.leak) is not None:
        spread.leak_rate, spread.leak_decades = 1e-9 * leak.rate_hz, leak.spread_decades
        model.leak_growth = leak.bright_factor - 1.0
    if (shot := config.shot_noise) is not None:
        spread.shot_rate, spread.shot_decades = 1e-9 * shot.rate_hz, shot.spread_decades
        model.bright_factor, model.shot_on_fraction = shot.bright_factor, shot.on_fraction
        model.shot_by_threshold = shot.by_threshold
    if (hot := config.hot_pixels) is not None:
        spread.hot_fraction, spread.hot_rate = hot.fraction, 1e-9 * hot.rate_hz
        model.hot_on_fraction = hot.on_fraction
    if (measured := config.measured_noise) is not None and "measured" in terms:
        light, medians, sampled = _read_noise(measured)
        light = np.log(light * config.white_radiance / measured.white_lux)
        model.noise_light = wp.array(light, dtype=wp.float64, device=device)
        model.noise_rates = wp.zeros((len(light), pixel_count), dtype=wp.vec2, device=device)
        spread.measured = wp.array(medians, dtype=wp.vec3d, device=device)
        spread.sampled = wp.array(sampled, dtype=wp.vec2, device=device)
    wp.launch(_draw_pixels, dim=pixel_count, inputs=[spread, model], device=device)


def _make_signals(
    config: EventCameraConfig, seed: int, stream: Callable[[str], int], terms: Sequence[str], device: Any
) -> Any:
    """Return what changes what pixels see; terms without settings have numbers 0."""
    given = {term: each for each in config.noise for term in each.terms()} | {"lin_log": config.lin_log}
    signals = []
    for name, _ in signal_terms(terms):
        term = SignalTerm()
        settings = given.get(name)
        numbers = () if settings is None else settings.numbers(config.white_radiance)
        term.numbers = wp.vec4d(*numbers, *[0.0] * (4 - len(numbers)))
        term.seed, term.stream = seed, stream(name)
        signals.append(term)
    return wp.array(signals, dtype=SignalTerm, device=device)
