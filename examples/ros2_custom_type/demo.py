"""Send a battery to ROS 2 and one back, through DDS, without a ROS installation.

    python examples/ros2_custom_type/demo.py

The last line is `to ROS: 14.8 V; from ROS: 11.1 V`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
from battery import Battery

from cortex import Node
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Qos
from cortex_ros2_bridge.backend.choose import open_backend
from cortex_ros2_bridge.bridge import Bridge
from cortex_ros2_bridge.config import load
from cortex_ros2_bridge.msgs import BatteryState

STATE = "sensor_msgs/msg/BatteryState"
DEADLINE_S = 60.0


def main() -> None:
    """Run a bridge, a robot on Cortex and a node on ROS 2, and print what arrives."""
    robot, between, ros = Node("robot"), Node("bridge"), open_backend("dds", node_name="ros_side")
    backend = open_backend("dds")
    stop, arrived = threading.Event(), []
    with robot, between, Bridge(load(None), backend, between) as bridge:
        worker = threading.Thread(target=bridge.run, args=(stop,))
        worker.start()
        try:
            measured = robot.publisher("/drone/battery", Battery)
            wanted = robot.subscriber("/ground/battery", Battery)
            ros.subscription("/drone/battery_state", STATE, Qos(), arrived.append)
            command = ros.publisher("/ground/battery_state", STATE, Qos())
            battery = Battery(1_000_000_000, np.full(4, 3.7, np.float32), 5.0)
            state = BatteryState(cell_voltage=[3.7, 3.7, 3.7])
            until(lambda: measured.subscriber_count and measured.publish(battery) and arrived)
            until(lambda: command.subscriber_count)
            received: list[Battery] = []

            def ask() -> bool:
                command.publish(cdr.encode(state))
                try:
                    received.append(wanted.recv(0.1))
                except TimeoutError:
                    return False
                return True

            until(ask)
        finally:
            stop.set()
            worker.join()
            ros.close()
    backend.close()
    there = cdr.decode(arrived[0], STATE)
    print(f"to ROS: {there.voltage:.1f} V; from ROS: {received[0].cell_voltage.sum():.1f} V")


def until(condition: Callable[[], object]) -> None:
    """Wait for a condition; raise if it does not come true."""
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"it did not happen within {DEADLINE_S} s")
        time.sleep(0.02)


if __name__ == "__main__":
    main()
