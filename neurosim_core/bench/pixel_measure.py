"""The patterns of light of a test bench for event pixels, and what theory says they give.

Light is given as log radiance that is linear between frames, so ramps and steps are exact; a sine has 128
frames a cycle. Pixels of one row or picture see the same unless a pattern moves: what differs between them is
mismatch and noise.

Reference: Lichtsteiner, Posch, Delbruck (2008), A 128x128 120 dB 15 us latency asynchronous temporal
contrast vision sensor (threshold, latency and bandwidth as they are measured here); McReynolds, Graca,
Delbruck (2022), Experimental methods to predict dynamic vision sensor event camera performance (S-curves,
noise over light).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import brentq

from neurosim_core.bench.pixel_result import BarTimes, Curve, Floats, Jitter, PresetRow
from neurosim_core.packets import EventArrays
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_presets import PRESETS
from neurosim_core.sensors.events import EventCamera

THRESHOLD = 0.2
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


class TestBench:
    """Shows patterns to pixels.

    Attributes:
        device: Warp device.
        quick: Few settings and pixels.
    """

    def __init__(self, *, device: str, quick: bool) -> None:
        self.device = device
        self.quick = quick

    def pick(self, full: int, quick: int) -> int:
        """Return a size that depends on how much is measured."""
        return quick if self.quick else full

    def expose(
        self,
        config: EventCameraConfig,
        log_radiance: Floats,
        time_s: Sequence[float] | Floats,
        *,
        seed: int = 0,
    ) -> EventArrays:
        """Return the events of pixels that begin at the first frame.

        Args:
            config: What the pixels are like.
            log_radiance: Shape [K, H, W].
            time_s: When, shape [K].
            seed: Of the noise.
        """
        _, height, width = log_radiance.shape
        camera = EventCamera(
            config, width=width, height=height, device=self.device, sensor="bench", seed=seed, on_host=True
        )
        stamps = np.rint(1e9 * np.asarray(time_s)).astype(np.int64)
        frames = log_radiance.astype(np.float32)
        camera.reset(frames[0], int(stamps[0]))
        return camera.feed(frames[1:], stamps[1:]).numpy()


def make_pixel(**settings: Any) -> EventCameraConfig:
    """Return pixels with both thresholds 0.2 and whatever else is asked for."""
    return EventCameraConfig.model_validate(
        {"threshold_on": THRESHOLD, "threshold_off": THRESHOLD, **settings}
    )


def make_preset(name: str, **settings: Any) -> EventCameraConfig:
    """Return the pixels of a preset, with some settings in place of its own."""
    return EventCameraConfig.model_validate({"preset": name, **settings})


def _still(level: float, *, height: int, width: int, count: int = 2) -> Floats:
    return np.full((count, height, width), level)


def _per_pixel(events: EventArrays, width: int, count: int) -> NDArray[np.int64]:
    """Return the number of events of each pixel, shape [count]."""
    pixel = events.y.astype(np.int64) * width + events.x
    return np.bincount(pixel, minlength=count)


def _rates_hz(events: EventArrays, width: int, count: int) -> Floats:
    """Return the rate of each pixel from its first to its last event, shape [count]; nan if it has one."""
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")
    pixel, t = pixel[order], events.t[order]
    found, first, number = np.unique(pixel, return_index=True, return_counts=True)
    rates = np.full(count, np.nan)
    several = number > 1
    span_s = 1e-6 * (t[first + number - 1] - t[first])[several]
    rates[found[several]] = (number[several] - 1) / span_s
    return rates


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
        measured.append(_rates_hz(bench.expose(config, log, [0.0, duration_s]), 1, 1)[0])
    return Curve(name=name, x=slopes, measured=np.array(measured), law=rate)


# ---- step ------------------------------------------------------------------------------------------------


def measure_staircase(bench: TestBench) -> list[Curve]:
    """Return the number of events over the height of a step, up and down."""
    heights = np.linspace(0.02, 1.5, bench.pick(75, 19)) + 1e-4  # not on a level
    curves = []
    for name, sign in (("ON", 1.0), ("OFF", -1.0)):
        log = np.stack([np.zeros_like(heights), sign * heights])[:, :, None]
        events = bench.expose(make_pixel(), log, [0.0, 1e-9 * _STEP_NS])
        counts = _per_pixel(events, 1, len(heights))
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
            log = np.concatenate([_still(0.0, height=side, width=side, count=1)] * 2)
            log[1] = sign * height
            events = bench.expose(config, log, [0.0, 1e-9 * _STEP_NS])
            shares.append(float((_per_pixel(events, side, side * side) > 0).mean()))
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


# ---- darkness --------------------------------------------------------------------------------------------


def measure_dark(bench: TestBench) -> list[Curve]:
    """Return rates of events of still pixels over radiance: shot noise, leak, and first passages."""
    radiance = np.logspace(-3.0, 0.0, bench.pick(10, 4))
    shot = make_preset("v2e_noisy").shot_noise
    assert shot is not None
    leak_hz, decades = 0.1, 0.1
    leak = make_pixel(leak={"rate_hz": leak_hz, "spread_decades": decades})
    spread = math.log(10.0) * decades
    mean_leak_hz = leak_hz * math.exp(spread**2 / 2.0)
    side = bench.pick(64, 24)
    seconds = bench.pick(40, 10)
    pixel_s = side * side * seconds
    curves = []
    found = _dark_rates(bench, make_pixel(shot_noise=shot), radiance, side, seconds)
    for polarity, name, share in ((1, "ON", shot.on_fraction), (0, "OFF", 1.0 - shot.on_fraction)):
        law = partial(_shot_hz, share * shot.rate_hz, shot.bright_factor)
        curves.append(
            Curve(
                name=f"shot noise, {name}",
                x=radiance,
                measured=found[polarity],
                law=law,
                deviation=np.sqrt(law(radiance) / pixel_s),
            )
        )
    found = _dark_rates(bench, leak, radiance, side, seconds)
    # rates differ from pixel to pixel, and so does the phase at which they are cut off
    variance = (leak_hz * math.exp(spread**2 / 2.0)) ** 2 * math.expm1(spread**2)
    variance += (1.0 / 6.0 + 1.0 / 12.0) / seconds**2
    curves.append(
        Curve(
            name="leak, ON",
            x=radiance,
            measured=found[1],
            law=lambda light: np.full_like(light, mean_leak_hz),
            deviation=np.full_like(radiance, math.sqrt(variance) / side),
        )
    )
    return [*curves, _dark_passages(bench, radiance, side, seconds)]


def _shot_hz(dark_hz: float, bright_factor: float, radiance: Floats) -> Floats:
    return dark_hz * (1.0 + (bright_factor - 1.0) * radiance)


def _dark_passages(bench: TestBench, radiance: Floats, side: int, seconds: float) -> Curve:
    """Return the rate of ON events of DVS-Voltmeter's DAVIS346, which leaks more in the light."""
    config = make_preset("voltmeter_dvs346")
    found = _dark_rates(bench, config, radiance, side, seconds)
    return Curve(
        name="DVS-Voltmeter, ON",
        x=radiance,
        measured=found[1],
        law=lambda radiance: np.array([_passage_rates(config, light)[0] for light in radiance]),
        # drift outweighs diffusion: the counts of a pixel differ by one, by the phase at which it begins
        deviation=np.full_like(radiance, 0.5 / (side * seconds)),
    )


