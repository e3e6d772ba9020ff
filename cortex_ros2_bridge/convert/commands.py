"""Commands and requests of ROS, to those of Cortex; what comes is a plain record of its type."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import messages
from cortex_ros2_bridge import frames
from cortex_ros2_bridge.convert.context import Context, ConvertError, check_finite
from cortex_ros2_bridge.convert.records import header, pose_of, quaternion, record, stamp_ns_of, vector
from cortex_ros2_bridge.convert.registry import command, recorded, request
from cortex_ros2_bridge.convert.state import rotor_speeds

DEFAULT_MAX_THRUST_N = 50.13
"""Thrust of an AttitudeTarget with thrust 1 [N], if neither an option nor the simulator says otherwise.

It is that of the airframe that Neurosim flies by default: four rotors at 1500 rad/s with 5.57e-6 N s^2."""
_AT_START_NS = 1
"""Stamp in ROS of an answer to the state of 0 ns: 0 would mean now, also when it is said again."""
_VELOCITY = ("frame", "max_speed_m_s", "max_rate_rad_s", "beyond")
_POSITION = ("max_position_m", "beyond")
_IGNORE_RATES = (1, 2, 4)
_IGNORE_THRUST, _IGNORE_ATTITUDE = 64, 128
_KNOWN_BITS = sum(_IGNORE_RATES) | _IGNORE_THRUST | _IGNORE_ATTITUDE


@command(messages.MotorCommand, "actuator_msgs/Actuators", "actuators", "max_speed_rad_s", "beyond")
def actuators(message: Any, context: Context) -> messages.MotorCommand:
    """Convert actuator_msgs/Actuators: rotor speeds [rad/s] from `velocity`.

    With the option `max_speed_rad_s`, also from `normalized`, 0 to 1.
    """
    speed = np.array(message.velocity, np.float64)
    if not len(speed) and len(message.normalized):
        largest = context.option("max_speed_rad_s")
        if largest is None:
            raise ConvertError(
                "Actuators.normalized needs the option max_speed_rad_s; or set velocity [rad/s]"
            )
        speed = np.array(message.normalized, np.float64)
        if (speed > 1.0).any():
            raise ConvertError(f"Actuators.normalized must be 0 to 1, got {speed.max()}")
        speed *= largest
    if not len(speed):
        raise ConvertError("Actuators.velocity is empty: it holds the speed of each rotor [rad/s]")
    check_finite("rotor speeds", speed)
    if (speed < 0.0).any():
        raise ConvertError(f"rotor speeds must be >= 0, got {speed.min()} rad/s")
    speed = context.within("rotor speed", speed, "max_speed_rad_s", "rad/s")
    return messages.MotorCommand(stamp_ns=_stamp_ns(message, context), speed=speed, sequence=context.sequence)


@command(messages.AttitudeCommand, "mavros_msgs/AttitudeTarget", "attitude_target", "max_thrust_n")
def attitude(message: Any, context: Context) -> messages.AttitudeCommand | None:
    """Convert a mavros_msgs/AttitudeTarget whose type_mask does not ignore the attitude.

    Body rates that it does not ignore either must be finite, and are not used: the attitude decides.

    Returns:
        None if it ignores the attitude.
    """
    if message.type_mask & _IGNORE_ATTITUDE:
        return None
    _check_mask(message.type_mask)
    for bit, axis in zip(_IGNORE_RATES, "xyz", strict=True):
        if not message.type_mask & bit:
            check_finite(f"body_rate.{axis}", getattr(message.body_rate, axis))
    return messages.AttitudeCommand(
        stamp_ns=_stamp_ns(message, context),
        thrust_n=_thrust_n(message, context),
        orientation=unit(message.orientation),
        sequence=context.sequence,
    )


@command(
    messages.RateThrustCommand,
    "mavros_msgs/AttitudeTarget",
    "attitude_target",
    "max_thrust_n",
    "max_rate_rad_s",
    "beyond",
)
def rates(message: Any, context: Context) -> messages.RateThrustCommand | None:
    """Convert a mavros_msgs/AttitudeTarget whose type_mask ignores the attitude, and no rate.

    Returns:
        None if it does not ignore the attitude.
    """
    if not message.type_mask & _IGNORE_ATTITUDE:
        return None
    _check_mask(message.type_mask)
    if message.type_mask & sum(_IGNORE_RATES):
        raise ConvertError(
            f"type_mask {message.type_mask} ignores the attitude and a body rate: all three are needed then"
        )
    rate = xyz(message.body_rate)
    check_finite("body rates", rate)
    rate = context.within("body rate", rate, "max_rate_rad_s", "rad/s")
    return messages.RateThrustCommand(
        stamp_ns=_stamp_ns(message, context),
        thrust_n=_thrust_n(message, context),
        body_rate=rate,
        sequence=context.sequence,
    )


@command(messages.VelocityCommand, "geometry_msgs/Twist", "cmd_vel", *_VELOCITY)
def twist(message: Any, context: Context) -> messages.VelocityCommand:
    """Convert geometry_msgs/Twist, in the frame that the option `frame` names, by default base_footprint."""
    return _velocity(message, context.option("frame"), context.now_ns, context)


@command(messages.VelocityCommand, "geometry_msgs/TwistStamped", "command_velocity", *_VELOCITY)
def twist_stamped(message: Any, context: Context) -> messages.VelocityCommand:
    """Convert geometry_msgs/TwistStamped; its frame says what the velocity is relative to.

    base_link: the vehicle as it is tilted now (REP 147); base_footprint: level, x where its nose points; map
    or odom: the ground. For an empty frame the option `frame` decides, as for a Twist. The yaw rate is always
    that of the heading, about the vertical.
    """
    frame = message.header.frame_id or context.option("frame")
    return _velocity(message.twist, frame, _stamp_ns(message, context), context)


@command(
    messages.VelocityCommand,
    "sensor_msgs/Joy",
    "joy",
    "stick_speed_m_s",
    "stick_rate_rad_s",
    *_VELOCITY[1:],
    default=False,
)
def joy(message: Any, context: Context) -> messages.VelocityCommand:
    """Convert sensor_msgs/Joy, a gamepad of two sticks: left up and yaw, right forward and left.

    Axes are those of the driver `joy` for gamepads: 1 up, 0 yaw, 4 forward, 3 left, each -1 to 1; full sticks
    are the options `stick_speed_m_s` and `stick_rate_rad_s`, in base_footprint.
    """
    axes = np.array(message.axes, np.float64)
    if len(axes) < 5 or not (np.abs(axes) <= 1.0).all():
        raise ConvertError(f"Joy.axes must be 5 or more from -1 to 1, got {axes.tolist()}")
    linear = context.option("stick_speed_m_s") * axes[[4, 3, 1]]
    turn = record("geometry_msgs/msg/Twist")(
        vector(linear), vector((0.0, 0.0, context.option("stick_rate_rad_s") * axes[0]))
    )
    return _velocity(turn, "base_footprint", _stamp_ns(message, context), context)


@command(messages.PoseCommand, "geometry_msgs/PoseStamped", "command_pose", *_POSITION)
def pose(message: Any, context: Context) -> messages.PoseCommand:
    """Convert geometry_msgs/PoseStamped in the map or odom frame: position and heading; tilt is not used."""
    return _pose_command(message, message.pose.position, message.pose.orientation, context)


@command(messages.PoseCommand, "trajectory_msgs/MultiDOFJointTrajectory", "command_trajectory", *_POSITION)
def trajectory(message: Any, context: Context) -> messages.PoseCommand:
    """Convert the first point of a trajectory_msgs/MultiDOFJointTrajectory in the map or odom frame."""
    if not message.points:
        raise ConvertError("a trajectory without points")
    if not message.points[0].transforms:
        raise ConvertError("the first point of the trajectory has no transform")
    first = message.points[0].transforms[0]
    return _pose_command(message, first.translation, first.rotation, context)


@recorded(messages.MotorCommand, "actuator_msgs/Actuators", "actuators")
def recorded_speeds(message: messages.MotorCommand, context: Context) -> Any:
    """Convert to actuator_msgs/Actuators, velocities in the order of the rotors."""
    return rotor_speeds(messages.RotorSpeeds(message.stamp_ns or _AT_START_NS, message.speed), context)


@recorded(messages.AttitudeCommand, "mavros_msgs/AttitudeTarget", "attitude_target", "max_thrust_n")
def recorded_attitude(message: messages.AttitudeCommand, context: Context) -> Any:
    """Convert to mavros_msgs/AttitudeTarget; more thrust than the vehicle has is all of it."""
    return _target(message, sum(_IGNORE_RATES), message.orientation, np.zeros(3), context)


@recorded(messages.RateThrustCommand, "mavros_msgs/AttitudeTarget", "attitude_target", "max_thrust_n")
def recorded_rates(message: messages.RateThrustCommand, context: Context) -> Any:
    """Convert to mavros_msgs/AttitudeTarget, likewise."""
    return _target(message, _IGNORE_ATTITUDE, np.array([0.0, 0.0, 0.0, 1.0]), message.body_rate, context)


@recorded(messages.VelocityCommand, "geometry_msgs/TwistStamped", "command_velocity")
def recorded_velocity(message: messages.VelocityCommand, context: Context) -> Any:
    """Convert to geometry_msgs/TwistStamped in the map frame."""
    turn = vector((0.0, 0.0, message.yaw_rate_rad_s))
    twist = record("geometry_msgs/msg/Twist")(vector(message.velocity), turn)
    head = header(message.stamp_ns or _AT_START_NS, frames.WORLD, context)
    return record("geometry_msgs/msg/TwistStamped")(head, twist)


@recorded(messages.PoseCommand, "geometry_msgs/PoseStamped", "command_pose")
def recorded_pose(message: messages.PoseCommand, context: Context) -> Any:
    """Convert to geometry_msgs/PoseStamped in the map frame, level."""
    half = 0.5 * message.yaw_rad
    place = pose_of(message.position, (0.0, 0.0, math.sin(half), math.cos(half)))
    head = header(message.stamp_ns or _AT_START_NS, frames.WORLD, context)
    return record("geometry_msgs/msg/PoseStamped")(head, place)


@request(messages.Reset, "std_msgs/Empty")
def reset_empty(message: Any, context: Context) -> messages.Reset:
    """Convert std_msgs/Empty to a reset to what is configured."""
    return messages.Reset()


@request(messages.Reset, "neurosim/Reset", "{topic}_to")
def reset(message: Any, context: Context) -> messages.Reset:
    """Convert neurosim/Reset."""
    chosen: dict[str, Any] = {}
    if message.use_seed:
        chosen["seed"] = int(message.seed)
    if message.use_pose:
        chosen["position"] = xyz(message.pose.position)
        check_finite("position", chosen["position"])
        chosen["orientation"] = unit(message.pose.orientation)
    if message.use_twist:
        chosen["velocity"] = xyz(message.twist.linear)
        chosen["body_rate"] = xyz(message.twist.angular)
        check_finite("twist", chosen["velocity"], chosen["body_rate"])
    return messages.Reset(vehicle=message.vehicle, **chosen)


@request(messages.Trigger, "std_msgs/Empty")
def trigger(message: Any, context: Context) -> messages.Trigger:
    """Convert std_msgs/Empty to a request without arguments."""
    return messages.Trigger(context.sequence)


@request(messages.Step, "std_msgs/UInt32")
def steps(message: Any, context: Context) -> messages.Step:
    """Convert std_msgs/UInt32: control periods to go on for."""
    count = message.data
    if count < 1:
        raise ConvertError("a step of 0 control periods")
    return messages.Step(count)


def xyz(vector: Any) -> NDArray[np.float64]:
    """Return the numbers of a Vector3 or Point."""
    return np.array([vector.x, vector.y, vector.z], np.float64)


def unit(quaternion: Any) -> NDArray[np.float64]:
    """Return the numbers of a Quaternion, xyzw; refuses what is none."""
    q = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)
    check_finite("orientation", q)
    norm = math.hypot(*q)
    if not 0.9 < norm < 1.1:  # rounded numbers of people are fine, zeros and angles are not
        raise ConvertError(f"orientation is no unit quaternion (x, y, z, w): {q.tolist()}")
    return q / norm


def _stamp_ns(message: Any, context: Context) -> int:
    stamp = message.header.stamp
    if stamp.sec < 0 or stamp.nanosec >= 1_000_000_000:
        raise ConvertError(f"a stamp of {stamp.sec} s and {stamp.nanosec} ns")
    stamp_ns = stamp_ns_of(stamp)
    return 0 if stamp_ns == _AT_START_NS else stamp_ns or context.now_ns


def _thrust_n(message: Any, context: Context) -> float:
    if message.type_mask & _IGNORE_THRUST:
        raise ConvertError(f"type_mask {message.type_mask} ignores thrust, without which nothing flies")
    if not 0.0 <= message.thrust <= 1.0:  # also refuses nan
        raise ConvertError(f"thrust must be 0 to 1, got {message.thrust}")
    return float(message.thrust) * max_thrust_n(context)


def max_thrust_n(context: Context) -> float:
    """Return the thrust of an AttitudeTarget with thrust 1: the option, else what the simulator says [N]."""
    chosen = context.option("max_thrust_n")
    if chosen is None:
        chosen = context.max_thrust_n
    return DEFAULT_MAX_THRUST_N if chosen is None else float(chosen)


def _target(message: Any, mask: int, orientation: Any, rate: Any, context: Context) -> Any:
    return record("mavros_msgs/msg/AttitudeTarget")(
        header(message.stamp_ns or _AT_START_NS, context.frames.body_of(context.vehicle), context),
        mask,
        quaternion(orientation),
        vector(rate),
        min(message.thrust_n / max_thrust_n(context), 1.0),
    )


def _check_mask(mask: int) -> None:
    """Refuse bits that mean something else than what is read, such as MAVLink's THRUST_BODY_SET (32)."""
    if mask & ~_KNOWN_BITS:
        raise ConvertError(
            f"type_mask {mask} has bits that AttitudeTarget does not define: {mask & ~_KNOWN_BITS}"
        )


