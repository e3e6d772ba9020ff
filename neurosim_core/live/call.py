"""A running simulator from the terminal: requests and its status (`neurosim call`), and `neurosim top`."""

from __future__ import annotations

import argparse
import contextlib
import json
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.text import Text

from cortex import Node, ServiceTimeout, ServiceUnavailable, Subscriber, latest
from cortex.messages import Parameters, Reset, SimulatorReply, SimulatorStatus, Step, Trigger
from neurosim_core.clock import NS_PER_S
from neurosim_core.live.topics import SERVICES, STATUS, STEP_DEADLINE_S
from neurosim_core.overrides import read_settings
from neurosim_core.signals import raise_at_signals

_TABLE_WIDTH = 100
_BARS = " ▁▂▃▄▅▆▇█"
_HISTORY = 60
_NEXT_S = 1.0
_LOST_AFTER_S = 5.0
GRACE_S = 1.0
"""How much longer than the steps may take the client waits to hear that they were not over [s]."""


def call(arguments: argparse.Namespace) -> int:
    """Send the request of a command line, and print the answer.

    `arguments`: as `neurosim call` parses them: `what`, `timeout` [s], and the arguments of the request.
    Returns 0 if it was done, 1 if it was refused.
    """
    console = Console(highlight=False, soft_wrap=True)
    timeout_s = arguments.timeout
    if not timeout_s > 0.0:
        raise ValueError(f"--timeout must be > 0, got {timeout_s}")
    if arguments.what == "status":
        wide = Console(highlight=False, width=max(console.width, _TABLE_WIDTH))
        with Node("call") as node, node.subscriber(STATUS, SimulatorStatus, policy=latest()) as statuses:
            wide.print(show_status(_status(statuses, timeout_s)))
        return 0
    service, request = _request(arguments)
    with Node("call") as node:
        reply = ask(node, service, request, timeout_s + GRACE_S * isinstance(request, Step))
    at = f"{reply.phase} at {reply.stamp_ns / NS_PER_S:g} s"
    if not reply.accepted:
        console.print(f"[red]refused[/] ({at}): {escape(reply.reason)}")
        return 1
    changed = request.to_dict() if isinstance(request, Parameters) else {}
    console.print("; ".join([*(f"{key} = {value}" for key, value in changed.items()), at]), markup=False)
    return 0


def parameters_of(settings: Sequence[str]) -> Parameters:
    """Return KEY=VALUE texts as parameters; values are read as YAML, lists stay text."""
    values = read_settings(settings, option="set")
    for key, value in values.items():
        if isinstance(value, list):
            values[key] = json.dumps(value)
        elif not isinstance(value, bool | int | float | str):
            raise ValueError(f"{key} takes a number, true, false, text or a list, got {value!r}")
    return Parameters.of(values)


class SensorRates:
    """Messages a second of each sensor, from one status to the next."""

    def __init__(self) -> None:
        self._statuses: deque[SimulatorStatus] = deque()

    def update(self, status: SimulatorStatus) -> dict[tuple[str, str], float]:
        """Take a status; return the rates of active sensors [Hz] by vehicle and sensor, as far as known.

        They are averages over the last second of simulated time; a run that begins again has none yet.
        """
        if self._statuses and status.stamp_ns < self._statuses[-1].stamp_ns:
            self._statuses.clear()
        if not self._statuses or status.stamp_ns > self._statuses[-1].stamp_ns:  # else it is paused
            self._statuses.append(status)
        while len(self._statuses) > 2 and status.stamp_ns - self._statuses[1].stamp_ns >= NS_PER_S:
            self._statuses.popleft()
        before, now = self._statuses[0], self._statuses[-1]
        passed_s = (now.stamp_ns - before.stamp_ns) / NS_PER_S
        counts = {(sensor.vehicle, sensor.name): sensor.published_count for sensor in before.sensors}
        return {
            key: max(sensor.published_count - counts[key], 0) / passed_s
            for sensor in now.sensors
            if sensor.active and passed_s > 0.0 and (key := (sensor.vehicle, sensor.name)) in counts
        }


def show_status(status: SimulatorStatus, **options: Any) -> RenderableType:
    """Return the text of `describe_status`, which takes the options, for a console."""
    from rich.markdown import Markdown  # its import takes 0.03 s, of the set-up of `neurosim serve`

    return Markdown(describe_status(status, **options))


