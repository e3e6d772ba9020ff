"""Processes of the live stack: each is killed and started again, and the others go on; Ctrl-C ends all."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from line_process import LineProcess
from live_rig import drain
from processes import ROOT, processes_with, wait_for

from cortex import Node, latest, reliable
from cortex.messages import Clock, Image, MotorCommand, SimulatorStatus
from neurosim_core.live.topics import STATUS, command_topic
from neurosim_core.record import Recording

START_S = 180.0
"""Deadline of a start, which imports much, on a machine that does a lot besides."""
END_S = 30.0
"""Deadline of an end; two seconds are promised, on a machine that does nothing besides."""
SETTINGS = """
scene: {kind: mesh, file: room.obj, up_axis: z, unit_m: 1.0}
path: {kind: hover}
device: cpu
control: {rate_hz: 50}
sensors: {imu: {kind: imu, rate_hz: 50}}
"""


def neurosim(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "neurosim_core", *map(str, arguments)]


def make_settings(folder: Path, *, mode: str = "streaming") -> Path:
    """A hover in an empty room of 6 x 6 x 3 m, which is loaded at once."""
    room = trimesh.creation.box((6.0, 6.0, 3.0))
    room.invert()
    room.export(folder / "room.obj")
    settings = folder / "room.yaml"
    settings.write_text(f"{SETTINGS}live: {{mode: {mode}}}\n")
    return settings


class Stack:
    """Simulator, controller and viewer as a user starts them in three shells, and a node that looks on."""

    def __init__(self, settings: Path) -> None:
        self.settings = settings
        self.running: dict[str, LineProcess] = {}
        self.node = Node("onlooker")
        self.statuses = self.node.subscriber(STATUS, SimulatorStatus, policy=latest())
        self.picture = settings
        self._start_count = 0

    def start(self, name: str) -> None:
        """Start one."""
        self._start_count += 1
        if name == "viewer":
            self.picture = self.settings.with_name(f"live{self._start_count}.rrd")
        command = {
            "simulator": neurosim("serve", self.settings),
            "controller": neurosim("fly", self.settings),
            "viewer": neurosim("view", "--save", self.picture),
        }
        self.running[name] = LineProcess(command[name])

    def hear(self, name: str, words: str) -> None:
        """Wait until one says something."""
        self.running[name].read_until(words, within_s=START_S)

    def kill(self, name: str) -> None:
        with self.running.pop(name) as process:
            process.kill()

    def wait_for_status(self, condition: Callable[[SimulatorStatus], object]) -> SimulatorStatus:
        """The first status from now on that fits."""
        found: list[SimulatorStatus] = []

        def look() -> bool:
            with contextlib.suppress(TimeoutError):
                status = self.statuses.recv(0.5)
                if condition(status):
                    found.append(status)
            return bool(found)

        wait_for(look, START_S)
        return found[0]

    def wait_for_flight(self) -> None:
        """Wait until commands come in, half a second of them from now on."""
        begin = self.wait_for_status(lambda s: s.phase == "running" and not s.vehicles[0].fail_safe)
        self.wait_for_status(
            lambda s: (
                s.vehicles[0].command_count >= begin.vehicles[0].command_count + 25
                and not s.vehicles[0].fail_safe
            )
        )

    def close(self) -> None:
        self.node.close()
        for process in self.running.values():
            process.kill()
            process.output.close()


@pytest.fixture(scope="module")
def stack(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """The processes of a mode, a viewer in streaming only; at the end nothing of them may be left."""
    directory = Path(tempfile.mkdtemp(prefix="ctx-", dir="/tmp"))
    files = set(os.listdir("/dev/shm"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CORTEX_RUNTIME_DIR", str(directory))
        patch.delenv("CORTEX_DOMAIN", raising=False)
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.setenv("PYTHONUNBUFFERED", "1")
        stack = Stack(make_settings(tmp_path_factory.mktemp("room"), mode=request.param))
        try:
            waiting = ("controller", "viewer") if request.param == "streaming" else ("controller",)
            for name in waiting:
                stack.start(name)
            for name in waiting:
                stack.hear(name, "waiting for a simulator")
            stack.start("simulator")
            for name in waiting:
                stack.hear(name, SAYS[name])
            stack.wait_for_flight()
            yield stack
            for running in stack.running.values():
                running.interrupt()
            for name, running in stack.running.items():
                running.rest()
                assert running.process.returncode == 130, name
            assert stack.picture.stat().st_size > 0
        finally:
            stack.close()
            left = {process: command_line(process) for process in processes_with(str(directory))}
            for process in left:  # the registry, which would wait for two seconds
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            shutil.rmtree(directory, ignore_errors=True)
    assert all(b"cortex.discovery" in command for command in left.values())
    shared = {name for name in os.listdir("/dev/shm") if "cortex" in name or "ctx" in name}  # ours, if any
    assert not shared - files


SAYS = {"controller": "flying drone", "viewer": "showing drone"}
"""What one says that has met the simulator."""


@pytest.mark.parametrize("stack", ["streaming"], indirect=True)
@pytest.mark.parametrize("names", [("simulator",), ("viewer", "controller")], ids="-".join)
def test_the_others_go_on_without_those_that_are_killed_and_meet_them_again(stack, names):
    """Killed together with SIGKILL, and started again in this order; the others stay the same processes."""
    for name in names:
        stack.kill(name)
    others = {name: process.process for name, process in stack.running.items()}
    if "simulator" in names:
        for name in others:
            stack.hear(name, "the simulator is gone" if name == "viewer" else "waiting for a simulator")
    else:
        before = stack.wait_for_status(lambda s: s.vehicles[0].fail_safe)
        stack.wait_for_status(lambda s: s.step_count >= before.step_count + 25)
    for name in names:
        stack.start(name)
    for name, words in SAYS.items():
        if name in names or "simulator" in names:
            stack.hear(name, words)
    stack.wait_for_flight()
    assert all(process.poll() is None for process in others.values())
    assert len(stack.running) == 3


@pytest.mark.parametrize("stack", ["lockstep"], indirect=True)
def test_in_lockstep_time_stands_still_until_a_controller_that_was_killed_is_back(stack):
    """A simulator that comes back is in the test before, and in lockstep in test_controller.py."""
    simulator = stack.running["simulator"].process
    stack.kill("controller")
    waiting = stack.wait_for_status(lambda s: s.phase == "waiting")
    assert "command" in waiting.reason
    stack.start("controller")
    stack.hear("controller", "flying drone")
    stack.wait_for_flight()
    assert simulator.poll() is None


def test_ctrl_c_ends_all_that_one_command_started(runtime, tmp_path, monkeypatch):
    """With the recording closed, the picture written, and nothing left; `runtime` looks for the rest."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    picture, record = tmp_path / "live.rrd", tmp_path / "flight"
    command = neurosim("up", make_settings(tmp_path), "--viewer", picture, "--record", record)
    with LineProcess(command) as up:
        up.read_until("controller: flying drone", "viewer: showing drone", within_s=START_S)
        with Node("onlooker") as node:
            status = node.subscriber(STATUS, SimulatorStatus, policy=latest())
            wait_for(lambda: status.recv(START_S).vehicles[0].command_count > 25, START_S)
        begin_s = time.monotonic()
        up.interrupt()
        lines = up.rest()
        ended_s = time.monotonic() - begin_s
    print(f"all had ended {ended_s:.2f} s after Ctrl-C")
    assert up.process.returncode == 130
    assert ended_s < END_S
    assert not [line for line in lines if "Traceback" in line]
    with Recording(record / "flight.h5") as flight:
        assert flight.clean
        assert flight.packet_count("imu") > 25
    assert picture.stat().st_size > 0
    assert not list(tmp_path.glob("neurosim-*"))
    assert not [pid for pid in processes_with(str(runtime)) if b"neurosim_core" in command_line(pid)]


