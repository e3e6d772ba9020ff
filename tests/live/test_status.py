"""What a simulator says of itself: whose readers hold it up, how late it publishes, which settings hold."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from live_rig import IMU, LiveRig, make_config
from processes import SOON_S
from rich.console import Console

from cortex import Node, reliable
from cortex.messages import Image, Imu, MotorCommand, Reset, Simulation
from neurosim_core.config import load_config
from neurosim_core.live.engine import VehicleEngine
from neurosim_core.live.serve import StatusLine, serve
from neurosim_core.record import Recording

pytestmark = pytest.mark.usefixtures("shared_runtime")


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
    with StatusLine(Console(file=text, force_terminal=True, width=200)) as line:
        line.show(status)
        shown = str(line._line.status)
    assert "7 lost" in shown
    assert "reliable readers do not keep up with /drone/imu" in shown


def test_pictures_that_come_late_are_said_to(monkeypatch: pytest.MonkeyPatch):
    """A camera that takes 30 ms for each look is late by about that; the IMU beside it is not."""
    render = VehicleEngine.render

    def slow(*arguments: Any) -> Any:
        packets = render(*arguments)
        threading.Event().wait(0.03)
        return packets

    monkeypatch.setattr(VehicleEngine, "render", slow)
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
    assert "/drone/: imu, odometry, rotor_speeds" in printed
    assert "waiting for the first command on /drone/command/*: `neurosim fly` sends them" in printed
    assert "ended: the 1 s are over" in printed
    assert "streaming, 1.000 s, 200 control periods" in printed
    assert (tmp_path / "out" / "flight.h5").exists()