def _dark_rates(
    bench: TestBench, config: EventCameraConfig, radiance: Floats, side: int, seconds: float
) -> Floats:
    """Return rates a pixel of OFF and ON events [Hz], shape [2, n]."""
    rates = []
    for number, light in enumerate(radiance):
        log = _still(math.log(light), height=side, width=side)
        events = bench.expose(config, log, [0.0, float(seconds)], seed=number)
        on = int(events.polarity.sum())
        rates.append([len(events.t) - on, on])
    return np.asarray(np.array(rates, dtype=float).T / (side * side * seconds))


def measure_survival(bench: TestBench) -> tuple[Curve, float]:
    """Return how intervals of shot noise are distributed, and the distance from the exponential law."""
    rate_hz, side, seconds = 10.0, bench.pick(32, 12), 20.0
    config = make_pixel(shot_noise={"rate_hz": rate_hz, "bright_factor": 1.0, "spread_decades": 0.0})
    events = bench.expose(config, _still(0.0, height=side, width=side), [0.0, seconds])
    pixel = events.y.astype(np.int64) * side + events.x
    order = np.argsort(pixel, kind="stable")
    # long intervals do not fit before the end: those that begin shortly before it are left out
    begins = events.t[order][:-1] < 0.9e6 * seconds
    interval_s = 1e-6 * np.diff(events.t[order])[(np.diff(pixel[order]) == 0) & begins]
    interval_s = np.sort(interval_s)
    distance = stats.kstest(interval_s, stats.expon(scale=1.0 / rate_hz).cdf).statistic
    time_s = np.linspace(0.0, 1.0, 41)
    measured = 1.0 - np.searchsorted(interval_s, time_s) / len(interval_s)
    expected = np.exp(-rate_hz * time_s)
    curve = Curve(
        name="shot noise",
        x=time_s,
        measured=measured,
        law=lambda time_s: np.exp(-rate_hz * time_s),
        deviation=np.sqrt(np.maximum(expected * (1.0 - expected), 1e-12) / len(interval_s)),
    )
    return curve, float(distance * math.sqrt(len(interval_s)))


