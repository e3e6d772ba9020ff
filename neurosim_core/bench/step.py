"""Whole steps a second: physics, control, render, event scan, packets read back, one render per step."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

from neurosim_core.config import load_config
from neurosim_core.packets import Events, Packet
from neurosim_core.simulation import State, make_model, make_state, run_model


@dataclass(frozen=True, kw_only=True)
class StepTimes:
    """What `measure_steps` found."""

    device: str
    scene: str
    triangles: int
    width: int
    height: int
    instants: int
    steps_per_s: tuple[float, ...]
    """Whole steps a second, one figure for each repetition; each flies past another part of the scene."""
    events_per_step: float
    phases_us: dict[str, float]
    """Host time by phase, per step [us]; on CUDA work is queued, and waited for where it is read back."""

    @property
    def median(self) -> float:
        """Median of the repetitions [1/s]."""
        return float(np.median(self.steps_per_s))

    @property
    def overall(self) -> float:
        """Steps of all repetitions over their time [1/s]."""
        return float(1.0 / np.mean(1.0 / np.array(self.steps_per_s)))


def measure_steps(
    *,
    scene: Path | None = None,
    device: str = "auto",
    width: int = 640,
    height: int = 480,
    rate_hz: float = 1000.0,
    instants: int = 16,
    step_count: int = 1600,
    repetitions: int = 5,
    lighting: str = "baked",
) -> StepTimes:
    """Fly with one event camera and nothing else, and time it.

    Args:
        scene: A mesh file; None: the generated apartment.
        device: Where to compute.
        width: Columns of the event camera [px].
        height: Rows of the event camera [px].
        rate_hz: Renders per simulated second [Hz].
        instants: Renders per launch.
        step_count: Renders per repetition.
        repetitions: How often to measure; the flight goes on from one to the next.
        lighting: `baked` or `unshadowed`.
    """
    warm_up = max(step_count // 2, 16 * instants)
    lens = {"width": width, "height": height, "horizontal_fov_rad": 1.5}
    settings: dict[str, Any] = {
        "duration_s": (warm_up + repetitions * step_count + 10 * (repetitions + 1) * instants) / rate_hz,
        "device": device,
        "instants_per_launch": instants,
        "vehicle": {"on_collision": "report"},
        "render": {"lighting": {"mode": lighting}},
        "sensors": {
            "events": {
                "kind": "event_camera",
                "lens": lens,
                "sampling_rate_hz": rate_hz,
                "packet_rate_hz": rate_hz / instants,
            }
        },
    }
    if scene is not None:
        settings["scene"] = {"kind": "mesh", "file": str(scene.resolve())}
    model = make_model(load_config(settings))
    state = make_state(model)
    packets = run_model(model, state)
    _fly(packets, state, warm_up)  # kernels, buffers and graphs
    state.wall_s.clear()
    rates, events, steps = [], 0, 0
    for _ in range(repetitions):
        begin = time.perf_counter()
        flown, seen = _fly(packets, state, step_count)
        rates.append(flown / (time.perf_counter() - begin))
        events += seen
        steps += flown
    return StepTimes(
        device=str(wp.get_device(model.device).name or platform.processor()),
        scene=model.scene.name,
        triangles=len(model.scene.faces),
        width=width,
        height=height,
        instants=instants,
        steps_per_s=tuple(rates),
        events_per_step=events / steps,
        phases_us={name: 1e6 * seconds / steps for name, seconds in state.wall_s.items()},
    )


def _fly(packets: Iterator[Packet], state: State, step_count: int) -> tuple[int, int]:
    """Take packets, one for each batch, until enough renders have been read; return renders and events."""
    begin, events = state.counts["renders"], 0
    while state.counts["renders"] - begin < step_count:
        packet = next(packets)
        assert isinstance(packet, Events)
        events += len(packet.numpy().t)
    return state.counts["renders"] - begin, events


def print_steps(times: StepTimes, console: Console) -> None:
    """Print a measurement as a table."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_row("device", f"{times.device}, Warp {wp.__version__}, Python {platform.python_version()}")
    table.add_row("scene", f"{times.scene}, {times.triangles:,} triangles")
    table.add_row("event camera", f"{times.width}x{times.height}, {times.instants} renders per launch")
    rates = times.steps_per_s
    table.add_row(
        "whole steps",
        f"{times.median:,.0f} /s (median of {len(rates)}, {min(rates):,.0f} to {max(rates):,.0f};"
        f" overall {times.overall:,.0f})",
    )
    table.add_row("events", f"{times.events_per_step:,.0f} per step")
    table.add_row("host time", ", ".join(f"{k} {v:.1f} us" for k, v in times.phases_us.items()))
    console.print(table, highlight=False)
