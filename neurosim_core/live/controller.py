"""The controller that follows the path, in a process of its own: `neurosim fly`."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar, cast, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from rich.console import Console
from rich.status import Status

from cortex import Closed, Info, Node, Subscriber, keep_last, latest, reliable
from cortex.messages import Odometry, RotorSpeeds, Simulation, SimulatorStatus
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.control import FollowMode, PathFollower
from neurosim_core.live.topics import COMMANDS, SIMULATION, STATUS, command_topic, stream_topic
from neurosim_core.live.translate import command_of
from neurosim_core.simulation import plan_paths
from neurosim_core.trajectory import Path

logger = logging.getLogger(__name__)

T = TypeVar("T")

_LOOK_S = 0.2
"""How often the console looks at what there is to say [s]."""
_PATIENCE_S = {"lockstep": 0.5, "streaming": 0.02}
"""How long odometry waits for the rotor speeds that belong to it [s]."""
_MISSES_MAX = 5
"""After so many misses in a row nobody waits any more, until some are there again."""


_WAITING = "waiting for a simulator (neurosim serve)"


class PathPilot:
    """Flies one vehicle of a simulator along a path: answers its odometry with commands.

    In lockstep every odometry message is answered; in streaming the newest one, so that a slow pilot is late
    by its own time only. State and path are taken at the odometry's stamp. Where no rotor speeds come with
    it, that is counted and said, and the newest ones are taken instead.

    Attributes:
        vehicle: Name of the vehicle.
        command_count: Commands sent so far.
        lost_count: Of these, such as the simulator did not take in in time.
        missing_count: Odometry messages without rotor speeds.
        error_square_sum_m2: Sum of the squared distances from the path, one for each command [m^2].
    """

    def __init__(
        self,
        node: Node,
        vehicle: str,
        follower: PathFollower,
        *,
        lockstep: bool,
        rotor_speed: NDArray[np.float64],
        delay_s: float = 0.0,
    ) -> None:
        """Connect.

        Args:
            node: What to talk through; it stays open.
            vehicle: Name of the vehicle.
            follower: Makes the commands; no other pilot may use it.
            lockstep: Whether the simulator waits for each command.
            rotor_speed: What to assume before any rotor speeds have come [rad/s], shape [R].
            delay_s: How long to sleep before each command [s].
        """
        self.vehicle = vehicle
        self.command_count = self.lost_count = self.missing_count = 0
        self.error_square_sum_m2 = 0.0
        self._follower = follower
        self._delay_s = delay_s
        self._patience_s = _PATIENCE_S["lockstep" if lockstep else "streaming"]
        self._newest = rotor_speed
        self._ahead: deque[RotorSpeeds] = deque(maxlen=1024)
        self._misses = 0
        self._say_again_s = 0.0
        self._closed = threading.Event()
        self._commands = node.publisher(command_topic(vehicle, follower.mode), COMMANDS[follower.mode])
        self._rotor_speeds = node.subscriber(
            stream_topic(vehicle, "rotor_speeds"),
            RotorSpeeds,
            policy=reliable() if lockstep else keep_last(256),
        )
        self._odometry = node.subscriber(
            stream_topic(vehicle, "odometry"), Odometry, policy=reliable() if lockstep else latest()
        )

    def answer(self, timeout_s: float | None = None) -> bool:
        """Wait for odometry, and send the command that answers it.

        Args:
            timeout_s: Longest wait for a simulator, and for its odometry [s]; None waits for ever.

        Returns:
            Whether any came.

        Raises:
            Closed: The pilot or its node was closed.
            ValueError: The vehicle has another number of rotors than the follower's.
        """
        if not self.command_count:  # one that is sent before somebody listens is lost
            wait_s = math.inf if timeout_s is None else timeout_s
            if not self._commands.wait_for_subscribers(timeout_s=wait_s):
                return False
        try:
            odometry = self._odometry.recv(timeout_s)
        except TimeoutError:
            return False
        rotor_speed = self._speed_of(odometry)
        if self._delay_s > 0.0:
            self._closed.wait(self._delay_s)
        command = self._follower.command(
            stamp_ns=odometry.stamp_ns,
            position=odometry.position,
            velocity=odometry.velocity,
            orientation=odometry.orientation,
            body_rate=odometry.body_rate,
            rotor_speed=rotor_speed,
        )
        message = command_of(
            self._follower.mode, command, stamp_ns=odometry.stamp_ns, sequence=self.command_count
        )
        if not self._commands.publish(message):
            self.lost_count += 1
            self._say("the simulator does not take in its commands")
        self.error_square_sum_m2 += self._follower.error_m(odometry.stamp_ns, odometry.position) ** 2
        self.command_count += 1
        return True

    def run(self) -> None:
        """Answer until somebody closes the pilot or its node."""
        with contextlib.suppress(Closed):
            while not self._closed.is_set():
                self.answer(_LOOK_S)

    def close(self) -> None:
        """Leave. From any thread; `run` returns soon after."""
        self._closed.set()
        for end in (self._odometry, self._rotor_speeds, self._commands):
            end.close()

    def __enter__(self) -> PathPilot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _speed_of(self, odometry: Odometry) -> NDArray[np.float64]:
        """Return the rotor speeds that belong to odometry: they are sent before it, but on their own way.

        The two have the same sequence; their stamps differ where their links have clocks of their own.
        """
        ahead = self._ahead
        for place, speeds in enumerate(ahead):
            if speeds.sequence == odometry.sequence:
                for _ in range(place + 1):
                    ahead.popleft()
                return self._found(speeds)
        deadline_s = time.monotonic() + (self._patience_s if self._misses < _MISSES_MAX else 0.0)
        with contextlib.suppress(TimeoutError):
            while True:
                speeds = self._rotor_speeds.recv(max(deadline_s - time.monotonic(), 0.0))
                if speeds.sequence == odometry.sequence:
                    ahead.clear()
                    return self._found(speeds)
                ahead.append(speeds)
        self._misses += 1
        self.missing_count += 1
        self._say(f"no rotor speeds came with the odometry of {odometry.stamp_ns} ns; using the newest")
        return ahead[-1].speed if ahead else self._newest

    def _found(self, speeds: RotorSpeeds) -> NDArray[np.float64]:
        self._misses = 0
        self._newest = speeds.speed
        return self._newest

    def _say(self, text: str) -> None:
        """Warn, once a second at most."""
        now_s = time.monotonic()
        if now_s >= self._say_again_s:
            self._say_again_s = now_s + 1.0
            logger.warning("%s: %s", self.vehicle, text)


class _Crew:
    """The pilots of all vehicles, a thread for each."""

    def __init__(self, node: Node, *, only: str | None, mode: FollowMode, delay_s: float) -> None:
        self._node = node
        self._only = only
        self.mode = mode
        self._delay_s = delay_s
        self._planned: SimulationConfig | None = None
        self._paths: dict[str, Path] = {}
        self._pilots: list[PathPilot] = []
        self._threads: list[Future[None]] = []
        self._stack = contextlib.ExitStack()
        self._looked_s = 0.0
        self._before: dict[str, tuple[int, float]] = {}

    def plan(self, config: SimulationConfig) -> None:
        """Plan the paths, unless that was done."""
        if config == self._planned:
            return
        names = list(config.vehicles) if self._only is None else [self._only]
        if unknown := [name for name in names if name not in config.vehicles]:
            raise ValueError(f"unknown vehicle {unknown[0]!r}, known: {', '.join(config.vehicles)}")
        self._paths, self._planned = plan_paths(config, names), config

    def fly(self, config: SimulationConfig, *, lockstep: bool) -> None:
        """Let pilots fly, instead of those that do."""
        self.land()
        self.plan(config)
        pool = self._stack.enter_context(ThreadPoolExecutor(len(self._paths), "pilot"))
        for name, path in self._paths.items():
            member = config.of(name)
            airframe = member.vehicle.airframe()
            pilot = PathPilot(
                self._node,
                name,
                PathFollower(path, airframe, member.control.gains, mode=self.mode),
                lockstep=lockstep,
                rotor_speed=np.full(airframe.rotor_count, airframe.hover_rotor_speed_rad_s),
                delay_s=self._delay_s,
            )
            self._stack.callback(pilot.close)  # before the pool waits for its threads
            self._pilots.append(pilot)
            self._threads.append(pool.submit(pilot.run))
        self._looked_s = time.monotonic()

    def land(self) -> None:
        """End the pilots."""
        self._stack.close()
        self._pilots.clear()
        self._threads.clear()
        self._before.clear()

    @property
    def vehicles(self) -> list[str]:
        """Who is flown now."""
        return [pilot.vehicle for pilot in self._pilots]

    def look(self) -> str:
        """Return how the pilots are doing since the last look; raise what one of them raised."""
        for thread in self._threads:
            if thread.done():
                thread.result()
        now_s = time.monotonic()
        elapsed_s, self._looked_s = now_s - self._looked_s, now_s
        return "; ".join(self._describe(pilot, elapsed_s) for pilot in self._pilots)

    def _describe(self, pilot: PathPilot, elapsed_s: float) -> str:
        count, square_sum_m2 = pilot.command_count, pilot.error_square_sum_m2
        count_before, square_sum_before_m2 = self._before.get(pilot.vehicle, (0, 0.0))
        self._before[pilot.vehicle] = count, square_sum_m2
        if count == count_before:
            return f"{pilot.vehicle}: no odometry"
        rate_hz = (count - count_before) / elapsed_s
        error_m = math.sqrt((square_sum_m2 - square_sum_before_m2) / (count - count_before))
        return f"{pilot.vehicle}: {rate_hz:.0f} commands/s, {100.0 * error_m:.1f} cm from its path (RMS)"

    def __enter__(self) -> _Crew:
        return self

    def __exit__(self, *_: object) -> None:
        self.land()


def fly(config: SimulationConfig | None, *, vehicle: str | None, mode: str, delay_s: float) -> int:
    """Fly the vehicles of a simulator along their paths, until it ends or we are interrupted.

    It waits for a simulator, and for the next one when that has gone. After a collision it waits for a reset.

    Args:
        config: What is flown where; None: as the simulator says.
        vehicle: Fly only this one; None: all.
        mode: What to command: motor_speeds, velocity or position.
        delay_s: How long to sleep before each command [s].

    Returns:
        0: the simulator has flown all that it was to fly.

    Raises:
        ValueError: An argument is not what it must be, there is no such vehicle, or no path.
    """
    if not 0.0 <= delay_s < math.inf:
        raise ValueError(f"delay_s must be >= 0, got {delay_s}")
    if mode not in get_args(FollowMode):
        raise ValueError(f"unknown mode {mode!r}, known: {', '.join(get_args(FollowMode))}")
    console = Console(highlight=False)
    with (
        Node("controller") as node,
        _Crew(node, only=vehicle, mode=cast(FollowMode, mode), delay_s=delay_s) as crew,
        console.status("") as line,
    ):
        if config is not None:
            line.update("planning")
            crew.plan(config)
        return _attend(node, crew, config, console, line)


def _attend(node: Node, crew: _Crew, config: SimulationConfig | None, console: Console, line: Status) -> int:
    """Let the crew fly for one simulator after the other, and say what happens."""
    announcements = node.subscriber(SIMULATION, Simulation, policy=latest())
    statuses = node.subscriber(STATUS, SimulatorStatus, policy=latest())
    run_on, said, source = True, "", 0

    def say(text: str) -> None:
        nonlocal said
        if text != said:
            console.print(text)
        said = text

    while True:
        found = _take_with_info(announcements, 0.0 if crew.vehicles else _LOOK_S)
        if found is not None and not (crew.vehicles and found[1].source == source):
            simulation, source = found[0], found[1].source  # the same one again: its settings have changed
            _take(statuses, 0.0)  # of the simulator before
            theirs = load_config(yaml.safe_load(simulation.config))
            run_on = theirs.live.run_on
            line.update("planning")
            crew.fly(config or theirs, lockstep=simulation.mode == "lockstep")
            console.print(
                f"flying {', '.join(crew.vehicles)}: {crew.mode}, {simulation.mode}, "
                f"{simulation.control_rate_hz:g} Hz"
            )
            said = ""
        status = _take(statuses, _LOOK_S) if crew.vehicles else None
        line.update(crew.look())
        if status is not None and status.phase == "ended":
            if not run_on:
                return 0
            say(f"the simulator has ended the flight ({status.reason}); waiting for a reset")
        elif status is not None:
            said = ""
        if announcements.publisher_count == 0:
            say(_WAITING)
            line.update(_WAITING)
            crew.land()


def _take_with_info(subscriber: Subscriber[T], timeout_s: float) -> tuple[T, Info] | None:
    """Return the next message and where it comes from; None if none comes in time."""
    try:
        return subscriber.recv_with_info(timeout_s)
    except TimeoutError:
        return None


def _take(subscriber: Subscriber[T], timeout_s: float) -> T | None:
    """Return the next message; None if none comes in time."""
    try:
        return subscriber.recv(timeout_s)
    except TimeoutError:
        return None