def measure_competition(bench: TestBench) -> Curve:
    """Return the rate of leak events of pixels that shot noise resets.

    Resets come at rate l, the leak needs T = 1 / r from one to its event: an event comes first with
    probability e^(-lT), and it does so at the rate l e^(-lT) / (1 - e^(-lT)).
    """
    leak_hz = 1.0
    noise_hz = np.logspace(-1.0, 1.0, bench.pick(9, 4))
    side, seconds, begin_s = bench.pick(48, 16), 50.0, 10.0  # a pixel begins at a random phase of its leak
    rates = []
    for number, rate_hz in enumerate(noise_hz):
        config = make_pixel(
            leak={"rate_hz": leak_hz, "spread_decades": 0.0},
            shot_noise={"rate_hz": rate_hz, "bright_factor": 1.0, "on_fraction": 0.0, "spread_decades": 0.0},
        )
        events = bench.expose(config, _still(0.0, height=side, width=side), [0.0, seconds], seed=number)
        leaked = (events.polarity == 1) & (events.t > 1e6 * begin_s)
        late = EventArrays(*(column[leaked] for column in events))
        rates.append(_per_pixel(late, side, side * side) / (seconds - begin_s))
    return Curve(
        name="leak among shot noise",
        x=noise_hz,
        measured=np.array([rate.mean() for rate in rates]),
        law=lambda noise_hz: noise_hz / np.expm1(noise_hz / leak_hz),
        deviation=np.array([max(float(rate.std()), 0.1 / seconds) / side for rate in rates]),
    )


def measure_hot(bench: TestBench) -> Curve:
    """Return the share of pixels that are found hot: those with more than a quarter of the rate."""
    side = bench.pick(256, 64)
    fractions = np.array([3e-4, 1e-3, 3e-3, 1e-2])
    shares = []
    for fraction in fractions:
        config = make_pixel(hot_pixels={"fraction": fraction, "rate_hz": 100.0})
        events = bench.expose(config, _still(0.0, height=side, width=side), [0.0, 1.0])
        shares.append(float((_per_pixel(events, side, side * side) > 25).mean()))
    deviation = np.sqrt(fractions * (1.0 - fractions)) / side
    return Curve(
        name="hot pixels", x=fractions, measured=np.array(shares), law=lambda f: f, deviation=deviation
    )


# ---- readout ---------------------------------------------------------------------------------------------


def measure_throughput(bench: TestBench) -> list[Curve]:
    """Return the rate out of two readouts over the rate in, when events come at random.

    Both read as many as come, until that is the bandwidth; what then waits in vain is dropped.
    """
    bandwidth_hz, side, seconds = 1e5, 32, 0.5
    loads = np.array([0.1, 0.2, 0.4, 0.6, 0.8, 1.25, 1.6, 2.0, 3.0])[:: bench.pick(1, 2)]
    curves = []
    for kind, name in (("event", "event by event"), ("row", "row by row")):
        rates = []
        for number, load in enumerate(loads):
            shot = _random_light(load * bandwidth_hz / side**2)
            readout = {"kind": kind, "bandwidth_hz": bandwidth_hz, "row_s": 0.0, "queue_length": 1000}
            config = make_pixel(shot_noise=shot, readout=readout)
            log = _still(0.0, height=side, width=side)
            events = bench.expose(config, log, [0.0, seconds], seed=number)
            rates.append(np.count_nonzero(events.t < 1e6 * seconds) / seconds)
        # Poisson below the bandwidth; at it, the queue fills first, and the last row may be under way
        deviation = np.where(loads < 1.0, np.sqrt(loads * bandwidth_hz / seconds), 1e-3 * bandwidth_hz)
        curves.append(
            Curve(
                name=name,
                x=loads * bandwidth_hz,
                measured=np.array(rates),
                law=lambda rate_hz: np.minimum(rate_hz, bandwidth_hz),
                deviation=deviation,
            )
        )
    return curves


