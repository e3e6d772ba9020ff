"""State of vehicles: time, inertial measurements, odometry, frames, rotors, paths."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import messages
from cortex_ros2_bridge import cdr, frames
from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.convert.context import Context, ConvertError, check_finite
from cortex_ros2_bridge.convert.records import (
    header,
    pose_of,
    quaternion,
    record,
    time_of,
    transform_record,
    vector,
)
from cortex_ros2_bridge.convert.registry import LATCHED, STREAM, standard
from cortex_ros2_bridge.frames import FrameNames

_NO_FLOATS: NDArray[np.float64] = np.empty(0)


@standard(messages.Clock, "rosgraph_msgs/Clock")
def clock(message: messages.Clock, context: Context) -> Any:
    """Convert to rosgraph_msgs/Clock."""
    return record("rosgraph_msgs/msg/Clock")(time_of(message.stamp_ns))


@standard(
    messages.Imu,
    "sensor_msgs/Imu",
    "{topic}",
    STREAM,
    "angular_velocity_std_rad_s",
    "linear_acceleration_std_m_s2",
)
def imu(message: messages.Imu, context: Context) -> Any:
    """Convert to sensor_msgs/Imu, without an orientation (its covariance begins with -1); at rest z is 9.81.

    The options `angular_velocity_std_rad_s` and `linear_acceleration_std_m_s2` give standard deviations of
    one sample, of which the covariances are made; 0, as in ROS, means that they are unknown.
    """
    check_finite("imu", message.angular_rate, message.specific_force)
    unknown = np.zeros(9)
    unknown[0] = -1.0
    return record("sensor_msgs/msg/Imu")(
        header(message.stamp_ns, context.frame_id, context),
        quaternion((0.0, 0.0, 0.0, 1.0)),
        unknown,
        vector(message.angular_rate),
        _diagonal([context.option("angular_velocity_std_rad_s")] * 3),
        vector(message.specific_force),
        _diagonal([context.option("linear_acceleration_std_m_s2")] * 3),
    )


@standard(
    messages.Odometry,
    "nav_msgs/Odometry",
    "{topic}",
    STREAM,
    "position_std_m",
    "orientation_std_rad",
    "velocity_std_m_s",
    "angular_velocity_std_rad_s",
)
def odometry(message: messages.Odometry, context: Context) -> Any:
    """Convert to nav_msgs/Odometry: the pose in the odom frame, the velocity turned into the body frame.

    The options `position_std_m`, `orientation_std_rad`, `velocity_std_m_s` and `angular_velocity_std_rad_s`
    give standard deviations, of which the covariances are made; 0 is the default.
    """
    check_finite("odometry", message.velocity, message.body_rate)
    _check_pose(message)
    pose = record("geometry_msgs/msg/PoseWithCovariance")(
        pose_of(message.position, message.orientation),
        _diagonal([context.option("position_std_m")] * 3 + [context.option("orientation_std_rad")] * 3),
    )
    velocity = frames.rotate_back(message.orientation, message.velocity)
    twist = record("geometry_msgs/msg/TwistWithCovariance")(
        record("geometry_msgs/msg/Twist")(vector(velocity), vector(message.body_rate)),
        _diagonal(
            [context.option("velocity_std_m_s")] * 3 + [context.option("angular_velocity_std_rad_s")] * 3
        ),
    )
    head = record("std_msgs/msg/Header")(time_of(message.stamp_ns), context.frames.odom_of(context.vehicle))
    return record("nav_msgs/msg/Odometry")(head, context.frames.body_of(context.vehicle), pose, twist)


@standard(messages.Odometry, "geometry_msgs/PoseStamped", "{topic}/pose", STREAM, default=False)
def pose_stamped(message: messages.Odometry, context: Context) -> Any:
    """Convert to geometry_msgs/PoseStamped, in the odom frame."""
    _check_pose(message)
    head = record("std_msgs/msg/Header")(time_of(message.stamp_ns), context.frames.odom_of(context.vehicle))
    pose = pose_of(message.position, message.orientation)
    return record("geometry_msgs/msg/PoseStamped")(head, pose)


@standard(messages.Odometry, "tf2_msgs/TFMessage", "/tf", STREAM)
def odometry_transform(message: messages.Odometry, context: Context) -> Any:
    """Convert to tf2_msgs/TFMessage: from the odom frame to the body frame."""
    _check_pose(message)
    ends = context.frames.odom_of(context.vehicle), context.frames.body_of(context.vehicle)
    pose = message.position, message.orientation
    return _transforms([transform_record(message.stamp_ns, *ends, *pose)])


@standard(messages.Transform, "tf2_msgs/TFMessage", "/tf_static", LATCHED)
def transform(message: messages.Transform, context: Context) -> Any:
    """Convert to tf2_msgs/TFMessage."""
    return _transforms([transform_of(message, context.frames)])


def static_transforms(transforms: Iterable[Any], vehicles: Iterable[str], names: FrameNames) -> Buffer:
    """Return one tf2_msgs/TFMessage with records of `transform_of`, and from map to each vehicle's odom."""
    origin = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    roots = [transform_record(0, names.ros(frames.WORLD), names.odom_of(each), *origin) for each in vehicles]
    return cdr.encode(_transforms([*roots, *transforms]))


