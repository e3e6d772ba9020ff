"""A controller in rclpy that flies a square beside where it starts, and says how near it came to the corners.

    python3 square.py [--side 0.5] [--laps 1] [--vehicle drone]

It answers each odometry with a velocity that bears the same stamp, so that it works in lockstep, too.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

GAIN_1_S = 1.5
"""Velocity for each metre to the next corner [1/s]."""
SPEED_MAX_M_S = 0.4
NEAR_M = 0.05
"""A corner is reached when it is this near [m]."""


class Square(Node):
    """Flies from corner to corner; the first is where it starts."""

    def __init__(self, *, vehicle: str = "drone", side_m: float = 0.5, laps: int = 1) -> None:
        """Connect to the bridge's topics of a vehicle."""
        super().__init__("square")
        self.reached_count = 0
        self.ended = False
        self._turns = [(side_m, 0.0), (side_m, side_m), (0.0, side_m), (0.0, 0.0)] * laps
        self._start: tuple[float, float, float] | None = None
        self._commands = self.create_publisher(TwistStamped, f"/{vehicle}/command_velocity", 1)
        self.create_subscription(Odometry, f"/{vehicle}/odometry", self.answer, 10)

    def answer(self, state: Odometry) -> None:
        """Send the velocity towards the next corner, and none at the last."""
        p = state.pose.pose.position
        self._start = x0, y0, z0 = self._start or (p.x, p.y, p.z)
        x, y = self._turns[min(self.reached_count, len(self._turns) - 1)]
        way = (x0 + x - p.x, y0 + y - p.y, z0 - p.z)
        distance_m = math.hypot(*way)
        if distance_m < NEAR_M and not self.ended:
            self.reached_count += 1
            self.ended = self.reached_count == len(self._turns)
        scale = min(GAIN_1_S, SPEED_MAX_M_S / max(distance_m, 1e-9))
        command = TwistStamped()
        command.header.stamp, command.header.frame_id = state.header.stamp, "map"
        linear = command.twist.linear
        linear.x, linear.y, linear.z = (scale * each for each in way)
        self._commands.publish(command)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly until the last corner, or until Ctrl-C."""
    parser = argparse.ArgumentParser(description="fly a square through ROS 2")
    parser.add_argument("--vehicle", default="drone")
    parser.add_argument("--side", type=float, default=0.5, help="[m]")
    parser.add_argument("--laps", type=int, default=1)
    options = parser.parse_args(arguments)
    rclpy.init()
    node = Square(vehicle=options.vehicle, side_m=options.side, laps=options.laps)
    try:
        while not node.ended:
            rclpy.spin_once(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    print(f"reached {node.reached_count} of {4 * options.laps} corners")
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