def _velocity(message: Any, frame: str, stamp_ns: int, context: Context) -> messages.VelocityCommand:
    velocity, rate = xyz(message.linear), xyz(message.angular)
    check_finite("velocity", velocity, rate)
    if rate[0] or rate[1]:
        raise ConvertError(
            f"angular.x and angular.y must be 0: only the heading can turn, got {rate.tolist()}"
        )
    velocity = context.within("velocity", velocity, "max_speed_m_s", "m/s")
    rate = context.within("yaw rate", rate, "max_rate_rad_s", "rad/s")
    kind = context.frames.kind_of(frame, context.vehicle)
    if kind is None:
        known = ", ".join(context.frames.known(context.vehicle))
        raise ConvertError(f"a velocity in frame {frame!r}, known: {known}")
    if kind != "world":
        if context.odometry is None:
            raise ConvertError(f"no odometry yet that would say how {frame} is turned")
        q = context.odometry.orientation
        if kind == "heading":
            half = 0.5 * frames.yaw_rad(q)
            q = np.array([0.0, 0.0, math.sin(half), math.cos(half)])
        velocity = frames.rotate(q, velocity)
    return messages.VelocityCommand(
        stamp_ns=stamp_ns, velocity=velocity, yaw_rate_rad_s=float(rate[2]), sequence=context.sequence
    )


def _pose_command(message: Any, point: Any, quaternion: Any, context: Context) -> messages.PoseCommand:
    frame = message.header.frame_id
    if frame and context.frames.kind_of(frame, context.vehicle) != "world":
        kinds = context.frames.known(context.vehicle)
        known = ", ".join(name for name, kind in kinds.items() if kind == "world")
        raise ConvertError(f"a pose in frame {frame!r}, known: {known}")
    position = xyz(point)
    check_finite("position", position)
    position = context.within("position", position, "max_position_m", "m")
    return messages.PoseCommand(
        stamp_ns=_stamp_ns(message, context),
        position=position,
        yaw_rad=frames.yaw_rad(unit(quaternion)),
        sequence=context.sequence,
    )
