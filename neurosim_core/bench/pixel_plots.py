"""Plots of the test bench of event pixels: marks are measured, lines are closed forms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from neurosim_core.bench.figures import COLORS, MARKERS, plain_ticks
from neurosim_core.bench.pixel_result import Curve, PixelResult
from neurosim_core.bench.report import Plot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def pixel_plots(result: PixelResult) -> list[Plot]:
    """Return a plot for each pattern."""
    return [
        Plot(name="pixel-ramp", title="Ramp", draw=lambda figure: _draw_ramp(result, figure)),
        Plot(name="pixel-step", title="Step", draw=lambda figure: _draw_step(result, figure)),
        Plot(name="pixel-sine", title="Sine", draw=lambda figure: _draw_sine(result, figure)),
        Plot(name="pixel-edge", title="Moving bar", draw=lambda figure: _draw_bar(result, figure)),
        Plot(name="pixel-noise", title="Darkness", draw=lambda figure: _draw_noise(result, figure)),
        Plot(name="pixel-readout", title="Readout", draw=lambda figure: _draw_readout(result, figure)),
        Plot(name="pixel-sensors", title="Presets", draw=lambda figure: _draw_presets(result, figure)),
    ]


def _draw_curves(
    axes: Axes, curves: Sequence[Curve], *, names: Sequence[str] | None = None, log: bool = True
) -> None:
    """Draw marks for what was measured, with bars of a standard deviation, on lines of what is expected."""
    for index, curve in enumerate(curves):
        color, marker = COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)]
        ends = float(curve.x.min()), float(curve.x.max())
        fine = np.geomspace(*ends, 500) if log else np.linspace(*ends, 500)
        axes.plot(fine, curve.law(fine), color=color, marker="", lw=1.2)
        axes.errorbar(
            curve.x,
            curve.measured,
            yerr=curve.deviation,
            color=color,
            marker=marker,
            ms=4.5,
            ls="",
            lw=1.0,
            mfc="none",
            label=curve.name if names is None else names[index],
        )


def _draw_ramp(result: PixelResult, figure: Figure) -> None:
    rate, threshold = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    _draw_curves(rate, result.ramp)
    rate.set(
        xscale="log",
        yscale="log",
        xlabel="slope of log radiance [1/s]",
        ylabel="event rate of a pixel [Hz]",
        title="rate: 1 / (t_ref + C / slope), slope / C + leak",
    )
    rate.legend()
    error = 100.0 * (result.threshold.measured / result.threshold.expected - 1.0)
    threshold.plot(result.threshold.x, error, ls="-", lw=0.8, mfc="none")
    threshold.axhline(0.0, color="0.3", lw=1.0)
    threshold.set(
        xscale="log",
        xlabel="slope of log radiance [1/s]",
        ylabel="error of the threshold [%]",
        title="threshold = slope / rate",
    )
    threshold.set_ylim(-0.12, 0.12)


def _draw_step(result: PixelResult, figure: Figure) -> None:
    figure.set_size_inches(8.0, 7.2)
    (stairs, share), (latency, late) = figure.subplots(2, 2)
    for curve, color, marker, sign in zip(result.staircase, COLORS, MARKERS, (1.0, -1.0), strict=False):
        fine = np.linspace(0.0, curve.x.max(), 1000)
        stairs.plot(sign * fine, sign * curve.law(fine), color=color, marker="", lw=1.0)
        stairs.plot(
            sign * curve.x, sign * curve.measured, color=color, marker=marker, ms=3.5, ls="", mfc="none",
            label=curve.name,
        )  # fmt: skip
    stairs.set(
        xlabel="step of log radiance", ylabel="events (OFF downwards)", title="events: floor(step / C)"
    )
    stairs.legend()
    _draw_curves(share, result.s_curve, log=False)
    share.set(
        xlabel="height of the step",
        ylabel="share of pixels that fire",
        title="S-curves: Phi((step - C) / sigma)",
    )
    share.legend(fontsize=7, loc="upper left")
    share.set_ylim(-0.03, 1.3)
    _draw_curves(latency, result.latency)
    latency.set(
        xscale="log",
        yscale="log",
        xlabel="radiance after the step [white = 1]",
        ylabel="latency of the first event [s]",
        title="latency: -tau ln(1 - C / step)",
    )
    latency.legend(fontsize=7)
    for curve, color, marker in zip(result.latency, COLORS, MARKERS, strict=False):
        error_us = 1e6 * (curve.measured - curve.expected)
        late.plot(curve.x, error_us, color=color, marker=marker, ls="-", lw=0.6, mfc="none", label=curve.name)
    late.axhspan(-0.5, 0.5, color="0.85", lw=0.0, label="stamps of 1 us")
    late.set(xscale="log", xlabel="radiance after the step [white = 1]", ylabel="measured - theory [us]")
    late.set_title("error of the latency")
    late.set_ylim(-2.0, 2.0)
    late.legend(fontsize=7)


def _draw_sine(result: PixelResult, figure: Figure) -> None:
    panels = figure.subplots(1, len(result.corner) + 1, width_ratios=[*([1.0] * len(result.corner)), 0.9])
    for axes, corner in zip(panels, result.corner, strict=False):
        curves = [curve for curve in result.gain if curve.name.startswith(corner.name)]
        _draw_curves(axes, curves, names=[curve.name.split("radiance ")[1] for curve in curves])
        axes.axhline(0.5**0.5, color="0.4", ls="--", lw=1.0, marker="")
        axes.set(xscale="log", yscale="log", xlabel="frequency [Hz]", title=f"photoreceptor of {corner.name}")
        plain_ticks(axes.yaxis)
        axes.legend(title="radiance", fontsize=7, title_fontsize=7, loc="lower left")
    panels[0].set_ylabel("gain, from the number of events a cycle (dashed: -3 dB)")
    _draw_curves(panels[-1], result.corner)
    panels[-1].set(
        xscale="log",
        yscale="log",
        xlabel="radiance [white = 1]",
        ylabel="3 dB frequency [Hz]",
        title="3 dB over light",
    )
    panels[-1].legend()


def _draw_bar(result: PixelResult, figure: Figure) -> None:
    along, spread = figure.subplots(1, 2, width_ratios=(2.2, 1.0), sharey=True)
    for times, row, color, marker in zip(result.bar, result.jitter, COLORS, MARKERS, strict=False):
        late_us = 1e6 * times.late_s
        along.plot(times.column, late_us[0], color=color, marker=marker, ms=3.0, ls="", label=times.name)
        along.axhline(1e6 * row.delay_expected_s, color=color, lw=1.0, marker="")
        if row.jitter_expected_s > 0.0:
            place = np.linspace(-4.0, 4.0, 200)
            density = np.exp(-0.5 * place**2) / np.sqrt(2.0 * np.pi)
            spread.plot(
                density, 1e6 * (row.delay_expected_s + place * row.jitter_expected_s), color=color, marker=""
            )
            edges = np.linspace(-4.0, 4.0, 33)
            found, _ = np.histogram(
                (times.late_s.ravel() - row.delay_expected_s) / row.jitter_expected_s, edges, density=True
            )
            middle = 0.5 * (edges[1:] + edges[:-1])
            found_us = 1e6 * (row.delay_expected_s + middle * row.jitter_expected_s)
            spread.plot(found, found_us, color=color, marker=marker, ls="", ms=3.5, mfc="none")
    along.set(
        xlabel="column [px]",
        ylabel="first event after that of an ideal pixel [us]",
        title="an edge along a row, 1000 px/s",
    )
    along.legend()
    spread.set(xlabel="density [1/sigma]", title="sigma = mismatch / slope")


def _draw_noise(result: PixelResult, figure: Figure) -> None:
    figure.set_size_inches(8.0, 7.2)
    (rate, interval), (leak, hot) = figure.subplots(2, 2)
    _draw_curves(rate, result.dark)
    rate.set(
        xscale="log",
        yscale="log",
        xlabel="radiance [white = 1]",
        ylabel="events a second and pixel [Hz]",
        title="still scene: rate over light",
    )
    rate.legend(fontsize=7)
    _draw_curves(interval, [result.survival], log=False)
    interval.set(
        yscale="log",
        xlabel="interval [s]",
        ylabel="share of longer intervals",
        title="shot noise: exp(-rate t)",
    )
    interval.set_ylim(2e-5, 1.5)
    _draw_curves(leak, [result.competition])
    leak.set(
        xscale="log",
        xlabel="shot noise that resets the pixel [Hz]",
        ylabel="leak events [Hz]",
        title="leak of 1 Hz, reset at random",
    )
    _draw_curves(hot, [result.hot])
    hot.set(xscale="log", yscale="log", xlabel="share set", ylabel="share found", title="hot pixels")


def _draw_readout(result: PixelResult, figure: Figure) -> None:
    out, batch, wait = figure.subplots(1, 3)
    _draw_curves(out, result.throughput)
    out.set(
        xscale="log",
        yscale="log",
        xlabel="rate in [Hz]",
        ylabel="rate out [Hz]",
        title="min(in, bandwidth)",
    )
    out.legend(fontsize=7)
    _draw_curves(batch, [result.batch], log=False)
    batch.ticklabel_format(axis="x", style="sci", scilimits=(0, 0))
    batch.set(
        yscale="log", xlabel="rate in [Hz]", ylabel="events read with a row", title="x row_s / (1 - x / B)"
    )
    _draw_curves(wait, [result.wait], log=False)
    wait.set(yscale="log", xlabel="load of the arbiter", ylabel="mean wait [s]", title="M/D/1 queue")


def _draw_presets(result: PixelResult, figure: Figure) -> None:
    """Draw thresholds with their mismatch, and the noise of a still scene, sensor by sensor."""
    threshold, noise = figure.subplots(1, 2, sharey=True, width_ratios=(1.3, 1.0))
    places = np.arange(len(result.presets), dtype=float)
    for kind, color, marker, shift in (
        ("on", COLORS[0], MARKERS[0], -0.12),
        ("off", COLORS[1], MARKERS[1], 0.12),
    ):
        rows = places + shift
        value, expected = (
            np.array([getattr(row, f"threshold_{kind}{end}") for row in result.presets])
            for end in ("", "_expected")
        )
        spread = [getattr(row, f"mismatch_{kind}") for row in result.presets]
        threshold.plot(expected, rows, color=color, marker="|", ms=12, ls="")
        threshold.errorbar(
            value, rows, xerr=spread, color=color, marker=marker, ls="", mfc="none", lw=1.0, capsize=2.0,
            label=kind.upper(),
        )  # fmt: skip
        rate, theory = (
            np.array([getattr(row, f"dark_{kind}{end}_hz") for row in result.presets])
            for end in ("", "_expected")
        )
        shown = theory > 1e-6
        noise.plot(theory[shown], rows[shown], color=color, marker="|", ms=12, ls="")
        noise.plot(rate[shown], rows[shown], color=color, marker=marker, ls="", mfc="none")
    threshold.set_yticks(places, [row.name for row in result.presets])
    threshold.invert_yaxis()
    threshold.set(
        xlabel="threshold in log radiance, and mismatch (bars)", title="on a ramp (strokes: as set)"
    )
    threshold.set_xlim(left=0.0)
    threshold.legend()
    noise.set(xscale="log", xlabel="events a second and pixel [Hz]", title="still scene (strokes: theory)")