def test_ctrl_c_waits_for_no_reader_that_has_stopped_reading(runtime, tmp_path, monkeypatch):
    """A reliable one may hold up the simulator for ten minutes, but not its end."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    record = tmp_path / "flight"
    lens = "{width: 160, height: 120, horizontal_fov_rad: 1.5}"
    options = ["renderer=synthetic", "vehicle.on_collision=report"]
    options += [f"sensors.rgb={{kind: rgb, rate_hz: 50, lens: {lens}}}"]
    settings = [part for text in options for part in ("--set", text)]
    command = neurosim("serve", make_settings(tmp_path), *settings, "--record", record)
    with LineProcess(command) as serve, Node("onlooker") as node:
        pictures = node.subscriber("/drone/rgb", Image, policy=reliable(1, timeout_s=600.0))
        clock = node.subscriber("/clock", Clock, policy=reliable(4096))
        commands = node.publisher(command_topic("drone", "motor_speeds"), MotorCommand)
        assert commands.wait_for_subscribers(1, START_S)
        assert pictures.wait_for_publisher(START_S)

        def time_passes() -> bool:
            commands.publish(MotorCommand(stamp_ns=0, speed=np.zeros(4)))
            return bool(drain(clock, 0.1))

        wait_for(time_passes, START_S)
        full_s = time.monotonic() + 2.0  # by then the reader has no room left
        while time.monotonic() < full_s:
            with contextlib.suppress(TimeoutError):
                clock.recv(0.1)
        begin_s = time.monotonic()
        serve.interrupt()
        lines = serve.rest()
        print(f"ended {time.monotonic() - begin_s:.2f} s after Ctrl-C")
    assert serve.process.returncode == 130
    assert not [line for line in lines if "Traceback" in line]
    with Recording(record / "flight.h5") as flight:
        assert flight.clean
        assert flight.packet_count("rgb") > 0


def command_line(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""
