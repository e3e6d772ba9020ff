"""Events: error against run time, over renders a second and over rays per pixel.

*In time*: one flight is flown once and rendered at 100 kHz; the events of all these renders are the
reference. Each candidate sees some of the same renders: the ticks of a slower clock, or those that adaptive
sampling asks for. A naive camera sees the former as well.

*In space*: a camera turns on the spot, and flies along a planned path, rendered at 500 Hz with several
numbers of rays per pixel; the events of 64 rays are the reference. Another pattern of 64 rays shows how well
that is known: no other picture can be nearer.

In time, events are matched by the alignment behind the distance of Victor and Purpura; in space, as many as
possible within a window; see `matching`.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.bench.engine import (
    EventArrays,
    EventCamera,
    EventCameraConfig,
    Flown,
    PinholeConfig,
    Poses,
    RenderConfig,
    Scene,
    ShiftedLens,
    View,
    adaptive_ticks,
    busy_s,
    camera_poses,
    find_device,
    fly,
    join_events,
    load_config,
    scene_settings,
    upload_scene,
)
from neurosim_core.bench.matching import align, match
from neurosim_core.bench.naive_events import NaiveEventCamera
from neurosim_core.bench.options import Options, Progress, silent
from neurosim_core.bench.report import Chapter, Claim, Panel, Plot, Row, Series, Table, cell, lines
from neurosim_core.bench.scenes import thin_structures

FIXED_HZ = (250.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0)
ADAPTIVE_PX = (2.0, 1.0, 0.5, 0.35, 0.2, 0.1)
WINDOW_MS = 10.0
"""Window of the study in time: q = 200/s."""
WINDOWS_MS = (1.0, 5.0, 20.0)
"""Windows of the study in space."""
SAMPLES = (1, 2, 4, 8, 16, 64)
REFERENCE_SAMPLES = 64
SPACE_HZ = 500.0
_STACK = 128
_TIMED_MAX = 1000
_SLOW_SHARE, _FAST_SHARE = 0.75, 0.15


def measure(options: Options, progress: Progress = silent) -> Chapter:
    """Measure, and return the chapter.

    Raises:
        ValueError: The scene cannot be loaded, the device is not there, or samples are out of range.
    """
    device, quick = find_device(options.device), options.quick
    samples = options.samples or (SAMPLES[::2] if quick else SAMPLES)
    if not all(1 <= count <= REFERENCE_SAMPLES for count in samples):
        raise ValueError(f"samples must be in [1, {REFERENCE_SAMPLES}], got {list(samples)}")
    on_cuda = wp.get_device(device).is_cuda

    def lens(columns: int) -> PinholeConfig:
        rows = options.height or round((9 / 16 if columns == 1280 else 3 / 4) * columns)
        return PinholeConfig(width=columns, height=rows, horizontal_fov_rad=1.5)

    columns = options.width or (346 if on_cuda else 32 if quick else 64)
    time_rows = _sample_in_time(lens(columns), options.scene, device, quick, progress)
    wanted = (options.width,) if options.width else (60,) if quick else (120, 346, 640, 1280)
    lenses = [lens(columns) for columns in (wanted if on_cuda else wanted[:2])]
    space_rows = _sample_in_space(lenses, options.scene, device, quick, samples, progress)
    return _chapter(time_rows, space_rows, quick)


# In time


@dataclass(kw_only=True, eq=False)
class _Candidate:
    """A camera that sees some ticks of the reference."""

    scheme: str
    setting: float
    ticks: NDArray[np.int64]
    choice_s: float = 0.0
    camera: Any = None
    parts: list[EventArrays] = field(default_factory=list)

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
    progress = (share - _SLOW_SHARE) / _FAST_SHARE
    if progress < 0.0:
        return (0.12, 0.05, 0.0, 0.08), "velocity"
    if progress < 1.0:
        sign = 1.0 if progress < 0.5 else -1.0
        return (weight_n, 10.0 * sign, 5.0 * sign, 1.0 * sign), "rates"
    return (weight_n, 0.0, 0.0, 0.0, 1.0), "attitude"


def _sample_in_time(
    lens: PinholeConfig, scene: Path | None, device: str, quick: bool, progress: Progress
) -> list[Row]:
    """Return a row for each candidate."""
    progress("fly")
    settings = {
        "duration_s": 0.3 if quick else 1.0,
        "device": device,
        "path": {"kind": "hover"},
        "render": {"samples_per_pixel": 8},
        **scene_settings(scene),
    }
    rate_hz = 10_000.0 if quick else 100_000.0
    flown = fly(load_config(settings), rate_hz, pilot=_dodge, velocity=(0.12, 0.05, 0.0))
    arrays = upload_scene(flown.model.scene, flown.model.config.render, device=device)
    progress("choose the renders of adaptive sampling")
    everything = np.arange(len(flown.stamps_ns))
    reference = _Candidate(scheme="reference", setting=rate_hz, ticks=everything)
    candidates = list(_candidates(flown, arrays, lens, quick))
    view, poses = View(arrays, lens, count=_STACK), flown.poses()
    render_s = _time_renders(view, poses, candidates, progress)
    pixel = EventCameraConfig()
    size: dict[str, Any] = {"width": lens.width, "height": lens.height, "device": device}
    thresholds: dict[str, Any] = {"threshold_on": pixel.threshold_on, "threshold_off": pixel.threshold_off}
    for candidate in (reference, *candidates):
        naive = candidate.scheme == "naive"
        candidate.camera = NaiveEventCamera(**size, **thresholds) if naive else EventCamera(pixel, **size)
    for rows, frames in view.stacks(poses):
        if rows.start % (_STACK * 32) == 0:
            progress(f"render {rows.start:,} of {len(everything):,}")
        for candidate in (reference, *candidates):
            candidate.see(frames, flown.stamps_ns[rows], rows.start)
    truth = join_events(reference.parts)
    found = []
    for candidate, seconds in zip(candidates, render_s, strict=True):
        progress(f"compare {candidate.scheme} {candidate.setting:g}")
        found.append(_time_row(candidate, truth, flown, lens.width, seconds))
    return found


def _candidates(flown: Flown, arrays: Any, lens: PinholeConfig, quick: bool) -> Iterator[_Candidate]:
    """Yield who sees which ticks of the reference."""
    for rate_hz in FIXED_HZ[:5] if quick else FIXED_HZ:
        ticks = _ticks(flown, rate_hz)
        yield _Candidate(scheme="fixed", setting=rate_hz, ticks=ticks)
        yield _Candidate(scheme="naive", setting=rate_hz, ticks=ticks)
    forced = np.zeros(len(flown.stamps_ns), dtype=bool)
    forced[_ticks(flown, 100.0)] = True  # ends of packets
    forced[-1] = True
    for limit_px in ADAPTIVE_PX[1:] if quick else ADAPTIVE_PX:
        ticks, choice_s = adaptive_ticks(flown, arrays, lens, limit_px, forced)
        yield _Candidate(scheme="adaptive", setting=limit_px, ticks=ticks, choice_s=choice_s)


def _ticks(flown: Flown, rate_hz: float) -> NDArray[np.int64]:
    """Return the ticks of the reference at which a slower clock ticks."""
    return np.arange(0, len(flown.stamps_ns), round(flown.rate.rate_hz / rate_hz))


def _time_renders(
    view: View, poses: Poses, candidates: Sequence[_Candidate], progress: Progress
) -> list[float]:
    """Return what the renders of each candidate take [s]; equal ticks are timed once, and some of many."""
    known: dict[bytes, float] = {}
    view.render((poses[0][:1], poses[1][:1]))  # compiles
    for candidate in candidates:
        key = candidate.ticks.tobytes()
        if key not in known:
            progress(f"time the renders of {candidate.scheme} {candidate.setting:g}")
            some = candidate.ticks[:: -(-len(candidate.ticks) // _TIMED_MAX)]
            begin_s = busy_s(view.device)
            for _ in view.stacks((poses[0][some], poses[1][some])):
                pass
            known[key] = (busy_s(view.device) - begin_s) * len(candidate.ticks) / len(some)
    return [known[candidate.ticks.tobytes()] for candidate in candidates]


def _time_row(candidate: _Candidate, truth: EventArrays, flown: Flown, width: int, render_s: float) -> Row:
    events, total = join_events(candidate.parts), len(truth.t)
    aligned = align(truth, events, width=width, window_us=1e3 * WINDOW_MS, device=flown.model.device)
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

    Between two rates the curve is interpolated in logarithms; what no fixed rate is as good or as bad as is
    left out.

    Args:
        rows: Of the study in time.
        cost: Heading of the cost.

    Returns:
        Factor by displacement [px].
    """
    fixed = sorted((r for r in rows if r["scheme"] == "fixed"), key=lambda r: r["distance per event"])
    errors, costs = (np.log([row[heading] for row in fixed]) for heading in ("distance per event", cost))
    return {
        row["Hz or px"]: float(
            np.exp(np.interp(math.log(row["distance per event"]), errors, costs)) / row[cost]
        )
        for row in rows
        if row["scheme"] == "adaptive" and errors[0] <= math.log(row["distance per event"]) <= errors[-1]
    }


