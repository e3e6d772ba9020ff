"""`neurosim fly`: the controller that follows the path, in a process of its own."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, TypeVar, cast, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from rich.console import Console

from cortex import Closed, Info, Node, Publisher, Subscriber, keep_last, latest, reliable
from cortex.messages import Odometry, RotorSpeeds, Simulation, SimulatorStatus
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.control import FollowMode, PathFollower
from neurosim_core.live.messages import command_of
from neurosim_core.live.topics import COMMANDS, SIMULATION, STATUS, command_topic, stream_topic
from neurosim_core.signals import INTERRUPTED_LINE, handle_signals, leave_at_once
from neurosim_core.sim import plan_paths
from neurosim_core.trajectory import Path

logger = logging.getLogger(__name__)

T = TypeVar("T")

_LOOK_S = 0.2
"""How often the console is updated [s]."""
_ROTORS_S = {"lockstep": 0.5, "streaming": 0.02}
"""How long odometry waits for the rotor speeds of its sequence [s]."""
_MISSES_MAX = 5
"""After so many misses in a row nothing waits any more, until rotor speeds arrive again."""
_WAITING = "waiting for a simulator (neurosim serve)"


class PathController:
    """Flies one vehicle along a path: answers its odometry with commands.

    In lockstep it answers every odometry message, in streaming the newest one. State and path are taken at
    the stamp of the odometry. Rotor speeds that do not arrive with it are counted, and replaced by the newest
    ones.

    Attributes:
        vehicle: Name of the vehicle.
        command_count: Commands sent.
        lost_count: Commands that the simulator did not take in time.
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

        `follower`: makes the commands; for this controller only. `lockstep`: whether the simulator waits for
        each command. `rotor_speed`: rotor speeds before any have arrived [rad/s], shape [R]. `delay_s`: how
        long to sleep before each command [s].
        """
        self.vehicle = vehicle
        self.command_count = self.lost_count = self.missing_count = 0
        self.error_square_sum_m2 = 0.0
        self._told = (0, 0.0)
        self._follower = follower
        self._delay_s = delay_s
        self._wait_s = _ROTORS_S["lockstep" if lockstep else "streaming"]
        self._newest = rotor_speed
        self._speeds: dict[int, NDArray[np.float64]] = {}
        """Rotor speeds by sequence that no odometry has asked for."""
        self._misses = 0
        self._logged_s = -math.inf
        self._closed = threading.Event()
        self._node = node
        self._commands: Publisher[Any] | None = None
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

        `timeout_s`: longest wait for a simulator, and for its odometry [s]; None: forever. Returns whether
        any came.
        """
        if not self.command_count and not self._connect(math.inf if timeout_s is None else timeout_s):
            return False
        try:
            odometry = self._odometry.recv(timeout_s)
        except TimeoutError:
            return False
        rotor_speed = self._rotor_speed_of(odometry)
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
        assert self._commands is not None
        if not self._commands.publish(message):
            self.lost_count += 1
            self._warn("the simulator does not take its commands")
        self.error_square_sum_m2 += self._follower.error_m(odometry.stamp_ns, odometry.position) ** 2
        self.command_count += 1
        return True

    def run(self) -> None:
        """Answer until the controller or its node is closed."""
        with contextlib.suppress(Closed):
            while not self._closed.is_set():
                self.answer(_LOOK_S)

    def describe(self, elapsed_s: float) -> str:
        """Return how it is doing since the last call, which is some time ago [s]."""
        now = self.command_count, self.error_square_sum_m2
        before, self._told = self._told, now
        count, square_sum_m2 = now[0] - before[0], now[1] - before[1]
        if not count:
            return f"{self.vehicle}: no odometry"
        error_m = math.sqrt(square_sum_m2 / count)
        rate = f"{count / elapsed_s:.0f} commands/s"
        return f"{self.vehicle}: {rate}, {100.0 * error_m:.1f} cm from its path (RMS)"

    def close(self) -> None:
        """Leave the topics, from any thread; `run` returns soon after."""
        self._closed.set()
        for end in (self._odometry, self._rotor_speeds, self._commands):
            if end is not None:
                end.close()

    def __enter__(self) -> PathController:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _connect(self, timeout_s: float) -> bool:
        """Wait until commands reach a simulator; False if they do not in time.

        A simulator repeats its state for who begins to send commands. They are offered when that state can be
        heard, or lockstep would begin with rotor speeds that nobody has told.
        """
        if self._commands is None:
            if not self._odometry.wait_for_publisher(timeout_s):
                return False
            self._rotor_speeds.wait_for_publisher(self._wait_s)
            mode = self._follower.mode
            self._commands = self._node.publisher(command_topic(self.vehicle, mode), COMMANDS[mode])
            if self._closed.is_set():  # since this began: `close` has not seen them
                self._commands.close()
        return self._commands.wait_for_subscribers(timeout_s=timeout_s)

    def _rotor_speed_of(self, odometry: Odometry) -> NDArray[np.float64]:
        """Return the rotor speeds with the sequence of odometry, which a link may have delayed."""
        deadline_s = time.monotonic() + (self._wait_s if self._misses < _MISSES_MAX else 0.0)
        with contextlib.suppress(TimeoutError):
            while odometry.sequence not in self._speeds:
                speeds = self._rotor_speeds.recv(max(deadline_s - time.monotonic(), 0.0))
                if speeds.sequence < max(self._speeds, default=0):  # a new run
                    self._speeds.clear()
                self._speeds[speeds.sequence] = self._newest = speeds.speed
            self._misses = 0
            speed = self._speeds[odometry.sequence]
            self._forget(odometry.sequence)
            return speed
        self._misses += 1
        self.missing_count += 1
        self._forget(odometry.sequence)
        self._warn(f"no rotor speeds came with the odometry of {odometry.stamp_ns} ns; using the newest")
        return self._newest

    def _forget(self, sequence: int) -> None:
        """Forget rotor speeds up to a sequence."""
        self._speeds = {number: speed for number, speed in self._speeds.items() if number > sequence}

    def _warn(self, text: str) -> None:
        """Log a warning, once a second at most."""
        now_s = time.monotonic()
        if now_s >= self._logged_s + 1.0:
            self._logged_s = now_s
            logger.warning("%s: %s", self.vehicle, text)


