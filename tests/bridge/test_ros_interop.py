"""The bridge and real nodes of ROS 2 (rclpy), in processes of their own, through DDS and through rclpy.

Humble, Jazzy, Lyrical and those between. The tests run where rclpy imports in this Python, or where
NEUROSIM_ROS_PYTHON names one in which it does, with what the bridge needs (numpy, pyyaml, pyzmq, rosbags):

    source /opt/ros/humble/setup.bash      # sets ROS_DISTRO
    pip install numpy pyyaml pyzmq rosbags
    NEUROSIM_ROS_PYTHON=python3 .venv/bin/python -m pytest tests/bridge/test_ros_interop.py

cyclonedds has no wheels for Python 3.14 (Lyrical): the tests through DDS skip where it is not installed.
"""

from __future__ import annotations

import importlib.util
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridge_process import BridgeProcess
from bridge_rig import imu, odometry
from processes import ROOT, SOON_S, Child, Lines, wait_for
from runtime_directory import own_directory

from cortex import Node
from cortex import messages as msg
from cortex_ros2_bridge.simulation import SERVED
from cortex_ros2_bridge.typestore import DEFAULT_DISTRO, DISTROS

INSTALL = "no rclpy: source a ROS installation, or name a Python that has it in NEUROSIM_ROS_PYTHON"
ROS_PYTHON = os.environ.get("NEUROSIM_ROS_PYTHON") or (
    sys.executable if importlib.util.find_spec("rclpy") is not None else ""
)
ROS_PATH = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
"""Where that Python finds Neurosim, and rclpy: the setup file of a ROS installation sets PYTHONPATH."""
pytestmark = pytest.mark.skipif(not ROS_PYTHON, reason=INSTALL)
DISTRO = os.environ.get("ROS_DISTRO") or DEFAULT_DISTRO
THIS_HOST = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOCALHOST_ONLY": "1"}
"""How nodes are told to keep to this host, by the variable that their distribution reads."""


