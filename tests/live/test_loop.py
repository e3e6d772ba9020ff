"""A flight over Cortex in lockstep is, to the last byte, the flight of the same controller in one process."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from processes import SOON_S, wait_for
from scipy.spatial.transform import Rotation

from cortex import Closed, Node, reliable
from cortex.messages import Events, Imu, MotorCommand, Odometry, Reset, RotorSpeeds, SimulatorReply
from neurosim_core.config import load_config, to_yaml
from neurosim_core.control import PathFollower
from neurosim_core.live import controller
from neurosim_core.live.controller import PathController
from neurosim_core.live.messages import command_of, to_packet
from neurosim_core.live.simulator import Simulator
from neurosim_core.live.topics import COMMANDS, command_topic, stream_topic
from neurosim_core.packets import Packet
from neurosim_core.sim import (
    Model,
    finish,
    make_fleet,
    make_model,
    make_state,
    observe,
    run_model,
    step,
)

STARTED_S = 60.0
"""Deadline for a process that loads a scene, on a machine that does a lot besides."""
TICK_NS = 5_000_000
TICKS = 60
SETTINGS: dict[str, Any] = {
    "duration_s": TICKS * TICK_NS * 1e-9,
    "device": "cpu",
    "seed": 11,
    "scene": {"kind": "apartment", "rooms": 2},
    "bodies": {
        "ball": {
            "shape": {"kind": "sphere", "radius_m": 0.1},
            "surface": {"kind": "checker"},
            "motion": {"position_m": [-0.6, 0.0, 1.4], "orbit": {"rate_hz": 3.0}, "spin_rad_s": [0, 0, 9]},
        }
    },
    "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
    "vehicle": {"on_collision": "report"},
    "path": {"kind": "circle", "ramp_s": 0.3, "speed_max_m_s": 3.0},
    "control": {"rate_hz": 200},
    "sensors": {
        "events": {
            "kind": "event_camera",
            "lens": {"width": 64, "height": 48, "horizontal_fov_rad": 1.5},
            "sampling_rate_hz": 500,
            "packet_rate_hz": 100,
        },
        "imu": {"kind": "imu", "rate_hz": 333, "gyroscope_noise_density": 1e-3},  # force: without noise
        "odometry": {"kind": "odometry", "rate_hz": 200},
    },
    "live": {"mode": "lockstep", "run_on": False, "command_deadline_s": 20.0},
}
BLUE = {
    "path": {"kind": "lissajous", "ramp_s": 0.3, "speed_max_m_s": 3.0},
    "control": {"rate_hz": 200, "gains": {"position_gain_per_s2": 8.0}},
}
"""What differs in the second one of a fleet."""
STREAMS = {"events": Events, "imu": Imu, "odometry": Odometry}
Law = Callable[[Any], np.ndarray]
"""A controller: from odometry (a packet or a message) to a setpoint."""


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rotor speeds that are on their way come, however busy the machine: without them the bits differ."""
    monkeypatch.setitem(controller._ROTORS_S, "lockstep", SOON_S)


@pytest.fixture(scope="module")
def model() -> Model:
    """Ask for it before `shared_runtime`, which checks that no threads are left: the renderer keeps some."""
    return make_model(load_config(SETTINGS))


@pytest.fixture(scope="module")
def rough() -> Model:
    """Gusty air over a ground that is never touched, and a noisy camera that leaves out ticks."""
    return make_model(
        load_config(
            SETTINGS,
            overrides={
                "vehicle.integrator": "dormand_prince",
                "vehicle.parameters": {
                    "turbulence": {"wind_20ft_m_s": 15.4},
                    "gusts": [{"velocity_m_s": [1.0, 0.5, 0.0], "start_s": 0.05, "rise_s": 0.1}],
                    "ground": {"height_m": 0.0, "rotor_radius_m": 0.1},
                },
                "sensors.events.pixel": {"preset": "v2e_noisy", "refractory_s": 1e-3},
                "sensors.events.sampling_rate_hz": 2000,
                "sensors.events.max_displacement_px": 0.5,
            },
        )
    )


def changed(model: Model, **overrides: Any) -> Model:
    """The same world under other settings."""
    return dataclasses.replace(model, config=load_config(SETTINGS, overrides=overrides))