# In space


def _sample_in_space(
    lenses: Sequence[PinholeConfig],
    scene: Path | None,
    device: str,
    quick: bool,
    samples: Sequence[int],
    progress: Progress,
) -> list[Row]:
    """Return a row for each scene, motion, size and number of rays per pixel, the default among them."""
    seconds = 0.06 if quick else 0.2
    progress("plan a flight")
    settings = {"duration_s": 2.0 + seconds, "device": device, **scene_settings(scene)}
    flown = fly(load_config(settings), SPACE_HZ)
    position, orientation = flown.poses()
    last = round(2.0 * SPACE_HZ)  # it is fast by then
    views: list[tuple[Scene, str, Poses]] = [
        (flown.model.scene, "planned flight", (position[last:], orientation[last:]))
    ]
    for shown, start in ((flown.model.scene, flown.states[0, :3]), (thin_structures(), np.zeros(3))):
        for rate_deg_s in (200.0,) if quick else (30.0, 200.0):
            views.append((shown, f"yaw at {rate_deg_s:g} deg/s", _turn(start, rate_deg_s, seconds)))
    lit = {id(shown): upload_scene(shown, RenderConfig(), device=device) for shown, _, _ in views}
    rows = []
    for (shown, motion, poses), lens in itertools.product(views, lenses):
        pixels = f"{lens.width}x{lens.height}"
        for count in dict.fromkeys((REFERENCE_SAMPLES, *samples, RenderConfig().samples_per_pixel)):
            progress(f"{shown.name}, {motion}, {pixels}, {count} rays per pixel")
            row, events = _space_row(lit[id(shown)], lens, poses, count)
            if count == REFERENCE_SAMPLES:
                progress(f"{shown.name}, {motion}, {pixels}, another pattern of {count} rays")
                other, its = _space_row(lit[id(shown)], ShiftedLens(lens, (0.382, 0.618)), poses, count)
                truth, row, events = events, {**other, "rays per pixel": f"{count}, another pattern"}, its
            windows = {
                window: match(truth, events, width=lens.width, window_us=1e3 * window)
                for window in WINDOWS_MS
            }
            row["events / reference"] = len(events.t) / max(len(truth.t), 1)
            for w, found in windows.items():
                row[f"spurious, {w:g} ms [%]"] = 100.0 * found.spurious_count / max(len(events.t), 1)
            for w, found in windows.items():
                row[f"missed, {w:g} ms [%]"] = 100.0 * found.missing_count / max(len(truth.t), 1)
            rows.append({"scene": shown.name, "motion": motion, "pixels": pixels, **row})
    return rows


