"""The chapter of `neurosim bench events`: what was promised, the answer in words, a table, plots."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from neurosim_core.bench.chapter import Bar, Chapter, Plot, Table
from neurosim_core.bench.events_result import (
    BINS_US,
    COST_PER_S,
    TIMED_MAX,
    EventStudy,
    Scheme,
    Score,
    falls,
    saving,
    timing_gain,
)
from neurosim_core.bench.figures import COLORS, MARKERS
from neurosim_core.bench.flown import SLOW_SHARE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class _Answer:
    """What a study says about adaptive sampling and about the naive scheme: factors, by setting."""

    renders: dict[float, float]
    """Renders of a fixed rate against adaptive, for the same distance."""
    renders_by_count: dict[float, float]
    """The same, for as many missing and spurious events."""
    time: dict[float, float]
    """Run time of a fixed rate against adaptive, for the same distance."""
    naive: dict[tuple[Scheme, str], dict[float, float]]
    """Timing error of the naive scheme against ours, by our scheme and the measure of the error."""


def _answer(study: EventStudy) -> _Answer:
    measures: dict[str, Callable[[Score], float]] = {
        "median": lambda s: s.median_us,
        "90 %": lambda s: s.high_us,
    }
    ours: tuple[Scheme, ...] = ("adaptive", "fixed")
    return _Answer(
        renders=saving(study, study.error, lambda s: s.render_count),
        renders_by_count=saving(
            study, lambda s: s.missing_count + s.spurious_count, lambda s: s.render_count
        ),
        time=saving(study, study.error, lambda s: s.run_s),
        naive={
            (scheme, name): timing_gain(study, scheme, error_us)
            for scheme in ours
            for name, error_us in measures.items()
        },
    )


def events_chapter(study: EventStudy) -> Chapter:
    """Return what a study says, for the report."""
    answer = _answer(study)
    return Chapter(
        name="events",
        title="Events: error against run time",
        summary=_summary(study, answer),
        command=_command(study),
        bars=_bars(study, answer),
        tables=[_table(study, answer)],
        plots=[
            Plot(
                name="events-error",
                title="Error of the event stream against renders and run time",
                draw=lambda figure: _draw_error(study, figure),
            ),
            Plot(
                name="events-timing",
                title="Timing error of matched events",
                draw=lambda figure: _draw_timing(study, figure),
            ),
        ],
    )


def _command(study: EventStudy) -> str:
    """Return what measures the same again, whatever the defaults of a machine are."""
    words = ["neurosim bench events", *(["--quick"] if study.quick else [])]
    if study.scene_file is not None:
        words.append(f"--scene {shlex.quote(str(study.scene_file))}")
    return " ".join([*words, f"--device {study.device} --width {study.width} --height {study.height}"])


def _bars(study: EventStudy, answer: _Answer) -> list[Bar]:
    """Return what was promised, and what came of it."""
    both = [scheme for scheme in ("fixed", "adaptive") if falls(study, scheme)]
    small = " (quick: too small to judge)" if study.quick else ""
    judged = answer.naive["adaptive", "median"]
    return [
        Bar(
            text="For the same error adaptive sampling needs at most half the renders of the best fixed rate",
            measured=f"by the spike-train distance {_span(answer.renders)} times fewer"
            f"{_left_out(study, answer.renders)}; by missing and spurious events "
            f"{_span(answer.renders_by_count)} times fewer{_left_out(study, answer.renders_by_count)}"
            f"{small}",
            met=None if study.quick or not answer.renders else min(answer.renders.values()) >= 2.0,
        ),
        Bar(
            text="At the same number of renders the timing error of the naive scheme is at least 5 times "
            "ours: judged by the median of matched events, naive at a fixed rate against adaptive sampling",
            measured=f"{_span(judged)} times, at {_rates(judged)}; by what 90 % are below "
            f"{_span(answer.naive['adaptive', '90 %'])} times. Against our own pixels at the same fixed "
            f"rate, {_rates(answer.naive['fixed', 'median'])}: median "
            f"{_span(answer.naive['fixed', 'median'])}, 90 % {_span(answer.naive['fixed', '90 %'])} times"
            f"{small}",
            met=None if study.quick or not judged else min(judged.values()) >= 5.0,
        ),
        Bar(
            text="The error falls monotonically with the number of renders",
            measured=f"it does for {' and '.join(both) or 'none'}",
            met=len(both) == 2,
        ),
    ]


def _span(factors: dict[float, float]) -> str:
    if not factors:
        return "?"
    low, high = (f"{bound(factors.values()):.2g}" for bound in (min, max))
    return low if low == high else f"{low} to {high}"


def _rates(factors: dict[float, float]) -> str:
    """Name the rates of some factors."""
    if not factors:
        return "no rate"
    low, high = (f"{bound(factors):g}" for bound in (min, max))
    return f"{low} Hz" if low == high else f"{low} to {high} Hz"


def _left_out(study: EventStudy, factors: dict[float, float]) -> str:
    """Name the displacements that have no factor."""
    left = [f"{s.setting:g}" for s in study.of("adaptive") if s.setting not in factors]
    return f" (left out, as no fixed rate here is as bad or as good: {', '.join(left)} px)" if left else ""


def _summary(study: EventStudy, answer: _Answer) -> str:
    """Return the answer in words."""
    finest = study.of("adaptive")[-1:]
    missing = (
        f"At {finest[0].setting:g} px {finest[0].missing_count / study.reference_count:.1%} of the "
        "events are missing: details that pass a pixel between two renders."
        if finest
        else ""
    )
    return "\n\n".join(
        [
            f"A vehicle creeps through *{study.scene}* for {SLOW_SHARE * study.duration_s:.2g} s, dodges "
            f"with a roll of 640 degrees a second, and recovers: {study.duration_s:g} s in all. It was flown "
            f"once and rendered at {study.reference_hz / 1e3:g} kHz, {study.width} x {study.height} pixels, "
            f"{study.samples_per_pixel} rays each, on {study.device}. The {study.reference_count:,} events "
            "are the reference; candidates see some of the same renders.",
            f"For the same spike-train distance adaptive sampling needs {_span(answer.renders)} times fewer "
            f"renders than a fixed rate, and {_span(answer.time)} times less {study.clock} to choose and "
            f"render them; for as many missing and spurious events it needs {_span(answer.renders_by_count)} "
            f"times fewer renders. {missing}",
            _choosing(study, answer),
            f"With as many renders as adaptive sampling the naive scheme stamps events "
            f"{_span(answer.naive['adaptive', 'median'])} times worse (median of those matched); at the same "
            f"fixed rate {_span(answer.naive['fixed', 'median'])} times worse than our pixels.",
            f"Distance: Victor and Purpura (1996), q = {COST_PER_S:g}/s, of each pixel and polarity, summed, "
            "and divided by the events of the reference. Its alignment matches events at most "
            f"{2e3 / COST_PER_S:g} ms apart.",
        ]
    )


def _choosing(study: EventStudy, answer: _Answer) -> str:
    """Say what the choice costs, and where it does not pay."""
    ours = study.of("adaptive")
    if not ours:
        return "Adaptive sampling was not measured."
    tick_count = round(study.duration_s * study.reference_hz) + 1
    each_us = [1e6 * s.choice_s / tick_count for s in ours]
    shares = [s.choice_s / s.render_s for s in ours]
    render_ms = 1e3 * sum(s.render_s for s in ours) / sum(s.render_count for s in ours)
    worse = sorted((px for px, factor in answer.time.items() if factor < 1.0), reverse=True)
    verdict = (
        f"At {', '.join(f'{px:g}' for px in worse)} px it does not pay here: a fixed rate of the same error "
        "takes less time."
        if worse
        else "Choosing included, no setting that can be compared takes longer than a fixed rate here."
    )
    return (
        f"To choose takes {min(each_us):.2g} to {max(each_us):.2g} us for each tick of the clock that is "
        f"chosen from, here the {study.reference_hz / 1e3:g} kHz of the reference (a clock of 1 kHz "
        "has far fewer), which adds "
        f"{min(shares):.0%} to {max(shares):.0%} to the time of rendering ({render_ms:.3g} ms a render). "
        f"{verdict} It pays less the cheaper a render is (few pixels, few rays, a fast GPU), the finer the "
        "clock, and the more packets end, as their ends are always rendered. It does not pay at an even "
        "speed: adaptive sampling bounds how far things move between two renders, not the time; where the "
        "vehicle is slow, events are off by as much of a pixel, which is more microseconds."
    )


def _table(study: EventStudy, answer: _Answer) -> Table:
    total = study.reference_count
    rows = [
        {
            "scheme": s.scheme,
            "setting": s.setting,
            "renders": s.render_count,
            "slow": s.slow_render_count,
            "choice": s.choice_s,
            "render": s.render_s,
            "run": s.run_s,
            "count": 100.0 * (s.event_count / total - 1.0),
            "missing": 100.0 * s.missing_count / total,
            "spurious": 100.0 * s.spurious_count / total,
            "distance": study.error(s),
            "median": s.median_us,
            "high": s.high_us,
            "worst": s.worst_us,
            "fewer": answer.renders.get(s.setting) if s.scheme == "adaptive" else None,
            "faster": answer.time.get(s.setting) if s.scheme == "adaptive" else None,
        }
        for scheme in ("fixed", "adaptive", "naive")
        for s in study.of(scheme)
    ]
    return Table(
        name="events-schemes",
        title="Events of a flight by how it was sampled",
        columns={
            "scheme": "scheme",
            "setting": "Hz or px",
            "renders": "renders",
            "slow": "of these before the manoeuvre",
            "choice": "choosing [s]",
            "render": "rendering [s]",
            "run": "both [s]",
            "count": "events more or fewer [%]",
            "missing": "missing [%]",
            "spurious": "spurious [%]",
            "distance": "distance per event",
            "median": "timing error, median [us]",
            "high": "90 % [us]",
            "worst": "largest [us]",
            "fewer": "renders of a fixed rate / of this",
            "faster": "time of a fixed rate / of this",
        },
        rows=rows,
        note="Timing errors are those of matched events, without sign; they are below the window by "
        f"definition. Seconds are {study.clock} (on a CPU that of all threads), of at most {TIMED_MAX:,} "
        "renders of each candidate, scaled to all. The last two columns compare with the fixed rate of the "
        "same distance, between two rates by interpolation; unknown where no fixed rate is as bad or as "
        "good. Adaptive sampling also renders the ends of packets, 100 a second.",
    )


_STYLE: dict[Scheme, tuple[str, str, str]] = {
    "fixed": (COLORS[0], MARKERS[0], "fixed rate"),
    "adaptive": (COLORS[1], MARKERS[1], "adaptive"),
    "naive": (COLORS[2], MARKERS[2], "naive"),
}
"""Colour, marker and name of each scheme."""


def _draw_error(study: EventStudy, figure: Figure) -> None:
    """Draw the distance against renders and against run time, and the timing error against renders."""
    panels = figure.subplots(1, 3)
    for scheme, (color, marker, label) in _STYLE.items():
        scores = study.of(scheme)
        style = {"color": color, "marker": marker, "label": label}
        renders: Sequence[float]
        renders, run_s = [s.render_count for s in scores], [s.run_s for s in scores]
        errors, medians_us = [study.error(s) for s in scores], [max(s.median_us, 1.0) for s in scores]
        for axes, costs, values in zip(
            panels, (renders, run_s, renders), (errors, errors, medians_us), strict=True
        ):
            axes.plot(costs, values, **style)
            if scheme != "naive":
                _name_points(axes, scores, costs, values)
    panels[0].set(xlabel="renders", ylabel="spike-train distance per event")
    panels[1].set(xlabel=f"choosing and rendering [s]\n({study.clock})", ylabel=panels[0].get_ylabel())
    panels[2].set(xlabel="renders", ylabel="median timing error [us]")
    for axes in panels:
        axes.set(xscale="log", yscale="log")
        axes.margins(x=0.15)
        axes.legend(loc="lower left", fontsize=8)


def _name_points(axes: Any, scores: Sequence[Score], costs: Sequence[float], values: Sequence[float]) -> None:
    """Write the settings beside the points of a curve."""
    for score, place in zip(scores, zip(costs, values, strict=True), strict=True):
        text = f"{score.setting:g} px" if score.scheme == "adaptive" else f"{score.setting / 1e3:g} kHz"
        offset, side = ((-5, -9), "right") if score.scheme == "adaptive" else ((5, 4), "left")
        axes.annotate(text, place, fontsize=7, textcoords="offset points", xytext=offset, ha=side)


def _draw_timing(study: EventStudy, figure: Figure) -> None:
    axes = figure.subplots()
    shown = study.of("adaptive")[len(study.of("adaptive")) // 2]
    edges = BINS_US
    for scheme, (color, _, label) in _STYLE.items():
        score = min(study.of(scheme), key=lambda s: abs(math.log(s.render_count / shown.render_count)))
        share = 100.0 * np.array(score.histogram) / study.reference_count
        axes.stairs(
            share, edges, color=color, label=f"{label}, {score.render_count:,} renders", linewidth=1.8
        )
    axes.set(
        xscale="log",
        xlabel="timing error [us], in the first bin all that is less",
        ylabel="share of the reference's events [% per bin]",
    )
    axes.legend()
