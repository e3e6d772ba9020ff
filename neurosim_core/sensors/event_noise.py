# mypy: disable-error-code="index,arg-type,call-overload,assignment,no-untyped-def,attr-defined"
"""The pixels of an event camera that are not ideal: their parameters as drawn, and their states.

What each term does is described in `event_noise_model`, and a pixel is scanned in `event_noise_scan`.

Every number is addressed by seed, name of the sensor, pixel, and the number of the event or the stamp of the
frame; numbers in time also by the stamp of the reset, so that noise does not come again after a gap. None
depends on how frames are split into calls, nor on threads.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.random import normal2, random_bits, stream_id, uniform2
from neurosim_core.sensors.event_config import EventCameraConfig, MeasuredNoiseConfig
from neurosim_core.sensors.event_noise_model import Memory, PixelModel
from neurosim_core.sensors.event_noise_pixel import signal_terms
from neurosim_core.sensors.event_terms import SignalTerm

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))


@wp.kernel
def _draw_thresholds(
    # Model:
    nominal: wp.vec2d,
    deviation: wp.vec2d,
    minimum: wp.float64,
    seed: wp.uint64,
    stream: wp.uint32,
    # Out:
    threshold_out: wp.array[wp.vec2d],
) -> None:
    pixel = wp.tid()
    value = nominal + wp.cw_mul(deviation, normal2(random_bits(seed, stream, wp.int64(0), pixel)))
    threshold_out[pixel] = wp.vec2d(wp.max(value[0], minimum), wp.max(value[1], minimum))


@wp.func
def _spread_rate(rate: wp.float64, decades: wp.float64, normal: wp.float64) -> wp.float64:
    return rate * wp.exp(wp.log(wp.float64(10.0)) * decades * normal)


@wp.kernel
def _draw_leak(
    # Model:
    rate_per_ns: wp.float64,
    decades: wp.float64,
    seed: wp.uint64,
    rate_stream: wp.uint32,
    phase_stream: wp.uint32,
    # Out:
    leak_out: wp.array[wp.vec2d],
) -> None:
    pixel = wp.tid()
    normal = normal2(random_bits(seed, rate_stream, wp.int64(0), pixel))
    phase = uniform2(random_bits(seed, phase_stream, wp.int64(0), pixel))[0]
    if rate_per_ns == _ZERO:
        phase = _ZERO
    leak_out[pixel] = wp.vec2d(_spread_rate(rate_per_ns, decades, normal[0]), phase)


@wp.kernel
def _draw_rates(
    # Model:
    shot_per_ns: wp.float64,
    decades: wp.float64,
    hot_fraction: wp.float64,
    hot_per_ns: wp.float64,
    seed: wp.uint64,
    rate_stream: wp.uint32,
    hot_stream: wp.uint32,
    model: PixelModel,
    # Out:
    rate_out: wp.array[wp.vec2d],
) -> None:
    pixel = wp.tid()
    normal = normal2(random_bits(seed, rate_stream, wp.int64(0), pixel))
    hot = uniform2(random_bits(seed, hot_stream, wp.int64(0), pixel))[0] < hot_fraction
    shot = _spread_rate(shot_per_ns, decades, normal[0])
    if model.shot_by_threshold and model.thresholds.shape[0] > 0:
        on = model.shot_on_fraction * model.threshold_on / model.thresholds[pixel][0]
        off = (wp.float64(1.0) - model.shot_on_fraction) * model.threshold_off / model.thresholds[pixel][1]
        shot *= on + off
    rate_out[pixel] = wp.vec2d(shot, wp.where(hot, hot_per_ns, _ZERO))


@wp.kernel
def _draw_measured(
    # Model:
    medians: wp.array[wp.vec3d],
    sampled: wp.array2d[wp.vec2],
    seed: wp.uint64,
    stream: wp.uint32,
    # Out:
    level_rate_out: wp.array2d[wp.vec2],
    rate_out: wp.array[wp.vec2d],
) -> None:
    """Draw the rates of a pixel in all lights, from medians (ON, OFF, spread) or from a measured pixel."""
    pixel = wp.tid()
    bits = random_bits(seed, stream, wp.int64(0), pixel)
    most = _ZERO
    for level in range(level_rate_out.shape[0]):
        rates = wp.vec2()
        if sampled.shape[0] > 0:
            rates = sampled[level, wp.int32(uniform2(bits)[0] * wp.float64(sampled.shape[1]))]
        else:
            factor = _spread_rate(wp.float64(1.0), medians[level][2], normal2(bits)[0])
            rates = wp.vec2(wp.float32(medians[level][0] * factor), wp.float32(medians[level][1] * factor))
        level_rate_out[level, pixel] = rates
        most = wp.max(most, wp.float64(rates[0]) + wp.float64(rates[1]))
    rate_out[pixel] = wp.vec2d(most, rate_out[pixel][1])


def mix_seed(seed: int, stamp_ns: int) -> int:
    """Return a seed of 64 bits that differs for each stamp (finaliser of SplitMix64, Steele et al. 2014)."""
    mixed = (seed + 0x9E3779B97F4A7C15 * (stamp_ns + 1)) % 2**64
    mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) % 2**64
    return mixed ^ (mixed >> 31)


def read_noise(config: MeasuredNoiseConfig) -> tuple[Any, Any, Any]:
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


class PixelNoise:
    """The pixels of an event camera that are not ideal: what stays, and what they remember, in a ring.

    Cameras with different names have independent noise.

    Attributes:
        terms: The terms that are compiled in.
        model: What the scan reads of pixels that stays, a `PixelModel`.
        memories: What pixels remember, a `Memory` for each state of the ring.
    """

    def __init__(
        self,
        config: EventCameraConfig,
        *,
        pixel_count: int,
        ring_size: int,
        seed: int,
        sensor: str,
        device: Any,
        terms: Sequence[str],
    ) -> None:
        self.terms = tuple(terms)
        self._config = config
        self._seed = seed
        self._sensor = sensor
        self._device = wp.get_device(device)
        self._pixel_count = pixel_count
        self.memories = [self._make_memory() for _ in range(ring_size)]
        self.model = self._make_model()

    def set_reset(self, stamp_ns: int) -> None:
        """Let the noise that follows be that after a reset at a stamp."""
        self.model.seed = mix_seed(self._seed, stamp_ns)

    def phase(self) -> tuple[int, bool]:
        """Return the stream of random phases, and whether voltages begin at one."""
        stochastic = self._config.stochastic
        return self._stream("phase"), stochastic is not None and stochastic.random_phase

    def _stream(self, use: str) -> int:
        return stream_id(f"{self._sensor}/events/{use}")

    def _has(self, *terms: str) -> bool:
        return any(term in self.terms for term in terms)

    def _array(self, dtype: Any, needed: bool) -> Any:
        return wp.zeros(self._pixel_count if needed else 0, dtype=dtype, device=self._device)

    def _make_memory(self) -> Any:
        memory = Memory()
        memory.reference = self._array(wp.float64, self._has("refractory", "spontaneous", "jitter"))
        memory.event_count = self._array(wp.int32, self._has("jitter"))
        memory.filtered = self._array(wp.float64, self._has("low_pass"))
        memory.exposure_ns = self._array(wp.float64, self._has("light_leak"))
        memory.held_ns = self._array(wp.float64, self._has("refractory"))
        memory.next_ns = self._array(wp.int64, self._has("spontaneous"))
        memory.noise_count = self._array(wp.int32, self._has("spontaneous"))
        memory.voltage = self._array(wp.float64, self._has("stochastic"))
        return memory

    def _make_model(self) -> Any:
        config = self._config
        model = PixelModel()
        model.threshold_on = config.threshold_on
        model.threshold_off = config.threshold_off
        model.white_radiance = config.white_radiance
        model.log_white = math.log(config.white_radiance)
        model.refractory_ns = 1e9 * config.refractory_s
        if (jitter := config.threshold_jitter) is not None:
            model.jitter, model.jitter_least = wp.vec2d(jitter.sigma_on, jitter.sigma_off), jitter.minimum
        model.signals = self._make_signals()
        if config.low_pass is not None:
            model.corner_per_ns = 2e-9 * math.pi * config.low_pass.cutoff_hz
            model.dark_radiance = config.low_pass.dark_radiance
        elif self._has("low_pass"):
            model.corner_per_ns = 1e9
        if config.leak is not None:
            model.leak_growth = config.leak.bright_factor - 1.0
        if config.shot_noise is not None:
            model.bright_factor = config.shot_noise.bright_factor
            model.shot_on_fraction = config.shot_noise.on_fraction
            model.shot_by_threshold = config.shot_noise.by_threshold
        if config.hot_pixels is not None:
            model.hot_on_fraction = config.hot_pixels.on_fraction
        if config.stochastic is not None:
            model.k1, model.k2 = config.stochastic.k1, config.stochastic.k2
            model.k3, model.k6 = (k / math.sqrt(1e3) for k in (config.stochastic.k3, config.stochastic.k6))
            model.k4, model.k5 = (k / 1e3 for k in (config.stochastic.k4, config.stochastic.k5))
        model.spontaneous_stream = self._stream("noise")
        model.step_stream = self._stream("voltage")
        model.touch_stream = self._stream("passage")
        model.jitter_stream = self._stream("jitter")
        model.thresholds = self._draw_thresholds()
        model.leak = self._draw_leak()
        model.rates = self._draw_rates(model)
        if config.measured_noise is not None and self._has("measured"):
            light, medians, sampled = read_noise(config.measured_noise)
            light = np.log(light * config.white_radiance / config.measured_noise.white_lux)
            model.noise_light = wp.array(light, dtype=wp.float64, device=self._device)
            model.noise_rates = wp.zeros((len(light), self._pixel_count), dtype=wp.vec2, device=self._device)
            wp.launch(
                _draw_measured,
                dim=self._pixel_count,
                inputs=[
                    wp.array(medians, dtype=wp.vec3d, device=self._device),
                    wp.array(sampled, dtype=wp.vec2, device=self._device),
                    self._seed,
                    self._stream("shot"),
                ],
                outputs=[model.noise_rates, model.rates],
                device=self._device,
            )
        return model

    def _make_signals(self) -> Any:
        """Return what changes what pixels see; terms without settings have numbers 0."""
        config = self._config
        given = {term: each for each in config.noise for term in each.terms()} | {"lin_log": config.lin_log}
        terms = []
        for name, _ in signal_terms(self.terms):
            term = SignalTerm()
            settings = given.get(name)
            numbers = () if settings is None else settings.numbers(config.white_radiance)
            term.numbers = wp.vec4d(*numbers, *[0.0] * (4 - len(numbers)))
            term.seed, term.stream = self._seed, self._stream(name)
            terms.append(term)
        return wp.array(terms, dtype=SignalTerm, device=self._device)

    def _draw(self, kernel: Any, out: Any, *parameters: Any) -> Any:
        if out.shape[0] > 0:
            wp.launch(kernel, dim=out.shape[0], inputs=[*parameters], outputs=[out], device=self._device)
        return out

    def _draw_thresholds(self) -> Any:
        config, spread = self._config, self._config.threshold_spread
        return self._draw(
            _draw_thresholds,
            self._array(wp.vec2d, self._has("spread")),
            wp.vec2d(config.threshold_on, config.threshold_off),
            wp.vec2d(*((0.0, 0.0) if spread is None else (spread.sigma_on, spread.sigma_off))),
            0.0 if spread is None else spread.minimum,
            self._seed,
            self._stream("threshold"),
        )

    def _draw_leak(self) -> Any:
        leak = self._config.leak
        return self._draw(
            _draw_leak,
            self._array(wp.vec2d, self._has("leak")),
            0.0 if leak is None else 1e-9 * leak.rate_hz,
            0.0 if leak is None else leak.spread_decades,
            self._seed,
            self._stream("leak"),
            self._stream("leak_phase"),
        )

    def _draw_rates(self, model: Any) -> Any:
        shot, hot = self._config.shot_noise, self._config.hot_pixels
        return self._draw(
            _draw_rates,
            self._array(wp.vec2d, self._has("spontaneous")),
            0.0 if shot is None else 1e-9 * shot.rate_hz,
            0.0 if shot is None else shot.spread_decades,
            0.0 if hot is None else hot.fraction,
            0.0 if hot is None else 1e-9 * hot.rate_hz,
            self._seed,
            self._stream("shot"),
            self._stream("hot"),
            model,
        )
