"""A slow controller in real time, beside what simulated latency in lockstep predicts for it.

Each tour is flown twice for every delay, by processes. In streaming the controller sleeps before each of its
commands (`neurosim fly --delay`). In lockstep it does not, but its commands travel for that time, and are
asked for that rarely (`links.command.latency_s`, `live.command_every`). Both are recorded; the figure is how
far the true positions are from the path.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core.bench.engine import Recording, SimulationConfig, load_config, set_options
from neurosim_core.bench.options import Options
from neurosim_core.bench.processes import NeurosimProcess, own_runtime
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, panel

TRANSPORT_S = 5e-4
"""What a command and its odometry are on their way, and a sleep takes longer than it should [wall-clock s].
Where a delay is a whole number of control periods it decides that a command misses the last of them."""
_DEADLINE_S = 120.0
"""Longest that a flight may take beyond its own time [wall-clock s]."""


def predicted_settings(delay_s: float, *, control_rate_hz: float, transport_s: float) -> dict[str, Any]:
    """Return the settings of a lockstep simulation whose commands come like those of a slow controller.

    It looks at the newest state, sleeps, sends, and looks again: one command per delay.
    """
    return {
        "live.mode": "lockstep",
        "live.command_every": max(1, round(delay_s * control_rate_hz)),
        "links.command.latency_s": delay_s + transport_s,
    }


def measure(options: Options) -> Chapter:
    """Fly tours with delays, in streaming and in lockstep."""
    delays_s = options.delays or ((0.0, 0.02) if options.quick else (0.0, 0.02, 0.05))
    tours = (1 if options.quick else 3) if options.tours is None else options.tours
    seconds = 4.0 if options.seconds is None else options.seconds
    if not all(0.0 <= delay_s < 10.0 for delay_s in delays_s):
        raise ValueError(f"delays must be from 0 to less than 10 s, got {list(delays_s)}")
    for name, value in (("tours", tours), ("seconds", seconds)):
        if not value > 0:  # also refuses nan
            raise ValueError(f"{name} must be > 0, got {value}")
    rows: list[Row] = []
    with own_runtime() as scratch:
        for tour, delay_s in itertools.product(range(tours), delays_s):
            options.progress(f"tour {tour}, {1e3 * delay_s:g} ms")
            base: dict[str, Any] = {
                "duration_s": seconds,
                "device": "cpu",
                "path": {"kind": "tour", "seed": tour},
                "vehicle": {"on_collision": "report"},
                "sensors": {"odometry": {"kind": "odometry", "rate_hz": 200.0}},
                "live": {"run_on": False},
            }
            config = load_config(base, overrides=options.settings, options=set_options(options.settings))
            rows.append(_compare(config, scratch / f"{len(rows)}", tour, delay_s, options.mode))
    return _chapter(rows, options.mode)


def _compare(config: SimulationConfig, folder: Path, tour: int, delay_s: float, mode: str) -> Row:
    """Fly one tour in lockstep and in streaming."""
    rate_hz = config.control.rate_hz
    lockstep = predicted_settings(delay_s, control_rate_hz=rate_hz, transport_s=TRANSPORT_S)
    streaming = {
        "live.mode": "streaming",
        "live.real_time_factor": 1.0,
        "links.command.jitter_s": 1e-10,  # a link that takes 0 ns, but is recorded
    }
    predicted_m, predicted_s = _fly(config, lockstep, folder / "lockstep", mode, 0.0)
    measured_m, measured_s = _fly(config, streaming, folder / "streaming", mode, delay_s)
    return {
        "tour": f"tour {tour}",
        "delay [ms]": 1e3 * delay_s,
        "predicted error [cm]": 1e2 * predicted_m,
        "measured error [cm]": 1e2 * measured_m,
        "measured / predicted": measured_m / predicted_m,
        "commands every [ms]": 1e3 * measured_s,
        "in lockstep [ms]": 1e3 * predicted_s,
    }


def _fly(
    config: SimulationConfig, changes: Mapping[str, Any], folder: Path, mode: str, sleep_s: float
) -> tuple[float, float]:
    """Fly by processes; return the RMS distance from the path [m], and the median command period [s]."""
    folder.mkdir(parents=True)
    changed = load_config(config.model_dump(mode="json"), overrides=changes)
    record = ("--record", str(folder / "flight"))
    with (
        NeurosimProcess("serve", changed, *record, log=folder / "serve.txt") as serve,
        NeurosimProcess("fly", None, "--mode", mode, "--delay", str(sleep_s), log=folder / "fly.txt") as fly,
    ):
        serve.wait(_DEADLINE_S)
        fly.wait(_DEADLINE_S)
    with Recording(folder / "flight" / "flight.h5") as flight:
        stamps_ns = flight.column("odometry", "stamp_ns")
        position = flight.column("odometry", "position")
        sent_ns = flight.column("command_link", "stamp_ns")
        header = flight.header
    axes = range(3)  # linear between 1001 points: off by a hundredth of a millimetre
    path = [np.interp(stamps_ns, header.path_stamp_ns, header.path_position[:, axis]) for axis in axes]
    square_m2 = np.sum((position - np.stack(path, axis=1)) ** 2, axis=1)
    return float(np.sqrt(square_m2.mean())), float(np.median(np.diff(sent_ns))) * 1e-9


def _chapter(rows: list[Row], mode: str) -> Chapter:
    ratios = [row["measured / predicted"] for row in rows]
    median, title = statistics.median(ratios), "Distance from the path under a delay"
    errors = [
        {**row, "what": f"{row['tour']}, {kind}", "error [cm]": row[f"{kind} error [cm]"]}
        for row in rows
        for kind in ("predicted", "measured")
    ]
    note = (
        "Where commands come far less often than the delay says the machine was too slow: it held time back."
    )
    return Chapter(
        name="delay",
        title="A slow controller in real time against the same delay in lockstep",
        summary=f"Distance from the path, root mean square, commanded by {mode}: measured over predicted is "
        f"{median:.3f} in the median, from {min(ratios):.3f} to {max(ratios):.3f}.",
        claims=[
            Claim("the error in real time is that predicted in lockstep, to 10 % in the median",
                  "the same delay, simulated", f"{median:.3f}", abs(median - 1.0) <= 0.1)
        ],
        tables=[Table("delay", title, rows, note)],
        plots=[Plot("delay", title, [panel(errors, "delay [ms]", "error [cm]", by="what", y_min=0.0)])],
    )  # fmt: skip
