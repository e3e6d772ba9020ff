"""`neurosim serve`: a simulator, and what it prints on the console."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.status import Status
from rich.table import Table

from cortex import Node
from cortex.messages import SimulatorStatus
from neurosim_core.config import SimulationConfig
from neurosim_core.garbage import no_collection
from neurosim_core.live.call import show_status
from neurosim_core.live.simulator import Simulator
from neurosim_core.live.topics import SIMULATION, command_topic
from neurosim_core.live.vehicle import VehicleNode
from neurosim_core.scene.reader import SceneReader
from neurosim_core.signals import stop_at_signals

_SWITCH_S = 2e-4
"""Longest turn of one Python thread while another one waits [s]: 5 ms by default, a whole control period."""
GONE_S = 2.0
"""After this a simulator that was killed is no longer known [s]."""
_SLOW_STATUSES = 5
"""Statuses in a row, five a second, after which a run is called slow."""


def serve(
    config: SimulationConfig,
    *,
    record: Path | None = None,
    overwrite: bool = False,
    reader: SceneReader | None = None,
) -> int:
    """Simulate for controllers in other processes until interrupted.

    `record`: folder to record to. `overwrite`: replace a recording that exists. `reader`: reads the scene in
    another process; None: it is read here. Returns the exit status: 0 done, 1 ended with an error, 130
    interrupted.

    Raises:
        ValueError: The scene cannot be loaded, no path exists, or there is no such device.
        OSError: There is a recording already, or it cannot be written.
        RuntimeError: Another simulator runs in this domain.
    """
    console = Console(highlight=False, soft_wrap=True)
    stop = threading.Event()
    with Node("simulator") as node:
        require_single_instance(node)
        with no_collection(), console.status("preparing") as preparing:

            def show(phase: str) -> None:
                preparing.update(f"preparing: {phase}")
                if not console.is_terminal:
                    console.print(f"preparing: {phase}")

            simulator = Simulator(
                config,
                node,
                record=record,
                overwrite=overwrite,
                on_phase=show,
                reader=reader,
            )
        sys.setswitchinterval(_SWITCH_S)
        with stop_at_signals(stop, on_stop=node.stop_waiting), simulator:
            print_plan(console, simulator.vehicles, config)
            with StatusLine(console, is_over=lambda: simulator.is_over) as line:
                simulator.status.on_status = line.show
                code = simulator.run(stop)
            if line.last is not None:
                console.print(show_status(line.last, phase=False))  # which was said
            for vehicle in simulator.vehicles:
                if count := vehicle.state.counts["redone intervals"]:
                    console.print(f"{vehicle.name}: adaptive steps replaced {count:,} fixed ones")
            if record is not None:
                console.print(f"recorded to {record}/")
    return 130 if stop.is_set() else code


def require_single_instance(node: Node) -> None:
    """Check that no other simulator runs in the domain of a node: two would fly each other's vehicles.

    Raises:
        RuntimeError: There is one.
    """
    node.wait_for_registry()
    deadline_s = time.monotonic() + GONE_S
    while any(topic.topic == SIMULATION and topic.publishers for topic in node.topics()):
        if time.monotonic() >= deadline_s:
            break
        time.sleep(0.02)
    else:
        return
    raise RuntimeError(
        f"a simulator runs in domain {node.domain} already: end it, or set CORTEX_DOMAIN to another number "
        "for all processes that belong together"
    )


def print_plan(console: Console, vehicles: Sequence[VehicleNode], config: SimulationConfig) -> None:
    """Print what is simulated, on which topics, and what it waits for."""
    model, live = vehicles[0].model, config.live
    if live.mode == "lockstep":
        pace = "lockstep: every control period waits for its command"
    elif live.real_time_factor:
        pace = f"streaming at {live.real_time_factor:g} x real time"
    else:
        pace = "streaming as fast as possible"
    console.print(
        f"[bold]{model.scene.name}[/], {len(model.scene.faces):,} triangles, on {model.device}; "
        f"{config.control.rate_hz:g} control periods a second, {pace}"
    )
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for vehicle in vehicles:
        names = dict.fromkeys([*vehicle.config.sensors, "odometry", "rotor_speeds"])
        table.add_row(vehicle.config.vehicle.title, f"/{vehicle.name}/: {', '.join(names)}")
    console.print(table)
    commands = ", ".join(command_topic(vehicle.name, "*") for vehicle in vehicles)
    console.print(f"waiting for the first command on {commands}: `neurosim fly` sends them")


class StatusLine:
    """A line that is updated with each status on a terminal, and further lines for events. A context manager.

    Attributes:
        last: The newest status; None if there was none.
    """

    def __init__(self, console: Console, *, is_over: Callable[[], bool]) -> None:
        """Begin with an empty line. `is_over`: returns whether the simulator ends with the run."""
        self.last: SimulatorStatus | None = None
        self._slow_count = self._late_count = 0
        self._senders: set[tuple[str, str]] = set()
        self._is_over = is_over
        self._console = console
        self._line = Status("", console=console, refresh_per_second=5)
        self._logs: list[logging.StreamHandler[TextIO]] = []

    def show(self, status: SimulatorStatus) -> None:
        """Update the line, and print what has changed."""
        before, self.last = self.last, status
        self._line.update(_summary(status))
        for text in (*self._news(before, status), *self._slowness(before, status)):
            self._console.print(f"[yellow]{text}[/]")

    def _news(self, before: SimulatorStatus | None, status: SimulatorStatus) -> list[str]:
        """Return what has changed, and once in a run each node that commands a vehicle."""
        if before is None or status.step_count < before.step_count:
            self._senders.clear()
        senders = {(each.name, each.command_source) for each in status.vehicles if each.command_source}
        new, self._senders = sorted(senders - self._senders), self._senders | senders
        lines = [f"{vehicle}: {sender} commands it" for vehicle, sender in new]
        return lines + changes(before, status, is_over=self._is_over())

    def _slowness(self, before: SimulatorStatus | None, status: SimulatorStatus) -> list[str]:
        """Return once in a run that kernels are compiled, and that it was slower than wanted for a second.

        A sensor that has not published yet is taken to be waiting for its kernels.
        """
        wanted = status.real_time_factor_wanted
        if before is None or status.step_count < before.step_count:
            self._slow_count = self._late_count = 0
            return []
        new = [
            f"{each.vehicle}/{each.name}"
            for each in status.sensors
            if each.active and not each.published_count
        ]
        slow = before.phase == status.phase == "running" and status.real_time_factor < 0.9 * wanted
        if slow and new:
            self._late_count += 1
            if self._late_count == _SLOW_STATUSES:
                return [f"compiling what computes {', '.join(new)}; it is kept for the next time"]
            return []
        self._slow_count = self._slow_count + 1 if slow or self._slow_count > _SLOW_STATUSES else 0
        if self._slow_count != _SLOW_STATUSES:
            return []
        return [
            f"this machine reaches {status.real_time_factor:.2f} x real time, not {wanted:g}: time is "
            "delayed (live.overrun: drop drops pictures instead); fewer, slower or smaller cameras help"
        ]

    def __enter__(self) -> StatusLine:
        if self._console.is_terminal:
            console = sys.stderr
            self._line.start()
            handlers = [h for h in logging.getLogger().handlers if isinstance(h, logging.StreamHandler)]
            self._logs = [handler for handler in handlers if handler.stream is console]
            self._log()  # to what clears the line first
        return self

    def __exit__(self, *_: object) -> None:
        self._line.stop()
        self._log()

    def _log(self) -> None:
        """Let what is logged to the console go to what `sys.stderr` is now."""
        for handler in self._logs:
            handler.setStream(sys.stderr)


def changes(before: SimulatorStatus | None, status: SimulatorStatus, *, is_over: bool) -> list[str]:
    """Return what has changed between two statuses that a user wants to know, a line each."""
    lines = []
    if status.phase == "ended" and (before is None or before.phase != "ended"):
        lines.append(f"ended: {status.reason}{'' if is_over else '; `neurosim call reset` begins again'}")
    if before is None or before.phase == "ended" or status.step_count < before.step_count:
        return lines
    if status.phase == "waiting" and status.reason and not before.reason and status.step_count:
        lines.append(f"waiting {status.reason}")
    for was, now in zip(before.vehicles, status.vehicles, strict=False):
        if now.fail_safe_count > was.fail_safe_count:
            lines.append(f"{now.name}: no command has come in time; the fail-safe flies")
        if was.fail_safe and not now.fail_safe:
            sender = f" (from {now.command_source})" if now.command_source else ""
            lines.append(f"{now.name}: commands arrive again{sender}")
    return lines


def _summary(status: SimulatorStatus) -> str:
    text = f"{status.phase} {status.reason}" if status.phase != "running" else "running"
    parts = [f"{text}, {status.stamp_ns / 1e9:.2f} s"]
    if status.phase == "running":
        parts.append(f"{status.real_time_factor:.2f} x real time")
        if status.mode == "streaming":
            parts.append(f"late {status.late_p99_ns / 1e6:.2f} ms (p99)")
        lost = sum(vehicle.lost_count + vehicle.undelivered_count for vehicle in status.vehicles)
        lost += sum(sensor.dropped_count + sensor.undelivered_count for sensor in status.sensors)
        parts.append(f"{lost:,} lost")
        if status.reason:
            parts.append(f"[yellow]{status.reason}[/]")
        if any(vehicle.fail_safe for vehicle in status.vehicles):
            parts.append("[red]fail-safe[/]")
    return ", ".join(parts)