@dataclass(kw_only=True, eq=False)
class _Fleet:
    """The controllers of all vehicles, a thread for each. A context manager."""

    node: Node
    only: str | None
    """Vehicle that is flown; None: all."""
    mode: FollowMode
    delay_s: float
    _planned: SimulationConfig | None = None
    _paths: dict[str, Path] = field(default_factory=dict)
    _controllers: list[PathController] = field(default_factory=list)
    _threads: list[Future[None]] = field(default_factory=list)
    _stack: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    _updated_s: float = 0.0

    def plan(self, config: SimulationConfig) -> None:
        """Plan the paths, unless that was done."""
        if config == self._planned:
            return
        names = list(config.vehicles) if self.only is None else [self.only]
        if unknown := [name for name in names if name not in config.vehicles]:
            raise ValueError(f"unknown vehicle {unknown[0]!r}, known: {', '.join(config.vehicles)}")
        self._paths, self._planned = plan_paths(config, names), config

    def start(self, config: SimulationConfig, *, lockstep: bool) -> None:
        """Start the controllers, in place of those that run."""
        self.stop()
        self.plan(config)
        pool = self._stack.enter_context(ThreadPoolExecutor(len(self._paths), "controller"))
        for name, path in self._paths.items():
            vehicle = config.of(name)
            airframe = vehicle.vehicle.airframe()
            controller = PathController(
                self.node,
                name,
                PathFollower(
                    path, airframe, vehicle.control.gains, mode=self.mode, controller=vehicle.control
                ),
                lockstep=lockstep,
                rotor_speed=np.full(airframe.rotor_count, airframe.hover_rotor_speed_rad_s),
                delay_s=self.delay_s,
            )
            self._stack.callback(controller.close)  # before the pool waits for its threads
            self._controllers.append(controller)
            self._threads.append(pool.submit(controller.run))
        self._updated_s = time.monotonic()

    def stop(self) -> None:
        """End the controllers."""
        self._stack.close()
        self._controllers.clear()
        self._threads.clear()

    @property
    def vehicles(self) -> list[str]:
        """The vehicles that are flown."""
        return [controller.vehicle for controller in self._controllers]

    def describe(self) -> str:
        """Return how the controllers are doing since the last call; raise what one of them raised."""
        for thread in self._threads:
            if thread.done():
                thread.result()
        now_s = time.monotonic()
        elapsed_s, self._updated_s = now_s - self._updated_s, now_s
        return "; ".join(controller.describe(elapsed_s) for controller in self._controllers)

    def __enter__(self) -> _Fleet:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def fly(config: SimulationConfig | None, *, vehicle: str | None, mode: str, delay_s: float) -> int:
    """Fly the vehicles of a simulator along their paths, until it ends or this is interrupted.

    It waits for a simulator, and for the next one when that has gone. After a collision it waits for a reset.
    `config`: what is flown where; None: as the simulator says. `vehicle`: fly only this one; None: all.
    `mode`: what to command: motor_speeds, velocity or position. `delay_s`: how long to sleep before each
    command [s]. Returns 0 if the simulator has flown all that it was to fly, 130 if interrupted.

    Raises:
        ValueError: An argument is not allowed, there is no such vehicle, or no path.
    """
    if not 0.0 <= delay_s < math.inf:
        raise ValueError(f"delay_s must be >= 0, got {delay_s}")
    if mode not in get_args(FollowMode):
        raise ValueError(f"unknown mode {mode!r}, known: {', '.join(get_args(FollowMode))}")
    console, stop = Console(highlight=False), threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        if stop.is_set() or not fleet.vehicles:  # planning may take long, and libraries swallow exceptions
            leave_at_once(number, frame)
        stop.set()
        node.stop_waiting()

    with (
        Node("controller") as node,
        _Fleet(node=node, only=vehicle, mode=cast(FollowMode, mode), delay_s=delay_s) as fleet,
        console.status("") as line,
        handle_signals(on_signal),
    ):
        if config is not None:
            line.update("planning")
            fleet.plan(config)
        announcements = node.subscriber(SIMULATION, Simulation, policy=latest())
        statuses = node.subscriber(STATUS, SimulatorStatus, policy=latest())
        run_on, said, source = True, "", 0
        while not stop.is_set():
            found = _receive(announcements, 0.0 if fleet.vehicles else _LOOK_S)
            if found is not None and not (fleet.vehicles and found[1].source == source):
                simulation, source = found[0], found[1].source  # the same again: its settings have changed
                _receive(statuses, 0.0)  # of the simulator before
                announced = load_config(yaml.safe_load(simulation.config))
                run_on = announced.live.run_on
                line.update("planning")
                fleet.start(config or announced, lockstep=simulation.mode == "lockstep")
                said = (
                    f"flying {', '.join(fleet.vehicles)}: {fleet.mode}, {simulation.mode}, "
                    f"{simulation.control_rate_hz:g} Hz, of {_owner(node, source)}"
                )
                console.print(said)
                if config is not None and (difference := _difference(config, announced)):
                    text = f"the simulator has another scene, where the path may meet walls: {difference}"
                    console.print(text, style="yellow", markup=False, soft_wrap=True)
            heard = _receive(statuses, _LOOK_S) if fleet.vehicles else None
            line.update(fleet.describe())
            text = ""
            if heard is not None and heard[0].phase == "ended":
                if not run_on:
                    return 0
                text = f"the simulator has ended the flight ({heard[0].reason}); waiting for a reset"
            if announcements.publisher_count == 0:
                text = _WAITING
                line.update(_WAITING)
                fleet.stop()
            if text and text != said:
                console.print(text)
            if text or heard is not None:
                said = text
    print(INTERRUPTED_LINE, file=sys.stderr)
    return 130


def _owner(node: Node, source: int) -> str:
    """Say whose publisher it is."""
    for record in node.nodes():
        if any(publisher.source == source for publisher in record.publishers):
            return f"the {record.name} in process {record.pid}, domain {node.domain}"
    return f"a simulator in domain {node.domain}"


def _difference(config: SimulationConfig, announced: SimulationConfig) -> str:
    """Say how the scene of a configuration differs from that of a simulator; nothing if it does not."""
    here, there = (each.scene.model_dump(mode="json") for each in (config, announced))
    for scene in (here, there):
        if "file" in scene:  # each process may have its own folder, or its own machine
            scene["file"] = os.path.basename(scene["file"])
    keys = [key for key in here if here[key] != there.get(key)]
    if "kind" in keys:
        keys = ["kind"]
    return ", ".join(f"scene.{key} is {there[key]}, here {here[key]}" for key in keys)


def _receive(subscriber: Subscriber[T], timeout_s: float) -> tuple[T, Info] | None:
    """Return the next message and where it comes from; None if none comes in time."""
    try:
        return subscriber.recv_with_info(timeout_s)
    except TimeoutError:
        return None