def _random_light(rate_hz: float) -> dict[str, float]:
    """Return shot noise of the same rate in all pixels [Hz]: events that come at random."""
    return {"rate_hz": rate_hz, "bright_factor": 1.0, "spread_decades": 0.0}


def measure_batch(bench: TestBench) -> Curve:
    """Return how many events are read together with a row, over the rate in.

    Rows are visited in turn and never empty here: with rows that take row_s and bandwidth B, those that come
    at the rate x while all others are visited are n = x row_s / (1 - x / B) on average (gated polling).
    """
    bandwidth_hz, row_s, height, width = 1e6, 1e-4, 16, 64
    loads = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])[:: bench.pick(1, 3)]
    seconds = bench.pick(2, 1)
    sizes, deviations = [], []
    for number, load in enumerate(loads):
        rate_hz = load * bandwidth_hz
        readout = {"kind": "row", "bandwidth_hz": bandwidth_hz, "row_s": row_s, "queue_length": 1 << 20}
        config = make_pixel(shot_noise=_random_light(rate_hz / (height * width)), readout=readout)
        log = _still(0.0, height=height, width=width)
        events = bench.expose(config, log, [0.0, float(seconds)], seed=number)
        late = events.t > 0.2e6 * seconds  # it began empty
        latch = events.t[late] * height + events.y[late]
        _, size = np.unique(latch, return_counts=True)
        size = size[:-1]  # the last may be incomplete
        parts = [part.mean() for part in np.array_split(size, 10)]
        sizes.append(size.mean())
        deviations.append(np.std(parts, ddof=1) / math.sqrt(len(parts)))
    return Curve(
        name="events per row",
        x=loads * bandwidth_hz,
        measured=np.array(sizes),
        law=lambda rate_hz: rate_hz * row_s / (1.0 - rate_hz / bandwidth_hz),
        deviation=np.array(deviations),
    )


def measure_wait(bench: TestBench) -> Curve:
    """Return how long events wait for the arbiter when they come at random.

    A queue with Poisson arrivals and constant service: rho / (2 mu (1 - rho)) by Pollaczek and Khinchine.
    The deviation is that of the means of 20 parts of the time.
    """
    bandwidth_hz = 1e4
    loads = np.array([0.1, 0.3, 0.5, 0.7, 0.8])[:: bench.pick(1, 2)]
    seconds, side = float(bench.pick(40, 8)), 16
    waits, deviations = [], []
    for number, load in enumerate(loads):
        shot = _random_light(load * bandwidth_hz / side**2)
        readout = {"kind": "event", "bandwidth_hz": bandwidth_hz, "queue_length": 1 << 18}
        log = _still(0.0, height=side, width=side)
        came, read = (
            bench.expose(config, log, [0.0, seconds], seed=number).t
            for config in (make_pixel(shot_noise=shot), make_pixel(shot_noise=shot, readout=readout))
        )
        wait_s = 1e-6 * (read - came[: len(read)])  # first come, first served
        parts = [part.mean() for part in np.array_split(wait_s, 20)]
        waits.append(wait_s.mean())
        deviations.append(np.std(parts, ddof=1) / math.sqrt(len(parts)))
    return Curve(
        name="wait",
        x=loads,
        measured=np.array(waits),
        law=lambda load: load / (2.0 * bandwidth_hz * (1.0 - load)),
        deviation=np.array(deviations),
    )


# ---- presets ---------------------------------------------------------------------------------------------


def measure_presets(bench: TestBench) -> list[PresetRow]:
    """Put the pixels of all presets on the bench: thresholds on a slow ramp, noise in a still scene."""
    names = ("davis346", "v2e_noisy", "voltmeter_dvs346") if bench.quick else tuple(PRESETS)
    return [_measure_preset(bench, name) for name in names]


