"""A test bench for event pixels: ramp, step, sine, moving bar, darkness, readout.

What a sensor is characterised with in a laboratory is shown to the pixel models, and what they do is set
beside the closed form of the law that they claim to follow. The patterns are in `pixel_response` and
`pixel_noise`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from neurosim_core.bench import pixel_noise, pixel_response
from neurosim_core.bench.pixel_bench import TestBench
from neurosim_core.bench.pixel_plots import pixel_plots
from neurosim_core.bench.pixel_result import Curve, Jitter, PixelResult, PresetRow
from neurosim_core.bench.report import Bar, Chapter, Table

SIGMA_MAX = 4.5
"""Largest deviation that is taken for chance, in standard deviations: about 1 run in 1000 of 100 points."""
DISTANCE_MAX = 1.95
"""Largest distance of two distributions that is, times the root of the number (Kolmogorov: 1 in 1000)."""
STAMP_S = 1e-6
"""Resolution of stamps [s]."""


def measure_pixel(
    *, quick: bool = False, device: str = "auto", progress: Callable[[str], None] | None = None
) -> PixelResult:
    """Put the pixel models on the bench.

    Args:
        quick: Few settings, few pixels.
        device: Where the pixels are.
        progress: Told what is measured next.
    """
    tell = progress or (lambda _: None)
    device = ("cuda:0" if wp.get_cuda_device_count() else "cpu") if device == "auto" else device
    bench = TestBench(device=device, quick=quick)
    tell("ramp (kernels are compiled on the first run)")
    ramp, threshold = pixel_response.measure_ramp(bench)
    tell("step")
    staircase = pixel_response.measure_staircase(bench)
    s_curve, s_curve_distance = pixel_response.measure_s_curves(bench)
    latency = pixel_response.measure_latency(bench)
    tell("sine")
    gain, corner = pixel_response.measure_gain(bench)
    tell("moving bar")
    bar, jitter = pixel_response.measure_bar(bench)
    tell("darkness")
    dark = pixel_noise.measure_dark(bench)
    survival, survival_distance = pixel_noise.measure_survival(bench)
    competition = pixel_noise.measure_competition(bench)
    hot = pixel_noise.measure_hot(bench)
    tell("readout")
    throughput = pixel_noise.measure_throughput(bench)
    batch = pixel_noise.measure_batch(bench)
    wait = pixel_noise.measure_wait(bench)
    tell("presets")
    return PixelResult(
        quick=quick,
        device=str(wp.get_device(device).name),
        ramp=ramp,
        threshold=threshold,
        staircase=staircase,
        s_curve=s_curve,
        s_curve_distance=s_curve_distance,
        latency=latency,
        gain=gain,
        corner=corner,
        bar=bar,
        jitter=jitter,
        dark=dark,
        survival=survival,
        survival_distance=survival_distance,
        competition=competition,
        hot=hot,
        throughput=throughput,
        batch=batch,
        wait=wait,
        presets=pixel_noise.measure_presets(bench),
    )


def pixel_chapter(result: PixelResult) -> Chapter:
    """Return the answer in words, tables and plots."""
    bars = _bars(result)
    return Chapter(
        name="pixel",
        title="A test bench for event pixels",
        summary=_summary(result, bars),
        command=f"neurosim bench pixel{' --quick' if result.quick else ''}",
        bars=bars,
        tables=[_preset_table(result), _curve_table(result), _jitter_table(result)],
        plots=pixel_plots(result),
    )


def _bars(result: PixelResult) -> list[Bar]:
    return [*_ramp_bars(result), *_step_bars(result), *_sine_bars(result), *_bar_bars(result),
            *_dark_bars(result), *_readout_bars(result), *_preset_bars(result)]  # fmt: skip


def _ramp_bars(result: PixelResult) -> list[Bar]:
    threshold = result.threshold.relative_error_max
    rate = max(curve.relative_error_max for curve in result.ramp)
    return [
        Bar(
            text="ramp: the rate of an ideal pixel gives its threshold back, to 0.1 %",
            measured=f"to {threshold:.2g} (stamps have 1 us)",
            met=threshold <= 1e-3,
        ),
        Bar(
            text="ramp: rates are 1 / (t_ref + C / slope) with a refractory time, and slope / C and the leak "
            "add up, to 0.1 %",
            measured=f"to {rate:.2g}",
            met=rate <= 1e-3,
        ),
    ]


def _step_bars(result: PixelResult) -> list[Bar]:
    wrong = sum(int((curve.measured != curve.expected).sum()) for curve in result.staircase)
    steps = sum(len(curve.x) for curve in result.staircase)
    late = max(_late(curve) for curve in result.latency)
    return [
        Bar(
            text="step: as many events as thresholds fit in, for every height, up and down",
            measured=f"{wrong} of {steps} counts differ",
            met=wrong == 0,
        ),
        Bar(
            text="step: S-curves of a DAVIS346 are those of normal thresholds (Kolmogorov-Smirnov, "
            f"D sqrt(n) <= {DISTANCE_MAX})",
            measured=f"{result.s_curve_distance:.2f}",
            met=result.s_curve_distance <= DISTANCE_MAX,
        ),
        Bar(
            text="step: latency is -tau ln(1 - C / height) at all radiances, to 0.1 % and a stamp of 1 us",
            measured=f"{late:.2g} of that tolerance",
            met=late <= 1.0,
        ),
    ]


def _late(curve: Curve) -> float:
    """Return the largest error of a latency, as a share of what is allowed."""
    allowed = STAMP_S + 1e-3 * curve.expected
    return float((np.abs(curve.measured - curve.expected) / allowed).max())


def _sine_bars(result: PixelResult) -> list[Bar]:
    corner = max(curve.relative_error_max for curve in result.corner)
    gain = max(curve.error_max for curve in result.gain)
    return [
        Bar(
            text="sine: the gain is that of a first-order low-pass to 0.01, and its 3 dB frequency follows "
            "radiance to 1 %",
            measured=f"gain to {gain:.2g}, 3 dB frequency to {corner:.2g}",
            met=gain <= 0.01 and corner <= 0.01,
        )
    ]


def _bar_bars(result: PixelResult) -> list[Bar]:
    worst = max(_jitter_sigma(row) for row in result.jitter)
    return [
        Bar(
            text="bar: delay, jitter and sharpness along a row are those of mismatch and low-pass, to "
            f"{SIGMA_MAX} standard deviations and a stamp of 1 us",
            measured=f"{worst:.2g} standard deviations",
            met=worst <= SIGMA_MAX,
        )
    ]


def _jitter_sigma(row: Jitter) -> float:
    """Return how far delay, jitter and sharpness are off, in standard deviations."""
    deviation_s = row.jitter_expected_s / math.sqrt(row.count)
    return max(
        _sigma(row.delay_s - row.delay_expected_s, deviation_s),
        _sigma(row.jitter_s - row.jitter_expected_s, deviation_s / math.sqrt(2.0)),
        _sigma(row.span_s - row.span_expected_s, row.span_deviation_s / math.sqrt(row.count)),
    )


def _sigma(error_s: float, deviation_s: float) -> float:
    """Return an error beyond a stamp in standard deviations."""
    beyond_s = max(0.0, abs(error_s) - STAMP_S)
    return beyond_s / deviation_s if deviation_s > 0.0 else math.inf if beyond_s > 0.0 else 0.0


def _dark_bars(result: PixelResult) -> list[Bar]:
    rates = max(curve.sigma_max for curve in (*result.dark, result.competition, result.hot))
    return [
        Bar(
            text="darkness: rates of shot noise, leak and first passages over radiance, of leak that noise "
            f"resets, and the share of hot pixels are those of theory, to {SIGMA_MAX} standard deviations",
            measured=f"{rates:.2g} standard deviations",
            met=rates <= SIGMA_MAX,
        ),
        Bar(
            text=f"darkness: intervals of shot noise are exponential (D sqrt(n) <= {DISTANCE_MAX})",
            measured=f"{result.survival_distance:.2f}",
            met=result.survival_distance <= DISTANCE_MAX,
        ),
    ]


def _readout_bars(result: PixelResult) -> list[Bar]:
    worst = max(curve.sigma_max for curve in (*result.throughput, result.batch, result.wait))
    return [
        Bar(
            text="readout: throughput, events a row and the mean wait are those of queueing theory, to "
            f"{SIGMA_MAX} standard deviations",
            measured=f"{worst:.2g} standard deviations",
            met=worst <= SIGMA_MAX,
        )
    ]


def _preset_bars(result: PixelResult) -> list[Bar]:
    threshold = max(
        abs(measured / expected - 1.0)
        for row in result.presets
        for measured, expected in (
            (row.threshold_on, row.threshold_on_expected),
            (row.threshold_off, row.threshold_off_expected),
        )
    )
    noise = max(abs(row.dark_on_hz - row.dark_on_expected_hz) / row.dark_on_expected_hz
                for row in result.presets if row.dark_on_expected_hz > 0.0)  # fmt: skip
    allowed = 0.02 if result.quick else 0.01
    return [
        Bar(
            text=f"presets: the thresholds that are set are found again to {allowed:.0%}, and the noise of a "
            "still scene to 5 %",
            measured=f"thresholds to {threshold:.2g}, noise to {noise:.2g}",
            met=threshold <= allowed and noise <= 0.05,
        )
    ]


def _summary(result: PixelResult, bars: Sequence[Bar]) -> str:
    met = sum(bar.met is True for bar in bars)
    slowest = min(result.corner, key=lambda curve: float(curve.expected.min()))
    wait = result.wait
    return "\n".join(
        [
            f"Patterns of light as in a laboratory, shown to pixels on {result.device}; {met} of {len(bars)} "
            "closed forms are met. Marks are measured, lines are the closed form.",
            "",
            f"- A ramp gives the threshold back to {result.threshold.relative_error_max:.1g}; a pixel fires "
            f"at most once in its refractory time.",
            f"- The photoreceptor of {slowest.name} passes {slowest.measured.max():.3g} Hz near white and "
            f"{slowest.measured.min():.2g} Hz in the dark; there an edge is seen "
            f"{1e3 * max(c.measured.max() for c in result.latency):.3g} ms late.",
            f"- Still pixels fire {_rates(result)} a second, from dark to white.",
            f"- An event waits {1e6 * wait.measured[-1]:.0f} us for an arbiter that is busy "
            f"{wait.x[-1]:.0%} of the time with 100 us for each.",
        ]
    )


def _rates(result: PixelResult) -> str:
    return ", ".join(
        f"{curve.measured[0]:.2g} to {curve.measured[-1]:.2g} times ({curve.name})" for curve in result.dark
    )


def _preset_table(result: PixelResult) -> Table:
    columns = {
        "name": "preset",
        "threshold_on": "C on",
        "threshold_on_expected": "set",
        "threshold_off": "C off",
        "threshold_off_expected": "set ",
        "mismatch_on": "mismatch on",
        "mismatch_on_expected": "set  ",
        "mismatch_off": "mismatch off",
        "mismatch_off_expected": "set   ",
        "dark_on_hz": "ON noise [Hz]",
        "dark_on_expected_hz": "theory",
        "dark_off_hz": "OFF noise [Hz]",
        "dark_off_expected_hz": "theory ",
        "corner_hz": "3 dB at white [Hz]",
        "refractory_s": "refractory [s]",
        "bandwidth_hz": "readout [Hz]",
    }
    return Table(
        name="pixel-presets",
        title="Presets on the bench",
        columns=columns,
        rows=[_preset_cells(row, columns) for row in result.presets],
        note="C is the threshold in natural log radiance, from the intervals on a ramp: mean and standard "
        "deviation over the pixels. Noise: events a second and pixel of a still scene at a tenth of white. "
        "The last three columns are settings; what they do is measured above. Sources: event_presets.py.",
    )


def _preset_cells(row: PresetRow, columns: dict[str, str]) -> dict[str, object]:
    return {key: value for key, value in dataclasses.asdict(row).items() if key in columns}


def _curve_table(result: PixelResult) -> Table:
    groups = {
        "ramp: rate [Hz] over slope [1/s]": result.ramp,
        "ramp: threshold over slope [1/s]": [result.threshold],
        "step: events over height": result.staircase,
        "step: share of pixels over height": result.s_curve,
        "step: latency [s] over radiance": result.latency,
        "sine: gain over frequency [Hz]": result.gain,
        "sine: 3 dB frequency [Hz] over radiance": result.corner,
        "darkness: rate [Hz] over radiance": result.dark,
        "darkness: share of longer intervals over time [s]": [result.survival],
        "darkness: leak [Hz] over rate of resets [Hz]": [result.competition],
        "darkness: share of hot pixels over share set": [result.hot],
        "readout: rate out [Hz] over rate in [Hz]": result.throughput,
        "readout: events a row over rate in [Hz]": [result.batch],
        "readout: wait [s] over load": [result.wait],
    }
    rows = [
        {
            "pattern": pattern,
            "curve": curve.name,
            "points": len(curve.x),
            "from": float(curve.x.min()),
            "to": float(curve.x.max()),
            "error": curve.error_max,
            "relative_error": _relative(curve),
            "sigma": curve.sigma_max,
        }
        for pattern, curves in groups.items()
        for curve in curves
    ]
    return Table(
        name="pixel-deviations",
        title="Deviation from the closed forms",
        columns={
            "pattern": "pattern",
            "curve": "curve",
            "points": "points",
            "from": "from",
            "to": "to",
            "error": "largest error",
            "relative_error": "relative",
            "sigma": "in standard deviations",
        },
        rows=rows,
        note="Of the largest among the points. Standard deviations where chance has a part.",
    )


def _relative(curve: Curve) -> float | None:
    return curve.relative_error_max if (curve.expected != 0.0).all() else None


def _jitter_table(result: PixelResult) -> Table:
    return Table(
        name="pixel-bar",
        title="Times of an edge along a row",
        columns={
            "name": "pixel",
            "delay_s": "delay [s]",
            "delay_expected_s": "theory",
            "jitter_s": "jitter [s]",
            "jitter_expected_s": "theory ",
            "span_s": "first to last event [s]",
            "span_expected_s": "theory  ",
            "count": "pixels",
        },
        rows=[
            {k: v for k, v in dataclasses.asdict(row).items() if k != "span_deviation_s"}
            for row in result.jitter
        ],
        note="An edge of 0.7 in log radiance, 4 px wide, at 1000 px/s: the first event of each pixel, after "
        "that of an ideal one. Jitter is the standard deviation along the rows.",
    )
