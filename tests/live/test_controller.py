"""The path controller as a process of its own, against a simulator that the test plays itself."""

from __future__ import annotations

import contextlib
import itertools
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import SOON_S, wait_for
from rich.status import Status
from small_room import room_scene

from cortex import Node, reliable
from cortex.messages import Odometry, RotorSpeeds, Simulation, SimulatorStatus
from neurosim_core.config import load_config, to_yaml
from neurosim_core.control import PathFollower
from neurosim_core.live import controller
from neurosim_core.live.controller import PathController, fly
from neurosim_core.live.messages import setpoint_of
from neurosim_core.live.topics import COMMANDS, SIMULATION, STATUS, command_topic, stream_topic
from neurosim_core.sim import plan_paths
from neurosim_core.trajectory.shapes import FigureEightConfig, figure_eight
from neurosim_core.vehicle import preset

VEHICLE = preset("hummingbird")
PATH = figure_eight(FigureEightConfig(), center=np.zeros(3))
HOVER = np.full(4, VEHICLE.hover_rotor_speed_rad_s)
TICK_NS = 5_000_000
CONFIG: dict[str, Any] = {
    "device": "cpu",
    "scene": {"kind": "apartment", "rooms": 2},
    "path": {"kind": "hover"},
    "sensors": {},
}


def a_state(tick: int) -> dict[str, np.ndarray]:
    """Some state, another for each tick."""
    random = np.random.default_rng(tick)
    q = random.normal(size=4)
    return {
        "position": random.normal(size=3),
        "velocity": random.normal(size=3),
        "orientation": q / np.linalg.norm(q),
        "body_rate": random.normal(size=3),
        "rotor_speed": random.uniform(300.0, 900.0, size=4),
    }


