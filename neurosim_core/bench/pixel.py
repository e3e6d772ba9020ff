"""A test bench for event pixels: ramp, step, sine, and the noise of the presets.

Patterns with which sensors are characterised in a laboratory are shown to the pixel models, and what they do
is set beside the closed form of the law that they claim to follow, or beside the figures of their sources.
Log radiance is linear between frames, so ramps and steps are exact.

Reference: Lichtsteiner, Posch, Delbruck (2008), A 128x128 120 dB 15 us latency asynchronous temporal contrast
vision sensor; McReynolds, Graca, Delbruck (2022), Experimental methods to predict dynamic vision sensor event
camera performance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from neurosim_core.bench import engine
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Panel, Plot, Row, Series, Table

Floats = NDArray[np.float64]

THRESHOLD = 0.2
DISTANCE_MAX = 1.95
"""Largest distance of two distributions that is, times the root of the number (Kolmogorov: 1 in 1000)."""
_GAIN_THRESHOLD, _GAIN_AMPLITUDE = 1e-3, 0.1
"""The threshold is so fine that the number of events measures an amplitude."""
_FRAMES_PER_CYCLE = 128
_PHOTORECEPTORS = ("dvs128", "v2e_noisy")
"""Presets with a low-pass."""
_STAMP_S = 1e-6
"""Resolution of stamps."""
_STEP_S = 1e-6
"""Rise time of a step."""
_CLAIMS = {
    "ramp": ("rates are 1 / (t_ref + C / slope), and slope / C and the leak add up, to 0.1 %",
             "law of the pixel"),
    "step: share": (f"S-curves of a DAVIS346 are those of normal thresholds (D sqrt(n) <= {DISTANCE_MAX})",
                    "McReynolds et al. (2022); Kolmogorov-Smirnov"),
    "step: latency": ("latency is -tau ln(1 - C / height) at all radiances, to 0.1 % and a stamp of 1 us",
                      "first-order low-pass"),
    "sine: gain": ("the gain is that of a first-order low-pass, to 0.01", "first-order low-pass"),
    "sine: 3 dB": ("the 3 dB frequency follows radiance, to 1 %", "Lichtsteiner et al. (2008)"),
}  # fmt: skip
"""Beginning of a pattern -> what is claimed of it, and the reference."""


def measure(options: Options) -> Chapter:
    """Measure, and return the chapter."""
    bench = TestBench(device=engine.find_device(options.device), quick=options.quick)
    curves: list[Curve] = []
    for pattern in (ramp, s_curves, latency, gain):
        options.progress(pattern.__name__.replace("_", " "))
        curves += pattern(bench)
    options.progress("presets")
    figures = measure_noise_figures(bench)
    within = [row["within"] for row in figures]
    text = "presets: the noise of a still scene is that of their sources, within the spread these have"
    said = f"{sum(within)} of {len(within)} figures"
    claims = [*claims_of(curves), Claim(text, "sources of the presets", said, all(within))]
    met = sum(claim.met is True for claim in claims)
    noise = "Rates are means over the pixels of a still scene [Hz]; sources are in event_presets.yaml."
    return Chapter(
        name="pixel",
        title="A test bench for event pixels",
        summary="Patterns of light as in a laboratory, shown to pixels on "
        f"{engine.device_title(bench.device)}; {met} of {len(claims)} claims are met. "
        "Marks are measured, lines are the closed form.",
        claims=claims,
        tables=[Table("pixel-noise", "Noise of presets beside their sources", figures, noise)],
        plots=[_plot(curves)],
    )


def claims_of(curves: Sequence[Curve]) -> list[Claim]:
    """Judge curves; a claim without curves is left out."""
    claims = []
    for beginning, (text, reference) in _CLAIMS.items():
        judged = [curve for curve in curves if curve.pattern.startswith(beginning)]
        if judged:
            worst = max(judged, key=lambda curve: curve.worst)
            said = f"{worst.worst:.2g} of what is allowed ({worst.name})"
            claims.append(Claim(f"{beginning}: {text}", reference, said, worst.worst <= 1.0))
    return claims


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity that was measured at several settings, and its closed form; arrays have shape [n]."""

    pattern: str
    """Pattern: quantity over setting, with units."""
    name: str
    x: Floats
    """Settings."""
    measured: Floats
    expected: Floats
    """The closed form at the settings."""
    allowed: ArrayLike
    """How far from it a measurement may be, for each setting, or one for all."""

    @property
    def worst(self) -> float:
        """Largest deviation, as a share of what is allowed; inf where a measurement is nan."""
        share = np.abs(self.measured - self.expected) / self.allowed
        return float(np.nan_to_num(share, nan=math.inf).max())


