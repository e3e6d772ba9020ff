"""Patterns of changing light for event pixels, and what theory says they give: ramp, step, sine, moving bar.

A sine has 128 frames a cycle.

Reference: Lichtsteiner, Posch, Delbruck (2008), A 128x128 120 dB 15 us latency asynchronous temporal
contrast vision sensor (threshold, latency and bandwidth as they are measured here); McReynolds, Graca,
Delbruck (2022), Experimental methods to predict dynamic vision sensor event camera performance (S-curves).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from neurosim_core.bench.pixel_bench import (
    THRESHOLD,
    TestBench,
    make_pixel,
    make_preset,
    per_pixel,
    rates_hz,
    still,
)
from neurosim_core.bench.pixel_result import BarTimes, Curve, Floats, Jitter
from neurosim_core.sensors.event_config import EventCameraConfig

GAIN_THRESHOLD = 1e-3
"""Fine, so that the number of events measures an amplitude."""
GAIN_AMPLITUDE = 0.1
PHOTORECEPTORS = ("dvs128", "v2e_noisy")
"""Presets with a low-pass."""

_FRAMES_PER_CYCLE = 128
_SETTLE = 8.0
"""Time constants until a transient is taken for over: e^-8."""
_STEP_NS = 1_000
"""Rise time of a step [ns]."""


# ---- ramp ------------------------------------------------------------------------------------------------


def measure_ramp(bench: TestBench) -> tuple[list[Curve], Curve]:
    """Return rates over the slope of a ramp, and the threshold that an ideal pixel's rate gives back."""
    slopes = np.logspace(-1.0, 4.0, bench.pick(21, 6))
    ideal = _ramp_curve(bench, "ideal", make_pixel(), slopes, lambda s: s / THRESHOLD)
    curves = [ideal]
    for dead_s in (1e-3, 1e-2):
        curves.append(
            _ramp_curve(
                bench,
                f"refractory {1e3 * dead_s:g} ms",
                make_pixel(refractory_s=dead_s),
                slopes,
                partial(_dead_rate_hz, dead_s),
            )
        )
    leak_hz = 10.0
    curves.append(
        _ramp_curve(
            bench,
            f"leak {leak_hz:g} Hz",
            make_pixel(leak={"rate_hz": leak_hz, "spread_decades": 0.0}),
            slopes,
            lambda s: s / THRESHOLD + leak_hz,
        )
    )
    recovered = Curve(
        name="threshold", x=slopes, measured=slopes / ideal.measured, law=lambda s: np.full_like(s, THRESHOLD)
    )
    return curves, recovered


def _dead_rate_hz(dead_s: float, slope: Floats) -> Floats:
    return 1.0 / (dead_s + THRESHOLD / slope)


def _ramp_curve(
    bench: TestBench, name: str, config: EventCameraConfig, slopes: Floats, rate: Callable[[Floats], Floats]
) -> Curve:
    """Show each slope for as long as about 100 events take, but no more than the camera takes of light."""
    measured = []
    for slope, rate_hz in zip(slopes, rate(slopes), strict=True):
        duration_s = min(100.5 / rate_hz, 900.0 / slope)
        log = np.array([0.0, slope * duration_s]).reshape(2, 1, 1)
        measured.append(rates_hz(bench.expose(config, log, [0.0, duration_s]), 1, 1)[0])
    return Curve(name=name, x=slopes, measured=np.array(measured), law=rate)


# ---- step ------------------------------------------------------------------------------------------------


def measure_staircase(bench: TestBench) -> list[Curve]:
    """Return the number of events over the height of a step, up and down."""
    heights = np.linspace(0.02, 1.5, bench.pick(75, 19)) + 1e-4  # not on a level
    curves = []
    for name, sign in (("ON", 1.0), ("OFF", -1.0)):
        log = np.stack([np.zeros_like(heights), sign * heights])[:, :, None]
        events = bench.expose(make_pixel(), log, [0.0, 1e-9 * _STEP_NS])
        counts = per_pixel(events, 1, len(heights))
        curves.append(
            Curve(name=name, x=heights, measured=counts.astype(float), law=lambda h: np.floor(h / THRESHOLD))
        )
    return curves


