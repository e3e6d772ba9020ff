"""Many worlds stepped together against as many single simulations: renders, events and steps a second."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.bench import engine
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, panel

RENDERS_PER_STEP = 8
CONTROL_HZ = 100.0
_ROUNDS = 3


def measure(options: Options) -> Chapter:
    """Turn on the spot in many worlds with one event camera each, and in single simulations beside them."""
    device = engine.find_device(options.device)
    columns, rows_px = options.width or options.height, options.height or options.width
    sizes = [(columns, rows_px)] if columns and rows_px else [(64, 64), (128, 128)]
    counts = options.worlds or ((1, 16, 128, 1024, 4096) if wp.get_device(device).is_cuda else (1, 16, 128))
    if options.quick:
        sizes, counts = sizes[:1], options.worlds or (1, 4)
    budget_s = (options.seconds or (0.3 if options.quick else 3.0)) / _ROUNDS
    base, rows = engine.make_model(engine.load_config(_settings(options, device, (32, 32)))), []
    for size, count in itertools.product(sizes, counts):
        pixels = f"{size[0]}x{size[1]}"
        options.progress(f"{count} worlds of {pixels} px")
        model = engine.refit(base, engine.load_config(_settings(options, device, size)))
        rows.append({"pixels": pixels, "worlds": count, **_case(model, count, budget_s)})
    return _chapter(rows, base, device)


def _settings(options: Options, device: str, size: tuple[int, int]) -> dict[str, Any]:
    rate_hz = CONTROL_HZ * RENDERS_PER_STEP
    return {
        **engine.event_settings(size, rate_hz=rate_hz, instants=RENDERS_PER_STEP),
        **engine.scene_settings(options.scene, quick=options.quick),
        "device": device,
        "control": {"rate_hz": CONTROL_HZ},
        "path": {"kind": "hover"},
    }


def _case(model: engine.Model, count: int, budget_s: float) -> Row:
    together = engine.Simulation(model.config, worlds=count, models=[model])
    together.reset()
    turning = np.zeros((count, 4))
    turning[:, 3] = np.linspace(0.5, 1.5, count)  # yaw rates of their own: no two worlds see the same
    singles = [engine.make_state(model) for _ in range(min(count, 4))]
    flown = 0

    def step_together() -> None:
        together.step(turning, mode="velocity")

    def step_alone() -> None:
        nonlocal flown
        index = flown % len(singles)
        engine.step(model, singles[index], turning[index], mode="velocity")
        flown += 1

    for _ in range(3):
        step_together()  # kernels, graphs
    step_alone()
    rates: dict[str, list[tuple[float, float]]] = {"together": [], "alone": []}
    for _ in range(_ROUNDS):  # by turns, so that both see the same machine
        rates["together"].append(_pace(step_together, model.device, budget_s, count))
        rates["alone"].append(_pace(step_alone, model.device, budget_s, 1))
    seen: Any = together.step(turning, mode="velocity").frames["events"]
    events, dropped = int(seen.counts.numpy().sum()), int(seen.dropped.numpy().sum())
    best, alone = max(rates["together"]), max(rates["alone"])
    return {
        "renders/s": best[0] * RENDERS_PER_STEP,
        "steps/s": best[0],
        "events/s": best[0] * events / count,
        "events dropped a step": dropped,
        "renders/s, single": alone[0] * RENDERS_PER_STEP,
        "ratio": best[0] / alone[0],
        "CPU of a render [ms]": 1e3 * min(cpu_s for _, cpu_s in rates["together"]) / RENDERS_PER_STEP,
        "CPU, single [ms]": 1e3 * min(cpu_s for _, cpu_s in rates["alone"]) / RENDERS_PER_STEP,
    }


def _pace(advance: Callable[[], None], device: str, budget_s: float, count: int) -> tuple[float, float]:
    """Return steps of worlds a second, and the CPU time of each [s]; a CUDA device is waited for."""
    begin_s, cpu_s, flown = time.perf_counter(), time.process_time(), 0
    while flown == 0 or time.perf_counter() - begin_s < budget_s:
        advance()
        flown += count
        if flown % (8 * count) == 0:
            wp.synchronize_device(device)  # else far too many would be queued
    wp.synchronize_device(device)
    return flown / (time.perf_counter() - begin_s), (time.process_time() - cpu_s) / flown


def _chapter(rows: list[Row], base: engine.Model, device: str) -> Chapter:
    most = max(rows, key=lambda row: row["renders/s"])
    plotted = [{**row, "what": row["pixels"]} for row in rows]
    for row in rows:
        single = {"what": f"{row['pixels']}, single simulations", "renders/s": row["renders/s, single"]}
        plotted.append({**row, **single})
    ratios = [row["ratio"] for row in rows if row["worlds"] >= 16]
    drawn = panel(plotted, "worlds", "renders/s", by="what", log="xy", y_min=1.0)
    note = (
        f"Rates are of all worlds together; a step is 10 ms of flight with {RENDERS_PER_STEP} renders. Best "
    )
    note += "of three rounds, by turns with single simulations."
    return Chapter(
        name="worlds",
        title="Many worlds together",
        summary=f"On {engine.device_title(device)}, in {base.scene.name} of {len(base.scene.faces):,} "
        f"triangles, {most['worlds']:,} worlds with an event camera of {most['pixels']} px give "
        f"{most['renders/s']:,.0f} renders a second in total, {most['ratio']:.2f} times as many as "
        "single simulations.",
        claims=[
            Claim("16 worlds and more, stepped together, render at least as often as single simulations",
                  "single simulations of the same model, by turns in the same run",
                  f"{min(ratios):.2f} times at least" if ratios else "fewer were flown",
                  min(ratios) >= 1.0 if ratios else None)
        ],
        tables=[Table("worlds", "Worlds that are stepped together", rows, note)],
        plots=[Plot("worlds", "Renders a second of all worlds", [drawn])],
    )  # fmt: skip
