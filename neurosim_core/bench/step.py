"""Whole steps a second: physics, control, render, event scan and packets read back, one render per step."""

from __future__ import annotations

import time
from itertools import islice
from typing import Any, cast

import numpy as np

from neurosim_core.bench import engine
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Row, Table

RATE_HZ = 1000.0
"""Steps per simulated second."""


def measure(options: Options) -> Chapter:
    """Fly with one event camera and nothing else, and time it."""
    count = options.steps // 10 if options.quick else options.steps
    names = engine.option_names("events", max_displacement_px="--max-displacement")
    names["render.samples_per_pixel"] = "--samples"
    rows = []
    for rays in options.samples or (None,):
        options.progress("set-up" if rays is None else f"{rays} rays per pixel")
        more: dict[str, Any] = {"samples": rays, "max_displacement_px": options.max_displacement}
        size = (options.width or 640, options.height or 480)
        settings = engine.event_settings(size, rate_hz=RATE_HZ, instants=options.instants, **more)
        settings |= {"duration_s": 7.0 * count / RATE_HZ + 1.0, "device": options.device}
        settings |= engine.scene_settings(options.scene)
        model = engine.make_model(engine.load_config(settings, options=names))
        rows.append(time_steps(model, warm_up=count // 2, count=count, repetitions=5))
    best = max(rows, key=lambda row: row["whole steps/s"])
    return Chapter(
        name="step",
        title="Whole steps a second",
        summary=f"{best['whole steps/s']:,.0f} whole steps a second on "
        f"{engine.device_title(options.device)}, {best['times real time']:.3g} times real time at "
        f"{RATE_HZ:g} steps a second.",
        tables=[Table("step", "Whole steps a second", rows, "Medians of five repetitions.")],
    )


def time_steps(
    model: engine.Model, *, warm_up: int, count: int, repetitions: int, repetition_s: float = float("inf")
) -> Row:
    """Fly a model with one event camera and nothing else, and return a row of what was measured.

    The flight goes on from one repetition to the next. A repetition ends after `count` steps or
    `repetition_s`, whichever comes first.
    """
    camera: Any
    (camera,) = model.config.sensors.values()
    instants = model.config.instants_per_launch
    packets = engine.run_model(model, engine.make_state(model))
    for _ in islice(packets, 1 + warm_up // instants):
        pass
    rates, events, steps, last_ns = [], 0, 0, None
    for _ in range(repetitions):
        flown, begin_s = 0, time.perf_counter()
        for packet in packets:
            if last_ns is not None:
                flown += round(1e-9 * (packet.stamp_ns - last_ns) * RATE_HZ)
            last_ns = packet.stamp_ns
            events += len(cast(engine.Events, packet).numpy().t)
            if flown >= count or (flown and time.perf_counter() - begin_s > repetition_s):
                break
        rates.append(flown / (time.perf_counter() - begin_s))
        steps += flown
    rate = float(np.median(rates))
    return {
        "scene": model.scene.name,
        "triangles": len(model.scene.faces),
        "pixels": f"{camera.lens.width}x{camera.lens.height}",
        "rays per pixel": model.config.render.samples_per_pixel,
        "renders per launch": instants,
        "whole steps/s": rate,
        "slowest": min(rates),
        "fastest": max(rates),
        "times real time": rate / RATE_HZ,
        "events per step": events / max(steps, 1),
    }
