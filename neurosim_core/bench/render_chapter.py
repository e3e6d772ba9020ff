"""The chapter of `neurosim bench render`: what was promised, the answer in words, tables, plots."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from neurosim_core.bench.figures import COLORS, plain_ticks
from neurosim_core.bench.render_result import (
    CHECK_PX,
    DEFAULT,
    POINT,
    REFERENCE_SAMPLES,
    PanEvents,
    RenderResult,
    Sampling,
)
from neurosim_core.bench.report import Bar, Chapter, Plot, Table
from neurosim_core.sensors.events import EventCameraConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FALSE_EVENTS_BAR = 10.0
"""How many times fewer false events the default settings are to give than point sampling."""


def render_chapter(result: RenderResult) -> Chapter:
    """Return the answer in words, tables and plots."""
    return Chapter(
        name="render",
        title="Rendering: error against run time, and false events from aliasing",
        summary=_summary(result),
        command=f"neurosim bench render{' --quick' if result.quick else ''}",
        bars=[_false_events_bar(result)],
        tables=[_picture_table(result), _pan_table(result)],
        plots=[
            Plot(
                name="render-error",
                title="Error of log radiance against the time of a picture",
                draw=lambda figure: _draw_error(result, figure),
            ),
            Plot(
                name="render-aliasing",
                title="What a pan over a fine checkerboard makes of aliasing",
                draw=lambda figure: _draw_aliasing(result, figure),
            ),
        ],
    )


def _of(result: RenderResult, sampling: Sampling) -> PanEvents:
    return next(row for row in result.pan if row.sampling == sampling)


def _summary(result: RenderResult) -> str:
    point, default = _of(result, POINT), _of(result, DEFAULT)
    lines = [
        f"Reference: {REFERENCE_SAMPLES} samples per pixel. Its own error is {result.reference_rms:.3f} "
        f"(root mean square of log radiance, checkerboard, against {16 * REFERENCE_SAMPLES} samples); an "
        f"event is {EventCameraConfig().threshold_on:g}. Pictures are {result.width}x{result.height}, on "
        f"{result.device}.",
        "",
    ]
    for scene in dict.fromkeys(row.scene for row in result.pictures):
        rows = {row.sampling: row for row in result.pictures if row.scene == scene}
        best = min(rows.values(), key=lambda row: row.rms)
        lines.append(
            f"- {scene}: {rows[DEFAULT].rms:.3f} by default in {1e3 * rows[DEFAULT].picture_s:.1f} ms, "
            f"{rows[POINT].rms:.3f} by point sampling, {best.rms:.3f} at best ({best.sampling}) in "
            f"{best.picture_s / rows[DEFAULT].picture_s:.1f} times the time."
        )
    lines += [
        f"- A pan at {result.pan_speed_px_s:g} px/s over squares of at most {CHECK_PX:g} px: of "
        f"{point.true_count:,} true events the default misses {default.missing_count:,} "
        f"({default.missing_count / point.true_count:.0%}: texture is averaged over the long side of a "
        f"pixel's footprint, which takes detail as well as aliasing) and adds {default.false_count:,} false "
        f"ones; point sampling misses {point.missing_count:,} and adds {point.false_count:,}.",
    ]
    return "\n".join(lines)


def _false_events_bar(result: RenderResult) -> Bar:
    point, default = _of(result, POINT).false_count, _of(result, DEFAULT).false_count
    return Bar(
        text=f"with defaults at least {FALSE_EVENTS_BAR:g} times fewer false events than with point "
        "sampling, on a slow pan over a fine checkerboard",
        measured=f"{point / max(default, 1):,.0f} times fewer: {default:,} against {point:,}",
        met=point >= FALSE_EVENTS_BAR * max(default, 1),
    )


def _picture_table(result: RenderResult) -> Table:
    return Table(
        name="render-pictures",
        title="Error of log radiance and time of a picture",
        columns={
            "scene": "scene",
            "samples_per_pixel": "samples per pixel",
            "texture_filter": "texture filter",
            "mip_bias": "mip bias",
            "rms": "RMS error",
            "p99": "99 % of errors below",
            "picture_ms": "time [ms]",
        },
        rows=[
            {
                "scene": row.scene,
                **dataclasses.asdict(row.sampling),
                "rms": row.rms,
                "p99": row.p99,
                "picture_ms": 1e3 * row.picture_s,
            }
            for row in result.pictures
        ],
        note=f"Log radiance is a natural logarithm. {result.width}x{result.height} px, best of three.",
    )


def _pan_table(result: RenderResult) -> Table:
    return Table(
        name="render-aliasing",
        title="Events of a slow pan over a fine checkerboard",
        columns={
            "samples_per_pixel": "samples per pixel",
            "texture_filter": "texture filter",
            "mip_bias": "mip bias",
            "event_count": "events",
            "true_count": "of the reference",
            "missing_count": "missing",
            "wrong_polarity_count": "wrong polarity",
            "spurious_count": "spurious",
            "false_count": "false",
            "picture_ms": "time of a picture [ms]",
        },
        rows=[
            {
                **dataclasses.asdict(row.sampling),
                "event_count": row.event_count,
                "true_count": row.true_count,
                "missing_count": row.missing_count,
                "wrong_polarity_count": row.wrong_polarity_count,
                "spurious_count": row.spurious_count,
                "false_count": row.false_count,
                "picture_ms": 1e3 * row.picture_s,
            }
            for row in result.pan
        ],
        note=f"{result.pan_width}x{result.pan_height} px, {result.pan_s:g} s at {result.pan_speed_px_s:g} "
        f"px/s, rendered at {result.pan_rate_hz:g} Hz. Two events are the same if pixel and polarity are, "
        f"and times differ by at most {1e3 * result.tolerance_s:g} ms (half a pixel). False: no such event "
        "in the reference; wrong polarity: one of the other polarity is there.",
    )


def _draw_error(result: RenderResult, figure: Figure) -> None:
    """Draw one line per filter and bias, over the number of samples."""
    scenes = list(dict.fromkeys(row.scene for row in result.pictures))
    panels = np.atleast_1d(figure.subplots(1, len(scenes), sharey=True))
    for axes, scene in zip(panels, scenes, strict=True):
        rows = [row for row in result.pictures if row.scene == scene]
        for key in dict.fromkeys((row.sampling.texture_filter, row.sampling.mip_bias) for row in rows):
            line = [row for row in rows if (row.sampling.texture_filter, row.sampling.mip_bias) == key]
            name = (
                key[0] if key[0] != "trilinear" else f"trilinear, bias {key[1]:+g}" if key[1] else "trilinear"
            )
            axes.loglog([1e3 * row.picture_s for row in line], [row.rms for row in line], label=name)
        axes.axhline(EventCameraConfig().threshold_on, color="0.5", ls="--", lw=1.0, marker="")
        axes.set(xlabel="time of a picture [ms]", title=scene)
        plain_ticks(axes.xaxis)
    plain_ticks(panels[0].yaxis)
    panels[0].set_ylabel("RMS error of log radiance (dashed: one event)")
    samples = sorted({row.sampling.samples_per_pixel for row in result.pictures})
    panels[-1].legend(title=f"left to right: {', '.join(map(str, samples))} samples", title_fontsize=8)


def _draw_aliasing(result: RenderResult, figure: Figure) -> None:
    """Draw what the camera sees, where events are false, and how many."""
    from matplotlib.colors import SymLogNorm

    figure.set_size_inches(8.0, 8.0)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.0, 0.75))
    upper, lower = parts
    panels = upper.subplots(2, 3)
    names = ("point sampling", "default", f"{REFERENCE_SAMPLES} samples")
    for axes, name, view in zip(panels[0], names, result.views, strict=True):
        axes.imshow(
            view, cmap="gray", vmin=result.views.min(), vmax=result.views.max(), interpolation="nearest"
        )
        axes.set_title(f"log radiance, {name}")
    most = max(int(result.false_per_pixel.max()), 2)
    for axes, name, count in zip(panels[1], names[:2], result.false_per_pixel, strict=False):
        shown = axes.imshow(
            count, cmap="magma", norm=SymLogNorm(1.0, vmin=0, vmax=most), interpolation="nearest"
        )
        axes.set_title(f"false events, {name}")
    for axes in panels.flat:
        axes.axis("off")
    scale = panels[1, 2].inset_axes((0.1, 0.05, 0.08, 0.9))
    upper.colorbar(shown, cax=scale, label="false events per pixel")
    _draw_counts(result, lower.subplots())


def _draw_counts(result: RenderResult, axes: Axes) -> None:
    """Draw how many events are false, and how many are missing."""
    places = np.arange(len(result.pan))
    false, missing = ([getattr(row, name) for row in result.pan] for name in ("false_count", "missing_count"))
    axes.barh(places - 0.2, false, height=0.4, label="false", color=COLORS[1])
    axes.barh(places + 0.2, missing, height=0.4, label="missing", color=COLORS[5])
    axes.axvline(result.pan[0].true_count, color="0.3", ls="--", lw=1.0, label="true events")
    axes.set_yticks(places, [str(row.sampling) for row in result.pan])
    axes.set(xscale="log", xlabel="events")
    axes.grid(visible=False, axis="y")
    axes.invert_yaxis()
    axes.legend()
