"""The speed of whole steps and of their parts, and of a naive event camera on the same frames.

Everything is measured on one device in one run. A row that fails says why, and the next one is measured.
"""

from __future__ import annotations

import dataclasses
import gc
import itertools
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
import warp as wp

from neurosim_core.bench import engine
from neurosim_core.bench.naive_events import NaiveEventCamera
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, cell, panel
from neurosim_core.bench.step import RATE_HZ, time_steps

EXACT, ADAPTIVE = "every step rendered", "at most 0.5 px between renders"
STACK = "events: the whole stack a call"
DROP_IN, NAIVE = "events: one frame a call, read by the host", "naive: one frame a call, read by the host"
"""Parts, besides what is rendered: the count of events is read each call, columns only of whole stacks."""
_VGA, _DAVIS = (640, 480), (346, 260)
_ALONE = ("renders per launch", "rays per pixel")
"""What is varied alone, and the heading of its value."""
_STAMPS_NS = 1_000_000
"""Between two frames [ns]."""


def measure(options: Options) -> Chapter:
    """Measure, and return the chapter."""
    device, quick = engine.find_device(options.device), options.quick
    on_cuda = bool(wp.get_device(device).is_cuda)
    sizes = ((48, 36), (96, 72)) if quick else ((128, 128), _DAVIS, _VGA, (1280, 720))
    size = sizes[0] if quick else _VGA if on_cuda else _DAVIS
    instants = 4 if quick else 32 if on_cuda else 16
    counts = (1, 4) if quick else (1, 4, 16, 32, 64)
    duration_s = 2.0 if quick else 40.0 if on_cuda else 12.0

    fixed = {"device": device, "duration_s": duration_s, **engine.scene_settings(options.scene, quick=quick)}

    def settings(pixels: tuple[int, int] = size, launch: int = instants, **more: Any) -> dict[str, Any]:
        return engine.event_settings(pixels, rate_hz=RATE_HZ, instants=launch, **more) | fixed

    options.progress("the scene, its light and the path")
    base = engine.make_model(engine.load_config(settings()))

    def model(more: dict[str, Any]) -> engine.Model:
        config = engine.load_config(settings(**more))
        uploaded = base.scene_on_device
        if "samples" in more:
            uploaded = engine.upload_scene(base.scene, config.render, device=device)
        return engine.refit(dataclasses.replace(base, config=config, scene_on_device=uploaded), config)

    limits = {EXACT: None, ADAPTIVE: 0.5}
    cases: list[tuple[str, str, dict[str, Any]]] = [
        ("resolution", mode, {"pixels": pixels, "max_displacement_px": limit_px})
        for pixels, (mode, limit_px) in itertools.product(sizes, limits.items())
    ]
    cases += [("renders per launch", EXACT, {"launch": count}) for count in counts]
    cases += [("rays per pixel", EXACT, {"samples": count}) for count in options.samples or (1, 4, 16)]
    rows = []
    for what, mode, more in cases:
        options.progress(f"whole steps: {what}, {mode}")
        found = _try(partial(_steps, partial(model, more), quick))
        rows.append({"what is varied": what, "mode": mode, **found})
    options.progress("parts alone")
    parts = _parts(base, options)
    return _chapter(rows, parts, device, on_cuda)


def _try(measure: Callable[[], Row]) -> Row:
    """Return what was measured, or why it was not: nothing ends the run."""
    try:
        return measure()
    except Exception as error:  # whatever it is, the row says so
        return {"failure": f"{type(error).__name__}: {error}"}
    finally:
        gc.collect()  # states refer to themselves, and hold memory of the device


def _steps(make: Callable[[], engine.Model], quick: bool) -> Row:
    """Time whole steps from 1 s of the flight on: it begins at rest."""
    model = make()
    warm_up = 100 if quick else 1000
    left = round((model.config.duration_s - 0.2) * RATE_HZ) - warm_up
    return time_steps(
        model, warm_up=warm_up, count=left // 6, repetitions=2 if quick else 5, repetition_s=0.8
    )


def _seconds(call: Callable[[], object], device: str, seconds: float) -> float:
    """Return how long a call takes that is repeated for about so long [s], the device included."""
    call()
    wp.synchronize_device(device)
    count = 1
    while True:
        begin_s = time.perf_counter()
        for _ in range(count):
            call()
        wp.synchronize_device(device)
        elapsed_s = time.perf_counter() - begin_s
        if elapsed_s >= 0.5 * seconds:
            return elapsed_s / count
        count = math.ceil(count * min(10.0, seconds / max(elapsed_s, 1e-6)))