class Stage:
    """What a vehicle sees of a simulator: it sends states, and hears commands."""

    def __init__(self, node: Node, vehicle: str = "drone", mode: str = "motor_speeds") -> None:
        self.odometry = node.publisher(stream_topic(vehicle, "odometry"), Odometry, latch=True)
        self.rotor_speeds = node.publisher(stream_topic(vehicle, "rotor_speeds"), RotorSpeeds, latch=True)
        self.commands = node.subscriber(command_topic(vehicle, mode), COMMANDS[mode], policy=reliable())
        self.mode = mode

    def send(self, tick: int, *, stamp_ns: int | None = None, rotors: bool = True) -> None:
        state = a_state(tick)
        stamp_ns = tick * TICK_NS if stamp_ns is None else stamp_ns
        speed = state.pop("rotor_speed")
        if rotors:
            self.rotor_speeds.publish(RotorSpeeds(stamp_ns=tick * TICK_NS, speed=speed, sequence=tick))
        self.odometry.publish(Odometry(stamp_ns=stamp_ns, sequence=tick, **state))

    def hear(self, timeout_s: float = SOON_S) -> tuple[int, bytes]:
        """Stamp and content of the next command."""
        command = self.commands.recv(timeout_s)
        return command.stamp_ns, setpoint_of(self.mode, command).tobytes()

    def silence(self) -> bool:
        """Whether no command has come."""
        with contextlib.suppress(TimeoutError):
            self.commands.recv(0.0)
            return False
        return True


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rotor speeds that are on their way come, however busy the machine."""
    monkeypatch.setitem(controller._ROTORS_S, "lockstep", SOON_S)


@pytest.fixture
def stage(shared_runtime) -> Iterator[Stage]:
    with Node("simulator") as node:
        yield Stage(node)


@pytest.fixture
def start_pilot(shared_runtime) -> Iterator[Callable[..., PathController]]:
    """Starts pilots in threads, and ends them."""
    with contextlib.ExitStack() as stack:
        node = stack.enter_context(Node("controller"))

        def start(vehicle: str = "drone", *, mode: Any = "motor_speeds", **options: Any) -> PathController:
            follower = PathFollower(PATH, VEHICLE, mode=mode)
            pilot = PathController(
                node, vehicle, follower, **{"lockstep": True, "rotor_speed": HOVER, **options}
            )
            thread = threading.Thread(target=pilot.run)
            thread.start()
            stack.callback(thread.join, SOON_S)
            stack.callback(pilot.close)
            return pilot

        yield start


def expected(tick: int, mode: Any = "motor_speeds", **changes: Any) -> tuple[int, bytes]:
    state = {"stamp_ns": tick * TICK_NS, **a_state(tick), **changes}
    return state["stamp_ns"], PathFollower(PATH, VEHICLE, mode=mode).command(**state).tobytes()


@pytest.mark.parametrize("mode", ["motor_speeds", "velocity", "position"])
def test_every_odometry_is_answered(shared_runtime, start_pilot, mode):
    """All at once, and in their order, with the bits of the same follower in-process."""
    with Node("simulator") as node:
        stage = Stage(node, mode=mode)
        pilot = start_pilot(mode=mode)
        stage.odometry.wait_for_subscribers(timeout_s=SOON_S)
        stage.rotor_speeds.wait_for_subscribers(timeout_s=SOON_S)
        for tick in range(40):
            stage.send(tick)
        assert [stage.hear() for _ in range(40)] == [expected(tick, mode) for tick in range(40)]
        assert pilot.missing_count == 0
        wait_for(lambda: pilot.command_count == 40)
        squares = [
            np.sum((a_state(t)["position"] - PATH.evaluate([t * TICK_NS]).position[0]) ** 2)
            for t in range(40)
        ]
        assert pilot.error_square_sum_m2 == pytest.approx(np.sum(squares), rel=1e-12)


def test_who_comes_late_answers_what_was_said_last(stage, start_pilot):
    stage.send(7)
    start_pilot()
    assert stage.hear() == expected(7)


def test_who_is_asked_twice_answers_twice_the_same(stage, start_pilot):
    """As a simulator asks again while it waits for a command, and somebody new has come."""
    pilot = start_pilot()
    stage.odometry.wait_for_subscribers(timeout_s=SOON_S)
    stage.rotor_speeds.wait_for_subscribers(timeout_s=SOON_S)
    for tick in (0, 0, 1):
        stage.send(tick)
    assert [stage.hear() for _ in range(3)] == [expected(tick) for tick in (0, 0, 1)]
    assert pilot.missing_count == 0


def test_a_reset_is_answered_like_the_rest(stage, start_pilot):
    """Stamps and sequence begin again, also with rotor speeds of before still on their way."""
    start_pilot()
    stage.odometry.wait_for_subscribers(timeout_s=SOON_S)
    stage.rotor_speeds.wait_for_subscribers(timeout_s=SOON_S)
    for tick in (0, 1, 2):
        stage.send(tick)
    speed = a_state(3)["rotor_speed"]
    stage.rotor_speeds.publish(RotorSpeeds(stamp_ns=3 * TICK_NS, speed=speed, sequence=3))
    for tick in (0, 1, 2, 3):
        stage.send(tick)
    assert [stage.hear() for _ in range(7)] == [expected(tick) for tick in (0, 1, 2, 0, 1, 2, 3)]


def test_the_path_is_taken_at_the_odometrys_stamp(stage, start_pilot):
    """Whatever its clock shows; rotor speeds belong to it by their sequence."""
    pilot = start_pilot()
    stage.send(2, stamp_ns=123_456_789)
    assert stage.hear() == expected(2, stamp_ns=123_456_789)
    assert pilot.missing_count == 0


def test_missing_rotor_speeds_are_said_and_replaced(stage, start_pilot, caplog, monkeypatch):
    """By hover before any have come, else by the newest; after some misses nobody waits for them any more."""
    monkeypatch.setitem(controller._ROTORS_S, "streaming", 0.3)
    begin_s = time.monotonic()
    pilot = start_pilot(lockstep=False)
    stage.send(1, rotors=False)
    assert stage.hear() == expected(1, rotor_speed=HOVER)
    stage.rotor_speeds.wait_for_subscribers(timeout_s=SOON_S)
    stage.send(2)
    assert stage.hear() == expected(2)
    for tick in range(3, 100):
        stage.send(tick, rotors=False)
        assert stage.hear() == expected(tick, rotor_speed=a_state(2)["rotor_speed"])
    wait_for(lambda: pilot.missing_count == 98)
    assert time.monotonic() - begin_s < 98 * 0.3  # it waits 5 + 1 times, then no more
    said = [record.getMessage() for record in caplog.records]
    assert said[0].startswith("drone: no rotor speeds came with the odometry of 5000000 ns")
    assert len(said) < 50  # once a second at most

    def found_again() -> bool:
        stage.send(30)
        return stage.hear() == expected(30)

    wait_for(found_again)


def test_in_streaming_the_newest_counts(stage, start_pilot, monkeypatch):
    """A pilot that is slow answers what is new when it looks again."""
    monkeypatch.setitem(controller._ROTORS_S, "streaming", SOON_S)
    start_pilot(lockstep=False, delay_s=0.3)
    stage.odometry.wait_for_subscribers(timeout_s=SOON_S)
    stage.rotor_speeds.wait_for_subscribers(timeout_s=SOON_S)
    ticks = itertools.count()

    def answers() -> int:
        """How many answers there are to five states that come while it sleeps, unless this thread does."""
        sent = list(itertools.islice(ticks, 5))
        for tick in sent:
            stage.send(tick)
        count = 1
        while stage.hear() != expected(sent[-1]):
            count += 1
        return count

    wait_for(lambda: answers() <= 2)
    assert stage.silence()


def test_a_pilot_ends_while_it_sleeps(stage, start_pilot):
    pilot = start_pilot(delay_s=1e4)
    stage.send(0)
    wait_for(lambda: stage.rotor_speeds.subscriber_count)
    pilot.close()  # the fixture joins its thread


def test_vehicles_do_not_wait_for_each_other(shared_runtime, start_pilot):
    with Node("simulator") as node:
        red, blue = Stage(node, "red"), Stage(node, "blue")
        start_pilot("red")
        start_pilot("blue")
        blue.send(1)
        assert blue.hear() == expected(1)
        red.send(2)
        assert red.hear() == expected(2)
        assert blue.silence()


# The command


class Simulator:
    """Announces itself, and says how it is doing."""

    def __init__(self, node: Node, config: dict[str, Any], *, mode: str = "lockstep") -> None:
        self.config = load_config(config)
        self.simulation = node.publisher(SIMULATION, Simulation, latch=True)
        self.status = node.publisher(STATUS, SimulatorStatus)
        self.stages = {name: Stage(node, name) for name in self.config.vehicles}
        self.mode = mode
        self.announce()

    def announce(self) -> None:
        self.simulation.publish(
            Simulation(
                config=to_yaml(self.config),
                version="0",
                vehicles=list(self.config.vehicles),
                mode=self.mode,
                control_rate_hz=200.0,
            )
        )

    def say(self, phase: str, reason: str = "") -> None:
        self.status.publish(
            SimulatorStatus(
                stamp_ns=0,
                wall_ns=0,
                phase=phase,
                reason=reason,
                mode="lockstep",
                real_time_factor_wanted=0.0,
                real_time_factor=0.0,
                step_count=0,
                step_median_ns=0,
                step_p99_ns=0,
                late_median_ns=0,
                late_p99_ns=0,
                overrun_count=0,
                slipped_ns=0,
                sensors=[],
                vehicles=[],
            )
        )


class Fly:
    """`neurosim fly` as a process."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self._log = log
        with log.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-W", "error", "-m", "neurosim_core", "fly", *arguments],
                stdout=file,
                stderr=subprocess.STDOUT,
            )

    @property
    def said(self) -> str:
        return self._log.read_text()

    def wait_until_said(self, text: str, count: int = 1) -> None:
        wait_for(lambda: self.said.count(text) >= count or self.process.poll() is not None, 60.0)
        assert self.said.count(text) >= count, self.said

    def end(self) -> None:
        self.process.kill()
        self.process.wait(SOON_S)