def _turn(position: NDArray[Any], rate_deg_s: float, seconds: float) -> Poses:
    """Return the poses of a camera that turns about the vertical, looking forward."""
    yaw = np.radians(rate_deg_s) * np.arange(round(seconds * SPACE_HZ) + 1) / SPACE_HZ
    return camera_poses(np.tile(position, (len(yaw), 1)), Rotation.from_euler("z", yaw[:, None]))


def _space_row(
    lit: Any, lens: Any, poses: Poses, count: int | Literal["adaptive"]
) -> tuple[Row, EventArrays]:
    """Render poses in an uploaded scene with a number of rays per pixel; return a row and the events."""
    device, config = lit.device, RenderConfig(samples_per_pixel=count)
    view = View(dataclasses.replace(lit, config=config), lens, count=16)
    camera = EventCamera(EventCameraConfig(), width=lens.width, height=lens.height, device=device)
    stamps_ns = np.rint(np.arange(len(poses[0])) * (1e9 / SPACE_HZ)).astype(np.int64)
    camera.reset(view.render((poses[0][:1], poses[1][:1]))[0])  # compiles, too
    parts, spent_s, begin_s = [], 0.0, busy_s(device)
    for rows, frames in view.stacks((poses[0][1:], poses[1][1:])):
        spent_s += busy_s(device) - begin_s
        stamps = stamps_ns[1:][rows]
        parts.append(camera.feed(frames[: len(stamps)], stamps).numpy())
        begin_s = busy_s(device)
    events = join_events(parts)
    default = count == RenderConfig().samples_per_pixel
    row: Row = {
        "rays per pixel": f"{count} (default)" if default else str(count),
        "time of a picture [ms]": 1e3 * spent_s / (len(poses[0]) - 1),
        "events": len(events.t),
    }
    return row, events


