"""A controller in rclpy that flies a circle, and says how far from it the vehicle was.

    python3 circle.py [--radius 0.4] [--period 6] [--seconds 20] [--vehicle drone]

It answers each odometry with a velocity that bears the same stamp, so that it works in lockstep, too.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import Any

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile

GAIN_1_S = 2.0
"""Velocity for each metre of error [1/s]."""
LEAD_S = 0.1
"""So much later the vehicle has the velocity that it is told [s]."""
SETTLE_S = 3.0
"""So long after the start errors do not count [s]."""


class Circle(Node):
    """Flies a circle of which it stands at the eastern end when it starts."""

    def __init__(self, *, vehicle: str, radius_m: float, period_s: float, duration_s: float) -> None:
        """Connect to the bridge's topics of a vehicle."""
        super().__init__("circle")
        self.errors_m: list[float] = []
        self.ended = False
        self._radius_m, self._rate = radius_m, 2.0 * math.pi / period_s
        self._duration_s = duration_s
        self._begin_s = 0.0
        self._center: tuple[float, float, float] | None = None
        self._commands = self.create_publisher(TwistStamped, f"/{vehicle}/command_velocity", 1)
        self.create_subscription(Odometry, f"/{vehicle}/odometry", self._answer, QoSProfile(depth=10))

    def _answer(self, state: Odometry) -> None:
        stamp, p = state.header.stamp, state.pose.pose.position
        now_s = stamp.sec + 1e-9 * stamp.nanosec
        if self._center is None:
            self._center, self._begin_s = (p.x - self._radius_m, p.y, p.z), now_s
        elapsed_s = now_s - self._begin_s
        angle = self._rate * elapsed_s
        x0, y0, z = self._center
        x, y = x0 + self._radius_m * math.cos(angle), y0 + self._radius_m * math.sin(angle)
        if elapsed_s > SETTLE_S:
            self.errors_m.append(math.dist((x, y, z), (p.x, p.y, p.z)))
        command = TwistStamped()
        command.header.stamp, command.header.frame_id = stamp, "map"
        linear: Any = command.twist.linear
        speed, ahead = self._radius_m * self._rate, angle + self._rate * LEAD_S
        linear.x = -speed * math.sin(ahead) + GAIN_1_S * (x - p.x)
        linear.y = speed * math.cos(ahead) + GAIN_1_S * (y - p.y)
        linear.z = GAIN_1_S * (z - p.z)
        self._commands.publish(command)
        self.ended = elapsed_s > self._duration_s


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly, and print the RMS error."""
    parser = argparse.ArgumentParser(description="fly a circle through ROS 2")
    parser.add_argument("--vehicle", default="drone")
    parser.add_argument("--radius", type=float, default=0.4, help="[m]")
    parser.add_argument("--period", type=float, default=6.0, help="[s]")
    parser.add_argument("--seconds", type=float, default=20.0, help="simulated time [s]")
    options = parser.parse_args(arguments)
    rclpy.init()
    node = Circle(
        vehicle=options.vehicle,
        radius_m=options.radius,
        period_s=options.period,
        duration_s=options.seconds,
    )
    while rclpy.ok() and not node.ended:
        rclpy.spin_once(node, timeout_sec=1.0)
    rms_m = math.sqrt(sum(e * e for e in node.errors_m) / max(len(node.errors_m), 1))
    print(f"circle of {options.radius:g} m: {100.0 * rms_m:.2f} cm RMS over {len(node.errors_m)} states")
    rclpy.shutdown()


if __name__ == "__main__":
    main()
