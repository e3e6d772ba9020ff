"""The command: options, what it prints, and that it ends when told to."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest
import yaml
from bridge_process import BridgeProcess
from bridge_rig import imu
from processes import ROOT, SOON_S, wait_for
from runtime_directory import own_directory
from test_routes import DRONE

from cortex import Node
from cortex import messages as msg
from cortex_ros2_bridge import cli
from cortex_ros2_bridge.config import load
from cortex_ros2_bridge.options import OPTIONS
from cortex_ros2_bridge.routes import known_options, look, make_routes

SETTINGS = {
    "namespace": "/sim",
    "rename": {"/drone/rgb": "/front"},
    "exclude": ["*/path"],
    "routes": [
        {"cortex": "/drone/events", "type": "event_camera_msgs/EventPacket", "options": {"encoding": "mono"}},
        {"cortex": "*", "type": "sensor_msgs/CompressedImage"},
        {"cortex": "/drone/imu", "qos": "sensor_data"},
    ],
}


@pytest.fixture(scope="module", autouse=True)
def one_registry():
    """All tests of this module share a runtime directory."""
    with pytest.MonkeyPatch.context() as monkeypatch, own_directory(monkeypatch):
        yield


@pytest.fixture
def simulator(monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    """A node that others see, with both its topics; the command looks for as long as it takes to find it."""
    monkeypatch.setattr(cli, "LIST_S", SOON_S)
    with Node("simulator") as node, Node("observer") as observer:
        node.publisher("/drone/imu", msg.Imu)
        node.subscriber("/drone/command/rates", msg.RateThrustCommand)
        wait_for(lambda: len(look(observer).topics) == 2)
        yield node


def test_printed_settings_make_the_same_routes():
    """Namespace, names, options, qualities and what is on request come back; so do routes of new topics."""
    config = load(SETTINGS)
    routes, problems = make_routes(DRONE, config)
    text = cli.to_yaml(config, routes)
    again, problems_again = make_routes(DRONE, load(yaml.safe_load(text)))
    for one, other in zip(routes, again, strict=True):
        assert dataclasses.replace(one, options={}) == dataclasses.replace(other, options={})
        defaults = {name: OPTIONS[name].default for name in known_options(one)}
        assert other.options == {**defaults, **one.options}
    assert problems == problems_again == []
    assert "!!" not in text


def test_printed_defaults_are_read_back(capsys, monkeypatch, tmp_path):
    """As `cortex-ros2-bridge --help` shows it: print, edit, use."""
    monkeypatch.setattr(cli, "LIST_S", 0.1)
    assert cli.main(["--print-config"]) == 0
    path = tmp_path / "bridge.yaml"
    path.write_text(capsys.readouterr().out)
    assert load(path) == load(None)


def test_list(simulator, capsys):
    """A line for each route: from where, to where, as what."""
    assert cli.main(["--list", "--namespace", "sim"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:4] for line in lines] == [
        ["/drone/command/rates", "<-", "/sim/drone/attitude_target", "mavros_msgs/msg/AttitudeTarget"],
        ["/drone/imu", "->", "/sim/drone/imu", "sensor_msgs/msg/Imu"],
    ]
    assert lines[1].endswith("reliable, volatile, depth 1000")


def test_print_config(simulator, capsys, tmp_path):
    path = tmp_path / "bridge.yaml"
    path.write_text(yaml.safe_dump(SETTINGS))
    assert cli.main(["--print-config", "--config", str(path), "--distro", "humble"]) == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed["distro"] == "humble"
    assert printed["routes"][1] == {
        "cortex": "/drone/imu",
        "type": "sensor_msgs/msg/Imu",
        "ros": "/drone/imu",
        "qos": {"reliability": "best_effort", "durability": "volatile", "depth": 5},
        "options": {
            "angular_velocity_std_rad_s": 0.0,
            "linear_acceleration_std_m_s2": 0.0,
            "queue": None,
        },
    }


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"routes": [{"cortex": "/dron/imu"}]}, "routes[0]: no Cortex topic fits /dron/imu"),
        ({"routes": [{"cortex": "/drone/imu", "type": "sensor_msgs/Imuu"}]}, "sensor_msgs/msg/Imuu"),
        ({"routes": [{"cortex": "/drone/imu", "options": {"encoding": "evt3"}}]}, "option 'encoding'"),
        ({"routes": [{"cortex": "/a", "options": {"encoding": "evt2"}}]}, "bridge.yaml: routes[0].options"),
        ({"frames": {"prefx": "x"}}, "bridge.yaml: frames: unknown key 'prefx'"),
    ],
)
def test_list_says_what_is_wrong_with_settings(settings, said, simulator, capsys, tmp_path):
    path = tmp_path / "bridge.yaml"
    path.write_text(yaml.safe_dump(settings))
    assert cli.main(["--list", "--config", str(path)]) == 1
    assert said in capsys.readouterr().err


def test_list_with_topics_that_may_have_no_routes(simulator, capsys, tmp_path):
    path = tmp_path / "bridge.yaml"
    path.write_text("include: ['/dron/*']")
    assert cli.main(["--list", "--config", str(path)]) == 0
    assert "none of 2 Cortex topics goes anywhere" in capsys.readouterr().out


def test_list_without_anything(capsys, monkeypatch):
    monkeypatch.setattr(cli, "LIST_S", 0.1)
    with own_directory(monkeypatch):
        assert cli.main(["--list"]) == 0
    assert "no Cortex topics" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--config", "nothing.yaml"], "cannot read nothing.yaml: No such file or directory"),
        (["--namespace", "a b"], "namespace must be a ROS name"),
        (["--domain", "-1"], "cortex_domain: Input should be greater than or equal to 0, got -1"),
        (["--cortex-domain", "-1"], "cortex_domain: Input should be greater than or equal to 0, got -1"),
        (["--backend", "carrier-pigeon"], "carrier-pigeon"),
        (["--distro", "hydro", "--backend", "dds"], "hydro"),
    ],
)
def test_wrong_use_is_one_line(arguments, text, capsys):
    assert cli.main(arguments) == 1
    error = capsys.readouterr().err
    assert text in error
    assert error.startswith("cortex-ros2-bridge: ")
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_within_a_second(number, dds_domain, simulator):
    """With streams open; it says what it does in lines for people."""
    with BridgeProcess("--verbose", "--backend", "dds", "--distro", "jazzy", "-v") as command:
        command.wait_for("/drone/imu -> /drone/imu (sensor_msgs/msg/Imu)")
        assert "/cortex_bridge: dds, jazzy" in command.said
        assert command.end(number) < 1.0 + BUSY_S
        assert "Traceback" not in command.said


BUSY_S = 20.0
"""What a busy machine may add."""


def test_a_service_that_does_not_answer_does_not_hold_it_up(dds_domain, simulator):
    """The bridge ends while a request is under way."""
    from cortex_ros2_bridge.backend.base import Qos
    from cortex_ros2_bridge.backend.dds import DdsBackend
    from cortex_ros2_bridge.cdr import encode
    from cortex_ros2_bridge.msgs import message_class

    begun, go_on = threading.Event(), threading.Event()

    def answer(_: msg.Reset) -> msg.SimulatorReply:
        begun.set()
        go_on.wait(SOON_S)
        return msg.SimulatorReply(True, "", 0, "running")

    simulator.service("/reset", msg.Reset, msg.SimulatorReply, answer)
    ros = DdsBackend(distro="jazzy", node_name="asker")
    try:
        with BridgeProcess("--verbose", "--backend", "dds", "--distro", "jazzy") as command:
            command.wait_for("/reset <- /reset ")
            publisher = ros.publisher("/reset", "std_msgs/msg/Empty", Qos())
            wait_for(lambda: publisher.subscriber_count)
            publisher.publish(encode(message_class("std_msgs/msg/Empty")()))
            assert begun.wait(SOON_S)
            assert command.end(signal.SIGINT) < 1.0 + BUSY_S
    finally:
        go_on.set()
        ros.close()


def test_a_bag_of_what_flew(simulator, tmp_path):
    """--backend run.mcap records without ROS, and is complete after Ctrl-C."""
    from rosbags.highlevel import AnyReader

    sent = simulator.publisher("/drone/gyro", msg.Imu)
    path = tmp_path / "run.mcap"
    with BridgeProcess("--verbose", "--backend", str(path)) as command:
        command.wait_for("/drone/gyro -> /drone/gyro")
        wait_for(lambda: sent.subscriber_count)
        for stamp_ns in range(1, 4):
            sent.publish(imu(stamp_ns))
        wait_for(lambda: taken_by_bridge(simulator, "/drone/gyro") == 3)
        command.end(signal.SIGINT)
    with AnyReader([tmp_path / "run"]) as reader:
        found = [c for c, _, _ in reader.messages() if c.topic == "/drone/gyro"]
    assert len(found) in (3, 4)  # the last may have come too late
    assert {c.msgtype for c in found} == {"sensor_msgs/msg/Imu"}


def taken_by_bridge(node: Node, topic: str) -> int:
    """Messages that the bridge has taken from a Cortex topic."""
    (bridge,) = [record.node for record in node.nodes() if record.name.startswith("cortex_bridge into ")]
    return sum(s.received for s in node.ask_stats(bridge, SOON_S).subscribers if s.topic == topic)


def test_the_module_and_the_command_are_one():
    process = subprocess.run(
        [sys.executable, "-m", "cortex_ros2_bridge", "--help"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=SOON_S,
        check=True,
    )
    assert "cortex-ros2-bridge --list" in process.stdout
