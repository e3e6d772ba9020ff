"""Events: error against run time, over renders a second and over rays per pixel.

*In time*: one flight is flown once and rendered at 100 kHz; the events of all these renders are the
reference. Each candidate sees some of the same renders: the ticks of a slower clock, or those that adaptive
sampling asks for. A naive camera sees the former as well.

*In space*: see `events_space`.

In time, events are matched by the alignment behind the distance of Victor and Purpura; see `matching`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.bench import engine
from neurosim_core.bench.events_space import (
    REFERENCE_SAMPLES,
    SAMPLES,
    case_of,
    sample_in_space,
    space_claims,
    space_plot,
)
from neurosim_core.bench.matching import match
from neurosim_core.bench.naive_events import NaiveEventCamera
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, cell, panel

FIXED_HZ = (250.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0)
ADAPTIVE_PX = (2.0, 1.0, 0.5, 0.35, 0.2, 0.1)
WINDOW_MS = 10.0
"""Window of the study in time: q = 200/s."""
_STACK = 128
_TIMED = 1000
"""Renders that are timed, spread over the flight: those of a candidate take their mean."""
_SLOW_SHARE, _FAST_SHARE = 0.75, 0.15


def measure(options: Options) -> Chapter:
    """Measure, and return the chapter."""
    options, quick = replace(options, device=engine.find_device(options.device)), options.quick
    samples = options.samples or (SAMPLES[::2] if quick else SAMPLES)
    if not all(1 <= count <= REFERENCE_SAMPLES for count in samples):
        raise ValueError(f"samples must be in [1, {REFERENCE_SAMPLES}], got {list(samples)}")
    on_cuda = options.device != "cpu"

    def lens(columns: int) -> engine.PinholeConfig:
        rows = options.height or round((9 / 16 if columns == 1280 else 3 / 4) * columns)
        return engine.PinholeConfig(width=columns, height=rows, horizontal_fov_rad=1.5)

    columns = options.width or (346 if on_cuda else 32 if quick else 64)
    time_rows = _sample_in_time(lens(columns), options)
    wanted = (options.width,) if options.width else (60,) if quick else (120, 346, 640, 1280)
    lenses = [lens(columns) for columns in (wanted if on_cuda else wanted[:2])]
    space_rows = sample_in_space(lenses, samples, options)
    return _chapter(time_rows, space_rows, quick)


@dataclass(kw_only=True, eq=False)
class _Candidate:
    """A camera that sees some ticks of the reference."""

    scheme: str
    setting: float
    ticks: NDArray[np.int64]
    choice_s: float = 0.0
    camera: Any = None
    parts: list[engine.EventArrays] = field(default_factory=list)

    def see(self, frames: Any, stamps_ns: NDArray[np.int64], begin: int) -> None:
        """Take those of consecutive frames that are its own; the very first is its reference."""
        low, high = np.searchsorted(self.ticks, [begin, begin + len(stamps_ns)])
        places = self.ticks[low:high] - begin
        if begin == 0:
            self.camera.reset(frames[0])
            places = places[1:]
        if isinstance(self.camera, NaiveEventCamera):
            for place in places:
                count = self.camera.feed(frames[int(place)], int(stamps_ns[place]) // 1000)
                self.parts.append(self.camera.events(count))
        elif len(places):
            index: Any = wp.array(places.astype(np.int32), dtype=int, device=frames.device)
            picked: Any = wp.indexedarray(frames, cast(Any, [index, None, None]))
            self.parts.append(self.camera.feed(picked.contiguous(), stamps_ns[places]).numpy())


def _dodge(airframe: Any, share: float) -> tuple[tuple[float, ...], str]:
    """Command a slow drift, then a roll as fast as a flip and back, and recover."""
    weight_n = airframe.mass_kg * airframe.gravity_m_s2
    through = (share - _SLOW_SHARE) / _FAST_SHARE
    if through < 0.0:
        return (0.12, 0.05, 0.0, 0.08), "velocity"
    if through < 1.0:
        sign = 1.0 if through < 0.5 else -1.0
        return (weight_n, 10.0 * sign, 5.0 * sign, 1.0 * sign), "rates"
    return (weight_n, 0.0, 0.0, 0.0, 1.0), "attitude"


def _sample_in_time(lens: engine.PinholeConfig, options: Options) -> list[Row]:
    """Return a row for each candidate."""
    device, quick = options.device, options.quick
    options.progress("fly")
    settings = {
        "duration_s": 0.3 if quick else 1.0,
        "device": device,
        "path": {"kind": "hover"},
        "render": {"samples_per_pixel": 8},
        **engine.scene_settings(options.scene, quick=quick),
    }
    rate_hz = 10_000.0 if quick else 100_000.0
    flown = engine.fly(engine.load_config(settings), rate_hz, pilot=_dodge, velocity=(0.12, 0.05, 0.0))
    arrays = engine.upload_scene(flown.model.scene, flown.model.config.render, device=device)
    options.progress("choose the renders of adaptive sampling")
    everything = np.arange(len(flown.stamps_ns))
    reference = _Candidate(scheme="reference", setting=rate_hz, ticks=everything)
    candidates = list(_candidates(flown, arrays, lens, quick))
    view, poses = engine.View(arrays, lens, count=_STACK), flown.poses()
    options.progress("time renders")
    some = np.linspace(0, len(everything) - 1, _TIMED, dtype=np.int64)
    view.render((poses[0][:1], poses[1][:1]))  # compiles
    begin_s = engine.busy_s(device)
    for _ in view.stacks((poses[0][some], poses[1][some])):
        pass
    render_s = (engine.busy_s(device) - begin_s) / _TIMED
    pixel = engine.EventCameraConfig()
    size: dict[str, Any] = {"width": lens.width, "height": lens.height, "device": device}
    thresholds: dict[str, Any] = {"threshold_on": pixel.threshold_on, "threshold_off": pixel.threshold_off}
    for candidate in (reference, *candidates):
        naive = candidate.scheme == "naive"
        candidate.camera = (
            NaiveEventCamera(**size, **thresholds) if naive else engine.EventCamera(pixel, **size)
        )
    for rows, frames in view.stacks(poses):
        if rows.start % (_STACK * 32) == 0:
            options.progress(f"render {rows.start:,} of {len(everything):,}")
        for candidate in (reference, *candidates):
            candidate.see(frames, flown.stamps_ns[rows], rows.start)
    truth = engine.join_events(reference.parts)
    found = []
    for candidate in candidates:
        options.progress(f"compare {candidate.scheme} {candidate.setting:g}")
        seconds = render_s * len(candidate.ticks)
        found.append(_time_row(candidate, truth, flown, lens.width, seconds))
    return found


def _candidates(
    flown: engine.Flown, arrays: Any, lens: engine.PinholeConfig, quick: bool
) -> Iterator[_Candidate]:
    """Yield who sees which ticks of the reference."""

    def clock(rate_hz: float) -> NDArray[np.int64]:
        return np.arange(0, len(flown.stamps_ns), round(flown.rate.rate_hz / rate_hz))

    for rate_hz in FIXED_HZ[:5] if quick else FIXED_HZ:
        for scheme in ("fixed", "naive"):
            yield _Candidate(scheme=scheme, setting=rate_hz, ticks=clock(rate_hz))
    forced = np.zeros(len(flown.stamps_ns), dtype=bool)
    forced[clock(100.0)] = True  # ends of packets
    forced[-1] = True
    for limit_px in ADAPTIVE_PX[1:] if quick else ADAPTIVE_PX:
        ticks, choice_s = engine.adaptive_ticks(flown, arrays, lens, limit_px, forced)
        yield _Candidate(scheme="adaptive", setting=limit_px, ticks=ticks, choice_s=choice_s)


def _time_row(
    candidate: _Candidate, truth: engine.EventArrays, flown: engine.Flown, width: int, render_s: float
) -> Row:
    events, total = engine.join_events(candidate.parts), len(truth.t)
    window: dict[str, Any] = {"window_us": 1e3 * WINDOW_MS, "shift_cost": 2.0}
    aligned = match(truth, events, width=width, device=flown.model.device, **window)
    shifts = np.abs(aligned.error_us[~np.isnan(aligned.error_us)])
    median, high = np.quantile(shifts, [0.5, 0.9]) if len(shifts) else (math.nan, math.nan)
    return {
        "scheme": candidate.scheme,
        "Hz or px": candidate.setting,
        "renders": len(candidate.ticks),
        "events of the reference": total,
        "choosing [s]": candidate.choice_s,
        "rendering [s]": render_s,
        "both [s]": candidate.choice_s + render_s,
        "events more or fewer [%]": 100.0 * (len(events.t) / total - 1.0),
        "missing [%]": 100.0 * aligned.missing_count / total,
        "spurious [%]": 100.0 * aligned.spurious_count / total,
        "distance per event": aligned.distance / total,
        "timing error, median [us]": float(median),
        "90 % [us]": float(high),
    }


def saving(rows: Sequence[Row], cost: str) -> dict[float, float]:
    """Return how many times as much a fixed rate costs for the same distance as adaptive sampling.

    The factors are by displacement [px]; `cost` is a heading. Between two rates the curve is interpolated in
    logarithms; what no fixed rate is as good or as bad as is left out.
    """
    fixed = sorted((r for r in rows if r["scheme"] == "fixed"), key=lambda r: r["distance per event"])
    errors, costs = (np.log([row[heading] for row in fixed]) for heading in ("distance per event", cost))
    found = {}
    for row in (row for row in rows if row["scheme"] == "adaptive"):
        error = math.log(row["distance per event"])
        if errors[0] <= error <= errors[-1]:
            found[row["Hz or px"]] = float(np.exp(np.interp(error, errors, costs)) / row[cost])
    return found


def _chapter(time_rows: list[Row], space_rows: list[Row], quick: bool) -> Chapter:
    fewer, faster = saving(time_rows, "renders"), saving(time_rows, "both [s]")
    said = [
        "In time: a vehicle creeps, dodges with a roll of 640 degrees a second, and recovers; "
        f"{time_rows[0]['events of the reference']:,} events at the highest rate are the reference. For the "
        f"same spike-train distance adaptive sampling needs {_span(fewer)} times fewer renders than a fixed "
        f"rate, and {_span(faster)} times less time to choose and render them."
    ]
    for row in (row for row in space_rows if row["rays per pixel"].endswith("(default)")):
        spurious, missed = (f"{row[f'{kind}, 20 ms [%]']:.0f} %" for kind in ("spurious", "missed"))
        said.append(
            f"In space, {', '.join(case_of(row))}: by default {spurious} of the events are spurious and "
            f"{missed} are missed within 20 ms, against {REFERENCE_SAMPLES} rays per pixel."
        )
    time_note = (
        "Matched within 10 ms (Victor and Purpura, q = 200/s). Seconds are CPU time of all threads, or "
        "wall-clock time on CUDA. Adaptive sampling also renders the ends of packets, 100 a second."
    )
    space_note = (
        "Spurious events are a share of those of the row, missed ones of those of the reference. Rendered at "
        "500 Hz. The row with another pattern is the floor."
    )
    by_rays = f"Events by rays per pixel, against {REFERENCE_SAMPLES}"
    return Chapter(
        name="events",
        title="Events: error against run time, over renders a second and rays per pixel",
        summary="\n\n".join(said),
        claims=[*_time_claims(time_rows, fewer, quick), *space_claims(space_rows)],
        tables=[
            Table("events-time", "Events by how a flight was sampled in time", time_rows, time_note),
            Table("events-space", by_rays, space_rows, space_note),
        ],
        plots=[_time_plot(time_rows), space_plot(space_rows)],
    )


def _time_claims(rows: Sequence[Row], fewer: dict[float, float], quick: bool) -> list[Claim]:
    reference = "Victor, Purpura (1996), against renders at 100 kHz"
    small, median = " (quick: too small to judge)" if quick else "", "timing error, median [us]"
    rows = sorted(rows, key=lambda r: r["renders"])
    curves = {scheme: [r for r in rows if r["scheme"] == scheme] for scheme in ("fixed", "adaptive", "naive")}
    renders = np.log([row["renders"] for row in curves["adaptive"]])
    errors = np.log([max(row[median], 1.0) for row in curves["adaptive"]])
    gains = {
        row["Hz or px"]: row[median] / math.exp(np.interp(math.log(row["renders"]), renders, errors))
        for row in curves["naive"]
        if renders[0] <= math.log(row["renders"]) <= renders[-1]
    }
    distances = ([row["distance per event"] for row in curves[scheme]] for scheme in ("fixed", "adaptive"))
    falling = [all(a > b for a, b in itertools.pairwise(each)) for each in distances]
    half = "for the same error adaptive sampling needs at most half the renders of the best fixed rate"
    fifth = "at as many renders the median timing error of a naive camera is at least 5 times that of "
    less = "the error falls with every further render, at fixed rates and adaptively"
    naive = "one event per pixel and frame, stamped at the frame, as in many simulators"
    said = f"{_span(fewer)} times fewer, at {', '.join(f'{px:g}' for px in fewer)} px{small}"
    both = f"fixed: {cell(falling[0])}, adaptive: {cell(falling[1])}"
    saved = None if quick or not fewer else min(fewer.values()) >= 2.0
    gained = None if quick or not gains else min(gains.values()) >= 5.0
    return [
        Claim(half, reference, said, saved),
        Claim(fifth + "adaptive sampling", naive, f"{_span(gains)} times{small}", gained),
        Claim(less, reference, both, all(falling)),
    ]


def _span(factors: dict[float, float]) -> str:
    return (
        " to ".join(dict.fromkeys(f"{end(factors.values()):.2g}" for end in (min, max))) if factors else "?"
    )


def _time_plot(rows: list[Row]) -> Plot:
    distance, median = "distance per event", "timing error, median [us]"
    pairs = [("renders", distance), ("both [s]", distance), ("renders", median), ("renders", "spurious [%]")]
    panels = [
        panel(rows, x, y, by="scheme", log="xy", x_label=x.replace("both", "to choose and to render"))
        for x, y in (*pairs, ("renders", "missing [%]"))
    ]
    return Plot("events-time", "In time: error against renders and run time; 0 has no mark", panels)