@pytest.fixture
def start_fly(shared_runtime, tmp_path) -> Iterator[Callable[..., Fly]]:
    """Starts `neurosim fly`, and ends it."""
    with contextlib.ExitStack() as stack:

        def start(*arguments: str) -> Fly:
            fly = Fly(tmp_path / "said.txt", *arguments)
            stack.callback(fly.end)
            return fly

        yield start


@pytest.fixture(scope="module")
def paths() -> dict[str, Any]:
    return plan_paths(load_config(CONFIG))


def test_fly_serves_one_simulator_after_the_other(start_fly, paths):
    """It waits for the first, for a reset of it, for a second that begins anew, and ends with that."""
    process = start_fly()
    process.wait_until_said("waiting for a simulator (neurosim serve)")
    follower = PathFollower(paths["drone"], VEHICLE)
    for run_on, count in ((True, 1), (False, 2)):
        with Node("simulator") as node:
            simulator = Simulator(node, {**CONFIG, "live": {"mode": "lockstep", "run_on": run_on}})
            for tick in range(3):
                simulator.stages["drone"].send(tick)
                command = follower.command(stamp_ns=tick * TICK_NS, **a_state(tick))
                assert simulator.stages["drone"].hear(60.0) == (tick * TICK_NS, command.tobytes())
            process.wait_until_said("flying drone: motor_speeds, lockstep, 200 Hz", count)
            if run_on:
                simulator.announce()  # settings were changed; pilots fly on
            simulator.say("ended", "it has hit a wall")
            if run_on:
                process.wait_until_said("it has hit a wall")
                simulator.say("ended", "it has hit the floor")  # the announcement is looked at before this
                process.wait_until_said("it has hit the floor")
                assert process.said.count("flying drone") == count
                assert "another scene" not in process.said
                assert process.process.poll() is None
        if run_on:
            process.wait_until_said("waiting for a simulator", 2)
    assert process.process.wait(SOON_S) == 0


