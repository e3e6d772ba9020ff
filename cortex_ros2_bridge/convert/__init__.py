"""Messages of Cortex to messages of ROS 2, as CDR, and back: two tables of pure functions.

Stamps are the same numbers on both sides: simulated time. What is given in another frame or by another
convention in ROS is said at each function. What cannot be used is refused, with a reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from cortex import messages
from cortex_ros2_bridge.convert.camera import (
    camera_info,
    compressed_image,
    image,
    image_camera_info,
    point_cloud,
    point_cloud_of_depth,
)
from cortex_ros2_bridge.convert.commands import (
    actuators,
    attitude,
    joy,
    pose,
    rates,
    reset,
    reset_empty,
    steps,
    trajectory,
    trigger,
    twist,
    twist_stamped,
)
from cortex_ros2_bridge.convert.context import Context, ConvertError, In, Out
from cortex_ros2_bridge.convert.events import event_array, event_image, event_packet, events_camera_info
from cortex_ros2_bridge.convert.registry import from_ros, share, to_ros
from cortex_ros2_bridge.convert.simulator import (
    collision,
    simulation,
    simulator_diagnostics,
    simulator_status,
    text,
)
from cortex_ros2_bridge.convert.state import (
    check_transform,
    clock,
    imu,
    odometry,
    odometry_transform,
    path,
    pose_stamped,
    rotor_speeds,
    static_transforms,
    transform,
)

__all__ = [
    "IN",
    "OPTIONS",
    "OUT",
    "Context",
    "ConvertError",
    "In",
    "Out",
    "actuators",
    "attitude",
    "camera_info",
    "check_transform",
    "clock",
    "collision",
    "compressed_image",
    "event_array",
    "event_image",
    "event_packet",
    "events_camera_info",
    "from_ros",
    "image",
    "image_camera_info",
    "imu",
    "joy",
    "odometry",
    "odometry_transform",
    "path",
    "point_cloud",
    "point_cloud_of_depth",
    "pose",
    "pose_stamped",
    "rates",
    "reset",
    "reset_empty",
    "rotor_speeds",
    "share",
    "simulation",
    "simulator_diagnostics",
    "simulator_status",
    "static_transforms",
    "steps",
    "text",
    "to_ros",
    "trajectory",
    "transform",
    "trigger",
    "twist",
    "twist_stamped",
]

OUT: Mapping[tuple[type[Any], str], Out] = {
    (messages.Clock, "rosgraph_msgs/msg/Clock"): clock,
    (messages.Imu, "sensor_msgs/msg/Imu"): imu,
    (messages.Odometry, "nav_msgs/msg/Odometry"): odometry,
    (messages.Odometry, "tf2_msgs/msg/TFMessage"): odometry_transform,
    (messages.Odometry, "geometry_msgs/msg/PoseStamped"): pose_stamped,
    (messages.Transform, "tf2_msgs/msg/TFMessage"): transform,
    (messages.Image, "sensor_msgs/msg/Image"): image,
    (messages.Image, "sensor_msgs/msg/CompressedImage"): compressed_image,
    (messages.Image, "sensor_msgs/msg/CameraInfo"): image_camera_info,
    (messages.Image, "sensor_msgs/msg/PointCloud2"): point_cloud_of_depth,
    (messages.CameraInfo, "sensor_msgs/msg/CameraInfo"): camera_info,
    (messages.Events, "event_camera_msgs/msg/EventPacket"): event_packet,
    (messages.Events, "dvs_msgs/msg/EventArray"): event_array,
    (messages.Events, "sensor_msgs/msg/Image"): event_image,
    (messages.Events, "sensor_msgs/msg/CameraInfo"): events_camera_info,
    (messages.PointCloud, "sensor_msgs/msg/PointCloud2"): point_cloud,
    (messages.RotorSpeeds, "actuator_msgs/msg/Actuators"): rotor_speeds,
    (messages.Path, "nav_msgs/msg/Path"): path,
    (messages.Text, "std_msgs/msg/String"): text,
    (messages.Simulation, "std_msgs/msg/String"): simulation,
    (messages.Collision, "neurosim/msg/Collision"): collision,
    (messages.SimulatorStatus, "neurosim/msg/SimulatorStatus"): simulator_status,
    (messages.SimulatorStatus, "diagnostic_msgs/msg/DiagnosticArray"): simulator_diagnostics,
}
"""Conversions to ROS, by the class in Cortex and the type in ROS."""

IN: Mapping[tuple[str, type[Any]], In] = {
    ("actuator_msgs/msg/Actuators", messages.MotorCommand): actuators,
    ("mavros_msgs/msg/AttitudeTarget", messages.AttitudeCommand): attitude,
    ("mavros_msgs/msg/AttitudeTarget", messages.RateThrustCommand): rates,
    ("geometry_msgs/msg/TwistStamped", messages.VelocityCommand): twist_stamped,
    ("geometry_msgs/msg/Twist", messages.VelocityCommand): twist,
    ("sensor_msgs/msg/Joy", messages.VelocityCommand): joy,
    ("geometry_msgs/msg/PoseStamped", messages.PoseCommand): pose,
    ("trajectory_msgs/msg/MultiDOFJointTrajectory", messages.PoseCommand): trajectory,
    ("neurosim/msg/Reset", messages.Reset): reset,
    ("std_msgs/msg/Empty", messages.Reset): reset_empty,
    ("std_msgs/msg/Empty", messages.Trigger): trigger,
    ("std_msgs/msg/UInt32", messages.Step): steps,
}
"""Conversions from ROS, by the type in ROS and the class in Cortex. All of them also raise `cdr.CdrError`."""

OPTIONS: Mapping[Callable[..., Any], frozenset[str]] = {
    point_cloud_of_depth: frozenset({"depth_max_m"}),
    compressed_image: frozenset({"compression"}),
    joy: frozenset({"stick_speed_m_s", "stick_rate_rad_s", "max_speed_m_s", "max_rate_rad_s", "beyond"}),
    events_camera_info: frozenset({"period_s"}),
    imu: frozenset({"angular_velocity_std_rad_s", "linear_acceleration_std_m_s2"}),
    odometry: frozenset(
        {"position_std_m", "orientation_std_rad", "velocity_std_m_s", "angular_velocity_std_rad_s"}
    ),
    event_packet: frozenset({"encoding"}),
    event_image: frozenset({"period_s"}),
    actuators: frozenset({"max_speed_rad_s", "beyond"}),
    attitude: frozenset({"max_thrust_n"}),
    rates: frozenset({"max_thrust_n", "max_rate_rad_s", "beyond"}),
    twist_stamped: frozenset({"frame", "max_speed_m_s", "max_rate_rad_s", "beyond"}),
    twist: frozenset({"frame", "max_speed_m_s", "max_rate_rad_s", "beyond"}),
    pose: frozenset({"max_position_m", "beyond"}),
    trajectory: frozenset({"max_position_m", "beyond"}),
}
"""Names of the options that a conversion knows; the others know none."""