@standard(messages.RotorSpeeds, "actuator_msgs/Actuators", "{topic}", STREAM)
def rotor_speeds(message: messages.RotorSpeeds, context: Context) -> Any:
    """Convert to actuator_msgs/Actuators, velocities in the order of the rotors."""
    speed = np.ascontiguousarray(message.speed, dtype=np.float64)
    head = record("std_msgs/msg/Header")(time_of(message.stamp_ns), context.frames.body_of(context.vehicle))
    return record("actuator_msgs/msg/Actuators")(head, _NO_FLOATS, speed, _NO_FLOATS)


@standard(messages.Path, "nav_msgs/Path", "{topic}", LATCHED)
def path(message: messages.Path, context: Context) -> Any:
    """Convert to nav_msgs/Path; each pose is stamped with its time, and not turned."""
    check_finite("path", message.position)
    if len(message.time_ns) != len(message.position):
        raise ConvertError(f"a path with {len(message.time_ns)} times for {len(message.position)} positions")
    frame = message.frame_id or frames.WORLD
    level = (0.0, 0.0, 0.0, 1.0)
    stamped = record("geometry_msgs/msg/PoseStamped")
    poses = [
        stamped(header(time_ns, frame, context), pose_of(position, level))
        for time_ns, position in zip(message.time_ns.tolist(), message.position, strict=True)
    ]
    return record("nav_msgs/msg/Path")(header(message.stamp_ns, frame, context), poses)


def _check_pose(message: messages.Odometry) -> None:
    """Raise `ConvertError` for what tf would refuse message by message."""
    check_finite("odometry", message.position, message.orientation)
    if not np.any(message.orientation):
        raise ConvertError("odometry: its orientation is zero")


def _diagonal(deviations: list[float]) -> NDArray[np.float64]:
    """Return a covariance without correlations, row by row."""
    covariance = np.zeros(len(deviations) ** 2)
    covariance[:: len(deviations) + 1] = np.square(deviations)
    return covariance


def transform_of(message: messages.Transform, names: FrameNames) -> Any:
    """Return a geometry_msgs/TransformStamped.

    Raises:
        ConvertError: It is none: not finite, without a rotation, or of one frame.
    """
    what = f"transform to {message.child!r}"
    check_finite(what, message.translation, message.rotation)
    if not message.child or not message.parent:
        raise ConvertError(f"a transform from {message.parent!r} to {message.child!r}")
    parent, child = names.ros(message.parent), names.ros(message.child)
    if parent == child:
        raise ConvertError(f"{what}: its parent is itself, which tf2 refuses")
    if not np.any(message.rotation):
        raise ConvertError(f"{what}: its rotation is zero")
    return transform_record(message.stamp_ns, parent, child, message.translation, message.rotation)


def _transforms(records: list[Any]) -> Any:
    return record("tf2_msgs/msg/TFMessage")(records)
