"""Offboard topics of PX4: a controller written for PX4 flies a vehicle of Neurosim.

    source ~/px4_ws/install/setup.bash        # has the package px4_msgs; its definitions are read there
    cortex-ros2-bridge --config examples/ros2_px4/px4.yaml

    /fmu/in/trajectory_setpoint        a position (with velocities as feed-forward left out), or a velocity
    /fmu/in/vehicle_rates_setpoint     body rates, and thrust_body[2]: -1 is all rotors at full speed
    /fmu/out/vehicle_odometry          the true state

PX4's frames are NED and FRD, ours ENU and FLU. Timestamps are simulated time (use_sim_time), or 0 for now.
There is no arming: OffboardControlMode and VehicleCommand are not needed, and not read.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import messages
from cortex_ros2_bridge.convert import Context, ConvertError, from_ros, to_ros
from cortex_ros2_bridge.convert.commands import max_thrust_n
from cortex_ros2_bridge.frames import yaw_rad
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.typestore import define

SETPOINT = "px4_msgs/msg/TrajectorySetpoint"
RATES = "px4_msgs/msg/VehicleRatesSetpoint"
ODOMETRY = "px4_msgs/msg/VehicleOdometry"
_NED = 1
"""POSE_FRAME_NED and VELOCITY_FRAME_NED."""
_FLIP = np.array([1.0, -1.0, -1.0])
"""FRD of FLU, and back."""


def _installed(type_name: str) -> str:
    """Return the definition of a message in the ROS installation: versions of PX4 differ."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        package, kind, name = type_name.split("/")
        path = Path(prefix, "share", package, kind, f"{name}.msg")
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise ImportError("the ROS package px4_msgs is not installed: source the workspace that has it")


for _type in (SETPOINT, RATES, ODOMETRY):
    define(_type, _installed(_type))


@from_ros(SETPOINT, messages.PoseCommand, name="{base}/fmu/in/trajectory_setpoint")
def pose_of(setpoint: Any, context: Context) -> messages.PoseCommand | None:
    """Return the position that a TrajectorySetpoint asks for; None if it asks for a velocity."""
    position = _ned(setpoint.position)
    if np.isnan(position).all():
        return None
    if not np.isfinite(position).all():
        raise ConvertError(f"a position in which some axes are free: {position.tolist()}")
    yaw = 0.5 * math.pi - setpoint.yaw
    if not math.isfinite(yaw):  # as it is
        yaw = 0.0 if context.odometry is None else yaw_rad(context.odometry.orientation)
    return messages.PoseCommand(
        stamp_ns=_stamp_ns(setpoint, context),
        position=context.within("position", position, "max_position_m", "m"),
        yaw_rad=yaw,
        sequence=context.sequence,
    )


@from_ros(SETPOINT, messages.VelocityCommand, name="{base}/fmu/in/trajectory_setpoint")
def velocity_of(setpoint: Any, context: Context) -> messages.VelocityCommand | None:
    """Return the velocity that a TrajectorySetpoint asks for; None if it asks for a position."""
    if not np.isnan(setpoint.position).all():
        return None
    velocity = _ned(setpoint.velocity)
    if not np.isfinite(velocity).all():
        raise ConvertError(f"neither a position nor a velocity: {velocity.tolist()}")
    rate = 0.0 if math.isnan(setpoint.yawspeed) else -float(setpoint.yawspeed)
    return messages.VelocityCommand(
        stamp_ns=_stamp_ns(setpoint, context),
        velocity=context.within("velocity", velocity, "max_speed_m_s", "m/s"),
        yaw_rate_rad_s=float(context.within("yaw rate", np.array([rate]), "max_rate_rad_s", "rad/s")[0]),
        sequence=context.sequence,
    )


@from_ros(RATES, messages.RateThrustCommand, name="{base}/fmu/in/vehicle_rates_setpoint")
def rates_of(setpoint: Any, context: Context) -> messages.RateThrustCommand:
    """Return the body rates and the thrust of a VehicleRatesSetpoint."""
    rate = np.array([setpoint.roll, setpoint.pitch, setpoint.yaw], np.float64) * _FLIP
    thrust = -float(setpoint.thrust_body[2])
    if not np.isfinite(rate).all() or not 0.0 <= thrust <= 1.0:
        raise ConvertError(f"rates must be finite and thrust_body[2] -1 to 0, got {rate.tolist()}, {-thrust}")
    return messages.RateThrustCommand(
        stamp_ns=_stamp_ns(setpoint, context),
        thrust_n=thrust * max_thrust_n(context),
        body_rate=context.within("body rate", rate, "max_rate_rad_s", "rad/s"),
        sequence=context.sequence,
    )


@to_ros(messages.Odometry, ODOMETRY, name="{base}/fmu/out/vehicle_odometry")
def odometry_of(odometry: messages.Odometry, context: Context) -> Any:
    """Return a VehicleOdometry: NED, of a body frame FRD."""
    message = message_class(ODOMETRY)()
    message.timestamp = message.timestamp_sample = odometry.stamp_ns // 1000
    message.pose_frame = message.velocity_frame = _NED
    message.position = _ned(odometry.position).astype(np.float32)
    message.velocity = _ned(odometry.velocity).astype(np.float32)
    message.angular_velocity = (odometry.body_rate * _FLIP).astype(np.float32)
    x, y, z, w = odometry.orientation.tolist()
    # q_NED<-ENU q q_FLU<-FRD written out, w first: half turns about x = y, and about x.
    message.q = (math.sqrt(0.5) * np.array([w + z, x + y, x - y, w - z])).astype(np.float32)
    return message


def _ned(vector: Any) -> NDArray[np.float64]:
    """Return ENU of NED, and NED of ENU."""
    x, y, z = (float(part) for part in vector)
    return np.array([y, x, -z])


def _stamp_ns(setpoint: Any, context: Context) -> int:
    return int(setpoint.timestamp) * 1000 or context.now_ns