def test_fly_takes_the_vehicles_that_it_is_told(start_fly, tmp_path):
    """With settings of its own, in the mode that it is told, and SIGTERM ends it at once.

    That the simulator has another scene is said; it may have the same in another folder.
    """
    settings = tmp_path / "scene.yaml"
    config = {**CONFIG, "scene": room_scene(tmp_path), "vehicles": {"red": {}, "blue": {}}}
    settings.write_text(to_yaml(load_config(config)))
    process = start_fly(str(settings), "--vehicle", "blue", "--mode", "position")
    with Node("simulator") as node:
        stage = Stage(node, "blue", "position")
        simulator = Simulator(
            node, {**config, "scene": {**config["scene"], "file": "room.ply", "unit_m": 2.0}}
        )
        stage.send(0)
        start = plan_paths(load_config(config))["blue"].evaluate([0])
        assert stage.hear(60.0) == (0, np.array([*start.position[0], start.yaw[0]]).tobytes())
        assert simulator.stages["red"].odometry.subscriber_count == 0
        process.wait_until_said(
            "another scene, where the path may meet walls: scene.unit_m is 2.0, here None\n"
        )
        process.process.send_signal(signal.SIGTERM)
        assert process.process.wait(SOON_S) == 130
    assert "interrupted" in process.said


def test_a_signal_ends_fly_though_what_it_interrupts_swallows_exceptions(shared_runtime, monkeypatch, capsys):
    """As imports, and libraries in C, may do."""
    with Node("simulator") as node:
        simulator = Simulator(node, CONFIG)

        def update(self: Status, text: str) -> None:
            if text.startswith("drone: "):
                with contextlib.suppress(BaseException):
                    signal.raise_signal(signal.SIGTERM)
                simulator.say("ended")

        monkeypatch.setattr(Status, "update", update)
        assert fly(None, vehicle=None, mode="position", delay_s=0.0) == 130
    assert "interrupted" in capsys.readouterr().err


def test_wrong_use_is_refused(shared_runtime):
    for arguments, text in (
        ({"mode": "rates"}, "unknown mode 'rates', known: motor_speeds, velocity, position"),
        ({"delay_s": -1.0}, "delay_s must be >= 0, got -1.0"),
        ({"vehicle": "plane"}, "unknown vehicle 'plane', known: drone"),
    ):
        options: dict[str, Any] = {"vehicle": None, "mode": "position", "delay_s": 0.0, **arguments}
        with pytest.raises(ValueError, match=text):
            fly(load_config(CONFIG), **options)
