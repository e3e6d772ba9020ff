"""Simulators and listeners come and go, again and again: nothing is left behind, and nothing goes deaf.

NEUROSIM_CYCLES=1000 makes it long; where rclpy imports, the real executor is in it, too.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib.util
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from bridge_rig import imu
from processes import wait_for

from cortex import Node
from cortex import messages as msg
from cortex_ros2_bridge import bridge as bridge_module
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Qos
from cortex_ros2_bridge.backend.choose import open_backend
from cortex_ros2_bridge.bridge import Bridge
from cortex_ros2_bridge.config import load
from cortex_ros2_bridge.msgs import message_class

CYCLES = int(os.environ.get("NEUROSIM_CYCLES", "12"))
WARM = 4
"""After so many cycles, whatever is made once has been made."""
TWIST = "geometry_msgs/msg/TwistStamped"


@pytest.fixture(params=["dds", "rclpy"])
def kind(request: pytest.FixtureRequest, runtime: Any, dds_domain: int) -> Iterator[str]:
    if importlib.util.find_spec("cyclonedds" if request.param == "dds" else "rclpy") is None:
        pytest.skip(f"{request.param} is not installed")
    return request.param


def left_over() -> tuple[int, int]:
    """Return how many threads and open files this process has, without what waits for the collector."""
    gc.collect()
    return threading.active_count(), len(os.listdir("/proc/self/fd"))


def _is_within(threads: int, files: int) -> bool:
    now = left_over()
    return now[0] <= threads and now[1] <= files


def _cycle(number: int, foreign: Any, until: Callable[[Callable[[], Any]], None]) -> None:
    """A new simulator and a new listener: one measurement goes out, one command comes in."""
    heard: list[bytes] = []
    with Node("simulator") as simulator:
        measured = simulator.publisher("/drone/imu", msg.Imu)
        commands = simulator.subscriber("/drone/command/velocity", msg.VelocityCommand)
        listener = foreign.subscription("/drone/imu", "sensor_msgs/msg/Imu", Qos(), heard.append)
        stamped = foreign.publisher("/drone/command_velocity", TWIST, Qos(depth=1))
        until(lambda: measured.subscriber_count and stamped.subscriber_count)
        until(lambda: measured.publish(imu(number)) and heard)
        assert cdr.decode(heard[-1], "sensor_msgs/msg/Imu").header.stamp.nanosec == number
        twist = message_class(TWIST)()
        twist.header.frame_id, twist.twist.linear.x = "map", float(1 + number % 50)

        def flies() -> bool:
            stamped.publish(bytes(cdr.encode(twist)))
            with contextlib.suppress(TimeoutError):
                return commands.recv(0.02).velocity[0] == twist.twist.linear.x
            return False

        until(flies)
        for part in (listener, stamped):
            part.close()


def test_cycles_leave_nothing_behind(kind: str, dds_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each time a new simulator, a new listener, one measurement out and one command in; then both go."""
    monkeypatch.setattr(bridge_module, "GONE_S", 0.05)
    threads = files = 0
    foreign = open_backend(kind, node_name="foreign", domain=dds_domain)
    backend = open_backend(kind, node_name="cortex_bridge", domain=dds_domain)
    with Node("bridge") as node, Bridge(load(None), backend, node) as bridge:

        def until(condition: Any) -> None:
            wait_for(lambda: bridge.update() or condition())

        for number in range(1, CYCLES + 1):
            _cycle(number, foreign, until)
            until(lambda: not bridge.routes())
            if number <= WARM:
                now = left_over()
                threads, files = max(threads, now[0]), max(files, now[1])
            else:  # what ends a moment later has its time
                wait_for(functools.partial(_is_within, threads, files), every_s=0.05)
    backend.close()
    foreign.close()
    assert not [t for t in threading.enumerate() if t.name.startswith(("ros ", "executor "))]