def measure_s_curves(bench: TestBench) -> tuple[list[Curve], float]:
    """Return the share of the pixels of a DAVIS346 that fire over the height of a step.

    The thresholds are normal, so it is Phi((height - C) / sigma). Each height is shown to the same pixels:
    the curve is the empirical distribution of their thresholds, and the Kolmogorov-Smirnov distance is its
    largest error.
    """
    config = make_preset("davis346", leak=None, readout=None)
    spread = config.threshold_spread
    assert spread is not None
    side = bench.pick(128, 32)
    curves, distance = [], 0.0
    for name, sign, mean, sigma in (
        ("ON", 1.0, config.threshold_on, spread.sigma_on),
        ("OFF", -1.0, config.threshold_off, spread.sigma_off),
    ):
        heights = mean + sigma * np.linspace(-3.0, 3.0, bench.pick(37, 13))
        shares = []
        for height in heights:
            log = np.concatenate([still(0.0, height=side, width=side, count=1)] * 2)
            log[1] = sign * height
            events = bench.expose(config, log, [0.0, 1e-9 * _STEP_NS])
            shares.append(float((per_pixel(events, side, side * side) > 0).mean()))
        law = stats.norm(mean, sigma).cdf
        expected = law(heights)
        deviation = np.sqrt(expected * (1.0 - expected)) / side
        curve = Curve(
            name=f"{name}: C = {mean:.3f}, sigma = {sigma:g}",
            x=heights,
            measured=np.array(shares),
            law=law,
            deviation=deviation,
        )
        curves.append(curve)
        distance = max(distance, curve.error_max * side)
    return curves, distance


def measure_latency(bench: TestBench) -> list[Curve]:
    """Return the time from a step by a factor of two to the first event, over the radiance after it.

    The radiance is constant then, so the photoreceptor has one time constant, and its output reaches the
    threshold C of a step of height h after -tau ln(1 - C / h).
    """
    radiance = np.logspace(-4.0, 0.0, bench.pick(17, 5))
    height = math.log(2.0)
    curves = []
    for preset in PHOTORECEPTORS:
        low_pass = make_preset(preset).low_pass
        assert low_pass is not None
        law = partial(_latency_s, make_preset(preset), height)
        for name, sign in (("ON", 1.0), ("OFF", -1.0)):
            after = np.log(radiance)
            log = np.stack([after - sign * height, after, after])[:, :, None]
            last_s = 20.0 * float(law(radiance).max())
            events = bench.expose(make_pixel(low_pass=low_pass), log, [0.0, 1e-9 * _STEP_NS, last_s])
            first_us = np.full(len(radiance), np.nan)
            rows, first = np.unique(events.y, return_index=True)
            first_us[rows] = events.t[first]
            # half the rise time passes before the middle of the step, and stamps are floored to 1 us
            measured_s = 1e-6 * (first_us + 0.5) - 0.5e-9 * _STEP_NS
            curves.append(Curve(name=f"{preset}, {name}", x=radiance, measured=measured_s, law=law))
    return curves


def _latency_s(config: EventCameraConfig, height: float, radiance: Floats) -> Floats:
    return -math.log(1.0 - THRESHOLD / height) / (2.0 * math.pi * corner_hz(config, radiance))


# ---- sine ------------------------------------------------------------------------------------------------


def corner_hz(config: EventCameraConfig, radiance: Floats) -> Floats:
    """Return the 3 dB frequency of the photoreceptor at a radiance [Hz]."""
    assert config.low_pass is not None
    dark, white = config.low_pass.dark_radiance, config.white_radiance
    return np.asarray(config.low_pass.cutoff_hz * np.minimum((radiance + dark) / (white + dark), 1.0))