def content(packets: Sequence[Packet]) -> list[tuple[Any, ...]]:
    """All bytes of the packets, sensor by sensor."""

    def plain(value: Any) -> Any:
        return (value.dtype.str, value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value

    rows = [(p.sensor, p.sequence, *((k, plain(v)) for k, v in sorted(vars(p).items()))) for p in packets]
    return sorted(rows, key=lambda row: row[:2])


class Listener:
    """Hears every message of a vehicle."""

    def __init__(self, node: Node, vehicle: str = "drone", streams: Sequence[str] = tuple(STREAMS)) -> None:
        self._again: dict[str, list[Packet]] = {}
        self._before: dict[str, int] = {}
        self._speeds = node.subscriber(
            stream_topic(vehicle, "rotor_speeds"), RotorSpeeds, policy=reliable(4096)
        )
        self._streams = {
            name: node.subscriber(stream_topic(vehicle, name), STREAMS[name], policy=reliable(4096))
            for name in streams
        }
        for subscriber in (self._speeds, *self._streams.values()):
            assert subscriber.wait_for_publisher(STARTED_S)

    def packets(self, expected: Sequence[Packet]) -> list[Packet]:
        """As many packets of each sensor as are expected; fails if there are more."""
        counts = Counter(packet.sensor for packet in expected)
        heard = [
            packet for name in self._streams for packet in itertools.islice(self._heard(name), counts[name])
        ]
        for subscriber in self._streams.values():
            with pytest.raises(TimeoutError):
                subscriber.recv(0.05)
        return heard

    def packets_after_reset(self, expected: Sequence[Packet]) -> list[Packet]:
        """As `packets`, from the second beginning of each stream."""
        for name in self._streams:
            first = next(p for p in expected if p.sensor == name)
            begins = (p for p in self._heard(name) if p.sequence == 0)
            assert next(begins).stamp_ns == first.stamp_ns
            self._again[name] = [next(begins)]
        return self.packets(expected)

    def _heard(self, name: str) -> Iterator[Packet]:
        """Packets as they came, but odometry once: it is said again to controllers that come late."""
        yield from self._again.pop(name, [])
        while True:
            message = self._streams[name].recv(SOON_S)
            speed = self._speeds.recv(SOON_S).speed if name == "odometry" else ()
            if message.sequence != self._before.get(name):
                self._before[name] = message.sequence
                packet = to_packet(message, name)
                if name == "odometry":
                    packet = dataclasses.replace(packet, rotor_speed=np.asarray(speed))
                yield packet


@contextlib.contextmanager
def serving(*models: Model) -> Iterator[Callable[[], int]]:
    """A simulator in a thread; gives a function that waits for the end of its run, and returns its result."""
    stop, results = threading.Event(), []
    fleet = {next(iter(model.config.vehicles)): model for model in models}
    members = {name: {} for name in fleet}
    config = load_config(models[0].config.model_dump(mode="json"), overrides={"vehicles": members})
    with Simulator(config, models=fleet) as simulator:
        thread = threading.Thread(target=lambda: results.append(simulator.run(stop)))
        thread.start()

        def result() -> int:
            thread.join(60.0)
            assert not thread.is_alive()
            return results[0]

        try:
            yield result
        finally:
            stop.set()
            thread.join(SOON_S)


@contextlib.contextmanager
def commanding(node: Node, law: Law, mode: str) -> Iterator[None]:
    """A controller that is 15 lines of Cortex, in a thread."""
    commands = node.publisher(command_topic("drone", mode), COMMANDS[mode])
    odometry = node.subscriber(stream_topic("drone", "odometry"), Odometry, policy=reliable())

    def run() -> None:
        with contextlib.suppress(Closed):
            for message in odometry:
                commands.publish(command_of(mode, law(message), stamp_ns=message.stamp_ns))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        odometry.close()
        thread.join(SOON_S)


def flown_inside(
    model: Model, law: Law, mode: Any, *, seen_after: int = 0, acts_after: int = 0
) -> list[Packet]:
    """Packets of the same loop in one process.

    Args:
        model: What to fly.
        law: What flies it.
        mode: What it commands.
        seen_after: Control periods from a state to when the controller sees it.
        acts_after: Control periods from there to when its command takes over.
    """
    state = make_state(model)
    packets: list[Packet] = []
    states, commands = [observe(state)], {}
    for tick in range(TICKS):
        if tick == 0 or tick >= seen_after + 1:
            commands[tick + acts_after] = law(states[0 if tick == 0 else tick - seen_after])
        holds = [row for due, row in commands.items() if due <= tick]
        if holds:
            packets += step(model, state, holds[-1], mode=mode)
        else:
            packets += step(model, state, None)
        states.append(observe(state))
    return packets + finish(state)


def test_two_processes_fly_as_one(model, shared_runtime, tmp_path):
    """`neurosim serve` and `neurosim fly`, with the settings from the simulator, against `run`."""
    settings = tmp_path / "scene.yaml"
    settings.write_text(to_yaml(model.config))
    expected = list(run_model(model, make_state(model)))
    assert sum(len(p.t) for p in expected if p.sensor == "events") > 1000
    with contextlib.ExitStack() as stack:
        node = stack.enter_context(Node("listener"))
        processes = []
        for words in (["serve", str(settings)], ["fly"]):
            log = stack.enter_context((tmp_path / f"{words[0]}.txt").open("w"))
            process = subprocess.Popen(
                [sys.executable, "-W", "error", "-m", "neurosim_core", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
            )
            stack.callback(process.wait, SOON_S)
            stack.callback(process.kill)
            processes.append(process)
            if words[0] == "serve":
                listener = Listener(node)
        assert content(listener.packets(expected)) == content(expected)
        said = [path.read_text() for path in sorted(tmp_path.glob("*.txt"))]
        assert [process.wait(SOON_S) for process in processes] == [0, 0], said


def test_rough_air_and_a_noisy_camera_fly_as_in_one_process(rough, shared_runtime):
    """Turbulence, gusts, ground, adaptive steps, an adaptive camera and every noise of a preset."""
    state = make_state(rough)
    expected = list(run_model(rough, state))
    assert {"gusts", "turbulence", "ground"} <= set(state.vehicle.terms)
    noisy = state.groups[0].frames["events"].terms
    assert noisy == ("spread", "lin_log", "low_pass", "refractory", "leak", "spontaneous")
    assert state.counts["ticks left out"] > 100
    assert sum(len(p.t) for p in expected if p.sensor == "events") > 1000
    with serving(rough) as result, Node("controller") as node:
        listener = Listener(node)
        with piloting(node, rough):
            assert result() == 0
        assert content(listener.packets(expected)) == content(expected)


@contextlib.contextmanager
def piloting(
    node: Node, model: Model, vehicle: str = "drone", *, nap: Callable[[], float] = lambda: 0.0
) -> Iterator[PathController]:
    """A pilot in a thread, which sleeps before it looks."""
    follower = PathFollower(model.path, model.airframe, model.config.control.gains)
    hover = np.full(4, model.airframe.hover_rotor_speed_rad_s)
    done = threading.Event()
    with PathController(node, vehicle, follower, lockstep=True, rotor_speed=hover) as pilot:

        def run() -> None:
            while not done.wait(nap()):
                pilot.answer(0.1)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield pilot
        finally:
            done.set()
            thread.join(SOON_S)


def test_when_commands_come_does_not_matter(model, shared_runtime):
    """A controller that is late now and then, by up to 10 ms of wall-clock time, flies the same flight."""
    expected = list(run_model(model, make_state(model)))
    random = np.random.default_rng(0)
    with serving(model) as result, Node("controller") as node:
        listener = Listener(node)
        with piloting(node, model, nap=lambda: random.choice([0.0, 0.0, 0.0, 0.002, 0.01])) as pilot:
            assert result() == 0
        assert pilot.command_count >= TICKS
        assert content(listener.packets(expected)) == content(expected)


def test_after_a_reset_it_is_the_first_flight(model, shared_runtime):
    """In the middle of a flight, with an answer to the flight before outstanding."""
    expected = list(run_model(model, make_state(model)))
    with serving(model) as result, Node("controller") as node:
        listener = Listener(node)
        late = node.publisher(command_topic("drone", "motor_speeds"), MotorCommand)
        assert late.wait_for_subscribers(timeout_s=SOON_S)
        with piloting(node, model) as pilot:
            wait_for(lambda: pilot.command_count > 20)
        assert node.client("/reset", Reset, SimulatorReply).call(Reset(), SOON_S).accepted
        late.publish(MotorCommand(stamp_ns=19 * TICK_NS, speed=np.zeros(4)))
        with piloting(node, model):
            assert result() == 0
        assert content(listener.packets_after_reset(expected)) == content(expected)


def test_each_of_a_fleet_flies_as_alone(model, shared_runtime):
    """Two on paths of their own, with two controllers of which one is slow."""
    blind = {"sensors": {name: s for name, s in SETTINGS["sensors"].items() if name != "events"}}
    config = load_config(SETTINGS | blind, overrides={"vehicles": {"red": {}, "blue": BLUE}})
    fleet = make_fleet(config)
    expected = {name: list(run_model(member, make_state(member))) for name, member in fleet.items()}
    assert content(expected["red"]) != content(expected["blue"])
    with serving(*fleet.values()) as result, Node("controller") as node:
        listeners = {name: Listener(node, name, ["imu", "odometry"]) for name in fleet}
        with piloting(node, fleet["red"], "red"), piloting(node, fleet["blue"], "blue", nap=lambda: 0.003):
            assert result() == 0
        for name, listener in listeners.items():
            assert content(listener.packets(expected[name])) == content(expected[name])


def law_of(mode: str, model: Model) -> Law:
    """Some controller of each mode; it reads the whole state."""
    weight = model.airframe.mass_kg * model.airframe.gravity_m_s2

    def command(odometry: Any) -> np.ndarray:
        seconds = 1e-9 * odometry.stamp_ns
        push = np.array([np.sin(20.0 * seconds), np.cos(13.0 * seconds), 0.3])
        if mode == "position":
            return np.array([*(odometry.position + 0.3 * push), 0.5 * seconds])
        if mode == "velocity":
            return np.array([*(push - 0.1 * odometry.velocity), 0.4])
        thrust = weight * (1.0 + 0.1 * push[0])
        if mode == "rates":
            return np.array([thrust, *(push - 0.2 * odometry.body_rate)])
        tilt = Rotation.from_rotvec(0.2 * push) * Rotation.from_quat(odometry.orientation).inv()
        return np.array([thrust, *(Rotation.from_rotvec(0.1 * tilt.as_rotvec())).as_quat()])

    return command


@pytest.mark.parametrize("mode", ["rates", "attitude", "velocity", "position"])
def test_every_mode_flies_as_in_one_process(model, shared_runtime, mode):
    law = law_of(mode, model)
    expected = flown_inside(model, law, mode)
    with serving(model) as result, Node("controller") as node:
        listener = Listener(node)
        with commanding(node, law, mode):
            assert result() == 0
        assert content(listener.packets(expected)) == content(expected)


@pytest.mark.parametrize(
    ("links", "seen_after", "acts_after"),
    [
        ({"command": {"latency_s": 0.008}}, 0, 2),
        ({"command": {"latency_s": 0.005}}, 0, 1),
        ({"odometry": {"latency_s": 0.008}}, 2, 0),
        ({"odometry": {"latency_s": 0.012}, "command": {"latency_s": 0.001}}, 3, 1),
    ],
)
def test_a_latency_delays_the_flight_exactly(model, shared_runtime, links, seen_after, acts_after):
    """8 ms at 5 ms a tick: what is sent at tick k takes over at tick k + 2, in one process as well."""
    delayed = changed(model, links=links)
    law = law_of("velocity", model)
    expected = flown_inside(model, law, "velocity", seen_after=seen_after, acts_after=acts_after)
    with serving(delayed) as result, Node("controller") as node:
        listener = Listener(node)
        with commanding(node, law, "velocity"):
            assert result() == 0
        held_back = seen_after if "odometry" in links else 0
        arrived = [
            packet
            for packet in expected
            if packet.sensor != "odometry" or packet.stamp_ns <= (TICKS - held_back) * TICK_NS
        ]
        assert content(listener.packets(arrived)) == content(arrived)


def test_chance_is_in_the_seed(model, shared_runtime):
    """Links that delay and lose at random give the same flight again, and another one for another seed."""
    links = {
        "command": {"jitter_s": 0.02, "loss": 0.2},
        "odometry": {"latency_s": 0.002, "jitter_s": 0.01, "loss": 0.2},
    }

    def flight(seed: int) -> list[tuple[int, bytes]]:
        delayed = changed(model, links=links, seed=seed)
        with serving(delayed) as result, Node("controller") as node:
            imu = node.subscriber(stream_topic("drone", "imu"), Imu, policy=reliable(4096))
            assert imu.wait_for_publisher(SOON_S)
            with commanding(node, law_of("velocity", model), "velocity"):
                assert result() == 0
            samples = [imu.recv(SOON_S) for _ in range(100)]
            return [(sample.stamp_ns, sample.specific_force.tobytes()) for sample in samples]

    first = flight(1)
    assert flight(1) == first
    assert flight(2) != first
