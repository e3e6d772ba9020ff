"""Whole steps a second: physics, control, render, event scan, packets read back, one render per step.

An adaptive camera is rendered at some of the steps only; the others are flown and count as well.
"""

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

from neurosim_core.clock import NS_PER_S
from neurosim_core.config import load_config
from neurosim_core.packets import Events, Packet
from neurosim_core.schedule import batch_end_ns
from neurosim_core.simulation import (
    Model,
    State,
    advance,
    make_model,
    make_state,
    run_model,
    start,
    want,
)


@dataclass(frozen=True, kw_only=True)
class StepTimes:
    """What `measure_steps` found."""

    device: str
    scene: str
    triangles: int
    width: int
    height: int
    instants: int
    rate_hz: float
    """Steps per simulated second [Hz]."""
    steps_per_s: tuple[float, ...]
    """Whole steps a second, one figure for each repetition; each flies past another part of the scene."""
    renders_per_step: float
    """1 unless the camera is adaptive."""
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

    @property
    def real_time_factor(self) -> float:
        """Simulated time over run time, in the median."""
        return self.median / self.rate_hz


def flight_settings(
    *,
    width: int,
    height: int,
    rate_hz: float,
    instants: int,
    duration_s: float,
    device: str = "auto",
    scene: Path | None = None,
    lighting: str = "baked",
    max_displacement_px: float | None = None,
) -> dict[str, Any]:
    """Return the settings of a flight with one event camera and nothing else; arguments as `measure_steps`.

    Its packets end with the launches.
    """
    settings: dict[str, Any] = {
        "duration_s": duration_s,
        "device": device,
        "instants_per_launch": instants,
        "vehicle": {"on_collision": "report"},
        "render": {"lighting": {"mode": lighting}},
        "sensors": {
            "events": {
                "kind": "event_camera",
                "lens": {"width": width, "height": height, "horizontal_fov_rad": 1.5},
                "sampling_rate_hz": rate_hz,
                "packet_rate_hz": rate_hz / instants,
                "max_displacement_px": max_displacement_px,
            }
        },
    }
    if scene is not None:
        settings["scene"] = {"kind": "mesh", "file": str(scene.resolve())}
    return settings


_OPTIONS = {
    "sensors.events.lens.width": "--width",
    "sensors.events.lens.height": "--height",
    "sensors.events.max_displacement_px": "--max-displacement",
    "device": "--device",
}
"""What the command line calls the keys of its settings, for error messages."""


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
    max_displacement_px: float | None = None,
) -> StepTimes:
    """Fly with one event camera and nothing else, and time it.

    Args:
        scene: A mesh file; None: the generated apartment.
        device: Where to compute.
        width: Columns of the event camera [px].
        height: Rows of the event camera [px].
        rate_hz: Steps per simulated second [Hz].
        instants: Renders per launch.
        step_count: Steps per repetition.
        repetitions: How often to measure; the flight goes on from one to the next.
        lighting: `baked` or `unshadowed`.
        max_displacement_px: Render only so often that nothing moves further between two renders [px]; None:
            at every step.
    """
    warm_up = max(step_count // 2, 16 * instants)
    flown = warm_up + repetitions * step_count + 10 * (repetitions + 1) * instants
    settings = flight_settings(
        width=width,
        height=height,
        rate_hz=rate_hz,
        instants=instants,
        duration_s=flown / rate_hz,
        device=device,
        scene=scene,
        lighting=lighting,
        max_displacement_px=max_displacement_px,
    )
    return time_steps(
        make_model(load_config(settings, options=_OPTIONS)),
        warm_up_count=warm_up,
        step_count=step_count,
        repetitions=repetitions,
    )


def time_steps(
    model: Model,
    *,
    warm_up_count: int,
    step_count: int,
    repetitions: int,
    repetition_s: float = float("inf"),
    begin_s: float = 0.0,
) -> StepTimes:
    """Fly a model of `flight_settings` and time it.

    Args:
        model: With one event camera and nothing else; its run is long enough.
        warm_up_count: Steps before the first repetition.
        step_count: Steps per repetition.
        repetitions: How often to measure.
        repetition_s: A repetition ends after this time [s], even if it has taken fewer steps.
        begin_s: Fly so long with closed eyes first [s].
    """
    (cast,) = model.casts
    state = make_state(model)
    if begin_s > 0.0:
        fly_blind(model, state, begin_s)
    packets = run_model(model, state)
    _fly(packets, state, warm_up_count, repetition_s)  # kernels, buffers and graphs
    state.wall_s.clear()
    renders = state.counts["renders"]
    rates, events, steps = [], 0, 0
    for _ in range(repetitions):
        begin = time.perf_counter()
        flown, seen = _fly(packets, state, step_count, repetition_s)
        rates.append(flown / (time.perf_counter() - begin))
        events += seen
        steps += flown
    return StepTimes(
        device=str(wp.get_device(model.device).name or platform.processor()),
        scene=model.scene.name,
        triangles=len(model.scene.faces),
        width=cast.lens.width,
        height=cast.lens.height,
        instants=model.config.instants_per_launch,
        rate_hz=cast.rate.rate_hz,
        steps_per_s=tuple(rates),
        renders_per_step=(state.counts["renders"] - renders) / steps,
        events_per_step=events / steps,
        phases_us={name: 1e6 * seconds / steps for name, seconds in state.wall_s.items()},
    )


def fly_blind(model: Model, state: State, until_s: float) -> None:
    """Fly to a stamp [s] with closed eyes, which costs next to nothing, and open them."""
    names = state.wanted
    want(model, state, ())
    if state.launched_count == 0:
        start(model, state)
    end_ns = round(until_s * NS_PER_S)
    while state.launched_ns < end_ns:
        advance(model, state, batch_end_ns(model.schedule, state.launched_ns, end_ns))
    want(model, state, names)


def _fly(
    packets: Iterator[Packet], state: State, step_count: int, seconds_max: float = float("inf")
) -> tuple[int, int]:
    """Take packets, one for each batch, until enough steps have been read; return steps and events."""
    begin, events = _steps(state), 0
    end_s = time.perf_counter() + seconds_max
    while _steps(state) - begin < step_count and (_steps(state) == begin or time.perf_counter() < end_s):
        packet = next(packets)
        assert isinstance(packet, Events)
        events += len(packet.numpy().t)
    return _steps(state) - begin, events


def _steps(state: State) -> int:
    """Return how many ticks of the camera were read, rendered or not."""
    return state.counts["renders"] + state.counts["ticks left out"]


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
    table.add_row("real-time factor", f"{times.real_time_factor:.3g} at {times.rate_hz:g} steps per second")
    if times.renders_per_step < 1.0:
        table.add_row("renders", f"{times.renders_per_step:.3g} per step")
    table.add_row("events", f"{times.events_per_step:,.0f} per step")
    table.add_row("host time", ", ".join(f"{k} {v:.1f} us" for k, v in times.phases_us.items()))
    console.print(table, highlight=False)
