"""A test bench for event pixels: ramp, step, sine, darkness, readout.

Patterns with which sensors are characterised in a laboratory are shown to the pixel models, and what they do
is set beside the closed form of the law that they claim to follow. Log radiance is linear between frames, so
ramps and steps are exact. Patterns of still light are in `pixel_noise`.

Reference: Lichtsteiner, Posch, Delbruck (2008), A 128x128 120 dB 15 us latency asynchronous temporal contrast
vision sensor; McReynolds, Graca, Delbruck (2022), Experimental methods to predict dynamic vision sensor event
camera performance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from neurosim_core.bench import pixel_noise
from neurosim_core.bench.engine import EventCameraConfig, device_title, find_device
from neurosim_core.bench.options import Options, Progress, silent
from neurosim_core.bench.pixel_bench import (
    STAMP_S,
    THRESHOLD,
    Curve,
    Floats,
    TestBench,
    events_per_pixel,
    make_pixel,
    make_preset,
    rates_hz,
    still,
)
from neurosim_core.bench.report import Chapter, Claim, Panel, Plot, Row, Series, Table

SIGMA_MAX = 4.5
"""Largest deviation that is taken for chance, in standard deviations: about 1 run in 1000 of 100 points."""
DISTANCE_MAX = 1.95
"""Largest distance of two distributions that is, times the root of the number (Kolmogorov: 1 in 1000)."""
_GAIN_THRESHOLD, _GAIN_AMPLITUDE = 1e-3, 0.1
"""The threshold is so fine that the number of events measures an amplitude."""
_FRAMES_PER_CYCLE = 128
_PHOTORECEPTORS = ("dvs128", "v2e_noisy")
"""Presets with a low-pass."""
_NOISE_NOTE = "Rates are means over the pixels of a still scene [Hz]; sources are in event_presets.py."
_STEP_S = 1e-6
"""Rise time of a step."""


def measure(options: Options, progress: Progress = silent) -> Chapter:
    """Measure, and return the chapter."""
    bench = TestBench(device=find_device(options.device), quick=options.quick)
    curves: list[Curve] = []
    for pattern in (ramp, staircase, s_curves, latency, gain, *pixel_noise.PATTERNS):
        progress(pattern.__name__.replace("_", " "))
        curves += pattern(bench)
    progress("presets")
    presets = pixel_noise.measure_presets(bench)
    progress("noise of presets")
    figures = pixel_noise.measure_noise_figures(bench)
    claims = [*(_claim(rule, curves) for rule in _RULES), _preset_claim(presets, options.quick)]
    within = [row["within"] for row in figures]
    claims.append(
        Claim(
            "presets: the noise of a still scene is that of their sources, within the spread these have",
            "sources of the presets",
            f"{sum(within)} of {len(within)} figures",
            all(within),
        )
    )
    met = sum(claim.met is True for claim in claims)
    note = (
        "C is the threshold in natural log radiance, from the intervals on a ramp: mean and standard "
        "deviation over the pixels. Noise: events a second and pixel of a still scene at a tenth of white."
    )
    worst = "The largest of the points, and in standard deviations where chance has a part."
    return Chapter(
        name="pixel",
        title="A test bench for event pixels",
        summary=f"Patterns of light as in a laboratory, shown to pixels on {device_title(bench.device)}; "
        f"{met} of {len(claims)} closed forms are met. Marks are measured, lines are the closed form.",
        claims=claims,
        tables=[
            Table("pixel-presets", "Presets on the bench", presets, note),
            Table("pixel-noise", "Noise of presets beside their sources", figures, _NOISE_NOTE),
            Table("pixel-deviations", "Deviation from the closed forms", [c.row() for c in curves], worst),
        ],
        plots=[_plot(curves)],
    )


# Patterns of changing light


def ramp(bench: TestBench) -> list[Curve]:
    """Return rates over the slope of a ramp: ideal, with a refractory time, with a leak."""
    slopes = np.logspace(-1.0, 4.0, bench.pick(21, 6))
    leak = {"rate_hz": 10.0, "spread_decades": 0.0}
    models: dict[str, tuple[EventCameraConfig, Floats]] = {
        "ideal": (make_pixel(), slopes / THRESHOLD),
        "refractory 1 ms": (make_pixel(refractory_s=1e-3), 1.0 / (1e-3 + THRESHOLD / slopes)),
        "refractory 10 ms": (make_pixel(refractory_s=1e-2), 1.0 / (1e-2 + THRESHOLD / slopes)),
        "leak 10 Hz": (make_pixel(leak=leak), slopes / THRESHOLD + 10.0),
    }
    curves = []
    for name, (config, expected) in models.items():
        measured = []
        for slope, rate_hz in zip(slopes, expected, strict=True):
            duration_s = min(100.5 / rate_hz, 900.0 / slope)  # about 100 events, within the range of light
            log = np.array([0.0, slope * duration_s]).reshape(2, 1, 1)
            measured.append(rates_hz(bench.expose(config, log, [0.0, duration_s]), 1, 1)[0])
        curves.append(Curve("ramp: rate [Hz] over slope [1/s]", name, slopes, np.array(measured), expected))
    return curves


def staircase(bench: TestBench) -> list[Curve]:
    """Return the number of events over the height of a step, up and down."""
    heights = np.linspace(0.02, 1.5, bench.pick(75, 19)) + 1e-4  # not on a level
    curves = []
    for name, sign in (("ON", 1.0), ("OFF", -1.0)):
        log = np.stack([np.zeros_like(heights), sign * heights])[:, :, None]
        counts = events_per_pixel(bench.expose(make_pixel(), log, [0.0, _STEP_S]), 1, len(heights))
        expected = np.floor(heights / THRESHOLD)
        curves.append(Curve("step: events over height", name, heights, counts.astype(float), expected))
    return curves


def s_curves(bench: TestBench) -> list[Curve]:
    """Return the share of the pixels of a DAVIS346 that fire over the height of a step.

    The thresholds are normal, so it is Phi((height - C) / sigma).
    """
    config = make_preset("davis346", leak=None, readout=None)
    spread = config.threshold_spread
    assert spread is not None
    side = bench.pick(128, 32)
    curves = []
    for name, sign, mean, sigma in (
        ("ON", 1.0, config.threshold_on, spread.sigma_on),
        ("OFF", -1.0, config.threshold_off, spread.sigma_off),
    ):
        heights = mean + sigma * np.linspace(-3.0, 3.0, bench.pick(37, 13))
        shares = []
        for height in heights:
            log = still(0.0, side)
            log[1] = sign * height
            counts = events_per_pixel(bench.expose(config, log, [0.0, _STEP_S]), side, side * side)
            shares.append(float((counts > 0).mean()))
        expected = stats.norm(mean, sigma).cdf(heights)
        deviation = np.full_like(heights, 1.0 / side)  # Kolmogorov: D sqrt(n), n = side^2
        curves.append(
            Curve("step: share of pixels over height", name, heights, np.array(shares), expected, deviation)
        )
    return curves


def latency(bench: TestBench) -> list[Curve]:
    """Return the time from a step by a factor of two to the first event, over the radiance after it.

    The radiance is constant then, so the photoreceptor has one time constant, and its output reaches the
    threshold C of a step of height h after -tau ln(1 - C / h).
    """
    radiance = np.logspace(-4.0, 0.0, bench.pick(17, 5))
    height = math.log(2.0)
    curves = []
    for preset in _PHOTORECEPTORS:
        config = make_preset(preset)
        expected = -math.log(1.0 - THRESHOLD / height) / (2.0 * math.pi * corner_hz(config, radiance))
        for name, sign in (("ON", 1.0), ("OFF", -1.0)):
            after = np.log(radiance)
            log = np.stack([after - sign * height, after, after])[:, :, None]
            pixel = make_pixel(low_pass=config.low_pass)
            events = bench.expose(pixel, log, [0.0, _STEP_S, 20.0 * float(expected.max())])
            first_us = np.full(len(radiance), np.nan)
            rows, first = np.unique(events.y, return_index=True)
            first_us[rows] = events.t[first]
            # half the rise time passes before the middle of the step, and stamps are floored to 1 us
            measured = 1e-6 * (first_us + 0.5) - 0.5 * _STEP_S
            tolerance = STAMP_S + 1e-3 * expected
            title = "step: latency [s] over radiance"
            curves.append(Curve(title, f"{preset}, {name}", radiance, measured, expected, tolerance))
    return curves


def corner_hz(config: EventCameraConfig, radiance: Floats) -> Floats:
    """Return the 3 dB frequency of the photoreceptor at a radiance [Hz]."""
    assert config.low_pass is not None
    dark, white = config.low_pass.dark_radiance, config.white_radiance
    return np.asarray(config.low_pass.cutoff_hz * np.minimum((radiance + dark) / (white + dark), 1.0))


def gain(bench: TestBench) -> list[Curve]:
    """Return the gain of photoreceptors over frequency, and where it is 3 dB down, over radiance.

    A sine of peak-to-peak size P makes, with thresholds C, P / C - 1 events of each polarity a cycle: the
    mean over all places of the levels, of which each pixel has another. A first-order low-pass is expected.
    """
    gains, corners = [], []
    ratios = np.logspace(-1.0, 1.0, bench.pick(13, 5))
    for preset in _PHOTORECEPTORS:
        config = make_preset(preset)
        radiance = np.logspace(-3.0, -0.1, bench.pick(5, 2))
        fine = make_pixel(
            threshold_on=_GAIN_THRESHOLD, threshold_off=_GAIN_THRESHOLD, low_pass=config.low_pass
        )
        expected, found = corner_hz(config, radiance), []
        for light, at in zip(radiance, expected, strict=True):
            measured = np.array([_sine_gain(bench, fine, light, at, ratio) for ratio in ratios])
            law = 1.0 / np.sqrt(1.0 + ratios**2)
            gains.append(
                Curve(
                    "sine: gain over frequency [Hz]",
                    f"{preset}, radiance {light:.2g}",
                    ratios * at,
                    measured,
                    law,
                )
            )
            usable = (ratios > 0.4) & (ratios < 4.0)  # 1 / gain^2 - 1 = (f / fc)^2 at every frequency
            shift = np.log(ratios[usable] / np.sqrt(1.0 / measured[usable] ** 2 - 1.0))
            found.append(at * math.exp(shift.mean()))
        corners.append(
            Curve("sine: 3 dB frequency [Hz] over radiance", preset, radiance, np.array(found), expected)
        )
    return [*gains, *corners]


def _sine_gain(
    bench: TestBench, config: EventCameraConfig, radiance: float, corner: float, ratio: float
) -> float:
    """Return the gain at one radiance and `ratio` times the 3 dB frequency [Hz]."""
    pixel_count, counted = 16, 4
    settled = math.ceil(8.0 * ratio / (2.0 * math.pi)) + 1  # cycles until a transient is over: e^-8
    phase = np.arange((settled + counted) * _FRAMES_PER_CYCLE + 1) / _FRAMES_PER_CYCLE
    wave = _GAIN_AMPLITUDE * np.sin(2.0 * np.pi * phase)
    log = math.log(radiance) + np.repeat(wave[:, None, None], pixel_count, axis=2)
    log[0, 0] += _GAIN_THRESHOLD * np.arange(pixel_count) / pixel_count  # where the levels lie
    time_s = phase / (ratio * corner)
    events = bench.expose(config, log, time_s)
    late = events.t >= 1e6 * time_s[settled * _FRAMES_PER_CYCLE]
    per_half_cycle = late.sum() / (2.0 * counted * pixel_count)
    return float((per_half_cycle + 1.0) * _GAIN_THRESHOLD / (2.0 * _GAIN_AMPLITUDE))


# What is claimed


@dataclass(frozen=True)
class _Rule:
    """What is claimed of some curves."""

    patterns: tuple[str, ...]
    """Beginnings of their patterns."""
    deviation: str
    """Which deviation is judged: `error`, `relative` or `sigma` of `Curve`."""
    limit: float
    text: str
    reference: str


_RULES = (
    _Rule(
        ("ramp",), "relative", 1e-3,
        "ramp: rates are 1 / (t_ref + C / slope), and slope / C and the leak add up, to 0.1 %", "law of "
        "the pixel",
    ),
    _Rule(
        ("step: events",), "error", 0.0,
        "step: as many events as thresholds fit in, for every height, up and down", "Lichtsteiner et al. "
        "(2008)",
    ),
    _Rule(
        ("step: share",), "sigma", DISTANCE_MAX,
        f"step: S-curves of a DAVIS346 are those of normal thresholds (D sqrt(n) <= {DISTANCE_MAX})",
        "McReynolds et al. (2022); Kolmogorov-Smirnov",
    ),
    _Rule(
        ("step: latency",), "sigma", 1.0,
        "step: latency is -tau ln(1 - C / height) at all radiances, to 0.1 % and a stamp of 1 us",
        "first-order low-pass",
    ),
    _Rule(
        ("sine: gain",), "error", 0.01, "sine: the gain is that of a first-order low-pass, to 0.01",
        "first-order low-pass",
    ),
    _Rule(
        ("sine: 3 dB",), "relative", 0.01, "sine: the 3 dB frequency follows radiance, to 1 %",
        "Lichtsteiner et al. (2008)",
    ),
    _Rule(
        ("darkness: rate", "darkness: share of hot"), "sigma", SIGMA_MAX,
        f"darkness: rates of shot noise and leak, and the share of hot pixels, to {SIGMA_MAX} standard "
        "deviations",
        "Poisson and log-normal statistics",
    ),
    _Rule(
        ("darkness: share of longer",), "sigma", DISTANCE_MAX,
        f"darkness: intervals of shot noise are exponential (D sqrt(n) <= {DISTANCE_MAX})",
        "Kolmogorov-Smirnov",
    ),
    _Rule(
        ("readout",), "sigma", SIGMA_MAX,
        f"readout: throughput and the mean wait are those of queueing theory, to {SIGMA_MAX} standard "
        "deviations",
        "Pollaczek, Khinchine",
    ),
)  # fmt: skip


def _claim(rule: _Rule, curves: Sequence[Curve]) -> Claim:
    judged = [curve for curve in curves if curve.pattern.startswith(rule.patterns)]
    worst = max(judged, key=lambda curve: float(np.nan_to_num(getattr(curve, rule.deviation), nan=math.inf)))
    value = getattr(worst, rule.deviation)
    unit = {"error": "off", "relative": "off, relative", "sigma": "of what chance or tolerance allows"}
    said = f"{value:.2g} {unit[rule.deviation]} ({worst.name})"
    return Claim(rule.text, rule.reference, said, value <= rule.limit)


def _preset_claim(presets: Sequence[Row], quick: bool) -> Claim:
    thresholds = [abs(row[f"C {s}"] / row[f"C {s}, set"] - 1.0) for row in presets for s in ("on", "off")]
    noise = [
        abs(row["ON noise [Hz]"] / row["ON noise, theory [Hz]"] - 1.0)
        for row in presets
        if row["ON noise, theory [Hz]"] > 0.0
    ]
    allowed = 0.02 if quick else 0.01
    return Claim(
        f"presets: thresholds are found again to {allowed:.0%}, and the noise of a still scene to 5 %",
        "settings of the presets, and the theory of their noise",
        f"thresholds to {max(thresholds):.2g}, noise to {max(noise):.2g}",
        max(thresholds) <= allowed and max(noise) <= 0.05,
    )


def _plot(curves: Sequence[Curve]) -> Plot:
    """Draw a panel for each pattern: points are measured, lines are the closed form."""
    panels = []
    for pattern in dict.fromkeys(curve.pattern for curve in curves):
        mine = [curve for curve in curves if curve.pattern == pattern]
        y_label, _, x_label = pattern.partition(": ")[2].partition(" over ")
        series = []
        for curve in mine:
            series.append(
                Series(label=curve.name, x=curve.x.tolist(), y=curve.measured.tolist(), style="points")
            )
            law = {"label": "closed form", "colour_of": curve.name, "style": "law"}
            series.append(Series(x=curve.x.tolist(), y=curve.expected.tolist(), **law))  # type: ignore[arg-type]
        x = np.concatenate([curve.x for curve in mine])
        y = np.concatenate([curve.expected for curve in mine])
        panels.append(
            Panel(
                title=pattern.partition(":")[0],
                x_label=x_label,
                y_label=y_label,
                series=series,
                x_scale="log" if x.min() > 0.0 and x.max() >= 100.0 * x.min() else "linear",
                y_scale="log" if y.min() > 0.0 and y.max() >= 100.0 * y.min() else "linear",
            )
        )
    return Plot("pixel", "Event pixels: marks are measured, lines are the closed form", panels)
