"""Rendering: error against run time.

How far is the log radiance of a picture from that of 64 rays per pixel, and what does it cost to come nearer?
False events from aliasing are in `events_space`.
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
    load_scene,
    upload_scene,
)
from neurosim_core.bench.options import Options, Progress, silent
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, panel
from neurosim_core.bench.scenes import checkerboard_floor

SAMPLES = (1, 2, 4, 8, 16)
REFERENCE_SAMPLES = 64
CHECK_PX = 3.0
"""Size of the squares of the checkerboard where they are nearest [px]."""
_HEIGHT_M, _PITCH_RAD = 1.5, math.radians(40.0)
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
    return _chapter(rows, device, f"{lens.width}x{lens.height}")


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


def _chapter(rows: list[Row], device: str, size: str) -> Chapter:
    threshold, said, panels = EventCameraConfig().threshold_on, [], []
    errors = {(row["scene"], row["filter"], row["rays per pixel"]): row["RMS error"] for row in rows}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = [row for row in rows if row["scene"] == scene]
        best = min(mine, key=lambda row: row["RMS error"])
        one = next(row for row in mine if (row["filter"], row["rays per pixel"]) == (_DEFAULT, 1))
        said.append(
            f"{scene}: {one['RMS error']:.3f} with one ray and the default filter, "
            f"{errors[scene, _POINT, 1]:.3f} by point sampling, {best['RMS error']:.3f} at best "
            f"({best['filter']}, {best['rays per pixel']} rays) in {best[TIME_MS] / one[TIME_MS]:.1f} times "
            "the time."
        )
        event = {"one event": threshold}
        panels.append(panel(mine, TIME_MS, "RMS error", by="filter", title=scene, log="xy", y_lines=event))
    default, point = (errors["checkerboard", name, 1] for name in (_DEFAULT, _POINT))
    note = f"Natural logarithm; {size}; baked light; CPU time of all threads, or wall-clock time on CUDA."
    return Chapter(
        name="render",
        title="Rendering: error against run time",
        summary=f"RMS errors of log radiance against {REFERENCE_SAMPLES} rays per pixel, on "
        f"{device_title(device)}; an event is {threshold:g}.\n\n" + "\n\n".join(said),
        claims=[
            Claim(
                "with one ray per pixel the default filter has at most half the error of point sampling, "
                f"over squares of at most {CHECK_PX:g} px",
                "mip-mapping (Williams 1983) against point sampling; truth: 64 rays per pixel",
                f"{default:.3f} against {point:.3f}",
                default <= 0.5 * point,
            )
        ],
        tables=[Table("render-pictures", "Error of log radiance and time of a picture", rows, note)],
        plots=[
            Plot("render-error", "Error against the time of a picture; lines join numbers of rays", panels, 2)
        ],
    )