@dataclass(frozen=True, kw_only=True)
class TestBench:
    """Shows patterns to pixels; a quick one few settings to few pixels."""

    __test__ = False  # pytest would collect it

    device: str
    quick: bool

    def pick(self, full: int, quick: int) -> int:
        """Return a size that depends on how much is measured."""
        return quick if self.quick else full

    def expose(
        self, config: engine.EventCameraConfig, log: Floats, time_s: Sequence[float] | Floats
    ) -> engine.EventArrays:
        """Return the events of pixels that begin at the first frame: log radiance [K, H, W] at times [K]."""
        _, height, width = log.shape
        camera = engine.EventCamera(config, width=width, height=height, device=self.device, sensor="bench")
        stamps = np.rint(1e9 * np.asarray(time_s)).astype(np.int64)
        frames = log.astype(np.float32)
        camera.reset(frames[0], int(stamps[0]))
        return camera.feed(frames[1:], stamps[1:]).numpy()


def make_pixel(**settings: Any) -> engine.EventCameraConfig:
    """Return pixels with both thresholds 0.2 and whatever else is asked for."""
    thresholds = {"threshold_on": THRESHOLD, "threshold_off": THRESHOLD}
    return engine.EventCameraConfig.model_validate({**thresholds, **settings})


def make_preset(name: str, **settings: Any) -> engine.EventCameraConfig:
    """Return the pixels of a preset, with some settings in place of its own."""
    return engine.EventCameraConfig.model_validate({"preset": name, **settings})


def events_per_pixel(events: engine.EventArrays, side: int) -> NDArray[np.int64]:
    """Return the number of events of each of side x side pixels, shape [side^2]."""
    return np.bincount(events.y.astype(np.int64) * side + events.x, minlength=side * side)


def rate_hz(events: engine.EventArrays) -> float:
    """Return the rate of one pixel from its first to its last event; nan if it has one."""
    count = len(events.t)
    return float((count - 1) / (1e-6 * np.ptp(events.t))) if count > 1 else math.nan


# Patterns of light


def ramp(bench: TestBench) -> list[Curve]:
    """Return rates over the slope of a ramp: ideal, with a refractory time, with a leak."""
    slopes = np.logspace(-1.0, 4.0, bench.pick(21, 6))
    leak = {"rate_hz": 10.0, "spread_decades": 0.0}
    models: dict[str, tuple[engine.EventCameraConfig, Floats]] = {
        "ideal": (make_pixel(), slopes / THRESHOLD),
        "refractory 1 ms": (make_pixel(refractory_s=1e-3), 1.0 / (1e-3 + THRESHOLD / slopes)),
        "refractory 10 ms": (make_pixel(refractory_s=1e-2), 1.0 / (1e-2 + THRESHOLD / slopes)),
        "leak 10 Hz": (make_pixel(leak=leak), slopes / THRESHOLD + 10.0),
    }
    curves = []
    for name, (config, expected) in models.items():
        measured = []
        for slope, law_hz in zip(slopes, expected, strict=True):
            duration_s = min(100.5 / law_hz, 900.0 / slope)  # about 100 events, within the range of light
            log = np.array([0.0, slope * duration_s]).reshape(2, 1, 1)
            measured.append(rate_hz(bench.expose(config, log, [0.0, duration_s])))
        title = "ramp: rate [Hz] over slope [1/s]"
        curves.append(Curve(title, name, slopes, np.array(measured), expected, 1e-3 * expected))
    return curves


def s_curves(bench: TestBench) -> list[Curve]:
    """Return the share of DAVIS346 pixels that fire over the height of a step: Phi((height - C) / sigma)."""
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
            log = np.zeros((2, side, side))
            log[1] = sign * height
            counts = events_per_pixel(bench.expose(config, log, [0.0, _STEP_S]), side)
            shares.append(float((counts > 0).mean()))
        expected = stats.norm(mean, sigma).cdf(heights)
        title, allowed = "step: share of pixels over height", DISTANCE_MAX / side  # D sqrt(n), n = side^2
        curves.append(Curve(title, name, heights, np.array(shares), expected, allowed))
    return curves


