"""What a simulator says of itself: whose readers hold it up, how late it publishes, which settings hold."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import logging
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from live_rig import IMU, LiveRig, before_looks, make_config
from processes import SOON_S
from rich.console import Console

from cortex import Node, reliable
from cortex.messages import (
    Image,
    Imu,
    MotorCommand,
    Reset,
    SensorStatus,
    Simulation,
    SimulatorStatus,
    VehicleStatus,
)
from neurosim_core.config import load_config
from neurosim_core.live.serve import StatusLine, serve
from neurosim_core.record import Recording

pytestmark = pytest.mark.usefixtures("shared_runtime")


RUNNING = SimulatorStatus(
    1_000_000_000, 0, "running", "", "streaming", 1.0, 0.02, 200, 1, 2, 3, 4, 0, 0,
    [SensorStatus("drone", "events", True, 1, 0, 0), SensorStatus("drone", "rgb", False, 0, 0, 0)],
    [VehicleStatus("drone", "velocity", 9, 0, 0, 0, 0, False, 0, 0, command_source="fly")],
)  # fmt: skip


def line_on(text: io.StringIO, *, is_over: bool = False) -> StatusLine:
    console = Console(file=text, force_terminal=True, width=200, no_color=True)
    return StatusLine(console, is_over=lambda: is_over)


def said(*statuses: SimulatorStatus, is_over: bool = False) -> list[str]:
    """What is printed besides the line itself, without colours."""
    text = io.StringIO()
    line = StatusLine(Console(file=text, width=200), is_over=lambda: is_over)
    for status in statuses:
        line.show(status)
    return text.getvalue().splitlines()


def change(status: SimulatorStatus, vehicle: dict[str, Any] | None = None, **changes: Any) -> SimulatorStatus:
    vehicles = [dataclasses.replace(status.vehicles[0], **(vehicle or {}))]
    return dataclasses.replace(status, vehicles=vehicles, **changes)


def test_each_node_that_commands_is_named():
    first = change(RUNNING, real_time_factor=1.0)
    other = change(first, {"command_source": "stranger"})
    lost = change(other, {"fail_safe": True, "fail_safe_count": 1})
    found = change(other, {"fail_safe_count": 1})
    assert said(first, first, other, first, other, lost, found) == [
        "drone: fly commands it",
        "drone: stranger commands it",
        "drone: no command has come in time; the fail-safe flies",
        "drone: commands arrive again (from stranger)",
    ]


@pytest.mark.parametrize(("is_over", "how"), [(False, "; `neurosim call reset` begins again"), (True, "")])
def test_the_end_says_how_to_begin_again(is_over: bool, how: str):
    ended = change(RUNNING, phase="ended", reason="drone collided at 2.748 s")
    assert said(RUNNING, ended, ended, is_over=is_over)[1:] == [f"ended: drone collided at 2.748 s{how}"]


def test_a_machine_is_called_slow_when_its_kernels_are_compiled():
    published = [dataclasses.replace(RUNNING.sensors[0], published_count=20)]
    compiling = [RUNNING] * 20
    slow = [change(RUNNING, sensors=published, real_time_factor=0.2)] * 20
    assert said(*compiling, *slow)[1:] == [
        "compiling what computes drone/events; it is kept for the next time",
        "this machine reaches 0.20 x real time, not 1: time is delayed (live.overrun: drop drops pictures "
        "instead); fewer, slower or smaller cameras help",
    ]
    fast = [change(RUNNING, sensors=published, real_time_factor=1.0)] * 20
    assert said(*compiling[:3], *fast)[1:] == []


def test_what_is_logged_goes_above_the_line(monkeypatch: pytest.MonkeyPatch):
    text, console = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", console)
    logger = logging.getLogger("neurosim_core.test")
    monkeypatch.setattr(logging.getLogger(), "handlers", [logging.StreamHandler()])
    with line_on(text):
        logger.warning("refused")
    logger.warning("later")
    assert "refused" in text.getvalue()
    assert console.getvalue() == "later\n"


def test_who_has_sent_the_commands_is_known_beside_others_that_could():
    """One of them has sent commands before there was a simulator."""

    def publisher_of(node: Node) -> Any:
        return node.publisher("/drone/command/motor_speeds", MotorCommand)

    with Node("veteran") as veteran, Node("pilot") as pilot:
        earlier, now = publisher_of(veteran), publisher_of(pilot)
        earlier.publish(MotorCommand(stamp_ns=0, speed=np.zeros(4)))
        with LiveRig(make_config(sensors={})) as rig:
            assert earlier.wait_for_subscribers(1, SOON_S)
            assert now.wait_for_subscribers(1, SOON_S)
            for count in (1, 2, 3):
                now.publish(MotorCommand(stamp_ns=0, speed=rig.hover()))
                status = rig.wait_for_status(lambda s, n=count: s.vehicles[0].command_count >= n)
    assert status.vehicles[0].command_source == "pilot"


def test_what_is_only_recorded_counts_as_published(tmp_path: Path):
    config = make_config(sensors={"imu": IMU}, **{"live.real_time_factor": 0.0, "live.run_on": False})
    with LiveRig(config, record=tmp_path) as rig:
        rig.send(rig.hover())
        status = rig.wait_for_status(lambda s: s.phase == "ended")
    assert (status.sensors[0].published_count, status.sensors[0].subscriber_count) == (401, 0)


def test_a_reader_that_is_too_slow_is_named_and_its_losses_are_counted():
    config = make_config(sensors={"imu": IMU}, **{"live.real_time_factor": 0.0})
    with LiveRig(config) as rig:
        policy = reliable(1, timeout_s=0.05)
        with rig.node.subscriber("/drone/imu", Imu, policy=policy) as reader:
            assert reader.wait_for_publisher(SOON_S)
            rig.send(rig.hover())
            status = rig.wait_for_status(lambda s: s.sensors[0].undelivered_count and s.reason)
    assert status.phase == "running"
    assert status.reason == "reliable readers do not keep up with /drone/imu"


def test_the_line_names_who_holds_it_up():
    with LiveRig(make_config(sensors={"imu": IMU})) as rig:
        rig.send(rig.hover())
        status = rig.wait_for_status(lambda s: s.phase == "running")
    vehicle = dataclasses.replace(status.vehicles[0], undelivered_count=7)
    reason = "reliable readers do not keep up with /drone/imu"
    status = dataclasses.replace(status, reason=reason, vehicles=[vehicle])
    text = io.StringIO()
    with line_on(text) as line:
        line.show(status)
    shown = " ".join(text.getvalue().split())
    assert "7 lost" in shown
    assert "reliable readers do not keep up with /drone/imu" in shown


def test_pictures_that_come_late_are_said_to(monkeypatch: pytest.MonkeyPatch):
    """A camera that takes 30 ms for each look is late by about that; the IMU beside it is not."""
    before_looks(monkeypatch, lambda *_: time.sleep(0.03))
    with LiveRig(make_config()) as rig:
        pictures = rig.listen("/drone/rgb", Image)
        rig.send(rig.hover())
        pictures.recv(SOON_S)
        status = rig.wait_for_status(lambda s: s.sensors[2].late_p99_ns > 0)
    assert status.sensors[2].name == "rgb"
    assert status.sensors[2].late_p99_ns > 10_000_000
    assert status.sensors[0].late_p99_ns == 0  # nobody listens


def test_changed_settings_are_announced_and_recorded(tmp_path: Path):
    """By the same publisher, for those who come later, too; the recording says what changed when."""
    with LiveRig(make_config(sensors={"imu": IMU}, **{"live.mode": "lockstep"}), record=tmp_path) as rig:
        told = rig.listen("/simulation", Simulation)
        first, before = told.recv_with_info(SOON_S)
        assert rig.set({"links.imu.clock_offset_s": 0.003}).accepted
        second, after = told.recv_with_info(SOON_S)
        late = rig.listen("/simulation", Simulation).recv(SOON_S)
        assert rig.call("/reset", Reset(seed=5)).accepted
        assert rig.set({"live.fail_safe": "cut"}).accepted
    assert before.source == after.source
    # Four rotors of the Hummingbird at 1500 rad/s with 5.57e-6 N s^2.
    assert first.thrust_max_n == pytest.approx([4 * 5.57e-6 * 1500.0**2])
    assert "imu" not in load_config(yaml.safe_load(first.config)).links
    for simulation in (second, late):
        assert load_config(yaml.safe_load(simulation.config)).links["imu"].clock_offset_s == 0.003
    with Recording(tmp_path / "flight.h5") as flight:
        held = load_config(yaml.safe_load(flight.header.config_yaml))
    assert (held.links["imu"].clock_offset_s, held.live.fail_safe, held.seed) == (0.003, "hover", 5)
    (line,) = (tmp_path / "settings.jsonl").read_text().splitlines()
    assert json.loads(line) == {
        "file": "flight.h5",
        "stamp_ns": 0,
        "key": "live.fail_safe",
        "value": "cut",
        "before": "hover",
    }


def test_serve_prints_what_it_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """From the plan to the totals; and no second simulator in its domain."""
    config = make_config(sensors={"imu": IMU}, **{"live.real_time_factor": 0.0, "live.run_on": False})
    codes: list[int] = []
    run = functools.partial(serve, config, record=tmp_path / "out")
    serving = threading.Thread(target=lambda: codes.append(run()), daemon=True)
    with Node("controller") as node:
        commands = node.publisher("/drone/command/motor_speeds", MotorCommand)
        serving.start()
        assert commands.wait_for_subscribers(1, 60.0)
        with pytest.raises(RuntimeError, match=f"a simulator runs in domain {node.domain} already"):
            serve(config)
        commands.publish(MotorCommand(stamp_ns=0, speed=np.full(4, 500.0)))
        serving.join(SOON_S)
    assert codes == [0]
    printed = " ".join(capsys.readouterr().out.split())
    assert "preparing: kernels" in printed
    assert "/drone/: imu, odometry, rotor_speeds" in printed
    assert "waiting for the first command on /drone/command/*: `neurosim fly` sends them" in printed
    assert printed.count("ended: the 1 s are over") == 1
    assert "streaming, 1.000 s, 200 control periods" in printed
    assert (tmp_path / "out" / "flight.h5").exists()