# The chapter


def _chapter(time_rows: list[Row], space_rows: list[Row], quick: bool) -> Chapter:
    fewer, faster = saving(time_rows, "renders"), saving(time_rows, "both [s]")
    said = [
        "In time: a vehicle creeps, dodges with a roll of 640 degrees a second, and recovers; "
        f"{time_rows[0]['events of the reference']:,} events at the highest rate are the reference. For the "
        f"same spike-train distance adaptive sampling needs {_span(fewer)} times fewer renders than a fixed "
        f"rate, and {_span(faster)} times less time to choose and render them."
    ]
    for row in (row for row in space_rows if row["rays per pixel"].endswith("(default)")):
        said.append(
            f"In space, {row['scene']}, {row['motion']}, {row['pixels']}: by default "
            f"{row['spurious, 20 ms [%]']:.0f} % of the events are spurious and "
            f"{row['missed, 20 ms [%]']:.0f} % are missed within 20 ms, against {REFERENCE_SAMPLES} rays per "
            "pixel."
        )
    time_note = (
        "Matched within 10 ms (Victor and Purpura, q = 200/s). Seconds are CPU time of all threads, or "
        "wall-clock time on CUDA. Adaptive sampling also renders the ends of packets, 100 a second."
    )
    space_note = (
        "Spurious events are a share of those of the row, missed ones of those of the reference. Rendered at "
        "500 Hz. The row with another pattern is the floor."
    )
    return Chapter(
        name="events",
        title="Events: error against run time, over renders a second and rays per pixel",
        summary="\n\n".join(said),
        claims=[*_time_claims(time_rows, fewer, quick), *_space_claims(space_rows)],
        tables=[
            Table("events-time", "Events by how a flight was sampled in time", time_rows, time_note),
            Table(
                "events-space",
                f"Events by rays per pixel, against {REFERENCE_SAMPLES}",
                space_rows,
                space_note,
            ),
        ],
        plots=[_time_plot(time_rows), _space_plot(space_rows)],
    )


def _time_claims(rows: Sequence[Row], fewer: dict[float, float], quick: bool) -> list[Claim]:
    reference = "Victor, Purpura (1996), against renders at 100 kHz"
    small, median = " (quick: too small to judge)" if quick else "", "timing error, median [us]"
    rows = sorted(rows, key=lambda r: r["renders"])
    curves = {scheme: [r for r in rows if r["scheme"] == scheme] for scheme in ("fixed", "adaptive", "naive")}
    ours = curves["adaptive"]
    renders = np.log([row["renders"] for row in ours])
    errors = np.log([max(row[median], 1.0) for row in ours])
    gains = {
        row["Hz or px"]: row[median] / math.exp(np.interp(math.log(row["renders"]), renders, errors))
        for row in curves["naive"]
        if renders[0] <= math.log(row["renders"]) <= renders[-1]
    }
    falling = [
        all(a["distance per event"] > b["distance per event"] for a, b in itertools.pairwise(curves[scheme]))
        for scheme in ("fixed", "adaptive")
    ]
    return [
        Claim(
            "for the same error adaptive sampling needs at most half the renders of the best fixed rate",
            reference,
            f"{_span(fewer)} times fewer, at {', '.join(f'{px:g}' for px in fewer)} px{small}",
            None if quick or not fewer else min(fewer.values()) >= 2.0,
        ),
        Claim(
            "at as many renders the median timing error of a naive camera is at least 5 times that of "
            "adaptive sampling",
            "one event per pixel and frame, stamped at the frame, as in many simulators",
            f"{_span(gains)} times{small}",
            None if quick or not gains else min(gains.values()) >= 5.0,
        ),
        Claim(
            "the error falls with every further render, at fixed rates and adaptively",
            reference,
            f"fixed: {cell(falling[0])}, adaptive: {cell(falling[1])}",
            all(falling),
        ),
    ]