def latency(bench: TestBench) -> list[Curve]:
    """Return the time from a step by a factor of two to the first event, over the radiance after it.

    The photoreceptor has one time constant then: its output reaches the threshold C of a step of height h
    after -tau ln(1 - C / h).
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
            tolerance = _STAMP_S + 1e-3 * expected
            title = "step: latency [s] over radiance"
            curves.append(Curve(title, f"{preset}, {name}", radiance, measured, expected, tolerance))
    return curves


def corner_hz(config: engine.EventCameraConfig, radiance: Floats) -> Floats:
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
        thresholds = dict.fromkeys(("threshold_on", "threshold_off"), _GAIN_THRESHOLD)
        fine = make_pixel(**thresholds, low_pass=config.low_pass)
        expected, found = corner_hz(config, radiance), []
        for light, at in zip(radiance, expected, strict=True):
            measured = np.array([_sine_gain(bench, fine, light, at, ratio) for ratio in ratios])
            law = 1.0 / np.sqrt(1.0 + ratios**2)
            title, name = "sine: gain over frequency [Hz]", f"{preset}, radiance {light:.2g}"
            gains.append(Curve(title, name, ratios * at, measured, law, 0.01))
            usable = (ratios > 0.4) & (ratios < 4.0)  # 1 / gain^2 - 1 = (f / fc)^2 at every frequency
            shift = np.log(ratios[usable] / np.sqrt(1.0 / measured[usable] ** 2 - 1.0))
            found.append(at * math.exp(shift.mean()))
        title = "sine: 3 dB frequency [Hz] over radiance"
        corners.append(Curve(title, preset, radiance, np.array(found), expected, 0.01 * expected))
    return [*gains, *corners]


def _sine_gain(
    bench: TestBench, config: engine.EventCameraConfig, radiance: float, corner: float, ratio: float
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


# Presets


def measure_noise_figures(bench: TestBench) -> list[Row]:
    """Return a row for each figure that the source of a preset has of noise, beside what the preset does."""
    figures = {name: preset["noise"] for name, preset in engine.event_presets().items() if "noise" in preset}
    names = ("davis346", "gen3") if bench.quick else tuple(figures)
    side, seconds = bench.pick(96, 48), bench.pick(60, 20)
    rows: list[Row] = []
    for name in names:
        found: dict[float, dict[str, float]] = {}
        config = make_preset(name, readout=None)
        white_lux = config.measured_noise.white_lux if config.measured_noise else 1000.0
        for figure in figures[name]:
            lux, quantity, given, spread = (figure[key] for key in ("lux", "quantity", "value", "spread"))
            if lux not in found:
                log = np.full((2, side, side), math.log(config.white_radiance * lux / white_lux))
                events = bench.expose(config, log, [0.0, float(seconds)])
                found[lux] = _noise_statistics(events, side, seconds)
            value = found[lux][quantity]
            row: Row = {"preset": name, "light [lux]": lux, "quantity": quantity}
            row |= {"preset's": value, "source's": given, "its spread": spread}
            rows.append({**row, "within": abs(value - given) <= spread})
    return rows


def _noise_statistics(events: engine.EventArrays, side: int, seconds: float) -> dict[str, float]:
    count, on = events_per_pixel(events, side), int(events.polarity.sum())
    rates = {"ON rate": on, "OFF rate": len(events.t) - on, "rate": len(events.t)}
    spread = math.log1p(max(float(count.var() - count.mean()), 0.0) / max(float(count.mean()), 1e-9) ** 2)
    return {
        **{name: number / (side * side * seconds) for name, number in rates.items()},
        "ON share": on / max(len(events.t), 1),
        "spread": math.sqrt(spread) / math.log(10.0),
    }


def _plot(curves: Sequence[Curve]) -> Plot:
    """Draw a panel for each pattern: points are measured, lines are the closed form."""
    panels = []
    for pattern in dict.fromkeys(curve.pattern for curve in curves):
        mine = [curve for curve in curves if curve.pattern == pattern]
        y_label, _, x_label = pattern.partition(": ")[2].partition(" over ")
        series = []
        for curve in mine:
            x = curve.x.tolist()
            series.append(Series(label=curve.name, x=x, y=curve.measured.tolist(), style="points"))
            series.append(Series(label="closed form", x=x, y=curve.expected.tolist(), style="law"))
        spans = {"x": np.hstack([c.x for c in mine]), "y": np.hstack([c.expected for c in mine])}
        wide = [axis for axis, v in spans.items() if v.min() > 0.0 and v.max() >= 100.0 * v.min()]
        title, log = pattern.partition(":")[0], "".join(wide)
        panels.append(Panel(title=title, x_label=x_label, y_label=y_label, series=series, log=cast(Any, log)))
    return Plot("pixel", "Event pixels: marks are measured, lines are the closed form", panels)
