"""Rendering: error against run time.

How far is the log radiance of a picture from that of 64 rays per pixel, and what does it cost to come nearer?
What that means for events is asked by `events_space`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.bench import engine
from neurosim_core.bench.events_space import thin_structures
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, panel

SAMPLES = (1, 2, 4, 8, 16)
REFERENCE_SAMPLES = 64
TIME_MS = "time of a picture [ms]"
_FILTERS: dict[str, dict[str, Any]] = {
    "trilinear": {},
    "trilinear, bias -1": {"mip_bias": -1.0},
    "trilinear, bias +1": {"mip_bias": 1.0},
    "bilinear": {"texture_filter": "bilinear"},
    "nearest": {"texture_filter": "nearest"},
}
_DEFAULT = engine.RenderConfig().samples_per_pixel
_OWN, _ONE, _POINT = ("trilinear", _DEFAULT), ("trilinear", 1), ("nearest", 1)


def measure(options: Options) -> Chapter:
    """Measure, and return the chapter."""
    device, quick = engine.find_device(options.device), options.quick
    samples = dict.fromkeys((1, *(options.samples or (SAMPLES[::2] if quick else SAMPLES)), _DEFAULT))
    width, height = (96, 72) if quick else (346, 260)
    lens = engine.PinholeConfig(width=width, height=height, horizontal_fov_rad=1.5)
    shown = engine.load_config(engine.scene_settings(options.scene, quick=quick)).scene.load()
    around = np.arange(4) * np.pi / 2
    views = (
        (shown, *engine.free_views(shown, 2 if quick else 6, device=device)),
        (thin_structures(), np.zeros((4, 3)), around),
    )
    rows: list[Row] = []
    for scene, points, yaws in views:
        turns = Rotation.from_euler("ZY", np.stack([yaws, np.full_like(yaws, math.radians(10.0))], axis=1))
        poses = engine.camera_poses(points, turns)
        lit = {
            name: engine.upload_scene(scene, engine.RenderConfig(exposure=1.0, **chosen), device=device)
            for name, chosen in _FILTERS.items()
        }
        truth, _ = _render(lit["trilinear"], lens, poses, REFERENCE_SAMPLES)
        for name, count in itertools.product(_FILTERS, samples):
            options.progress(f"{scene.name}, {name}, {count} rays per pixel")
            seen, seconds = _render(lit[name], lens, poses, count)
            error = np.abs(seen.astype(np.float64) - truth)
            row: Row = {"scene": scene.name, "filter": name, "rays per pixel": count}
            row |= {"RMS error": math.sqrt(np.mean(error**2)), "99 % below": np.quantile(error, 0.99)}
            rows.append({**row, TIME_MS: 1e3 * seconds})
    return _chapter(rows, device, f"{lens.width}x{lens.height}")


def _render(
    lit: Any, lens: engine.PinholeConfig, poses: engine.Poses, count: Any
) -> tuple[NDArray[np.float32], float]:
    """Return log radiance, shape [K, H, W], and the time of one picture, the best of three [s]."""
    config = lit.config.model_copy(update={"samples_per_pixel": count})
    view = engine.View(replace(lit, config=config), lens, count=len(poses[0]))
    log = view.render(poses)  # loads the kernel
    times_s = []
    for _ in range(3):
        begin_s = engine.busy_s(view.device)
        log = view.render(poses)
        times_s.append((engine.busy_s(view.device) - begin_s) / len(poses[0]))
    return log.numpy(), min(times_s)


def _chapter(rows: list[Row], device: str, size: str) -> Chapter:
    threshold, said, panels, claims = engine.EventCameraConfig().threshold_on, [], [], []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = {(row["filter"], row["rays per pixel"]): row for row in rows if row["scene"] == scene}
        own, one, point = (mine[case]["RMS error"] for case in (_OWN, _ONE, _POINT))
        said.append(
            f"{scene}: {own:.3f} by default, in {mine[_OWN][TIME_MS] / mine[_ONE][TIME_MS]:.1f} times the "
            f"time of one ray, which has {one:.3f} with the default filter and {point:.3f} by point sampling."
        )
        text = f"{scene}: the default has at most half the RMS error of one ray per pixel"
        reference = f"the box filter of a pixel's area by {REFERENCE_SAMPLES} rays"
        claims.append(Claim(text, reference, f"{own:.3f} against {one:.3f}", own <= 0.5 * one))
        drawn = [{**row, "what": name} for (name, count), row in mine.items() if count != _DEFAULT]
        drawn.append({**mine[_OWN], "what": "the default"})
        lines = {"one event": threshold}
        panels.append(panel(drawn, TIME_MS, "RMS error", by="what", title=scene, log="xy", y_lines=lines))
    note = f"Natural logarithm; {size}; baked light; CPU time of all threads, or wall-clock time on CUDA."
    title = "Error against the time of a picture; lines join numbers of rays"
    return Chapter(
        name="render",
        title="Rendering: error against run time",
        summary=f"RMS errors of log radiance against {REFERENCE_SAMPLES} rays per pixel, on "
        f"{engine.device_title(device)}; an event is {threshold:g}.\n\n" + "\n\n".join(said),
        claims=claims,
        tables=[Table("render-pictures", "Error of log radiance and time of a picture", rows, note)],
        plots=[Plot("render-error", title, panels, 2)],
    )