def _case(row: Row) -> tuple[str, ...]:
    return row["scene"], row["motion"], row["pixels"]


def _space_claims(rows: Sequence[Row]) -> list[Claim]:
    """Judge the default: each share within its limit, or twice that of another pattern of 64 rays."""
    claims = []
    for row in (row for row in rows if row["rays per pixel"].endswith("(default)")):
        case = _case(row)
        floor = next(r for r in rows if "pattern" in r["rays per pixel"] and _case(r) == case)
        limits = {20.0: 5.0, 5.0: 8.0}
        if int(row["pixels"].partition("x")[0]) < 346:
            limits = dict.fromkeys(limits, 12.0)
        shares = {(kind, w): f"{kind}, {w:g} ms [%]" for kind in ("spurious", "missed") for w in limits}
        claims.append(
            Claim(
                f"default rays per pixel, {', '.join(case)}: spurious and missed events are "
                f"<= {limits[20.0]:g} % within 20 ms and <= {limits[5.0]:g} % within 5 ms, or twice the "
                "floor",
                "the box filter of a pixel's area by 64 rays; floor: another pattern of 64",
                ", ".join(f"{h} {row[h]:.1f} (floor {floor[h]:.1f})" for h in shares.values()),
                all(row[h] <= max(limits[w], 2.0 * floor[h]) for (_, w), h in shares.items()),
            )
        )
    return claims


def _span(factors: dict[float, float]) -> str:
    if not factors:
        return "?"
    low, high = (f"{bound(factors.values()):.2g}" for bound in (min, max))
    return low if low == high else f"{low} to {high}"


def _time_plot(rows: list[Row]) -> Plot:
    distance, median = "distance per event", "timing error, median [us]"
    pairs = [("renders", distance), ("both [s]", distance), ("renders", median), ("renders", "spurious [%]")]
    panels = [
        Panel(
            x_label=x,
            y_label=y,
            series=lines(rows, x, y, by="scheme", y_floor=1e-3),
            x_scale="log",
            y_scale="log",
        )
        for x, y in (*pairs, ("renders", "missing [%]"))
    ]
    return Plot("events-time", "In time: error against renders and run time", panels)


def _space_plot(rows: list[Row]) -> Plot:
    """Draw shares against the time of a picture, from 0 %, with the floor as a line."""
    panels = []
    for case in dict.fromkeys(map(_case, rows)):
        mine = [row for row in rows if _case(row) == case]
        floor, plain = mine[0], [row for row in mine if "pattern" not in row["rays per pixel"]]
        series = [
            Series(
                label=f"{kind} within {window:g} ms",
                x=[row["time of a picture [ms]"] for row in plain],
                y=[row[f"{kind}, {window:g} ms [%]"] for row in plain],
                style="line" if kind == "spurious" else "dashed",
                names=[row["rays per pixel"].split()[0] for row in plain]
                if (kind, window) == ("spurious", 1.0)
                else (),
            )
            for kind in ("spurious", "missed")
            for window in WINDOWS_MS
        ]
        panels.append(
            Panel(
                title=", ".join(case),
                x_label="time of a picture [ms]",
                y_label="share of events [%]",
                series=series,
                x_scale="log",
                y_min=0.0,
                y_lines={"spurious within 20 ms of another pattern of 64 rays": floor["spurious, 20 ms [%]"]},
            )
        )
    title = "In space: false events against run time, with the rays per pixel beside the marks"
    return Plot("events-space", title, panels, 2)
