"""Rendering: error against run time.

How far is the log radiance of a picture from that of 64 rays per pixel, and what does it cost to come nearer?
And how many false events does a pan over a checkerboard make? Other false events are in `events_space`.
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

from neurosim_core.bench import engine
from neurosim_core.bench.events_space import SPACE_HZ, events_of
from neurosim_core.bench.matching import match
from neurosim_core.bench.options import Options, Progress, silent
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, panel
from neurosim_core.bench.scenes import checkerboard_floor
from neurosim_core.frames import Q_FORWARD_OPTICAL

SAMPLES = (1, 2, 4, 8, 16)
REFERENCE_SAMPLES = 64
CHECK_PX = 3.0
"""Size of the squares of the checkerboard where they are nearest [px]."""
_HEIGHT_M, _PITCH_RAD = 1.5, math.radians(40.0)
_DEFAULT, _POINT = "trilinear", "nearest"
_ADAPTIVE = engine.RenderConfig().samples_per_pixel
_PAN_RAD_S, _PAN_STEPS, _PAN_WINDOW_US = 0.5, 40, 20_000.0

TIME_MS = "time of a picture [ms]"


def measure(options: Options, progress: Progress = silent) -> Chapter:
    """Measure, and return the chapter."""
    device, quick = engine.find_device(options.device), options.quick
    samples = (1, *(options.samples or (SAMPLES[::2] if quick else SAMPLES)))
    width, height = (96, 72) if quick else (346, 260)
    lens = engine.PinholeConfig(width=width, height=height, horizontal_fov_rad=1.5)
    shown = engine.load_scene(options.scene, rooms=1 if quick else None)
    points, yaws = engine.free_views(shown, 2 if quick else 6, device=device)
    above = np.array([[0.013, 0.007, _HEIGHT_M]])
    views = {
        shown.name: (shown, _looking(points, yaws, math.radians(10.0))),
        "checkerboard": (_checkerboard(lens), _looking(above, np.array([0.1]), _PITCH_RAD)),
    }
    rows = []
    for name, (where, poses) in views.items():
        truth, _ = _render(where, lens, poses, device, samples_per_pixel=REFERENCE_SAMPLES)
        for settings in _settings(samples, quick):
            progress(f"{name}, {settings}")
            seen, seconds = _render(where, lens, poses, device, **settings)
            error = np.abs(seen.astype(np.float64) - truth)
            row: Row = {"scene": name, "filter": _title(settings)}
            row |= {"rays per pixel": settings["samples_per_pixel"]}
            row |= {"RMS error": math.sqrt(np.mean(error**2)), "99 % below": np.quantile(error, 0.99)}
            rows.append({**row, TIME_MS: 1e3 * seconds})
    progress("a pan over the checkerboard")
    pan = {
        name: _false_share(views["checkerboard"][0], lens, above, device, name) for name in (_DEFAULT, _POINT)
    }
    return _chapter(rows, pan, device, f"{lens.width}x{lens.height}")


def _settings(samples: Sequence[int], quick: bool) -> list[dict[str, Any]]:
    """Return settings of `RenderConfig` that are compared: filters and biases, each with all samples."""
    biases = (-2.0, 0.0) if quick else (-2.0, -1.0, 0.0, 1.0, 2.0)
    filters = [{"texture_filter": _DEFAULT, "mip_bias": bias} for bias in biases]
    filters += [{"texture_filter": name} for name in ("bilinear", _POINT)]
    return [
        {"samples_per_pixel": count, **chosen}
        for chosen in filters
        for count in dict.fromkeys((*samples, _ADAPTIVE))
        if count in samples or chosen["texture_filter"] == _DEFAULT or not quick
    ]


def _title(settings: dict[str, Any]) -> str:
    bias = settings.get("mip_bias", 0.0)
    return f"{settings.get('texture_filter', _DEFAULT)}{f', bias {bias:+g}' if bias else ''}"


def _looking(points: NDArray[Any], yaws_rad: NDArray[Any], pitch_rad: float) -> engine.Poses:
    """Return poses of cameras that look along yaws, and down by a pitch, with upright pictures."""
    turns = Rotation.from_euler("ZY", np.stack([yaws_rad, np.full_like(yaws_rad, pitch_rad)], axis=1))
    optical = Rotation.from_quat(Q_FORWARD_OPTICAL)
    return points.astype(np.float32), (turns * optical).as_quat().astype(np.float32)


def _checkerboard(lens: engine.PinholeConfig) -> engine.Scene:
    """Return a floor whose squares are 3 pixels wide at the lower border, and smaller further away."""
    fy = lens.intrinsics().fy
    return checkerboard_floor(
        CHECK_PX / fy * _HEIGHT_M / math.sin(_PITCH_RAD + math.atan(0.5 * lens.height / fy))
    )


@lru_cache(maxsize=1)
def _upload(scene: engine.Scene, device: str, **filters: Any) -> Any:
    return engine.upload_scene(scene, engine.RenderConfig(exposure=1.0, **filters), device=device)


def _render(
    scene: engine.Scene,
    lens: engine.PinholeConfig,
    poses: engine.Poses,
    device: str,
    *,
    samples_per_pixel: Any,
    **filters: Any,
) -> tuple[NDArray[np.float32], float]:
    """Return log radiance, shape [K, H, W], and the time of one picture, the best of three [s]."""
    count = len(poses[0])
    arrays = _upload(scene, device, **filters)
    rays = arrays.config.model_copy(update={"samples_per_pixel": samples_per_pixel})
    view = engine.View(replace(arrays, config=rays), lens, count=count)
    view.render(poses)  # loads the kernel
    times_s, log = [], None
    for _ in range(3):
        begin_s = engine.busy_s(device)
        log = view.render(poses)
        times_s.append((engine.busy_s(device) - begin_s) / count)
    assert log is not None
    return log.numpy(), min(times_s)


def _false_share(
    board: engine.Scene, lens: engine.PinholeConfig, point: NDArray[Any], device: str, name: str
) -> float:
    """Return the false events of a pan with one ray per pixel, as a share of those of 64 rays [%]."""
    yaws = 0.1 + _PAN_RAD_S * np.arange(_PAN_STEPS) / SPACE_HZ
    poses = _looking(np.repeat(point, len(yaws), axis=0), yaws, _PITCH_RAD)
    counts = ((_DEFAULT, REFERENCE_SAMPLES), (name, 1))
    truth, seen = (events_of(_upload(board, device, texture_filter=f), lens, poses, n)[1] for f, n in counts)
    found = match(truth, seen, width=lens.width, window_us=_PAN_WINDOW_US, device=device)
    return 100.0 * found.spurious_count / max(len(truth.t), 1)


def _chapter(rows: list[Row], pan: dict[str, float], device: str, size: str) -> Chapter:
    threshold, said, panels = engine.EventCameraConfig().threshold_on, [], []
    errors = {(row["scene"], row["filter"], row["rays per pixel"]): row["RMS error"] for row in rows}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = [row for row in rows if row["scene"] == scene]
        best = min(mine, key=lambda row: row["RMS error"])
        one = next(row for row in mine if (row["filter"], row["rays per pixel"]) == (_DEFAULT, 1))
        own = next(row for row in mine if (row["filter"], row["rays per pixel"]) == (_DEFAULT, _ADAPTIVE))
        cost, most = (row[TIME_MS] / one[TIME_MS] for row in (own, best))
        said.append(
            f"{scene}: {own['RMS error']:.3f} by default, in {cost:.1f} times the time of one ray, which "
            f"has {one['RMS error']:.3f} with the default filter and {errors[scene, _POINT, 1]:.3f} by point "
            f"sampling; {best['RMS error']:.3f} at best ({best['filter']}, {best['rays per pixel']} rays), "
            f"in {most:.1f} times the time."
        )
        event = {"one event": threshold}
        drawn = [{**row, "what": row["filter"]} for row in mine if row["rays per pixel"] != _ADAPTIVE]
        drawn.append({**own, "what": "the default"})
        panels.append(panel(drawn, TIME_MS, "RMS error", by="what", title=scene, log="xy", y_lines=event))
    default, point = pan[_DEFAULT], pan[_POINT]
    note = f"Natural logarithm; {size}; baked light; CPU time of all threads, or wall-clock time on CUDA."
    return Chapter(
        name="render",
        title="Rendering: error against run time",
        summary=f"RMS errors of log radiance against {REFERENCE_SAMPLES} rays per pixel, on "
        f"{engine.device_title(device)}; an event is {threshold:g}.\n\n" + "\n\n".join(said),
        claims=[
            Claim(
                "with one ray per pixel the default filter has at most half the false events of point "
                f"sampling, in a pan over squares of at most {CHECK_PX:g} px",
                "mip-mapping (Williams 1983) against point sampling; truth: 64 rays per pixel",
                f"{default:.0f} against {point:.0f} % of the true events",
                default <= 0.5 * point,
            )
        ],
        tables=[Table("render-pictures", "Error of log radiance and time of a picture", rows, note)],
        plots=[
            Plot("render-error", "Error against the time of a picture; lines join numbers of rays", panels, 2)
        ],
    )