def measure_gain(bench: TestBench) -> tuple[list[Curve], list[Curve]]:
    """Return the gain of photoreceptors over frequency, and where it is 3 dB down, over radiance.

    A sine of peak-to-peak size P makes, with thresholds C, P / C - 1 events of each polarity a cycle: the
    mean over all places of the levels, of which each pixel has another. So P is measured by counting, with
    thresholds far finer than those of a sensor. Expected is a first-order low-pass, 1 / sqrt(1 + (f/fc)^2).
    """
    gains, corners = [], []
    ratios = np.logspace(-1.0, 1.0, bench.pick(13, 5))
    for preset in PHOTORECEPTORS:
        config = make_preset(preset)
        radiance = np.logspace(-3.0, -0.1, bench.pick(5, 2))
        fine = EventCameraConfig(
            threshold_on=GAIN_THRESHOLD, threshold_off=GAIN_THRESHOLD, low_pass=config.low_pass
        )
        corner = corner_hz(config, radiance)
        found = []
        for light, at in zip(radiance, corner, strict=True):
            gain = np.array([_sine_gain(bench, fine, light, at, ratio) for ratio in ratios])
            name = f"{preset}, radiance {light:.2g}"
            gains.append(Curve(name=name, x=ratios * at, measured=gain, law=partial(_first_order, at)))
            # 1 / gain^2 - 1 = (f / fc)^2 at every frequency
            squares = 1.0 / gain**2 - 1.0
            usable = (ratios > 0.4) & (ratios < 4.0)
            found.append(at * float(np.exp(np.mean(np.log(ratios[usable] / np.sqrt(squares[usable]))))))
        law = partial(corner_hz, config)
        corners.append(Curve(name=preset, x=radiance, measured=np.array(found), law=law))
    return gains, corners


def _first_order(corner: float, frequency_hz: Floats) -> Floats:
    return np.asarray(1.0 / np.sqrt(1.0 + (frequency_hz / corner) ** 2))


def _sine_gain(
    bench: TestBench, config: EventCameraConfig, radiance: float, corner: float, ratio: float
) -> float:
    """Return the gain at one radiance and `ratio` times the 3 dB frequency [Hz]."""
    pixel_count = 16
    settled = math.ceil(_SETTLE * ratio / (2.0 * math.pi)) + 1  # cycles
    counted = 4
    phase = np.arange((settled + counted) * _FRAMES_PER_CYCLE + 1) / _FRAMES_PER_CYCLE
    wave = GAIN_AMPLITUDE * np.sin(2.0 * np.pi * phase)
    log = math.log(radiance) + np.repeat(wave[:, None, None], pixel_count, axis=2)
    log[0, 0] += GAIN_THRESHOLD * np.arange(pixel_count) / pixel_count  # where the levels lie
    time_s = phase / (ratio * corner)
    events = bench.expose(config, log, time_s)
    late = events.t >= 1e6 * time_s[settled * _FRAMES_PER_CYCLE]
    per_half_cycle = late.sum() / (2.0 * counted * pixel_count)
    return float((per_half_cycle + 1.0) * GAIN_THRESHOLD / (2.0 * GAIN_AMPLITUDE))


# ---- moving bar ------------------------------------------------------------------------------------------

_BAR_HEIGHT = 0.7
_BAR_EDGE_PX = 4.0
_BAR_SPEED_PX_S = 1000.0
_BAR_FRAMES_PER_PX = 4


_BAR_SLOPE = _BAR_HEIGHT * _BAR_SPEED_PX_S / _BAR_EDGE_PX
_BAR_MISMATCH = 0.02
_BAR_CUTOFF_HZ = 300.0