def _measure_preset(bench: TestBench, name: str) -> PresetRow:
    config = make_preset(name, readout=None)
    nominal = make_preset(name)
    spread = config.threshold_spread
    on, off = (_preset_threshold(bench, config, sign) for sign in (1.0, -1.0))
    on_hz, off_hz = _preset_noise(bench, config)
    expected_on, expected_off = _expected_noise(config)
    stochastic = config.stochastic
    return PresetRow(
        name=name,
        title=PRESETS[name].title,
        threshold_on=on[0],
        threshold_on_expected=1.0 / stochastic.k1 if stochastic else config.threshold_on,
        threshold_off=off[0],
        threshold_off_expected=1.0 / stochastic.k1 if stochastic else config.threshold_off,
        mismatch_on=on[1],
        mismatch_on_expected=spread.sigma_on if spread else 0.0,
        mismatch_off=off[1],
        mismatch_off_expected=spread.sigma_off if spread else 0.0,
        dark_on_hz=on_hz,
        dark_on_expected_hz=expected_on,
        dark_off_hz=off_hz,
        dark_off_expected_hz=expected_off,
        corner_hz=config.low_pass.cutoff_hz if config.low_pass else math.inf,
        refractory_s=config.refractory_s,
        bandwidth_hz=nominal.readout.bandwidth_hz if nominal.readout else math.inf,
    )


def _preset_threshold(bench: TestBench, config: EventCameraConfig, sign: float) -> tuple[float, float]:
    """Return mean and standard deviation of the thresholds of pixels, from the intervals on a ramp.

    The ramp is above white, where the photoreceptor has one time constant, and fast against noise; the
    refractory time is taken off.
    """
    side, slope, seconds = bench.pick(64, 24), 20.0, 1.0
    plain = config.model_copy(update={"shot_noise": None, "leak": None, "hot_pixels": None})
    log = np.zeros((2, side, side))
    log[1 if sign > 0.0 else 0] = slope * seconds
    if config.stochastic is not None:  # its law is linear in ln(light + k2), its white is 255
        seconds, k2 = 0.002, config.stochastic.k2  # fast against its leak
        dim = 0.02
        log[1 if sign > 0.0 else 0] = 0.0
        log[0 if sign > 0.0 else 1] = math.log(dim)
        slope = math.log((255.0 + k2) / (255.0 * dim + k2)) / seconds
    events = bench.expose(plain, log, [0.0, seconds])
    interval_s = 1.0 / _rates_hz(events, side, side * side)
    thresholds = slope * (interval_s - config.refractory_s)
    return float(np.nanmean(thresholds)), float(np.nanstd(thresholds))


_PRESET_RADIANCE = 0.1


def _preset_noise(bench: TestBench, config: EventCameraConfig) -> tuple[float, float]:
    """Return the rates of ON and OFF events of a still pixel [Hz]."""
    side, seconds = bench.pick(64, 24), bench.pick(100, 20)
    off_hz, on_hz = _dark_rates(bench, config, np.array([_PRESET_RADIANCE]), side, seconds)
    return float(on_hz[0]), float(off_hz[0])


def _expected_noise(config: EventCameraConfig) -> tuple[float, float]:
    """Return the rates of ON and OFF events of a still pixel by theory [Hz].

    Leak alone has the mean of log-normal rates. Shot noise comes at l / (1 + l t_ref), and leaves the leak no
    time if it comes far more often.
    """
    if config.stochastic is not None:
        return _passage_rates(config, _PRESET_RADIANCE)
    leak_hz = 0.0
    if config.leak is not None:
        spread = math.log(10.0) * config.leak.spread_decades
        leak_hz = config.leak.rate_hz * math.exp(spread**2 / 2.0)
    if (shot := config.shot_noise) is None:
        return leak_hz, 0.0
    rate_hz = shot.rate_hz * (1.0 + (shot.bright_factor - 1.0) * _PRESET_RADIANCE)
    leak_hz = rate_hz / math.expm1(rate_hz / leak_hz) if leak_hz else 0.0
    rate_hz /= 1.0 + rate_hz * config.refractory_s
    return leak_hz + rate_hz * shot.on_fraction, rate_hz * (1.0 - shot.on_fraction)


def _passage_rates(config: EventCameraConfig, radiance: float) -> tuple[float, float]:
    """Return the rates of ON and OFF events of a Brownian motion with drift [Hz].

    Between -1 and 1, with drift m and variance v, it leaves after tanh(m / v) / m on average, and upwards
    with probability 1 / (1 + exp(-2 m / v)) (Karatzas and Shreve, 1991, section 3.5).
    """
    law = config.stochastic
    assert law is not None
    light = 255.0 * radiance / config.white_radiance
    drift_hz = 1e6 * (law.k4 + law.k5 * light)
    variance_hz = 1e6 * (law.k3 * math.sqrt(light) / (light + law.k2) + law.k6) ** 2
    rate_hz = drift_hz / math.tanh(drift_hz / variance_hz)
    off_hz = rate_hz / (1.0 + math.exp(min(2.0 * drift_hz / variance_hz, 700.0)))
    return rate_hz - off_hz, off_hz