class RosNode(Child):
    """A process of `ros_peer.py`: what it can do is there."""

    hello: Any = "it says none"

    def __init__(self) -> None:
        process = subprocess.Popen(
            [ROS_PYTHON, str(Path(__file__).with_name("ros_peer.py"))],
            env={**os.environ, "PYTHONPATH": ROS_PATH},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
        )
        Lines.__init__(self, process, "ros_peer")

    def do(self, what: str, **arguments: Any) -> Any:
        """Let it do something, and return what came of it."""
        return self.ask(do=what, **arguments)["answer"]


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A domain on this host, found as ROS does: no settings of Cyclone DDS, which Fast DDS does not know."""
    for name in (*THIS_HOST, "ROS_STATIC_PEERS", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    variable = DISTROS[DISTRO].range_variable
    monkeypatch.setenv(variable, THIS_HOST[variable])
    monkeypatch.setenv("ROS_DISTRO", DISTRO)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.randrange(1, 102)))
    with own_directory(monkeypatch):
        yield


@pytest.fixture
def ros_node(ros_domain: None) -> Iterator[RosNode]:
    node = RosNode()
    yield node
    node.end()


def skip_services_of_others(bridge: BridgeProcess) -> None:
    if bridge.backend == "dds" and os.environ.get("RMW_IMPLEMENTATION") != "rmw_cyclonedds_cpp":
        pytest.skip("services through DDS need RMW_IMPLEMENTATION=rmw_cyclonedds_cpp")


@pytest.fixture(params=["dds", "rclpy"])
def bridge(request: pytest.FixtureRequest, ros_domain: None) -> Iterator[BridgeProcess]:
    """A bridge through DDS, in this Python without ROS; or through rclpy."""
    if request.param == "dds" and importlib.util.find_spec("cyclonedds") is None:
        pytest.skip("cyclonedds is not installed")
    python, path = (sys.executable, str(ROOT)) if request.param == "dds" else (ROS_PYTHON, ROS_PATH)
    with BridgeProcess("--verbose", "--backend", request.param, python=python, path=path) as process:
        process.wait_for("waiting for Cortex topics")
        process.backend = request.param
        yield process


def test_a_node_of_ros_hears_sees_and_commands(bridge: BridgeProcess, ros_node: RosNode) -> None:
    """It starts after the bridge, on this host only: measurements, the graph, types, and commands back."""
    with Node("simulator") as simulator:
        measured = simulator.publisher("/drone/imu", msg.Imu)
        state = simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        commands = simulator.subscriber("/drone/command/velocity", msg.VelocityCommand)
        bridge.wait_for("/drone/imu -> /drone/imu")
        ros_node.do("subscribe", topic="/drone/imu", type_name="sensor_msgs/msg/Imu", reliable=False)
        ros_node.do("control", state="/drone/odometry", command="/drone/command_velocity")
        wait_for(lambda: measured.subscriber_count and state.subscriber_count)
        wait_for(lambda: measured.publish(imu(7_000_000_005)) and ros_node.do("heard", topic="/drone/imu")[0])
        assert ros_node.do("heard", topic="/drone/imu")[1:] == [7_000_000_005, "drone/imu"]
        assert commands.wait_for_publisher(SOON_S)
        for number in range(1, 51):
            stamp_ns = 8_000_000_000 + number

            def command(stamp_ns: int = stamp_ns) -> Any:
                state.publish(odometry(stamp_ns))
                got = commands.recv(SOON_S)
                return got is not None and got.stamp_ns == stamp_ns and got

            assert wait_for(command).velocity.tolist() == [2.0, 0.0, 0.0]
        assert "cortex_bridge" in ros_node.do("nodes")
        (publisher,) = ros_node.do("publishers", topic="/drone/imu")
        assert publisher == [
            "cortex_bridge",
            "sensor_msgs/msg/Imu",
            ros_node.do("own_hash", type_name="sensor_msgs/msg/Imu"),
        ]
    assert bridge.end(signal.SIGINT) < 5.0
    ros_node.process.kill()  # what it has said is complete then
    assert ros_node.process.stderr is not None
    assert "type hash" not in ros_node.process.stderr.read().decode()


def test_who_comes_late_gets_what_is_latched_and_no_other(bridge: BridgeProcess, ros_node: RosNode) -> None:
    """Also by quality of service: who wants a stream latched does not get it, and is told so."""
    with Node("simulator") as simulator:
        path = simulator.publisher("/drone/path", msg.Path, latch=True)
        path.publish(msg.Path(3_000_000_001, np.array([1, 2]), np.zeros((2, 3))))
        measured = simulator.publisher("/drone/imu", msg.Imu)
        bridge.wait_for("/drone/path -> /drone/path")
        ros_node.do("subscribe", topic="/drone/path", type_name="nav_msgs/msg/Path", latched=True)
        ros_node.do("subscribe", topic="/drone/imu", type_name="sensor_msgs/msg/Imu", latched=True)
        wait_for(lambda: ros_node.do("heard", topic="/drone/path")[0])
        assert ros_node.do("heard", topic="/drone/path")[1:] == [3_000_000_001, "map"]
        measured.publish(imu(5))
        assert measured.subscriber_count == 0
        assert ros_node.do("heard", topic="/drone/imu")[0] == 0


def test_a_wrong_type_is_said_with_the_right_topic(bridge: BridgeProcess, ros_node: RosNode) -> None:
    with Node("simulator") as simulator:
        simulator.publisher("/drone/imu", msg.Imu)
        bridge.wait_for("/drone/imu -> /drone/imu")
        ros_node.do("subscribe", topic="/drone/imu", type_name="sensor_msgs/msg/Image")
        bridge.wait_for("/drone/imu: a node subscribes to it as sensor_msgs/msg/Image")


@pytest.mark.parametrize("bridge", ["rclpy"], indirect=True)
def test_services_of_a_real_node(bridge: BridgeProcess, ros_node: RosNode) -> None:
    """Not through DDS: services of Fast DDS and of Cyclone DDS do not know each other."""
    with Node("simulator") as simulator:
        asked = []

        def pause(request: msg.Trigger) -> msg.SimulatorReply:
            asked.append(request)
            return msg.SimulatorReply(len(asked) == 1, "" if len(asked) == 1 else "again", 0, "paused")

        simulator.service("/pause", msg.Trigger, msg.SimulatorReply, pause)
        assert ros_node.do("call", name="/pause") == [True, ""]
        assert ros_node.do("call", name="/pause") == [False, "again"]
        (listed,) = ros_node.do(
            "call", name="/cortex_bridge/list_parameters", type_name="rcl_interfaces/srv/ListParameters"
        )
        assert "'frames.map'" in listed


def test_simulation_interfaces_of_a_real_node(bridge: BridgeProcess, ros_node: RosNode) -> None:
    """Through DDS where the other nodes are on Cyclone DDS too; the package has to be installed."""
    package = "simulation_interfaces"
    if not ros_node.do("has", package=package):
        pytest.skip(f"the ROS package {package} is not installed")
    skip_services_of_others(bridge)
    asked = []

    def answer(request: Any) -> msg.SimulatorReply:
        asked.append(request)
        return msg.SimulatorReply(True, "", 0, "paused")

    with Node("simulator") as simulator:
        for name, kind in SERVED.items():
            simulator.service(name, kind, msg.SimulatorReply, answer)
        (features,) = ros_node.do(
            "call", name="/get_simulator_features", type_name=f"{package}/srv/GetSimulatorFeatures"
        )
        assert "bodies of the settings are spawned" in features
        (result,) = ros_node.do(
            "call", name="/step_simulation", type_name=f"{package}/srv/StepSimulation", steps=7
        )
        assert "result=1" in result
        assert asked == [msg.Step(7)]


def test_a_real_node_manages_the_bridge(bridge: BridgeProcess, ros_node: RosNode) -> None:
    """Down to unconfigured and up again; its graph of transitions is that of a managed node of rclpy."""
    skip_services_of_others(bridge)
    with Node("simulator") as simulator:
        measured = simulator.publisher("/drone/imu", msg.Imu)
        ros_node.do("subscribe", topic="/drone/imu", type_name="sensor_msgs/msg/Imu")
        wait_for(lambda: measured.subscriber_count)
        down = ros_node.do("manage", node="/cortex_bridge", labels=["deactivate", "activate", "deactivate"])
        assert [done for done, _ in down] == [True] * 3
        assert "label='inactive'" in down[-1][1]
        wait_for(lambda: not measured.subscriber_count)
        up = ros_node.do(
            "manage", node="/cortex_bridge", labels=["cleanup", "activate", "configure", "activate"]
        )
        assert [done for done, _ in up] == [True, False, True, True]
        wait_for(lambda: measured.subscriber_count)
        wait_for(lambda: measured.publish(imu(5)) and ros_node.do("heard", topic="/drone/imu")[0])
        ours, theirs = (ros_node.do("transitions", node=name) for name in ("/cortex_bridge", ""))
        assert len(ours) == 25
        assert ours == theirs
