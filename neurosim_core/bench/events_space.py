"""Events over rays per pixel: a camera turns on the spot and flies along a planned path.

Pictures are rendered at 500 Hz with several numbers of rays per pixel; the events of 64 rays are the
reference. Another pattern of 64 rays shows how well that is known: no other picture can be nearer. As many
events as possible are matched within a window; see `matching`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.bench.engine import (
    EventArrays,
    EventCamera,
    EventCameraConfig,
    PinholeConfig,
    Poses,
    RenderConfig,
    Scene,
    ShiftedLens,
    View,
    busy_s,
    camera_poses,
    fly,
    join_events,
    load_config,
    scene_settings,
    upload_scene,
)
from neurosim_core.bench.matching import match
from neurosim_core.bench.options import Progress
from neurosim_core.bench.report import Claim, Panel, Plot, Row, Series
from neurosim_core.bench.scenes import thin_structures

WINDOWS_MS = (1.0, 5.0, 20.0)
"""Within which events are matched."""
SAMPLES = (1, 2, 4, 8, 16, 64)
REFERENCE_SAMPLES = 64
SPACE_HZ = 500.0


def sample_in_space(
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
    settings = {"duration_s": 2.0 + seconds, "device": device, **scene_settings(scene, quick=quick)}
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


def _case(row: Row) -> tuple[str, ...]:
    return row["scene"], row["motion"], row["pixels"]


def space_claims(rows: Sequence[Row]) -> list[Claim]:
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


def space_plot(rows: list[Row]) -> Plot:
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
                log="x",
                y_min=0.0,
                y_lines={"spurious within 20 ms of another pattern of 64 rays": floor["spurious, 20 ms [%]"]},
            )
        )
    title = "In space: false events against run time, with the rays per pixel beside the marks"
    return Plot("events-space", title, panels, 2)