def _parts(model: engine.Model, options: Options) -> list[Row]:
    """Time the render and the event camera alone, and a naive camera on the same frames.

    Frames of a flight are shown forth and back, so that the picture never jumps.
    """
    device, instants = model.device, model.config.instants_per_launch
    (sensor,) = model.config.sensors.values()
    lens, seconds = cast(Any, sensor).lens, 0.1 if options.quick else 0.5
    settings = model.config.model_copy(update={"duration_s": 1.5})
    flown = engine.fly(settings, RATE_HZ)
    position, orientation = (values[-instants:] for values in flown.poses())
    rows: list[Row] = []
    for output, name in (("depth", "cast: rays alone"), ("log_radiance", "render: log radiance")):
        options.progress(name)
        view = engine.View(model.scene_on_device, lens, count=instants, output=output)
        taken_s = _seconds(partial(view.render, (position, orientation)), device, seconds)
        rows.append({"part": name, "us per frame": 1e6 * taken_s / instants})
    stack = view.render((position, orientation)).numpy()
    forth_and_back = np.concatenate([stack, stack[::-1]])
    frames: Any = wp.array(forth_and_back, dtype=float, device=device)
    count, pixel = len(forth_and_back), engine.EventCameraConfig()
    each = [frames[index] for index in range(count)]
    size: dict[str, Any] = {"width": lens.width, "height": lens.height, "device": device}
    stamps = np.arange(1, count + 1, dtype=np.int64) * _STAMPS_NS

    def timed(part: str, frames_a_call: int, make: Any, feed: Callable[[Any, int], int]) -> Row:
        """Feed a camera call by call; `feed` takes it and the number of the call, and returns its events."""
        camera = make()
        camera.reset(each[0])
        calls = found = 0

        def call() -> None:
            nonlocal calls, found
            found += feed(camera, calls)
            calls += 1

        taken_s = _seconds(call, device, seconds)
        row: Row = {"part": part, "us per frame": 1e6 * taken_s / frames_a_call}
        return {**row, "events per frame": found / (calls * frames_a_call)}

    def whole_stack(camera: Any, call: int) -> int:
        return len(camera.feed(frames, call * stamps[-1] + stamps).numpy().t)

    def drop_in(camera: Any, call: int) -> int:
        return len(camera.step(each[(call + 1) % count], (call + 1) * _STAMPS_NS))

    def naive(camera: Any, call: int) -> int:
        return int(camera.feed(each[(call + 1) % count], (call + 1) * _STAMPS_NS // 1000))

    thresholds: dict[str, Any] = {"threshold_on": pixel.threshold_on, "threshold_off": pixel.threshold_off}
    ours, theirs = partial(engine.EventCamera, pixel, **size), partial(NaiveEventCamera, **size, **thresholds)
    cases = (STACK, count, ours, whole_stack), (DROP_IN, 1, ours, drop_in), (NAIVE, 1, theirs, naive)
    for part, frames_a_call, make, feed in cases:
        rows.append(_try(partial(timed, part, frames_a_call, make, feed)))
    for row in rows:
        row["frames/s"] = 1e6 / row["us per frame"] if "us per frame" in row else None
    return rows


def _chapter(rows: list[Row], parts: list[Row], device: str, on_cuda: bool) -> Chapter:
    known = [row for row in rows if "whole steps/s" in row]
    vga = next((row for row in known if row["pixels"] == "640x480" and row["mode"] == EXACT), None)
    by_part = {row.get("part"): row.get("frames/s") for row in parts}
    stack, naive = by_part.get(STACK), by_part.get(NAIVE)
    best, y = max(known, key=lambda row: row["whole steps/s"]), "whole steps/s"
    panels = []
    for what, x in (("resolution", "pixels of the camera"), *((name, name) for name in _ALONE)):
        mine = [
            {**row, "pixels of the camera": math.prod(map(int, row["pixels"].split("x")))}
            for row in known
            if row["what is varied"] == what
        ]
        panels.append(panel(mine, x, y, by="mode", title=what, log="xy", y_min=1.0))
    return Chapter(
        name="throughput",
        title="Whole steps a second, and where their time goes",
        summary=f"On {engine.device_title(device)} at most {best[y]:,.0f} whole steps a second "
        f"({best['pixels']}, {best['mode']}); a step is physics, control, render, event scan and "
        "packets on the host.",
        claims=[
            Claim("640x480, every step rendered: >= 2,700 whole steps a second on a CUDA device",
                  "Neurosim paper, arXiv 2602.15018: 2,300 to 2,700 on an RTX 4090",
                  f"{vga[y]:,.0f}/s" if vga else "not flown",
                  vga[y] >= 2700.0 if vga and on_cuda else None),
            Claim("the event camera takes no longer for a frame than a naive one on the same frames",
                  "one event per pixel and frame, unsorted, its count read by the host, in the same run",
                  f"{cell(stack)} against {cell(naive)} frames/s",
                  stack >= naive if stack and naive else None),
        ],
        tables=[
            Table("throughput-steps", "Whole steps a second", rows, "Medians, from 1 s on, at 1 kHz."),
            Table("throughput-parts", "Parts alone", parts, "Frames of a flight, shown forth and back."),
        ],
        plots=[Plot("throughput", "Whole steps a second", panels, 2)],
    )  # fmt: skip
