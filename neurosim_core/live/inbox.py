"""Commands from other processes, read in the thread that flies: no callback, no switch of threads."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from cortex import Node, Subscriber, TypeMismatch, keep_last, reliable
from neurosim_core.control.modes import MODES, CommandMode
from neurosim_core.live.helm import Command
from neurosim_core.live.topics import COMMANDS, command_topic
from neurosim_core.live.translate import setpoint_of
from neurosim_core.render.launch import core_count
from neurosim_core.vehicle.command_ranges import CommandRanges

log = logging.getLogger(__name__)

_DRAIN_MAX = 1024
"""Commands of one mode that are read at a time: a flood must not keep the simulator."""
_BLOCK_S = 0.02
"""Longest wait for the mode that came last before the others are looked at; from there on `recv` waits in the
socket itself, which is the fastest way to be woken."""
_SPIN_S = 300e-6
"""In lockstep, how long to look for a command before sleeping [s]: most come sooner than one is woken."""
_LOG_INTERVAL_S = 1.0


@dataclass(frozen=True, kw_only=True)
class InboxCounts:
    """What happened to the commands of a vehicle before they were taken."""

    refused: int = 0
    """Had numbers that are not finite, or a wrong shape, or were out of range where that is refused."""
    superseded: int = 0
    """Gave way to a newer one, or answered what nobody waits for."""
    lost: int = 0
    """Never arrived."""
    clamped: int = 0
    """Were out of range, and are flown as the nearest command within it."""


class Inbox:
    """The commands of one vehicle, in whatever mode they come.

    Attributes:
        missed: The last command that did not fit what was waited for; None if there was none.
        refusal: Why the last command was refused; empty if none was.
        clamping: What of the last command that was clamped was out of range; empty if none was.
    """

    def __init__(
        self, node: Node, vehicle: str, *, rotor_count: int, ranges: CommandRanges, lockstep: bool = False
    ) -> None:
        """Subscribe to the commands of a vehicle.

        Args:
            node: Where to.
            vehicle: Its name.
            rotor_count: Numbers in a command of rotor speeds.
            ranges: What the vehicle can be asked for; its controller clamps what is beyond.
            lockstep: Every command counts. Who floods is held up; and `wait` is in the socket at once.
        """
        policy = reliable(timeout_s=0.1) if lockstep else keep_last()
        self.vehicle = vehicle
        self.missed: Command | None = None
        self.refusal = self.clamping = ""
        self._ranges = ranges
        self._widths = {mode: len(MODES[mode].layout) for mode in COMMANDS} | {"motor_speeds": rotor_count}
        self._subscribers: dict[CommandMode, Subscriber[Any]] = {
            cast(CommandMode, mode): node.subscriber(command_topic(vehicle, mode), message, policy=policy)
            for mode, message in COMMANDS.items()
        }
        self._known: dict[CommandMode, set[int]] = {mode: set() for mode in self._subscribers}
        self._refused = self._clamped = 0
        self._superseded = 0
        self._before = InboxCounts()
        self._hot = next(iter(self._subscribers))
        self._may_spin = lockstep and core_count() > 1
        self._logged_s = -_LOG_INTERVAL_S

    @property
    def publisher_count(self) -> int:
        """How many publishers of commands are connected, of all modes together."""
        return sum(subscriber.publisher_count for subscriber in self._subscribers.values())

    def find_newcomers(self) -> bool:
        """Return whether publishers have been connected since the last time that were not there before."""
        newcomers = False
        for mode, subscriber in self._subscribers.items():
            sources = subscriber.sources()
            if subscriber.publisher_count >= len(sources):  # else one of them is being connected
                newcomers |= not sources <= self._known[mode]
                self._known[mode] = sources
        return newcomers

    @property
    def counts(self) -> InboxCounts:
        """What happened since the last `reset`."""
        now, before = self._totals(), self._before
        return InboxCounts(
            refused=now.refused - before.refused,
            superseded=now.superseded - before.superseded,
            lost=now.lost - before.lost,
            clamped=now.clamped - before.clamped,
        )

    def reset(self) -> None:
        """Throw away what has arrived, and count from 0."""
        while self._read():
            pass
        self.missed = None
        self._before = self._totals()

    def poll(self) -> Command | None:
        """Take the newest command that has arrived since the last look; None if there is none.

        Of those that are found together, it is the one with the latest stamp.
        """
        return self._newest(self._read())

    def wait(
        self,
        fits: Callable[[Command], bool],
        *,
        deadline_s: float | None = None,
        wake: Callable[[], bool],
    ) -> Command | None:
        """Wait for a command that fits; others are superseded.

        Args:
            fits: Says whether it is one that is waited for.
            deadline_s: When to give up, on `time.monotonic` [s]; None: never.
            wake: Called every 20 ms or so; gives up where it returns True.

        Returns:
            The command; None if it was given up.
        """
        while True:
            left_s = _BLOCK_S if deadline_s is None else deadline_s - time.monotonic()
            if self._may_spin:
                self._subscribers[self._hot].look_out(_SPIN_S)
            found = self._take(self._hot, min(max(left_s, 0.0), _BLOCK_S))
            if found is None:
                newest = self._newest(self._read(), fits)
            else:
                newest = found if fits(found) else self._newest([found], fits)
            if newest is not None:
                self._hot = newest.mode
                return newest
            if (deadline_s is not None and time.monotonic() >= deadline_s) or wake():
                return None

    def _newest(
        self, commands: list[Command], fits: Callable[[Command], bool] = lambda command: True
    ) -> Command | None:
        """Return the one to obey; all others are superseded."""
        fitting = []
        for command in commands:
            if fits(command):
                fitting.append(command)
            else:
                self.missed = command
        if not fitting:
            self._superseded += len(commands)
            return None
        self._superseded += len(commands) - 1
        latest_ns = max(command.stamp_ns for command in fitting)
        return [command for command in fitting if command.stamp_ns == latest_ns][-1]

    def _read(self) -> list[Command]:
        """Take everything that has arrived, mode by mode; that of one mode in the order of its arrival."""
        commands = []
        for mode in self._subscribers:
            for _ in range(_DRAIN_MAX):
                command = self._take(mode, 0.0)
                if command is None:
                    break
                commands.append(command)
        return commands

    def _take(self, mode: CommandMode, timeout_s: float) -> Command | None:
        """Take the next good command of a mode; those that are refused on the way are counted."""
        subscriber = self._subscribers[mode]
        for _ in range(_DRAIN_MAX):
            try:
                message: Any = subscriber.recv(timeout_s)
            except TimeoutError:
                return None
            except TypeMismatch as error:
                self._refuse(str(error))
                continue
            setpoint = setpoint_of(mode, message)
            reason = _fault(mode, setpoint, self._widths[mode]) or self._excess(mode, setpoint)
            if not reason:
                return Command(mode=mode, setpoint=setpoint, stamp_ns=message.stamp_ns)
            self._refuse(reason)
        return None

    def _excess(self, mode: CommandMode, setpoint: np.ndarray) -> str:
        """Say what is out of range where that is refused; else count it: the controller clamps it."""
        excess = self._ranges.excess(mode, setpoint.tolist())
        if not excess or self._ranges.refuse:
            return excess
        self._clamped += 1
        self.clamping = excess
        self._log("clamped", self._clamped, excess)
        return ""

    def _refuse(self, reason: str) -> None:
        self._refused += 1
        self.refusal = reason
        self._log("refused", self._refused, reason)

    def _log(self, what: str, count: int, reason: str) -> None:
        """Log once a second at most."""
        now_s = time.monotonic()
        if now_s - self._logged_s >= _LOG_INTERVAL_S:
            self._logged_s = now_s
            log.warning("%s: %s a command (%d so far): %s", self.vehicle, what, count, reason)

    def _totals(self) -> InboxCounts:
        counters = [subscriber.counters for subscriber in self._subscribers.values()]
        return InboxCounts(
            refused=self._refused,
            superseded=self._superseded + sum(c.overtaken for c in counters),
            lost=sum(c.lost for c in counters),
            clamped=self._clamped,
        )


def _fault(mode: CommandMode, setpoint: np.ndarray, width: int) -> str:
    """Say what is wrong with a setpoint; empty if nothing is."""
    if setpoint.shape != (width,):
        return f"{mode} takes {width} numbers, got {setpoint.size}"
    numbers = setpoint.tolist()
    if not all(map(math.isfinite, numbers)):
        return f"{mode} takes finite numbers, got {numbers}"
    if mode == "attitude" and not np.linalg.norm(setpoint[1:]) > 1e-6:
        return f"attitude takes a unit quaternion, got {setpoint[1:].tolist()}"
    return ""
