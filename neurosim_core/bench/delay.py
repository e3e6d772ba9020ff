"""A slow controller in real time, beside what simulated latency in lockstep predicts for it.

Each tour is flown twice for every delay, by processes. In streaming the controller sleeps before each of its
commands (`neurosim fly --delay`). In lockstep it does not, but its commands travel for that time, and are
asked for that rarely (`links.command.latency_s`, `live.command_every`). Both are recorded; the figure is how
far the true positions are from the path.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import rich.table
from rich.console import Console

from neurosim_core.bench.machine import describe_machine
from neurosim_core.bench.processes import NeurosimProcess, own_runtime
from neurosim_core.bench.report import Table, save_files
from neurosim_core.config import SimulationConfig, load_config, to_yaml
from neurosim_core.overrides import set_options
from neurosim_core.record import Recording

TRANSPORT_S = 5e-4
"""What a command and its odometry are on their way, and a sleep takes longer than it should [wall-clock s].
Where a delay is a whole number of control periods it decides that a command misses the last of them."""
_DEADLINE_S = 120.0
"""Longest that a flight may take beyond its own time [wall-clock s]."""


@dataclass(frozen=True, kw_only=True)
class DelayResult:
    """One tour under one delay; errors are distances from the path, root mean square."""

    tour: int
    """Seed of the tour."""
    delay_s: float
    """What the controller sleeps before each command [simulated s]."""
    predicted_m: float
    """Error in lockstep [m]."""
    measured_m: float
    """Error in streaming [m]."""
    predicted_interval_s: float
    """Between two commands in lockstep, median [simulated s]."""
    measured_interval_s: float
    """The same in streaming. Far below the delay, the machine is too slow: time was held back."""

    @property
    def ratio(self) -> float:
        """Measured over predicted error."""
        return self.measured_m / self.predicted_m


def predicted_settings(delay_s: float, *, control_rate_hz: float, transport_s: float) -> dict[str, Any]:
    """Return the settings of a lockstep simulation whose commands come like those of a slow controller.

    It looks at the newest state, sleeps, sends, and looks again: one command per delay.

    Args:
        delay_s: What the controller sleeps [s].
        control_rate_hz: Control periods a second [Hz].
        transport_s: What messages and sleeps take besides [s].
    """
    return {
        "live.mode": "lockstep",
        "live.command_every": max(1, round(delay_s * control_rate_hz)),
        "links.command.latency_s": delay_s + transport_s,
    }


def bench_delay(
    folder: Path,
    console: Console,
    *,
    delays_s: Sequence[float] = (0.0, 0.02, 0.05),
    tours: int = 3,
    mode: str = "velocity",
    seconds: float = 4.0,
    real_time_factor: float = 1.0,
    settings: Mapping[str, Any] | None = None,
) -> list[DelayResult]:
    """Fly, print a table, and leave delay.csv.

    Args:
        folder: Where to leave it; made if need be.
        console: Where to print.
        delays_s: What the controller sleeps before each command [simulated s].
        tours: How many tours to fly, with seeds from 0.
        mode: What is commanded; see `neurosim fly --mode`. Rotor speeds are unstable from 30 ms on.
        seconds: Length of a flight [simulated s].
        real_time_factor: How fast streaming goes; below 1 the machine's own delays count for less.
        settings: Further settings by dotted key.

    Raises:
        ValueError: An argument is out of its range.
        RuntimeError: A process failed.
    """
    if tours < 1:
        raise ValueError(f"tours must be >= 1, got {tours}")
    if not delays_s or not all(0.0 <= delay_s < 10.0 for delay_s in delays_s):
        raise ValueError(f"delays must be from 0 to less than 10 s, got {list(delays_s)}")
    if not seconds > 0.0:  # also refuses nan
        raise ValueError(f"seconds must be > 0, got {seconds}")
    if not real_time_factor > 0.0:
        raise ValueError(f"factor must be > 0, got {real_time_factor}")
    results: list[DelayResult] = []
    with own_runtime() as scratch, console.status("") as line:
        for tour in range(tours):
            for delay_s in delays_s:
                line.update(f"tour {tour}, {1e3 * delay_s:g} ms")
                config = _config(tour, seconds, settings or {})
                results.append(
                    _compare(config, scratch / f"{len(results)}", tour, delay_s, mode, real_time_factor)
                )
    print_delays(results, console, mode=mode)
    for text in describe_machine("cpu"):
        console.print(text, style="dim", highlight=False)
    save_files(folder, console, tables=[_table(results)])
    return results


def _table(results: Sequence[DelayResult]) -> Table:
    """Return one row for each tour and delay."""
    return Table(
        name="delay",
        title="distance from the path under a delay",
        columns={field.name: field.name for field in fields(DelayResult)},
        rows=[asdict(result) for result in results],
    )


def print_delays(results: Sequence[DelayResult], console: Console, *, mode: str) -> None:
    """Print a row for each tour and delay, and what they come to."""
    table = rich.table.Table(box=None, pad_edge=False, header_style="dim")
    for name in ("tour", "delay", "predicted", "measured", "ratio", "commands every", "in lockstep"):
        table.add_column(name, justify="right")
    for result in results:
        table.add_row(
            str(result.tour),
            f"{1e3 * result.delay_s:g} ms",
            f"{1e2 * result.predicted_m:.2f} cm",
            f"{1e2 * result.measured_m:.2f} cm",
            f"{result.ratio:.3f}",
            f"{1e3 * result.measured_interval_s:.1f} ms",
            f"{1e3 * result.predicted_interval_s:.1f} ms",
        )
    console.print(f"distance from the path, root mean square, commanded by {mode}", highlight=False)
    console.print(table, highlight=False)
    for delay_s in dict.fromkeys(result.delay_s for result in results):
        ratios = [result.ratio for result in results if result.delay_s == delay_s]
        console.print(
            f"{1e3 * delay_s:g} ms: measured / predicted {statistics.median(ratios):.3f}, "
            f"from {min(ratios):.3f} to {max(ratios):.3f}",
            highlight=False,
        )


def _config(tour: int, seconds: float, settings: Mapping[str, Any]) -> SimulationConfig:
    """Return a flight without cameras, which goes on when it touches something."""
    base: dict[str, Any] = {
        "duration_s": seconds,
        "device": "cpu",
        "path": {"kind": "tour", "seed": tour},
        "vehicle": {"on_collision": "report"},
        "sensors": {"odometry": {"kind": "odometry", "rate_hz": 200.0}},
        "live": {"run_on": False},
    }
    return load_config(base, overrides=settings, options=set_options(settings))


def _compare(
    config: SimulationConfig, folder: Path, tour: int, delay_s: float, mode: str, real_time_factor: float
) -> DelayResult:
    """Fly one tour in lockstep and in streaming."""
    transport_s = TRANSPORT_S * real_time_factor
    lockstep = predicted_settings(delay_s, control_rate_hz=config.control.rate_hz, transport_s=transport_s)
    streaming = {
        "live.mode": "streaming",
        "live.real_time_factor": real_time_factor,
        "links.command.jitter_s": 1e-10,  # a link that takes 0 ns, but is recorded
    }
    predicted_m, predicted_interval_s = _fly(_changed(config, lockstep), folder / "lockstep", mode, 0.0)
    measured_m, measured_interval_s = _fly(
        _changed(config, streaming), folder / "streaming", mode, delay_s / real_time_factor
    )
    return DelayResult(
        tour=tour,
        delay_s=delay_s,
        predicted_m=predicted_m,
        measured_m=measured_m,
        predicted_interval_s=predicted_interval_s,
        measured_interval_s=measured_interval_s,
    )


def _changed(config: SimulationConfig, settings: Mapping[str, Any]) -> SimulationConfig:
    return load_config(config.model_dump(mode="json"), overrides=settings)


def _fly(config: SimulationConfig, folder: Path, mode: str, sleep_s: float) -> tuple[float, float]:
    """Fly by processes; return the error [m] and the time between commands [s].

    Raises:
        RuntimeError: A process failed.
    """
    folder.mkdir(parents=True)
    settings, flight = folder / "config.yaml", folder / "flight"
    settings.write_text(to_yaml(config), encoding="utf-8")
    options = ("--mode", mode, "--delay", str(sleep_s))
    with (
        NeurosimProcess("serve", str(settings), "--record", str(flight), log=folder / "serve.txt") as serve,
        NeurosimProcess("fly", *options, log=folder / "fly.txt") as fly,
    ):
        for process in (serve, fly):
            status = process.wait(_DEADLINE_S)
            if status != 0:
                raise RuntimeError(f"a flight ended with status {status}; {process.last_words()}")
    return _read(flight / "flight.h5")


def _read(recording: Path) -> tuple[float, float]:
    """Return the distance from the path [m] and the time between commands [s] of a recording."""
    with Recording(recording) as flight:
        stamps_ns = flight.column("odometry", "stamp_ns")
        position = flight.column("odometry", "position")
        sent_ns = flight.column("command_link", "stamp_ns")
        header = flight.header
    axes = range(3)  # linear between 1001 points: off by a hundredth of a millimetre
    path = [np.interp(stamps_ns, header.path_stamp_ns, header.path_position[:, axis]) for axis in axes]
    square_m2 = np.sum((position - np.stack(path, axis=1)) ** 2, axis=1)
    return float(np.sqrt(square_m2.mean())), float(np.median(np.diff(sent_ns))) * 1e-9