def measure_bar(bench: TestBench) -> tuple[list[BarTimes], list[Jitter]]:
    """Let an edge pass along rows of pixels, and compare when each fires with when an ideal one does.

    Log radiance of the edge rises linearly by 0.7 over 4 px, at 1000 px/s. Mismatch sigma moves the first
    event by sigma / slope; a low-pass delays it. How sharp the edge is left is the time from the first event
    of a pixel to its last.
    """
    width, rows = bench.pick(256, 96), bench.pick(16, 4)
    tau_s = 1.0 / (2.0 * math.pi * _BAR_CUTOFF_HZ)
    first_s, last_s = (_reached_s(count * THRESHOLD, tau_s) for count in (1, _bar_count(THRESHOLD)))
    ideal_s = (_bar_count(THRESHOLD) - 1.0) * THRESHOLD / _BAR_SLOPE
    spread = {"sigma_on": _BAR_MISMATCH, "sigma_off": _BAR_MISMATCH}
    models = (  # name, pixel; then by theory: delay, jitter, mean and deviation of the time to the last event
        ("ideal", make_pixel(), 0.0, 0.0, ideal_s, 0.0),
        (
            f"mismatch {_BAR_MISMATCH:g}",
            make_pixel(threshold_spread=spread),
            0.0,
            _BAR_MISMATCH / _BAR_SLOPE,
            *_mismatched_span_s(),
        ),
        (
            f"low-pass {_BAR_CUTOFF_HZ:g} Hz",
            make_pixel(low_pass={"cutoff_hz": _BAR_CUTOFF_HZ}, white_radiance=1e-3),
            first_s - THRESHOLD / _BAR_SLOPE,
            0.0,
            last_s - first_s,
            0.0,
        ),
    )
    times, jitters = [], []
    for name, config, delay_s, jitter_s, span_s, span_deviation_s in models:
        first, last = _edge_times(bench, config, width, rows)
        late_s = first - THRESHOLD / _BAR_SLOPE
        times.append(BarTimes(name=name, column=np.arange(width, dtype=float), late_s=late_s))
        jitters.append(
            Jitter(
                name=name,
                delay_s=float(late_s.mean()),
                delay_expected_s=delay_s,
                jitter_s=float(late_s.std()),
                jitter_expected_s=jitter_s,
                span_s=float((last - first).mean()),
                span_expected_s=span_s,
                span_deviation_s=span_deviation_s,
                count=late_s.size,
            )
        )
    return times, jitters


def _bar_count(threshold: float) -> int:
    """Return how many events the edge gives a pixel."""
    return int(_BAR_HEIGHT / threshold)


def _mismatched_span_s() -> tuple[float, float]:
    """Return mean and standard deviation of the time from first to last event under mismatch [s]."""
    threshold = THRESHOLD + _BAR_MISMATCH * np.linspace(-8.0, 8.0, 200_001)
    density = stats.norm.pdf(threshold, THRESHOLD, _BAR_MISMATCH)
    density /= density.sum()
    span_s = (np.floor(_BAR_HEIGHT / threshold) - 1.0) * threshold / _BAR_SLOPE
    mean_s = float((density * span_s).sum())
    return mean_s, math.sqrt(float((density * (span_s - mean_s) ** 2).sum()))


def _reached_s(level: float, tau_s: float) -> float:
    """Return when a low-passed edge reaches a level, after it comes [s].

    Until the end T of the ramp it is slope (t - tau (1 - e^(-t / tau))), then it approaches the height.
    """
    end_s = _BAR_EDGE_PX / _BAR_SPEED_PX_S

    def ramp(time_s: float) -> float:
        return _BAR_SLOPE * (time_s + tau_s * math.expm1(-time_s / tau_s))

    if level > ramp(end_s):
        return end_s + tau_s * math.log((_BAR_HEIGHT - ramp(end_s)) / (_BAR_HEIGHT - level))
    return float(brentq(lambda time_s: ramp(time_s) - level, 0.0, end_s, xtol=1e-12))


def _edge_times(bench: TestBench, config: EventCameraConfig, width: int, rows: int) -> tuple[Floats, Floats]:
    """Return when first and last events come after the edge came to a pixel [s], shape [rows, width]."""
    frame_count = _BAR_FRAMES_PER_PX * (width + int(_BAR_EDGE_PX) + 4) + 1
    place_px = np.arange(frame_count) / _BAR_FRAMES_PER_PX  # of the front
    column = np.arange(width)
    rise = np.clip((place_px[:, None] - column) / _BAR_EDGE_PX, 0.0, 1.0)
    log = np.repeat((_BAR_HEIGHT * rise)[:, None, :], rows, axis=1)
    events = bench.expose(config, log, place_px / _BAR_SPEED_PX_S)
    pixel = events.y.astype(np.int64) * width + events.x
    first_s, last_s = np.full((2, rows * width), np.nan)
    first_s[pixel[::-1]] = 1e-6 * (events.t[::-1] + 0.5)  # of equal indices the last assignment stays
    last_s[pixel] = 1e-6 * (events.t + 0.5)
    came_s = column / _BAR_SPEED_PX_S
    return first_s.reshape(rows, width) - came_s, last_s.reshape(rows, width) - came_s
