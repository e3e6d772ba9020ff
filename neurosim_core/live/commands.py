"""Commands of one vehicle: their subscriber, and the hold that keeps the newest one until the next."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from cortex import Node, Subscriber, TypeMismatch, keep_last, reliable
from neurosim_core.control.modes import MODES, CommandMode
from neurosim_core.frames import heading_rad
from neurosim_core.live.config import LinkConfig, LiveConfig
from neurosim_core.live.links import Link
from neurosim_core.live.messages import setpoint_of
from neurosim_core.live.topics import COMMANDS, command_topic
from neurosim_core.packets import Delivery, Odometry
from neurosim_core.vehicle import MultirotorConfig
from neurosim_core.vehicle.command_ranges import CommandRanges

log = logging.getLogger(__name__)

_DRAIN_MAX = 1024
"""Commands of one mode that are read at a time, so that a flood cannot occupy the simulator."""
_BLOCK_S = 0.02
"""Longest wait for the mode of the last command before the other modes are checked [s]."""
_SPIN_S = 300e-6
"""In lockstep, how long to poll for a command before sleeping [s]: most arrive before a thread would wake."""
_LOG_INTERVAL_S = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Command:
    """A setpoint of one mode."""

    mode: CommandMode
    """One of `topics.COMMANDS`."""
    setpoint: NDArray[np.float64]
    """Row as in `control.modes.MODES`."""
    stamp_ns: int = 0
    """Stamp of the odometry that it answers, as in the message [ns]."""

    @property
    def size_bytes(self) -> int:
        """The bandwidth that it takes [bytes]."""
        return 8 + self.setpoint.nbytes


class CommandCounts(NamedTuple):
    """Commands that a subscriber did not return since its last reset."""

    refused: int = 0
    """Numbers that are not finite, of a wrong shape, or out of range where that is refused."""
    superseded: int = 0
    """Replaced by a newer command, or answers to a state that no control period waits for."""
    lost: int = 0
    """Never arrived."""
    clamped: int = 0
    """Out of range, and flown as the nearest command within it."""


class CommandSubscriber:
    """Reads the commands of one vehicle, in every mode, in the simulation thread.

    Attributes:
        missed: The last command that did not fit what was waited for; None if there was none.
        refusal: Why the last command was refused; empty if none was.
        clamping: What of the last command that was clamped was out of range; empty if none was.
    """

    def __init__(
        self, node: Node, vehicle: str, *, rotor_count: int, ranges: CommandRanges, lockstep: bool
    ) -> None:
        """Subscribe on a node.

        `rotor_count`: numbers in a command of rotor speeds. `ranges`: what the vehicle can be asked for; its
        controller clamps what is beyond. `lockstep`: every command counts, and a sender that floods is held
        up.
        """
        policy = reliable(timeout_s=0.1) if lockstep else keep_last()
        self.vehicle = vehicle
        self._node = node
        self._senders = ""
        self._sequences: dict[int, int] = {}
        self.missed: Command | None = None
        self.refusal = self.clamping = ""
        self._ranges = ranges
        self._widths = {mode: len(MODES[mode].layout) for mode in COMMANDS} | {"motor_speeds": rotor_count}
        self._subscribers: dict[CommandMode, Subscriber[Any]] = {
            cast(CommandMode, mode): node.subscriber(command_topic(vehicle, mode), message, policy=policy)
            for mode, message in COMMANDS.items()
        }
        self._sources: dict[CommandMode, set[int]] = {mode: set() for mode in self._subscribers}
        self._refused = self._superseded = self._clamped = 0
        self._before = CommandCounts()
        self._last_mode = next(iter(self._subscribers))
        self._spins = lockstep
        self._logged_s = -_LOG_INTERVAL_S

    @property
    def publisher_count(self) -> int:
        """Publishers of commands that are connected, of all modes."""
        return sum(subscriber.publisher_count for subscriber in self._subscribers.values())

    def has_new_publisher(self) -> bool:
        """Return whether a publisher was connected since the last call."""
        found = False
        for mode, subscriber in self._subscribers.items():
            sequences = subscriber.sources()
            self._sequences = {**sequences, **self._sequences}
            sources = set(sequences)
            if subscriber.publisher_count >= len(sources):  # else one of them is still connecting
                found |= not sources <= self._sources[mode]
                self._sources[mode] = sources
        return found

    def senders(self, mode: CommandMode) -> str:
        """Return the names of the nodes that have sent commands of a mode since the last call.

        If none has, what was returned then.
        """
        sequences = self._subscribers[mode].sources()
        active = {source for source, count in sequences.items() if count > self._sequences.get(source, count)}
        if not active and not self._senders:  # it came before its sender was first looked at
            active = {source for source, count in sequences.items() if count > 0}
        self._sequences |= sequences
        if active:
            self._senders = ", ".join(
                record.name
                for record in self._node.nodes()
                if any(publisher.source in active for publisher in record.publishers)
            )
        return self._senders

    @property
    def counts(self) -> CommandCounts:
        """Counts since the last `reset`."""
        return CommandCounts(*(a - b for a, b in zip(self._totals(), self._before, strict=True)))

    def reset(self) -> None:
        """Discard what has arrived, and count from 0."""
        while self._read():
            pass
        self.missed = None
        self._senders = ""
        self._before = self._totals()

    def poll(self) -> Command | None:
        """Return the newest command that has arrived since the last call; None if there is none."""
        return self._newest(self._read())

    def wait(
        self, fits: Callable[[Command], bool], *, deadline_s: float | None, wake: Callable[[], bool]
    ) -> Command | None:
        """Wait for a command that fits, and return it; others are superseded.

        `deadline_s`: when to give up and return None, on `time.monotonic` [s]; None: never. `wake`: called
        about every 20 ms; ends the wait by returning True.
        """
        while True:
            left_s = _BLOCK_S if deadline_s is None else deadline_s - time.monotonic()
            if self._spins:
                self._subscribers[self._last_mode].look_out(_SPIN_S)
            found = self._take(self._last_mode, min(max(left_s, 0.0), _BLOCK_S))
            if found is not None and fits(found):
                return found
            newest = self._newest(self._read() if found is None else [found], fits)
            if newest is not None:
                self._last_mode = newest.mode
                return newest
            if (deadline_s is not None and time.monotonic() >= deadline_s) or wake():
                return None

    def _newest(
        self, commands: list[Command], fits: Callable[[Command], bool] = lambda command: True
    ) -> Command | None:
        """Return the fitting command with the latest stamp; all others are superseded."""
        newest: Command | None = None
        for command in commands:
            if not fits(command):
                self.missed = command
            elif newest is None or command.stamp_ns >= newest.stamp_ns:
                newest = command
        self._superseded += len(commands) - (newest is not None)
        return newest

    def _read(self) -> list[Command]:
        """Take everything that has arrived, mode by mode."""
        commands = []
        for mode in self._subscribers:
            for _ in range(_DRAIN_MAX):
                command = self._take(mode, 0.0)
                if command is None:
                    break
                commands.append(command)
        return commands

    def _take(self, mode: CommandMode, timeout_s: float) -> Command | None:
        """Take the next valid command of a mode; those that are refused before it are counted."""
        for _ in range(_DRAIN_MAX):
            try:
                message: Any = self._subscribers[mode].recv(timeout_s)
            except TimeoutError:
                return None
            except TypeMismatch as error:
                self._refuse(str(error))
                continue
            setpoint = setpoint_of(mode, message)
            reason = _error_in(mode, setpoint, self._widths[mode]) or self._excess(mode, setpoint)
            if not reason:
                return Command(mode=mode, setpoint=setpoint, stamp_ns=message.stamp_ns)
            self._refuse(reason)
        return None

    def _excess(self, mode: CommandMode, setpoint: NDArray[np.float64]) -> str:
        """Return what is out of range where that is refused; else count it, and the controller clamps it."""
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
        """Log at most once a second."""
        now_s = time.monotonic()
        if now_s - self._logged_s >= _LOG_INTERVAL_S:
            self._logged_s = now_s
            log.warning("%s: %s a command (%d so far): %s", self.vehicle, what, count, reason)

    def _totals(self) -> CommandCounts:
        counters = [subscriber.counters for subscriber in self._subscribers.values()]
        return CommandCounts(
            refused=self._refused,
            superseded=self._superseded + sum(c.overtaken for c in counters),
            lost=sum(c.lost for c in counters),
            clamped=self._clamped,
        )


def _error_in(mode: CommandMode, setpoint: NDArray[np.float64], width: int) -> str:
    """Return what is wrong with a setpoint; empty if nothing is."""
    if setpoint.shape != (width,):
        return f"{mode} takes {width} numbers, got {setpoint.size}"
    numbers = setpoint.tolist()
    if not all(map(math.isfinite, numbers)):
        return f"{mode} takes finite numbers, got {numbers}"
    if mode == "attitude" and not np.linalg.norm(setpoint[1:]) > 1e-6:
        return f"attitude takes a unit quaternion, got {setpoint[1:].tolist()}"
    return ""


class CommandHold:
    """Holds the newest command of one vehicle, behind its link, and replaces it by the fail-safe when stale.

    All times are simulated: the same commands at the same ticks give the same flight.

    Attributes:
        live: Says when a command is stale, and what happens then.
        link: Commands in flight.
        command: The command that took effect last; None before the first.
        fail_safe: The command that flies in place of a stale one; None while commands are in time.
        taken_count: Commands that took effect since the last reset.
        superseded_count: Commands that a newer one replaced before they were due.
        fail_safe_count: How often the fail-safe set in.
    """

    def __init__(self, live: LiveConfig, link: LinkConfig, *, airframe: MultirotorConfig, seed: int) -> None:
        """Begin without a command; `link` is that of the commands, and `seed` its seed."""
        self.live = live
        self.link = Link(link, seed=seed, name="command")
        self._lowest = np.full(airframe.rotor_count, airframe.rotor_speed_min_rad_s)
        self.reset(seed=seed)

    def reset(self, *, seed: int) -> None:
        """Forget all commands."""
        self.link.reset(seed=seed)
        self.command: Command | None = None
        self.fail_safe: Command | None = None
        self._first: Command | None = None
        self.taken_count = self.superseded_count = self.fail_safe_count = 0
        self._since_ns = 0

    def send(self, command: Command, *, stamp_ns: int) -> Delivery | None:
        """Send a command at a tick [ns]; return what its link does to it, None if nothing."""
        return self.link.send(command, stamp_ns=stamp_ns, size_bytes=command.size_bytes)

    def command_at(
        self, stamp_ns: int, observe: Callable[[], Odometry]
    ) -> tuple[CommandMode, NDArray[np.float64] | None]:
        """Return mode and setpoint of the control period that begins at a tick [ns].

        The setpoint is None before the first command, unless the vehicle hovers then. `observe`: returns the
        state of the vehicle at the tick.
        """
        arrived = self.link.due(stamp_ns)
        if arrived:
            self.command = arrived[-1][1]
            self._since_ns = stamp_ns
            self.taken_count += 1
            self.superseded_count += len(arrived) - 1
            self.fail_safe = None
        if self.command is None:
            if self.live.begin == "command" or self.live.mode == "lockstep":
                return "motor_speeds", None
            self._first = self._first or _hover(observe())
            return self._first.mode, self._first.setpoint
        if self.fail_safe is None and self.age_ns(stamp_ns) > round(self.live.command_timeout_s * 1e9):
            self.fail_safe_count += 1
            self.fail_safe = self._make_fail_safe(self.command, observe)
        flown = self.fail_safe or self.command
        return flown.mode, flown.setpoint

    def age_ns(self, stamp_ns: int) -> int:
        """Return how long the command has been held [ns]; 0 before the first."""
        return 0 if self.command is None else stamp_ns - self._since_ns

    def _make_fail_safe(self, stale: Command, observe: Callable[[], Odometry]) -> Command:
        if self.live.fail_safe == "hold":
            return stale
        if self.live.fail_safe == "cut":
            return Command(mode="motor_speeds", setpoint=self._lowest)
        return _hover(observe())


def _hover(state: Odometry) -> Command:
    """Return the command to stay where a vehicle is."""
    return Command(mode="position", setpoint=np.array([*state.position, heading_rad(state.orientation)]))
