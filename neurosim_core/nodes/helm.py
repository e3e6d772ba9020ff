"""What flies a vehicle: the newest command that is due, or the fail-safe where none has come for too long."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.control.modes import CommandMode
from neurosim_core.frames import heading_rad
from neurosim_core.live import LinkConfig, LiveConfig
from neurosim_core.nodes.channel import Channel
from neurosim_core.packets import Delivery, Odometry
from neurosim_core.vehicle import MultirotorConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class Command:
    """What a vehicle is told to do."""

    mode: CommandMode
    """One of `topics.COMMANDS`."""
    setpoint: NDArray[np.float64]
    """Row as in `control.modes.MODES`."""
    stamp_ns: int = 0
    """Stamp of the odometry that it answers, as in the message [ns]."""

    @property
    def size_bytes(self) -> int:
        """What it takes of a link's bandwidth [bytes]."""
        return 8 + self.setpoint.nbytes


@dataclass(kw_only=True)
class HelmCounts:
    """What happened since the beginning of the run."""

    taken: int = 0
    """Commands that took over."""
    superseded: int = 0
    """Commands that a newer one replaced before they were due."""
    fail_safe: int = 0
    """How often the fail-safe set in."""


class Helm:
    """Holds the command of one vehicle, passes new ones through their link, and watches their age.

    All times are simulated, so that the same commands at the same ticks give the same flight.

    Attributes:
        holds: The command that took over last; None before the first.
        counts: What happened so far.
    """

    def __init__(self, live: LiveConfig, link: LinkConfig, *, airframe: MultirotorConfig, seed: int) -> None:
        """Make a helm that nobody has touched.

        Args:
            live: Says when a command is stale and what to do then.
            link: What commands meet on their way.
            airframe: What is flown.
            seed: Seed of the link.
        """
        self.live = live
        self.channel = Channel("command", link, seed=seed)
        self._lowest = np.full(airframe.rotor_count, airframe.rotor_speed_min_rad_s)
        self.holds: Command | None = None
        self.counts = HelmCounts()
        self._since_ns = 0
        self._instead: Command | None = None
        self._first: Command | None = None
        """Where it hovers before the first command."""

    def reset(self, *, seed: int) -> None:
        """Forget all commands and begin again."""
        self.channel.reset(seed=seed)
        self.holds = None
        self.counts = HelmCounts()
        self._since_ns = 0
        self._instead = self._first = None

    @property
    def fail_safe(self) -> bool:
        """Whether the command that holds is stale, and the fail-safe flies."""
        return self._instead is not None

    def send(self, command: Command, *, stamp_ns: int) -> Delivery | None:
        """Send a command on its way at a tick [ns]; what its link does to it, if there is one."""
        return self.channel.send(command, stamp_ns=stamp_ns, size_bytes=command.size_bytes)

    def command_at(
        self, stamp_ns: int, observe: Callable[[], Odometry]
    ) -> tuple[CommandMode, NDArray[np.float64] | None]:
        """Return what flies the control period that begins at a tick.

        Args:
            stamp_ns: The tick, after the one asked for last [ns].
            observe: Gives the state of the vehicle at the tick.

        Returns:
            Mode and setpoint; the setpoint is None as long as no command has come and it does not hover.
        """
        arrived: list[tuple[int, Any]] = self.channel.due(stamp_ns)
        if arrived:
            self.holds = arrived[-1][1]
            self._since_ns = stamp_ns
            self.counts.taken += 1
            self.counts.superseded += len(arrived) - 1
            self._instead = None
        if self.holds is None:
            if self.live.begin == "command" or self.live.mode == "lockstep":
                return "motor_speeds", None
            self._first = self._first or _hover(observe())
            return self._first.mode, self._first.setpoint
        if not self.fail_safe and self.age_ns(stamp_ns) > round(self.live.command_timeout_s * 1e9):
            self.counts.fail_safe += 1
            self._instead = self._give_up(self.holds, observe)
        flown = self._instead or self.holds
        return flown.mode, flown.setpoint

    def age_ns(self, stamp_ns: int) -> int:
        """Return for how long the command that holds has held [ns]; 0 before the first."""
        return 0 if self.holds is None else stamp_ns - self._since_ns

    def _give_up(self, stale: Command, observe: Callable[[], Odometry]) -> Command:
        if self.live.fail_safe == "hold":
            return stale
        if self.live.fail_safe == "cut":
            return Command(mode="motor_speeds", setpoint=self._lowest)
        return _hover(observe())


def _hover(state: Odometry) -> Command:
    """Return the command to stay where a vehicle is."""
    return Command(mode="position", setpoint=np.array([*state.position, heading_rad(state.orientation)]))