def describe_status(
    status: SimulatorStatus,
    *,
    phase: bool = True,
    rates_hz: Mapping[tuple[str, str], float] | None = None,
    lost: Mapping[tuple[str, str], int] | None = None,
) -> str:
    """Return a status as Markdown: the run, its vehicles, its sensors.

    `phase`: say in which phase the run is, and why. `rates_hz`: messages a second of simulated time [Hz], by
    vehicle and sensor, if known. `lost`: messages that a viewer has not received, by vehicle and sensor, if
    known.
    """
    run = f"{status.mode}, {status.stamp_ns / NS_PER_S:.3f} s, {status.step_count:,} control periods"
    counts = f"{status.overrun_count:,} overruns, delayed by {status.slipped_ns / NS_PER_S:.3f} s"
    if status.step_median_ns:  # else no period has been computed since the status before
        wanted = f" of {status.real_time_factor_wanted:g}" if status.real_time_factor_wanted else ""
        run += f", {status.real_time_factor:.2f}{wanted} x real time"
        counts = (
            f"step {_ms(status.step_median_ns)} (p99 {_ms(status.step_p99_ns)}), "
            f"late {_ms(status.late_median_ns)} (p99 {_ms(status.late_p99_ns)}), {counts}"
        )
    lines = [f"**{status.phase}**{f': {status.reason}' if status.reason else ''}"] if phase else []
    lines += [run, counts]
    vehicles = [
        {
            "vehicle": vehicle.name,
            "mode": "**fail-safe**" if vehicle.fail_safe else vehicle.command_mode or "no command yet",
            "from": vehicle.command_source or "-",
            "taken": vehicle.command_count,
            "age": _ms(vehicle.command_age_ns),
            "refused": vehicle.refused_count,
            "clamped": vehicle.clamped_count,
            "replaced": vehicle.superseded_count,
            "lost": vehicle.lost_count,
            "stale": vehicle.fail_safe_count,
            "by reader": vehicle.undelivered_count,
        }
        for vehicle in status.vehicles
    ]
    sensors = []
    for sensor in status.sensors:
        key = (sensor.vehicle, sensor.name)
        row: dict[str, object] = {"sensor": "/".join(key), "state": "on" if sensor.active else "off"}
        if rates_hz is not None:
            row["Hz"] = f"{rates_hz[key]:.0f}" if key in rates_hz else "-"
        row |= {
            "readers": sensor.subscriber_count,
            "published": sensor.published_count,
            "dropped": sensor.dropped_count,
            "by link": sensor.injected_lost_count,
            "by reader": sensor.undelivered_count,
        }
        if lost is not None:
            row["lost here"] = lost.get(key, 0)
        sensors.append(row | {"late": _ms(sensor.late_p99_ns)})
    return "\n\n".join(["  \n".join(lines), *(_table(rows) for rows in (vehicles, sensors) if rows)])


def _table(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a table in Markdown; the first two columns are text, the others numbers."""
    heads = list(rows[0])
    align = [":--", ":--", *["--:"] * (len(heads) - 2)]
    cells = ([f"{cell:,}" if isinstance(cell, int) else str(cell) for cell in row.values()] for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, align, *cells))


def _request(arguments: argparse.Namespace) -> tuple[str, Any]:
    """Return service and request of a command line."""
    match arguments.what:
        case "reset":
            position = None if arguments.position is None else np.array(arguments.position, dtype=np.float64)
            return "/reset", Reset(seed=arguments.seed, vehicle=arguments.vehicle, position=position)
        case "step":
            if not 1 <= arguments.count < 2**32:
                raise ValueError(f"the number of control periods must be >= 1, got {arguments.count}")
            return "/step", Step(arguments.count, timeout_s=min(arguments.timeout, STEP_DEADLINE_S))
        case "set":
            return "/set_parameters", parameters_of(arguments.settings)
        case _:
            return f"/{arguments.what}", Trigger()


def ask(node: Node, service: str, request: Any, timeout_s: float) -> SimulatorReply:
    """Send a request to the simulator, and return its answer.

    `service`: one of `topics.SERVICES`. `timeout_s`: how long to wait [s].
    """
    request_type, reply_type = SERVICES[service]
    try:
        reply: SimulatorReply = node.client(service, request_type, reply_type).call(request, timeout_s)
    except ServiceTimeout:
        raise RuntimeError(
            f"the simulator has not answered within {timeout_s:g} s, and may still do it; "
            "--timeout waits longer"
        ) from None
    except ServiceUnavailable:
        raise RuntimeError(no_simulator(timeout_s)) from None
    return reply


def _status(statuses: Subscriber[SimulatorStatus], timeout_s: float) -> SimulatorStatus:
    """Wait for the next status."""
    try:
        return statuses.recv(timeout_s)
    except TimeoutError:
        raise RuntimeError(no_simulator(timeout_s)) from None


def no_simulator(timeout_s: float) -> str:
    """Return what to say where no simulator answers."""
    return f"no simulator answers (waited {timeout_s:g} s): start one with `neurosim serve`"


def _ms(duration_ns: int) -> str:
    return f"{duration_ns * 1e-6:.2f} ms"


class Dashboard:
    """The lines that `top` shows, from one status to the next."""

    def __init__(self) -> None:
        self._factors: deque[float] = deque(maxlen=_HISTORY)
        self._rates = SensorRates()

    def update(self, status: SimulatorStatus) -> Group:
        """Return the screen after a status."""
        self._factors.append(status.real_time_factor)
        most = max(1.0, status.real_time_factor_wanted, *self._factors)
        bars = "".join(_BARS[round(factor / most * (len(_BARS) - 1))] for factor in self._factors)
        return Group(
            Text.assemble(("real-time factor ", "dim"), (bars, "green"), f" {status.real_time_factor:.2f}"),
            show_status(status, rates_hz=self._rates.update(status)),
        )


def top(*, once: bool = False, timeout_s: float = 10.0) -> int:
    """Show the status until Ctrl-C, or until the run has ended.

    `once`: print the screen after two statuses, and stop. `timeout_s`: how long to wait for a simulator [s].
    """
    console, dashboard = Console(highlight=False), Dashboard()
    with (
        raise_at_signals() as raise_again,
        Node("top") as node,
        node.subscriber(STATUS, SimulatorStatus, policy=latest()) as statuses,
    ):
        screen = dashboard.update(_status(statuses, timeout_s))
        if once:
            with contextlib.suppress(TimeoutError):  # of a run that has ended there is no other
                screen = dashboard.update(statuses.recv(_NEXT_S))
            console.print(screen)
            return 0
        with Live(screen, console=console, screen=console.is_terminal, auto_refresh=False) as live:
            while True:
                raise_again()
                try:
                    status = statuses.recv(_LOST_AFTER_S)
                except TimeoutError:
                    break
                live.update(dashboard.update(status), refresh=True)
                if status.phase == "ended":
                    break
    console.print("the simulator has ended")
    return 0
