"""What `neurosim serve` says to the people in front of it, and how they stop it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.status import Status
from rich.table import Table

from cortex.messages import SimulatorStatus
from neurosim_core.config import SimulationConfig
from neurosim_core.live import topics
from neurosim_core.live.craft import Craft


def print_plan(console: Console, crafts: Sequence[Craft], config: SimulationConfig) -> None:
    """Say what is simulated, where it can be heard, and what it waits for."""
    scene = crafts[0].model.scene
    live = config.live
    if live.mode == "lockstep":
        pace = "lockstep: every control period waits for its command"
    elif live.real_time_factor:
        pace = f"streaming at {live.real_time_factor:g} x real time"
    else:
        pace = "streaming as fast as it can"
    console.print(
        f"[bold]{scene.name}[/], {len(scene.faces):,} triangles, on {crafts[0].model.device}; "
        f"{config.control.rate_hz:g} control periods a second, {pace}",
        highlight=False,
        soft_wrap=True,
    )
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for craft in crafts:
        names = dict.fromkeys([*craft.model.config.sensors, "odometry", "rotor_speeds"])
        table.add_row(craft.model.config.vehicle.preset, f"/{craft.name}/: {', '.join(names)}")
    console.print(table, highlight=False)
    commands = ", ".join(topics.command_topic(craft.name, "*") for craft in crafts)
    console.print(f"waiting for the first command on {commands}: `neurosim fly` sends them", highlight=False)


_SLOW_STATUSES = 5
"""Statuses in a row, five a second, after which a run is called slow."""


class StatusLine:
    """One line that tells how it is going, on a terminal; and lines for what a user would want to know of.

    A context manager.

    Attributes:
        last: The newest status; None if there was none.
    """

    def __init__(self, console: Console) -> None:
        """Prepare the line.

        Args:
            console: Where to.
        """
        self.last: SimulatorStatus | None = None
        self._slow_count = 0
        self._console = console
        self._line: Status | None = None

    def show(self, status: SimulatorStatus) -> None:
        """Update the line, and say what has changed."""
        before, self.last = self.last, status
        if self._line is not None:
            self._line.update(_summary(status))
        for news in (*changes(before, status), *self._slowness(before, status)):
            self._console.print(f"[yellow]{news}[/]", highlight=False, soft_wrap=True)

    def _slowness(self, before: SimulatorStatus | None, status: SimulatorStatus) -> list[str]:
        """Say once in a run that it goes slower than it was meant to, when it has for a second."""
        wanted = status.real_time_factor_wanted
        if before is None or status.step_count < before.step_count:
            self._slow_count = 0
            return []
        slow = before.phase == status.phase == "running" and status.real_time_factor < 0.9 * wanted
        if slow or self._slow_count > _SLOW_STATUSES:  # once said, it is not said again
            self._slow_count += 1
        else:
            self._slow_count = 0
        if self._slow_count != _SLOW_STATUSES:
            return []
        return [
            f"this machine manages {status.real_time_factor:.2f} x real time, not {wanted:g}: time is held "
            "back (live.overrun: drop leaves out pictures instead); fewer, slower or smaller cameras help"
        ]

    def __enter__(self) -> StatusLine:
        if self._console.is_terminal:
            self._line = self._console.status("", refresh_per_second=5)
            self._line.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._line is not None:
            self._line.stop()
            self._line = None


def changes(before: SimulatorStatus | None, status: SimulatorStatus) -> list[str]:
    """Say what a user would want to know of that has changed between two statuses, a line each."""
    news = []
    if status.phase == "ended" and (before is None or before.phase != "ended"):
        news.append(f"ended: {status.reason}")
    if before is None or before.phase == "ended" or status.step_count < before.step_count:
        return news
    if status.phase == "waiting" and status.reason and not before.reason and status.step_count:
        news.append(f"waiting {status.reason}")
    for was, now in zip(before.vehicles, status.vehicles, strict=False):
        if now.fail_safe_count > was.fail_safe_count:
            news.append(f"{now.name}: no command has come in time; the fail-safe flies")
        if was.fail_safe and not now.fail_safe:
            news.append(f"{now.name}: commands are coming again")
    return news


def print_end(
    console: Console,
    last: SimulatorStatus | None,
    record: Path | None,
    *,
    redone: Mapping[str, int] | None = None,
) -> None:
    """Say what has been simulated since the last reset.

    Args:
        console: Where to.
        last: The last status; None: nothing was simulated.
        record: The folder that it was recorded to; None: it was not.
        redone: Intervals that fixed steps could not resolve, by the name of the vehicle.
    """
    if last is None:
        return
    taken = sum(vehicle.command_count for vehicle in last.vehicles)
    lost = sum(vehicle.lost_count for vehicle in last.vehicles)
    refused = sum(vehicle.refused_count for vehicle in last.vehicles)
    clamped = sum(vehicle.clamped_count for vehicle in last.vehicles)
    refusals = f"{refused:,} refused" + (f", {clamped:,} clamped to their range" if clamped else "")
    collisions = sum(vehicle.collision_count for vehicle in last.vehicles)
    console.print(
        f"simulated {last.stamp_ns / 1e9:.3f} s: {last.step_count:,} control periods, {taken:,} commands "
        f"({lost:,} lost, {refusals}), {collisions:,} collisions",
        highlight=False,
        soft_wrap=True,
    )
    for name, count in (redone or {}).items():
        if count:
            console.print(
                f"{name}: {count:,} intervals were too rough for fixed steps, and redone in adaptive ones",
                highlight=False,
                soft_wrap=True,
            )
    if last.mode == "streaming":
        dropped = sum(sensor.dropped_count for sensor in last.sensors)
        console.print(
            f"{last.overrun_count:,} periods took too long, time was held back by "
            f"{last.slipped_ns / 1e9:.3f} s, {dropped:,} frames were left out or lost",
            highlight=False,
            soft_wrap=True,
        )
    undelivered = _undelivered(last)
    if undelivered:
        console.print(
            f"[yellow]{undelivered:,} messages were lost by reliable readers that were too slow[/]",
            highlight=False,
            soft_wrap=True,
        )
    if record is not None:
        console.print(f"recorded to {record}/", highlight=False, soft_wrap=True)


def _undelivered(status: SimulatorStatus) -> int:
    """Messages that reliable readers lost."""
    return sum(s.undelivered_count for s in status.sensors) + sum(
        v.undelivered_count for v in status.vehicles
    )


def _summary(status: SimulatorStatus) -> str:
    text = f"{status.phase} {status.reason}" if status.phase != "running" else "running"
    parts = [f"{text}, {status.stamp_ns / 1e9:.2f} s"]
    if status.phase == "running":
        parts.append(f"{status.real_time_factor:.2f} x real time")
        if status.mode == "streaming":
            parts.append(f"late {status.late_p99_ns / 1e6:.2f} ms (p99)")
        lost = sum(v.lost_count for v in status.vehicles) + sum(s.dropped_count for s in status.sensors)
        parts.append(f"{lost + _undelivered(status):,} lost")
        if status.reason:
            parts.append(f"[yellow]{status.reason}[/]")
        if any(vehicle.fail_safe for vehicle in status.vehicles):
            parts.append("[red]fail-safe[/]")
    return ", ".join(parts)
