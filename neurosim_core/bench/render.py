"""Rendering: error against run time, and the false events that aliasing makes.

Two questions. How far is the log radiance of a picture from that of 64 rays per pixel, and what does it cost
to come nearer? And when a camera pans slowly over a checkerboard with squares down to a fraction of a pixel,
how many of the events are there only because too few samples were taken?
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

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
    View,
    busy_s,
    device_title,
    find_device,
    free_views,
    join_events,
    load_scene,
    upload_scene,
)
from neurosim_core.bench.matching import match
from neurosim_core.bench.options import Options, Progress, silent
from neurosim_core.bench.report import Chapter, Claim, Panel, Picture, Plot, Row, Series, Table, lines
from neurosim_core.bench.scenes import checkerboard_floor

SAMPLES = (1, 2, 4, 8, 16)
REFERENCE_SAMPLES = 64
CHECK_PX = 3.0
"""Size of the squares of the checkerboard where they are nearest [px]."""
_HEIGHT_M, _PITCH_RAD, _SPEED_PX_S = 1.5, math.radians(40.0), 20.0
_DEFAULT, _POINT = "trilinear", "nearest"

TIME_MS = "time of a picture [ms]"


def measure(options: Options, progress: Progress = silent) -> Chapter:
    """Measure, and return the chapter."""
    device, quick = find_device(options.device), options.quick
    samples = options.samples or (SAMPLES[::2] if quick else SAMPLES)
    lens = _lens(96, 72) if quick else _lens(346, 260)
    shown = load_scene(options.scene, rooms=1 if quick else None)
    points, yaws = free_views(shown, 2 if quick else 6, device=device)
    views = {
        shown.name: (shown, _looking(points, yaws, math.radians(10.0))),
        "checkerboard": (_checkerboard(lens), _looking(_above(1), np.array([0.1]), _PITCH_RAD)),
    }
    rows = []
    for name, (where, poses) in views.items():
        truth, _ = _render(where, lens, poses, device, samples_per_pixel=REFERENCE_SAMPLES)
        for settings in _settings(samples, quick):
            progress(f"{name}, {settings}")
            seen, seconds = _render(where, lens, poses, device, **settings)
            error = np.abs(seen.astype(np.float64) - truth)
            row: Row = {
                "scene": name,
                "filter": _title(settings),
                "rays per pixel": settings["samples_per_pixel"],
            }
            row |= {
                "RMS error": math.sqrt(np.mean(error**2)),
                "99 % of errors below": np.quantile(error, 0.99),
            }
            rows.append({**row, TIME_MS: 1e3 * seconds})
    pan, pictures = _pan(_lens(64, 48) if quick else _lens(173, 130), device, samples, quick, progress)
    return _chapter(rows, pan, pictures, device, f"{lens.width}x{lens.height}")


def _lens(width: int, height: int) -> PinholeConfig:
    return PinholeConfig(width=width, height=height, horizontal_fov_rad=1.5)


def _settings(samples: Sequence[int], quick: bool) -> list[dict[str, Any]]:
    """Return settings of `RenderConfig` that are compared: filters and biases, each with all samples."""
    biases = (-2.0, 0.0) if quick else (-2.0, -1.0, 0.0, 1.0, 2.0)
    filters = [{"texture_filter": _DEFAULT, "mip_bias": bias} for bias in biases]
    filters += [{"texture_filter": name} for name in ("bilinear", _POINT)]
    counts = dict.fromkeys((*samples, RenderConfig().samples_per_pixel))
    return [{"samples_per_pixel": count, **chosen} for chosen in filters for count in counts]


def _title(settings: dict[str, Any]) -> str:
    bias = settings.get("mip_bias", 0.0)
    return f"{settings.get('texture_filter', _DEFAULT)}{f', bias {bias:+g}' if bias else ''}"


def _looking(points: NDArray[Any], yaws_rad: NDArray[Any], pitch_rad: float) -> Poses:
    """Return poses of cameras that look along yaws, and down by a pitch, with upright pictures."""
    forward_left_up = Rotation.from_euler(
        "ZY", np.stack([yaws_rad, np.full_like(yaws_rad, pitch_rad)], axis=1)
    )
    optical = Rotation.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    return points.astype(np.float32), (forward_left_up * optical).as_quat().astype(np.float32)


def _above(count: int) -> NDArray[np.float64]:
    return np.tile([0.013, 0.007, _HEIGHT_M], (count, 1))


def _checkerboard(lens: PinholeConfig) -> Scene:
    """Return a floor whose squares are 3 pixels wide at the lower border, and smaller further away."""
    fy = lens.intrinsics().fy
    return checkerboard_floor(
        CHECK_PX / fy * _HEIGHT_M / math.sin(_PITCH_RAD + math.atan(0.5 * lens.height / fy))
    )


@lru_cache(maxsize=1)
def _upload(scene: Scene, device: str, filter_settings: tuple[tuple[str, Any], ...]) -> Any:
    return upload_scene(scene, RenderConfig(exposure=1.0, **dict(filter_settings)), device=device)


def _view(scene: Scene, lens: PinholeConfig, device: str, count: int, **settings: Any) -> View:
    rays = {key: settings.pop(key) for key in ["samples_per_pixel"] if key in settings}
    arrays = _upload(scene, device, tuple(sorted(settings.items())))
    return View(replace(arrays, config=arrays.config.model_copy(update=rays)), lens, count=count)


def _render(
    scene: Scene, lens: PinholeConfig, poses: Poses, device: str, **settings: Any
) -> tuple[NDArray[np.float32], float]:
    """Return log radiance, shape [K, H, W], and the time of one picture, the best of three [s]."""
    count = len(poses[0])
    view = _view(scene, lens, device, count, **settings)
    view.render(poses)  # loads the kernel
    times_s, log = [], None
    for _ in range(3):
        begin_s = busy_s(device)
        log = view.render(poses)
        times_s.append((busy_s(device) - begin_s) / count)
    assert log is not None
    return log.numpy(), min(times_s)


def _pan(
    lens: PinholeConfig, device: str, samples: Sequence[int], quick: bool, progress: Progress
) -> tuple[list[Row], list[Picture]]:
    """Pan slowly over the checkerboard; return a row for each setting, and pictures of false events."""
    rate_hz, seconds = (250.0, 0.2) if quick else (500.0, 0.5)
    stamps_ns = np.rint(np.arange(seconds * rate_hz + 1) * (1e9 / rate_hz)).astype(np.int64)
    # the axis of the turn is oblique: the centre moves by the cosine of the pitch
    rate_rad_s = _SPEED_PX_S / (lens.intrinsics().fx * math.cos(_PITCH_RAD))
    poses = _looking(_above(len(stamps_ns)), 0.1 + rate_rad_s * 1e-9 * stamps_ns, _PITCH_RAD)
    scene = _checkerboard(lens)
    window_us = 1e6 * 0.5 / _SPEED_PX_S  # half a pixel
    few: list[dict[str, Any]] = [
        {"samples_per_pixel": 1, "texture_filter": name} for name in (_POINT, "bilinear", _DEFAULT)
    ]
    few.append({})
    if not quick:
        few += [{"samples_per_pixel": 1, "mip_bias": bias} for bias in (-2.0, -1.0, 1.0, 2.0)]
        few += [
            {"samples_per_pixel": n, **more}
            for more in ({}, {"texture_filter": _POINT})
            for n in samples
            if n > 1
        ]
    truth, first, _ = _pan_events(scene, lens, poses, stamps_ns, device, samples_per_pixel=REFERENCE_SAMPLES)
    pictures = [Picture(title=f"log radiance, {REFERENCE_SAMPLES} rays", values=first.tolist())]
    rows: list[Row] = []
    for settings in few:
        progress(f"a pan over the checkerboard, {settings}")
        events, seen, picture_s = _pan_events(scene, lens, poses, stamps_ns, device, **settings)
        aligned = match(truth, events, width=lens.width, window_us=window_us)
        rays = settings.get("samples_per_pixel", RenderConfig().samples_per_pixel)
        title = f"{_title(settings)}, {rays} rays"
        if settings in few[:1] or not settings:
            pictures.append(Picture(title=f"log radiance, {title}", values=seen.tolist()))
        row: Row = {"setting": title, "events": len(events.t), "of the reference": len(truth.t)}
        row |= {"missing": aligned.missing_count, "false": aligned.spurious_count}
        rows.append({**row, TIME_MS: 1e3 * picture_s})
    return rows, pictures


def _pan_events(
    scene: Scene,
    lens: PinholeConfig,
    poses: Poses,
    stamps_ns: NDArray[np.int64],
    device: str,
    **settings: Any,
) -> tuple[EventArrays, NDArray[np.float32], float]:
    """Return the events of a pan, its first picture, and the time of one picture [s]."""
    view = _view(scene, lens, device, 50, **settings)
    camera = EventCamera(
        EventCameraConfig(), width=lens.width, height=lens.height, device=device, sensor="pan"
    )
    first = view.render((poses[0][:1], poses[1][:1]))[0]
    picture = first.numpy().copy()
    camera.reset(first, int(stamps_ns[0]))
    parts, times_s, begin_s = [], [], busy_s(device)
    for rows, frames in view.stacks((poses[0][1:], poses[1][1:])):
        stamps = stamps_ns[1:][rows]
        times_s.append((busy_s(device) - begin_s) / len(stamps))
        parts.append(camera.feed(frames[: len(stamps)], stamps).numpy())
        begin_s = busy_s(device)
    return join_events(parts), picture, min(times_s)


def _chapter(rows: list[Row], pan: list[Row], pictures: list[Picture], device: str, size: str) -> Chapter:
    point, default = pan[0], next(row for row in pan if row["setting"] == f"{_DEFAULT}, 1 rays")
    threshold, said, panels = EventCameraConfig().threshold_on, [], []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = [row for row in rows if row["scene"] == scene]
        one, nearest = (
            next(row for row in mine if (row["filter"], row["rays per pixel"]) == (name, 1))
            for name in (_DEFAULT, _POINT)
        )
        best = min(mine, key=lambda row: row["RMS error"])
        said.append(
            f"{scene}: {one['RMS error']:.3f} with one ray and the default filter, "
            f"{nearest['RMS error']:.3f} by point sampling, {best['RMS error']:.3f} at best "
            f"({best['filter']}, {best['rays per pixel']} rays) in {best[TIME_MS] / one[TIME_MS]:.1f} times "
            "the time."
        )
        panels.append(
            Panel(
                title=scene,
                x_label=TIME_MS,
                y_label="RMS error of log radiance",
                series=lines(mine, TIME_MS, "RMS error", by="filter"),
                x_scale="log",
                y_scale="log",
                y_lines={"one event": threshold},
            )
        )
    places = list(range(len(pan)))
    counts = Panel(
        x_label="events",
        series=[Series(label=k, x=places, y=[r[k] for r in pan], style="bar") for k in ("false", "missing")],
        y_ticks={row["setting"]: place for place, row in enumerate(pan)},
        x_lines={"events of the reference": point["of the reference"]},
    )
    times = f"Natural logarithm; {size}; baked light; CPU time of all threads, or wall-clock "
    "time on CUDA."
    return Chapter(
        name="render",
        title="Rendering: error against run time, and false events from aliasing",
        summary=f"RMS errors of log radiance against {REFERENCE_SAMPLES} rays per pixel, on "
        f"{device_title(device)}; an event is {threshold:g}.\n\n"
        + "\n\n".join(said)
        + f"\n\nA pan at {_SPEED_PX_S:g} px/s over squares of at most {CHECK_PX:g} px: of "
        f"{point['of the reference']:,} true events one ray with the default filter misses "
        f"{default['missing']:,} and adds {default['false']:,} false ones; point sampling misses "
        f"{point['missing']:,} and adds {point['false']:,}.",
        claims=[
            Claim(
                "with one ray per pixel the default filter gives at least 10 times fewer false events than "
                "point sampling, on a slow pan over a fine checkerboard",
                "mip-mapping (Williams 1983) against point sampling; truth: 64 rays per pixel",
                f"{point['false'] / max(default['false'], 1):,.0f} times: {default['false']:,} against "
                f"{point['false']:,}",
                point["false"] >= 10 * max(default["false"], 1),
            )
        ],
        tables=[
            Table("render-pictures", "Error of log radiance and time of a picture", rows, times),
            Table(
                "render-aliasing",
                "Events of a slow pan over a fine checkerboard",
                pan,
                "Within half a pixel.",
            ),
        ],
        plots=[
            Plot(
                "render-error", "Error against the time of a picture; lines join numbers of rays", panels, 2
            ),
            Plot("render-aliasing", "A pan over a fine checkerboard", [*pictures, counts], 2),
        ],
    )
