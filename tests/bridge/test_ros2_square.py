"""The square of the tutorial, through the conversions of the bridge, in the apartment that `serve` makes."""

from __future__ import annotations

import importlib.util
import sys
import types
from typing import Any

import numpy as np
import pytest
from processes import ROOT

import neurosim_core as ns
from cortex.messages import Odometry
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.convert import RULES, Context
from cortex_ros2_bridge.msgs import message_class
from neurosim_core.sim import observe

STATES, COMMANDS = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped"
LIMIT_NS = 15_000_000_000


class Node:
    """As much of rclpy's node as the example uses."""

    def __init__(self, name: str) -> None:
        self.sent: list[Any] = []

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        assert topic == "/drone/command_velocity"
        return types.SimpleNamespace(publish=self.sent.append)

    def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
        assert topic == "/drone/odometry"


@pytest.fixture
def square(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The example, with stand-ins for what a sourced ROS has."""
    modules = {
        "rclpy": {},
        "rclpy.executors": {"ExternalShutdownException": RuntimeError},
        "rclpy.node": {"Node": Node},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"TwistStamped": message_class(COMMANDS)},
        "nav_msgs": {},
        "nav_msgs.msg": {"Odometry": message_class(STATES)},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("square", ROOT / "examples" / "ros2_tour" / "square.py")
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    return example


def convert(kind: str, direction: str) -> Any:
    return next(rule.convert for rule in RULES if (rule.ros_type, rule.direction) == (kind, direction))


def test_the_square_is_flown_and_touches_no_wall(square: Any) -> None:
    model = ns.make_model(ns.load_config({"device": "cpu", "sensors": {"imu": {"kind": "imu"}}}))
    state = ns.make_state(model)
    node = square.Square()
    context, to_ros, from_ros = Context(vehicle="drone"), convert(STATES, "out"), convert(COMMANDS, "in")
    path = []
    while not node.ended and not state.ended and state.stamp_ns < LIMIT_NS:
        now = observe(state)
        path.append(now.position)
        message = Odometry(state.stamp_ns, now.position, now.orientation, now.velocity, now.body_rate)
        node.answer(cdr.decode(to_ros(message, context), STATES))
        command = from_ros(cdr.encode(node.sent[-1]), context)
        assert command.stamp_ns == state.stamp_ns
        ns.step(model, state, ns.Velocity(velocity_m_s=command.velocity.tolist(), yaw_rate_rad_s=0.0))
    assert not state.ended
    assert node.ended
    assert node.reached_count == 4
    assert np.ptp(path, axis=0)[:2] == pytest.approx([0.5, 0.5], abs=0.1)  # corners are cut by 0.05 m
    assert float(np.ptp(path, axis=0)[2]) < 0.05
