"""A process with a real node of ROS 2: it knows nothing of the bridge.

It reads lines of JSON, such as {"do": "heard", "topic": "/x"}, and answers each with {"answer": ...}.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import json
import re
import sys
import threading
import time
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

SOON_S = 60.0


def _class(type_name: str) -> Any:
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


class Peer:
    """What the process has, and can do."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("foreign_node")
        self.received: dict[str, list[Any]] = {}
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        threading.Thread(target=self._spin, daemon=True).start()

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self.executor.spin()

    def subscribe(self, topic: str, type_name: str, reliable: bool = True, latched: bool = False) -> None:
        """Keep what comes on a topic."""
        received = self.received.setdefault(topic, [])
        qos = QoSProfile(
            depth=100,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self.node.create_subscription(_class(type_name), topic, received.append, qos)

    def heard(self, topic: str) -> Any:
        """Return how many messages came on a topic, and the stamp and frame of the last one."""
        received = self.received[topic]
        if not received:
            return [0, None, None]
        header = received[-1].header
        return [len(received), header.stamp.sec * 10**9 + header.stamp.nanosec, header.frame_id]

    def control(self, state: str, command: str) -> None:
        """Answer each odometry with a velocity of the same stamp."""
        kind = _class("geometry_msgs/msg/TwistStamped")
        publisher = self.node.create_publisher(kind, command, 10)

        def answer(odometry: Any) -> None:
            message = kind()
            message.header.stamp = odometry.header.stamp
            message.header.frame_id = "map"
            message.twist.linear.x = odometry.pose.pose.position.x + 1.0
            publisher.publish(message)

        self.node.create_subscription(_class("nav_msgs/msg/Odometry"), state, answer, 10)

    def nodes(self) -> list[str]:
        """Return the names of the nodes that ROS knows."""
        return sorted(self.node.get_node_names())

    def publishers(self, topic: str) -> list[Any]:
        """Return who publishes on a topic: node, type, and hash of the type."""
        return [
            [info.node_name, info.topic_type, str(getattr(info, "topic_type_hash", None))]
            for info in self.node.get_publishers_info_by_topic(topic)
        ]

    def own_hash(self, type_name: str) -> str:
        """Return the hash of a type as ROS itself has it."""
        publisher = self.node.create_publisher(_class(type_name), "/own", 1)
        deadline = time.monotonic() + SOON_S
        while not (found := self.node.get_publishers_info_by_topic("/own")) and time.monotonic() < deadline:
            time.sleep(0.01)
        self.node.destroy_publisher(publisher)
        return str(getattr(found[0], "topic_type_hash", None))  # Humble has none

    def has(self, package: str) -> bool:
        """Return whether a ROS package is installed."""
        return importlib.util.find_spec(package) is not None

    def manage(self, node: str, labels: list[str]) -> list[Any]:
        """Ask a managed node for transitions; return for each whether it was done, and the state then."""
        kind = _class("lifecycle_msgs/msg/Transition")
        answers = []
        for label in labels:
            (done,) = self.call(
                f"{node}/change_state", "lifecycle_msgs/srv/ChangeState", transition=kind(label=label)
            )
            (state,) = self.call(f"{node}/get_state", "lifecycle_msgs/srv/GetState")
            answers.append([done, state])
        return answers

    def transitions(self, node: str = "") -> Any:
        """Return the transition graph of a managed node; by default of one of rclpy that is made here."""
        service, kind = "get_transition_graph", "lifecycle_msgs/srv/GetAvailableTransitions"
        if not node:
            from rclpy.lifecycle import LifecycleNode

            if not hasattr(self, "managed"):
                self.managed = LifecycleNode("managed_of_rclpy")
                self.executor.add_node(self.managed)
            node = "/managed_of_rclpy"
        (found,) = self.call(f"{node}/{service}", kind)
        return sorted(re.findall(r"TransitionDescription\(.*?goal_state=.*?\)\)", found))

    def call(self, name: str, type_name: str = "std_srvs/srv/Trigger", **fields: Any) -> Any:
        """Call a service; return the fields of its response, as text where nested."""
        kind = _class(type_name)
        client = self.node.create_client(kind, name)
        if not client.wait_for_service(SOON_S):
            return None
        future = client.call_async(kind.Request(**fields))
        deadline = time.monotonic() + SOON_S
        while not future.done() and time.monotonic() < deadline:
            time.sleep(0.01)
        if not future.done():
            return None
        values = [getattr(future.result(), field) for field in future.result().get_fields_and_field_types()]
        return [value if isinstance(value, bool | int | str) else str(value) for value in values]


def main() -> None:
    """Answer line after line."""
    peer = Peer()
    for line in sys.stdin:
        words = json.loads(line)
        print(json.dumps({"answer": getattr(peer, words.pop("do"))(**words)}), flush=True)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
