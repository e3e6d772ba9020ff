"""Asking a running simulator: `neurosim call reset | step | pause | resume | set | status`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cortex import Node, ServiceTimeout, ServiceUnavailable, latest
from cortex.messages import Parameters, Reset, SimulatorReply, SimulatorStatus, Step, Trigger
from neurosim_core.clock import NS_PER_S
from neurosim_core.live.requests import STEP_DEADLINE_S
from neurosim_core.live.topics import SERVICES, STATUS

GRACE_S = 1.0
"""So much longer than steps may take do we wait to hear that they were not over [s]."""


def call(arguments: argparse.Namespace) -> int:
    """Ask a simulator for what the command line says, and print what it answers.

    Args:
        arguments: As `neurosim call` parses them: `what`, `timeout` [s], and what belongs to the request.

    Returns:
        0 if it was done, 1 if it was refused.

    Raises:
        ValueError: A value of the command line is not allowed.
        RuntimeError: There is no simulator, or it does not answer in time.
    """
    console = Console(highlight=False)
    timeout_s = arguments.timeout
    if not timeout_s > 0.0:
        raise ValueError(f"--timeout must be > 0, got {timeout_s}")
    if arguments.what == "status":
        print_status(_status(timeout_s), console)
        return 0
    service, request = _request(arguments)
    if isinstance(request, Step):
        timeout_s += GRACE_S
    reply = _ask(service, request, timeout_s)
    at = f"{reply.phase} at {reply.stamp_ns / NS_PER_S:g} s"
    if reply.accepted:
        changed = (
            [f"{key} = {value}" for key, value in request.to_dict().items()]
            if isinstance(request, Parameters)
            else []
        )
        console.print("; ".join([*changed, at]), markup=False, soft_wrap=True)
        return 0
    console.print(f"[red]refused[/] ({at}): {escape(reply.reason)}", soft_wrap=True)
    return 1


def parameters_of(settings: Sequence[str]) -> Parameters:
    """Return KEY=VALUE texts as parameters; values are read as YAML.

    Raises:
        ValueError: One is not KEY=VALUE, or its value is neither a number, true, false nor text.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        key, separator, text = setting.partition("=")
        if not separator or not key:
            raise ValueError(f"a setting is KEY=VALUE, got {setting!r}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = None
        if not isinstance(value, bool | int | float | str):
            raise ValueError(f"{key} takes a number, true, false or text, got {text!r}")
        values[key] = value
    return Parameters.of(values)


def print_status(status: SimulatorStatus, console: Console) -> None:
    """Print how a simulator is doing: the run, its vehicles, its sensors."""
    run = Table(box=None, pad_edge=False, show_header=False)
    run.add_column(style="dim", min_width=12)
    run.add_column()
    run.add_row("phase", escape(f"{status.phase} ({status.reason})" if status.reason else status.phase))
    run.add_row("time", f"{status.stamp_ns / NS_PER_S:.3f} s, {status.step_count:,} control periods")
    if status.mode == "lockstep":
        wanted = "lockstep"
    else:
        wanted = f"of {status.real_time_factor_wanted:g}" if status.real_time_factor_wanted else "at most"
    run.add_row("speed", f"{status.real_time_factor:.2f} x real time ({wanted})")
    run.add_row("a period", f"{_ms(status.step_median_ns)} (99 %: {_ms(status.step_p99_ns)})")
    if status.mode == "streaming":
        run.add_row("late by", f"{_ms(status.late_median_ns)} (99 %: {_ms(status.late_p99_ns)})")
        run.add_row(
            "overruns", f"{status.overrun_count:,}; held back by {status.slipped_ns / NS_PER_S:.3f} s"
        )
    for vehicle in status.vehicles:
        if vehicle.undelivered_count:
            lost = f"{vehicle.undelivered_count:,} messages on other topics than those of sensors"
            run.add_row("by readers", f"{escape(vehicle.name)} lost {lost}")
        if vehicle.clamped_count:
            run.add_row(
                "clamped", f"{vehicle.clamped_count:,} commands to {escape(vehicle.name)}, out of range"
            )
    console.print(run)

    vehicles = _table("vehicle", "flown by", "commands", "age", "refused", "superseded", "lost", "fail-safe")
    for vehicle in status.vehicles:
        fail_safe = f"{vehicle.fail_safe_count}, flies now" if vehicle.fail_safe else vehicle.fail_safe_count
        vehicles.add_row(
            vehicle.name,
            vehicle.command_mode or "nobody yet",
            f"{vehicle.command_count:,}",
            _ms(vehicle.command_age_ns),
            *(f"{n:,}" for n in (vehicle.refused_count, vehicle.superseded_count, vehicle.lost_count)),
            str(fail_safe),
        )
    sensors = _table("sensor", "state", "readers", "published", "dropped", "by link", "by reader", "late")
    for sensor in status.sensors:
        sensors.add_row(
            f"{sensor.vehicle}/{sensor.name}",
            "on" if sensor.active else "off",
            *(f"{n:,}" for n in (sensor.subscriber_count, sensor.published_count, sensor.dropped_count)),
            f"{sensor.injected_lost_count:,}",
            f"{sensor.undelivered_count:,}",
            _ms(sensor.late_p99_ns),
        )
    for table in (vehicles, sensors):
        if table.row_count:
            console.print()
            console.print(table)


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


def _ask(service: str, request: Any, timeout_s: float) -> SimulatorReply:
    """Ask, and return the answer."""
    request_type, reply_type = SERVICES[service]
    with Node("call") as node:
        try:
            reply: SimulatorReply = node.client(service, request_type, reply_type).call(request, timeout_s)
        except ServiceTimeout:
            raise RuntimeError(
                f"the simulator has not answered within {timeout_s:g} s, and may still do it; "
                "--timeout waits longer"
            ) from None
        except ServiceUnavailable:
            raise RuntimeError(_nobody(timeout_s)) from None
    return reply


def _status(timeout_s: float) -> SimulatorStatus:
    """Wait for the next status."""
    with Node("call") as node, node.subscriber(STATUS, SimulatorStatus, policy=latest()) as statuses:
        try:
            return statuses.recv(timeout_s)
        except TimeoutError:
            raise RuntimeError(_nobody(timeout_s)) from None


def _nobody(timeout_s: float) -> str:
    return f"no simulator answers (waited {timeout_s:g} s): start one with `neurosim serve`"


def _table(name: str, *columns: str) -> Table:
    """Return a table whose first column is a name, and whose last ones are numbers."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column(name)
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left")
    return table


def _ms(duration_ns: int) -> str:
    return f"{duration_ns * 1e-6:.2f} ms"
