"""Messages of Cortex to messages of ROS 2, as CDR, and back: two tables of pure functions.

Stamps are the same numbers on both sides: simulated time. What is given in another frame or by another
convention in ROS is said at each function. What cannot be used is refused, with a reason.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import messages
from cortex_ros2_bridge import cdr, frames
from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.event_codec import (
    Bytes,
    EventCodecError,
    EventPicture,
    Evt3Encoder,
    dvs_size,
    encode_mono,
    write_dvs,
)
from cortex_ros2_bridge.frames import FrameNames

DEFAULT_MAX_THRUST_N = 50.13
"""Thrust of an AttitudeTarget with thrust 1 [N], unless the option `max_thrust_n` says otherwise.

It is that of the airframe that Neurosim flies by default: four rotors at 1500 rad/s with 5.57e-6 N s^2."""


class ConvertError(ValueError):
    """A message cannot be used; the text says why."""


@dataclass(kw_only=True)
class Context:
    """What the conversion of one route needs besides the message; whoever converts keeps it up to date."""

    frames: FrameNames = field(default_factory=FrameNames)
    """Names of frames in ROS."""
    vehicle: str = ""
    """Whose message it is: "drone" for /drone/imu."""
    frame_id: str = ""
    """Frame of a message that does not name its own, as Cortex calls it, such as "drone/imu"."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the route; those that a conversion knows are in `OPTIONS`."""
    camera_info: messages.CameraInfo | None = None
    """Newest calibration of the camera."""
    odometry: messages.Odometry | None = None
    """Newest state of the vehicle, to turn velocities that are given in its body frame."""
    now_ns: int = 0
    """Newest time that is known [ns]; commands without a stamp get it."""
    sequence: int = 0
    """Messages that were sent before."""
    memory: dict[str, Any] = field(default_factory=dict)
    """What a conversion keeps from message to message."""


Out = Callable[[Any, Context], "Buffer | None"]
"""Makes CDR of a message of Cortex; None: there is nothing to send now."""
In = Callable[[Buffer, Context], Any]
"""Makes a message of Cortex of CDR; None: the message of ROS is meant for another route."""


# Cortex -> ROS


def clock(message: messages.Clock, context: Context) -> Buffer:
    """Convert to rosgraph_msgs/Clock."""
    return cdr.encode(_record("rosgraph_msgs/msg/Clock")(_time(message.stamp_ns)))


def imu(message: messages.Imu, context: Context) -> Buffer:
    """Convert to sensor_msgs/Imu, without an orientation (its covariance begins with -1); at rest z is 9.81.

    The options `angular_velocity_std_rad_s` and `linear_acceleration_std_m_s2` give standard deviations of
    one sample, of which the covariances are made; 0, as in ROS, means that they are unknown.
    """
    unknown = np.zeros(9)
    unknown[0] = -1.0
    record = _record("sensor_msgs/msg/Imu")(
        _header(message.stamp_ns, context.frame_id, context),
        _quaternion((0.0, 0.0, 0.0, 1.0)),
        unknown,
        _vector(message.angular_rate),
        _diagonal([_option(context, "angular_velocity_std_rad_s", 0.0)] * 3),
        _vector(message.specific_force),
        _diagonal([_option(context, "linear_acceleration_std_m_s2", 0.0)] * 3),
    )
    return cdr.encode(record)


def odometry(message: messages.Odometry, context: Context) -> Buffer:
    """Convert to nav_msgs/Odometry: the pose in the odom frame, the velocity turned into the body frame.

    The options `position_std_m`, `orientation_std_rad`, `velocity_std_m_s` and `angular_velocity_std_rad_s`
    give standard deviations, of which the covariances are made; 0 is the default.
    """
    _finite("odometry", message.position, message.orientation, message.velocity, message.body_rate)
    pose = _record("geometry_msgs/msg/PoseWithCovariance")(
        _pose(message.position, message.orientation),
        _diagonal(
            [_option(context, "position_std_m", 0.0)] * 3 + [_option(context, "orientation_std_rad", 0.0)] * 3
        ),
    )
    velocity = frames.rotate_back(message.orientation, message.velocity)
    twist = _record("geometry_msgs/msg/TwistWithCovariance")(
        _record("geometry_msgs/msg/Twist")(_vector(velocity), _vector(message.body_rate)),
        _diagonal(
            [_option(context, "velocity_std_m_s", 0.0)] * 3
            + [_option(context, "angular_velocity_std_rad_s", 0.0)] * 3
        ),
    )
    header = _record("std_msgs/msg/Header")(_time(message.stamp_ns), context.frames.odom_of(context.vehicle))
    return cdr.encode(
        _record("nav_msgs/msg/Odometry")(header, context.frames.body_of(context.vehicle), pose, twist)
    )


def odometry_transform(message: messages.Odometry, context: Context) -> Buffer:
    """Convert to tf2_msgs/TFMessage: from the odom frame to the body frame."""
    _finite("odometry", message.position, message.orientation)
    names = context.frames
    return _transforms(
        [
            _transform(
                message.stamp_ns,
                names.odom_of(context.vehicle),
                names.body_of(context.vehicle),
                message.position,
                message.orientation,
            )
        ]
    )


def transform(message: messages.Transform, context: Context) -> Buffer:
    """Convert to tf2_msgs/TFMessage."""
    return _transforms([_transform_of(message, context.frames)])


def static_transforms(
    transforms: Iterable[messages.Transform], vehicles: Iterable[str], names: FrameNames
) -> Buffer:
    """Return one tf2_msgs/TFMessage with all static transforms, and those from map to each vehicle's odom.

    Args:
        transforms: Where sensors sit.
        vehicles: Names of the vehicles.
        names: Names of frames in ROS.

    Raises:
        ConvertError: A transform has numbers that are not finite, or no rotation.
    """
    roots = [
        _transform(0, names.ros(frames.WORLD), names.odom_of(vehicle), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        for vehicle in vehicles
    ]
    return _transforms(roots + [_transform_of(each, names) for each in transforms])


def check_transform(message: messages.Transform, names: FrameNames) -> None:
    """Raise `ConvertError` unless a transform is one: finite, with a rotation, between two frames."""
    _transform_of(message, names)


def image(message: messages.Image, context: Context) -> Buffer:
    """Convert to sensor_msgs/Image; encodings are called the same."""
    data = np.ascontiguousarray(message.data)
    if data.ndim != 3:
        raise ConvertError(f"an image must have rows, columns and channels, got shape {data.shape}")
    height, width, channels = data.shape
    dtype, expected = _pixel(message.encoding)
    if data.dtype.newbyteorder("=") != dtype or channels != expected:
        raise ConvertError(
            f"{message.encoding} means {expected} channels of {dtype}, got {channels} of {data.dtype}"
        )
    record = _record("sensor_msgs/msg/Image")(
        _header(message.stamp_ns, message.frame_id or context.frame_id, context),
        height,
        width,
        message.encoding,
        int(data.dtype.byteorder == ">"),
        width * channels * data.itemsize,
        data.reshape(-1).view(np.uint8),
    )
    return cdr.encode(record)


def image_camera_info(message: messages.Image, context: Context) -> Buffer | None:
    """Return the calibration of the camera, as sensor_msgs/CameraInfo with the stamp of a picture.

    None, as long as the calibration is not known.
    """
    return _camera_info(message.stamp_ns, context.camera_info, context)


def events_camera_info(message: messages.Events, context: Context) -> Buffer | None:
    """Return the calibration of an event camera, or None; as for pictures, with the stamp of the packet."""
    return _camera_info(_events_stamp_ns(message), context.camera_info, context)


def camera_info(message: messages.CameraInfo, context: Context) -> Buffer | None:
    """Convert to sensor_msgs/CameraInfo.

    In ROS the centre of the first pixel is at 0, in Cortex at 0.5: the principal point moves by half a pixel.
    """
    return _camera_info(message.stamp_ns, message, context)


def event_packet(message: messages.Events, context: Context) -> Buffer:
    """Convert to event_camera_msgs/EventPacket; the option `encoding` is evt3 (default) or mono.

    As drivers do it, its stamp is the time of the first event; of a packet without events, the end of its
    window. `time_base` is that time in mono, and 0 in evt3, where it has no meaning.
    """
    encoding = context.options.get("encoding", "evt3")
    if encoding not in ("evt3", "mono"):
        raise ConvertError(f"option encoding must be evt3 or mono, got {encoding!r}")
    stamp_ns = _events_stamp_ns(message)
    base_us = stamp_ns // 1000
    if encoding == "mono" and base_us < 0:
        raise ConvertError(f"mono holds no time before 0, got {base_us} us")
    prefix = cdr.encode(
        _record("event_camera_msgs/msg/EventPacket")(
            _header(stamp_ns, message.frame_id or context.frame_id, context),
            message.height,
            message.width,
            message.sequence,
            base_us * 1000 if encoding == "mono" else 0,
            encoding,
            False,
            _NO_BYTES,
        )
    )
    room = _Room(prefix)
    columns = (message.t, message.x, message.y, message.polarity)
    try:
        if encoding == "mono":
            encode_mono(
                *columns, width=message.width, height=message.height, base_us=base_us, allocate=room.make
            )
        else:
            encoder = _remembered(context, "evt3", Evt3Encoder)
            encoder.encode(
                *columns, width=message.width, height=message.height, end_us=base_us, allocate=room.make
            )
    except EventCodecError as error:
        raise ConvertError(str(error)) from error
    return room.message()


def event_array(message: messages.Events, context: Context) -> Buffer:
    """Convert to dvs_msgs/EventArray, which older programs use; stamped as an event packet is."""
    prefix = cdr.encode(
        _record("dvs_msgs/msg/EventArray")(
            _header(_events_stamp_ns(message), message.frame_id or context.frame_id, context),
            message.height,
            message.width,
            [],
        )
    )
    room = _Room(prefix)
    count = len(message.t)
    try:
        write_dvs(
            room.make(dvs_size(count), count=count),
            message.t,
            message.x,
            message.y,
            message.polarity,
            width=message.width,
            height=message.height,
        )
    except EventCodecError as error:
        raise ConvertError(str(error)) from error
    return room.message()


def event_image(message: messages.Events, context: Context) -> Buffer | None:
    """Draw events, and return a sensor_msgs/Image (rgb8) each time that the option `period_s` has passed.

    White where there was no event, else the last one: blue is brighter, red is darker. The default is 1/30 s
    of simulated time. The stamp is that of the last window that was drawn.
    """
    period_ns = round(_option(context, "period_s", 1.0 / 30.0) * 1e9)
    size = (int(message.width), int(message.height))
    if context.memory.get("picture_size") != size:
        context.memory["picture_size"] = size
        context.memory["picture"] = EventPicture(width=size[0], height=size[1])
        context.memory["picture_due_ns"] = None
    picture: EventPicture = context.memory["picture"]
    try:
        picture.add(message.x, message.y, message.polarity)
    except EventCodecError as error:
        raise ConvertError(str(error)) from error
    due_ns = context.memory["picture_due_ns"]
    if due_ns is not None and message.stamp_ns < due_ns - period_ns:  # time was set back
        picture.take()
        due_ns = None
    if due_ns is None:
        due_ns = max(message.start_ns, message.stamp_ns - period_ns) + period_ns
        context.memory["picture_due_ns"] = due_ns
    if message.stamp_ns < due_ns:
        return None
    late_ns = message.stamp_ns - due_ns
    context.memory["picture_due_ns"] = due_ns + period_ns * (1 + late_ns // max(period_ns, 1))
    data = picture.take()
    record = _record("sensor_msgs/msg/Image")(
        _header(message.stamp_ns, message.frame_id or context.frame_id, context),
        size[1],
        size[0],
        "rgb8",
        0,
        3 * size[0],
        data.reshape(-1),
    )
    return cdr.encode(record)


def point_cloud(message: messages.PointCloud, context: Context) -> Buffer:
    """Convert to sensor_msgs/PointCloud2 with fields x, y, z and, where there are such, intensity and rgb."""
    count = len(message.points)
    names = ["x", "y", "z"]
    names += ["intensity"] if message.intensity is not None else []
    names += ["rgb"] if message.color is not None else []
    points = np.empty((count, len(names)), "<f4")
    points[:, :3] = message.points
    if message.intensity is not None:
        points[:, 3] = _of_length("intensity", message.intensity, count)
    if message.color is not None:
        color = _of_length("color", message.color, count)
        packed = points[:, -1:].view("u1")  # a float to PCL and RViz, whose bytes are blue, green, red, 0
        packed[:, :3], packed[:, 3] = color[:, ::-1], 0
    describe = _record("sensor_msgs/msg/PointField")
    fields = [describe(name, 4 * index, _POINT_FLOAT32, 1) for index, name in enumerate(names)]
    record = _record("sensor_msgs/msg/PointCloud2")(
        _header(message.stamp_ns, message.frame_id or context.frame_id, context),
        1,
        count,
        fields,
        False,
        4 * len(names),
        points.nbytes,
        points.reshape(-1).view(np.uint8),
        bool(np.isfinite(message.points).all()),
    )
    return cdr.encode(record)


def rotor_speeds(message: messages.RotorSpeeds, context: Context) -> Buffer:
    """Convert to actuator_msgs/Actuators, velocities in the order of the rotors."""
    speed = np.ascontiguousarray(message.speed, dtype=np.float64)
    header = _record("std_msgs/msg/Header")(_time(message.stamp_ns), context.frames.body_of(context.vehicle))
    return cdr.encode(_record("actuator_msgs/msg/Actuators")(header, _NO_FLOATS, speed, _NO_FLOATS))


def path(message: messages.Path, context: Context) -> Buffer:
    """Convert to nav_msgs/Path; each pose is stamped with its time, and not turned."""
    _finite("path", message.position)
    if len(message.time_ns) != len(message.position):
        raise ConvertError(f"a path with {len(message.time_ns)} times for {len(message.position)} positions")
    frame = message.frame_id or frames.WORLD
    level = (0.0, 0.0, 0.0, 1.0)
    stamped = _record("geometry_msgs/msg/PoseStamped")
    poses = [
        stamped(_header(time_ns, frame, context), _pose(position, level))
        for time_ns, position in zip(message.time_ns.tolist(), message.position, strict=True)
    ]
    return cdr.encode(_record("nav_msgs/msg/Path")(_header(message.stamp_ns, frame, context), poses))


def text(message: messages.Text, context: Context) -> Buffer:
    """Convert to std_msgs/String."""
    return cdr.encode(_record("std_msgs/msg/String")(message.text))


def simulation(message: messages.Simulation, context: Context) -> Buffer:
    """Convert to std_msgs/String: the settings, as YAML."""
    return cdr.encode(_record("std_msgs/msg/String")(message.config))


def collision(message: messages.Collision, context: Context) -> Buffer:
    """Convert to neurosim/Collision, in the map frame."""
    record = _record("neurosim/msg/Collision")(
        _header(message.stamp_ns, frames.WORLD, context), _point(message.position), float(message.clearance_m)
    )
    return cdr.encode(record)


def simulator_status(message: messages.SimulatorStatus, context: Context) -> Buffer:
    """Convert to neurosim/SimulatorStatus; counts are sums over sensors and vehicles."""
    second, nanosecond = divmod(message.slipped_ns, 1_000_000_000)
    record = _record("neurosim/msg/SimulatorStatus")(
        _header(message.stamp_ns, "", context),
        message.phase,
        message.reason,
        message.mode,
        message.real_time_factor,
        message.real_time_factor_wanted,
        message.step_count,
        message.overrun_count,
        _record("builtin_interfaces/msg/Duration")(second, nanosecond),
        sum(sensor.dropped_count for sensor in message.sensors),
        sum(vehicle.refused_count for vehicle in message.vehicles),
        sum(vehicle.collision_count for vehicle in message.vehicles),
        any(vehicle.fail_safe for vehicle in message.vehicles),
    )
    return cdr.encode(record)


def simulator_diagnostics(message: messages.SimulatorStatus, context: Context) -> Buffer:
    """Convert to diagnostic_msgs/DiagnosticArray: of the simulator, of each sensor and vehicle."""
    pair = _record("diagnostic_msgs/msg/KeyValue")
    status = _record("diagnostic_msgs/msg/DiagnosticStatus")

    def made(level: int, name: str, text: str, values: Mapping[str, Any]) -> Any:
        return status(level, name, text, "", [pair(key, str(value)) for key, value in values.items()])

    late = message.overrun_count > 0 or message.slipped_ns > 0
    level = _ERROR if message.phase == "ended" else _WARN if late else _OK
    statuses = [
        made(
            level,
            "simulator",
            f"{message.phase}: {message.reason}" if message.reason else message.phase,
            {
                name: getattr(message, name)
                for name in (
                    "mode",
                    "real_time_factor",
                    "real_time_factor_wanted",
                    "step_count",
                    "step_median_ns",
                    "step_p99_ns",
                    "late_p99_ns",
                    "overrun_count",
                    "slipped_ns",
                )
            },
        )
    ]
    for sensor in message.sensors:
        unwanted = sensor.dropped_count > sensor.injected_lost_count
        statuses.append(
            made(
                _WARN if unwanted else _OK,
                f"sensor {sensor.vehicle}/{sensor.name}",
                f"{sensor.dropped_count} dropped"
                if sensor.dropped_count
                else "ok"
                if sensor.active
                else "idle",
                {
                    name: getattr(sensor, name)
                    for name in (
                        "subscriber_count",
                        "published_count",
                        "dropped_count",
                        "injected_lost_count",
                    )
                },
            )
        )
    for vehicle in message.vehicles:
        trouble = vehicle.fail_safe or vehicle.collision_count > 0
        statuses.append(
            made(
                _WARN if trouble or vehicle.refused_count else _OK,
                f"vehicle {vehicle.name}",
                "fail-safe" if vehicle.fail_safe else vehicle.command_mode or "no command yet",
                {
                    name: getattr(vehicle, name)
                    for name in (
                        "command_count",
                        "refused_count",
                        "superseded_count",
                        "lost_count",
                        "command_age_ns",
                        "fail_safe_count",
                        "collision_count",
                    )
                },
            )
        )
    array = _record("diagnostic_msgs/msg/DiagnosticArray")
    return cdr.encode(array(_header(message.stamp_ns, "", context), statuses))


# ROS -> Cortex


def actuators(data: Buffer, context: Context) -> messages.MotorCommand:
    """Convert actuator_msgs/Actuators: rotor speeds [rad/s] from `velocity`.

    With the option `max_speed_rad_s`, also from `normalized`, 0 to 1.
    """
    message = cdr.decode_record(data, "actuator_msgs/msg/Actuators")
    speed = np.array(message.velocity, np.float64)
    if not len(speed) and len(message.normalized):
        largest = _option(context, "max_speed_rad_s", 0.0)
        if not largest:
            raise ConvertError(
                "Actuators.normalized needs the option max_speed_rad_s; or set velocity [rad/s]"
            )
        speed = np.array(message.normalized, np.float64)
        if (speed > 1.0).any():
            raise ConvertError(f"Actuators.normalized must be 0 to 1, got {speed.max()}")
        speed *= largest
    if not len(speed):
        raise ConvertError("Actuators.velocity is empty: it holds the speed of each rotor [rad/s]")
    _finite("rotor speeds", speed)
    if (speed < 0.0).any():
        raise ConvertError(f"rotor speeds must be >= 0, got {speed.min()} rad/s")
    return messages.MotorCommand(stamp_ns=_stamp_ns(message, context), speed=speed, sequence=context.sequence)


def attitude(data: Buffer, context: Context) -> messages.AttitudeCommand | None:
    """Convert a mavros_msgs/AttitudeTarget whose type_mask does not ignore the attitude.

    Body rates that it does not ignore either must be finite, and are not used: the attitude decides. Thrust 1
    is the option `max_thrust_n`.

    Returns:
        None if it ignores the attitude.
    """
    message = cdr.decode_record(data, "mavros_msgs/msg/AttitudeTarget")
    if message.type_mask & _IGNORE_ATTITUDE:
        return None
    for bit, axis in zip(_IGNORE_RATES, "xyz", strict=True):
        if not message.type_mask & bit:
            _finite(f"body_rate.{axis}", getattr(message.body_rate, axis))
    return messages.AttitudeCommand(
        stamp_ns=_stamp_ns(message, context),
        thrust_n=_thrust_n(message, context),
        orientation=_unit(message.orientation),
        sequence=context.sequence,
    )


def rates(data: Buffer, context: Context) -> messages.RateThrustCommand | None:
    """Convert a mavros_msgs/AttitudeTarget whose type_mask ignores the attitude, and no rate.

    Thrust 1 is the option `max_thrust_n`.

    Returns:
        None if it does not ignore the attitude.
    """
    message = cdr.decode_record(data, "mavros_msgs/msg/AttitudeTarget")
    if not message.type_mask & _IGNORE_ATTITUDE:
        return None
    if message.type_mask & sum(_IGNORE_RATES):
        raise ConvertError(
            f"type_mask {message.type_mask} ignores the attitude and a body rate: all three are needed then"
        )
    rate = _xyz(message.body_rate)
    _finite("body rates", rate)
    return messages.RateThrustCommand(
        stamp_ns=_stamp_ns(message, context),
        thrust_n=_thrust_n(message, context),
        body_rate=rate,
        sequence=context.sequence,
    )


def twist_stamped(data: Buffer, context: Context) -> messages.VelocityCommand:
    """Convert geometry_msgs/TwistStamped; its frame says what the velocity is relative to.

    base_link: the vehicle as it is tilted now (REP 147); base_footprint: level, x where its nose points; map
        or odom:
    the ground. For an empty frame the option `frame` decides: base_link (default), base_footprint or map.
    """
    message = cdr.decode_record(data, "geometry_msgs/msg/TwistStamped")
    frame = message.header.frame_id or context.options.get("frame", frames.BODY)
    return _velocity(message.twist, frame, _stamp_ns(message, context), context)


def twist(data: Buffer, context: Context) -> messages.VelocityCommand:
    """Convert geometry_msgs/Twist, in the frame that the option `frame` names, by default base_footprint."""
    message = cdr.decode_record(data, "geometry_msgs/msg/Twist")
    return _velocity(message, context.options.get("frame", frames.HEADING), context.now_ns, context)


def pose(data: Buffer, context: Context) -> messages.PoseCommand:
    """Convert geometry_msgs/PoseStamped in the map or odom frame: position and heading; tilt is not used."""
    message = cdr.decode_record(data, "geometry_msgs/msg/PoseStamped")
    return _pose_command(message, message.pose.position, message.pose.orientation, context)


def trajectory(data: Buffer, context: Context) -> messages.PoseCommand:
    """Convert the first point of a trajectory_msgs/MultiDOFJointTrajectory in the map or odom frame."""
    message = cdr.decode_record(data, "trajectory_msgs/msg/MultiDOFJointTrajectory")
    if not message.points:
        raise ConvertError("a trajectory without points")
    if not message.points[0].transforms:
        raise ConvertError("the first point of the trajectory has no transform")
    first = message.points[0].transforms[0]
    return _pose_command(message, first.translation, first.rotation, context)


def reset(data: Buffer, context: Context) -> messages.Reset:
    """Convert neurosim/Reset."""
    message = cdr.decode_record(data, "neurosim/msg/Reset")
    chosen: dict[str, Any] = {}
    if message.use_seed:
        chosen["seed"] = int(message.seed)
    if message.use_pose:
        chosen["position"] = _xyz(message.pose.position)
        _finite("position", chosen["position"])
        chosen["orientation"] = _unit(message.pose.orientation)
    if message.use_twist:
        chosen["velocity"] = _xyz(message.twist.linear)
        chosen["body_rate"] = _xyz(message.twist.angular)
        _finite("twist", chosen["velocity"], chosen["body_rate"])
    return messages.Reset(vehicle=message.vehicle, **chosen)


def reset_empty(data: Buffer, context: Context) -> messages.Reset:
    """Convert std_msgs/Empty to a reset to what is configured."""
    cdr.decode_record(data, "std_msgs/msg/Empty")
    return messages.Reset()


def trigger(data: Buffer, context: Context) -> messages.Trigger:
    """Convert std_msgs/Empty to a request without arguments."""
    cdr.decode_record(data, "std_msgs/msg/Empty")
    return messages.Trigger(context.sequence)


def steps(data: Buffer, context: Context) -> messages.Step:
    """Convert std_msgs/UInt32: control periods to go on for."""
    count = cdr.decode_record(data, "std_msgs/msg/UInt32").data
    if count < 1:
        raise ConvertError("a step of 0 control periods")
    return messages.Step(count)


OUT: Mapping[tuple[type[Any], str], Out] = {
    (messages.Clock, "rosgraph_msgs/msg/Clock"): clock,
    (messages.Imu, "sensor_msgs/msg/Imu"): imu,
    (messages.Odometry, "nav_msgs/msg/Odometry"): odometry,
    (messages.Odometry, "tf2_msgs/msg/TFMessage"): odometry_transform,
    (messages.Transform, "tf2_msgs/msg/TFMessage"): transform,
    (messages.Image, "sensor_msgs/msg/Image"): image,
    (messages.Image, "sensor_msgs/msg/CameraInfo"): image_camera_info,
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
    ("geometry_msgs/msg/PoseStamped", messages.PoseCommand): pose,
    ("trajectory_msgs/msg/MultiDOFJointTrajectory", messages.PoseCommand): trajectory,
    ("neurosim/msg/Reset", messages.Reset): reset,
    ("std_msgs/msg/Empty", messages.Reset): reset_empty,
    ("std_msgs/msg/Empty", messages.Trigger): trigger,
    ("std_msgs/msg/UInt32", messages.Step): steps,
}
"""Conversions from ROS, by the type in ROS and the class in Cortex. All of them also raise `cdr.CdrError`."""

OPTIONS: Mapping[Callable[..., Any], frozenset[str]] = {
    imu: frozenset({"angular_velocity_std_rad_s", "linear_acceleration_std_m_s2"}),
    odometry: frozenset(
        {"position_std_m", "orientation_std_rad", "velocity_std_m_s", "angular_velocity_std_rad_s"}
    ),
    event_packet: frozenset({"encoding"}),
    event_image: frozenset({"period_s"}),
    actuators: frozenset({"max_speed_rad_s"}),
    attitude: frozenset({"max_thrust_n"}),
    rates: frozenset({"max_thrust_n"}),
    twist_stamped: frozenset({"frame"}),
    twist: frozenset({"frame"}),
}
"""Names of the options that a conversion knows; the others know none."""


_OK, _WARN, _ERROR = 0, 1, 2
_IGNORE_RATES = (1, 2, 4)
_IGNORE_THRUST, _IGNORE_ATTITUDE = 64, 128
_POINT_FLOAT32 = 7
_NO_BYTES: Bytes = np.empty(0, np.uint8)
_NO_FLOATS: NDArray[np.float64] = np.empty(0)
_SECONDS_MIN, _SECONDS_MAX = -(2**31), 2**31 - 1
_NAMED_PIXELS = {
    "mono8": ("u1", 1),
    "mono16": ("u2", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "rgb16": ("u2", 3),
    "bgr16": ("u2", 3),
}
_PIXEL = re.compile(r"(8|16|32|64)([USF])C([1-9][0-9]*)")
_record = functools.cache(cdr.record_class)


class _Room:
    """Makes room behind the beginning of a message for what its last field holds: nothing is copied twice."""

    def __init__(self, prefix: memoryview) -> None:
        """Begin with a message whose last field is an empty sequence: the last 4 bytes are its length, 0."""
        self._prefix = prefix
        self._buffer = _NO_BYTES

    def make(self, size: int, *, count: int | None = None) -> Bytes:
        """Return so many bytes to write to, and up to 3 more; `count` elements, None: of one byte."""
        begin = len(self._prefix)
        self._buffer = np.empty(begin + (size + 3 & -4), np.uint8)
        self._buffer[:begin] = self._prefix
        self._buffer[begin - 4 : begin].view("<u4")[0] = size if count is None else count
        return self._buffer[begin:]

    def message(self) -> memoryview:
        """Return the message."""
        return self._buffer.data.toreadonly()


def _time(stamp_ns: int) -> Any:
    second, nanosecond = divmod(int(stamp_ns), 1_000_000_000)
    if not _SECONDS_MIN <= second <= _SECONDS_MAX:
        raise ConvertError(f"ROS has no time for a stamp of {stamp_ns} ns: seconds have 32 bits")
    return _record("builtin_interfaces/msg/Time")(second, nanosecond)


def _header(stamp_ns: int, frame: str, context: Context) -> Any:
    return _record("std_msgs/msg/Header")(_time(stamp_ns), context.frames.ros(frame))


def _vector(v: Iterable[float]) -> Any:
    x, y, z = v
    return _record("geometry_msgs/msg/Vector3")(x, y, z)


def _point(p: Iterable[float]) -> Any:
    x, y, z = p
    return _record("geometry_msgs/msg/Point")(x, y, z)


def _quaternion(q: Iterable[float]) -> Any:
    x, y, z, w = q
    return _record("geometry_msgs/msg/Quaternion")(x, y, z, w)


def _pose(position: Iterable[float], orientation: Iterable[float]) -> Any:
    return _record("geometry_msgs/msg/Pose")(_point(position), _quaternion(orientation))


def _diagonal(deviations: list[float]) -> NDArray[np.float64]:
    """Return a covariance without correlations, row by row."""
    covariance = np.zeros(len(deviations) ** 2)
    covariance[:: len(deviations) + 1] = np.square(deviations)
    return covariance


def _transform(
    stamp_ns: int, parent: str, child: str, translation: Iterable[float], rotation: Iterable[float]
) -> Any:
    return _record("geometry_msgs/msg/TransformStamped")(
        _record("std_msgs/msg/Header")(_time(stamp_ns), parent),
        child,
        _record("geometry_msgs/msg/Transform")(_vector(translation), _quaternion(rotation)),
    )


def _transform_of(message: messages.Transform, names: FrameNames) -> Any:
    what = f"transform to {message.child!r}"
    _finite(what, message.translation, message.rotation)
    if not message.child or not message.parent:
        raise ConvertError(f"a transform from {message.parent!r} to {message.child!r}")
    if names.ros(message.parent) == names.ros(message.child):
        raise ConvertError(f"{what}: its parent is itself, which tf2 refuses")
    if not np.any(message.rotation):
        raise ConvertError(f"{what}: its rotation is zero")
    return _transform(
        message.stamp_ns,
        names.ros(message.parent),
        names.ros(message.child),
        message.translation,
        message.rotation,
    )


def _transforms(records: list[Any]) -> Buffer:
    return cdr.encode(_record("tf2_msgs/msg/TFMessage")(records))


def _camera_info(stamp_ns: int, message: messages.CameraInfo | None, context: Context) -> Buffer | None:
    if message is None:
        return None
    matrix = np.array(message.matrix, np.float64)
    matrix[0, 2] -= 0.5
    matrix[1, 2] -= 0.5
    projection = np.zeros((3, 4))
    projection[:, :3] = matrix
    distortion = np.array(message.distortion, np.float64)
    if not message.distortion_model:
        distortion = np.zeros(5)
    record = _record("sensor_msgs/msg/CameraInfo")(
        _header(stamp_ns, message.frame_id or context.frame_id, context),
        message.height,
        message.width,
        message.distortion_model or "plumb_bob",
        distortion,
        matrix.reshape(-1),
        np.eye(3).reshape(-1),
        projection.reshape(-1),
        0,
        0,
        _record("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False),
    )
    return cdr.encode(record)


def _events_stamp_ns(message: messages.Events) -> int:
    """Return the time of the first event, or of the end of a window without any [ns]."""
    return int(message.t[0]) * 1000 if len(message.t) else message.stamp_ns


@functools.cache
def _pixel(encoding: str) -> tuple[np.dtype[Any], int]:
    """Return what one channel is, and how many there are."""
    kind, channels = _NAMED_PIXELS.get(encoding, ("", 0))
    general = _PIXEL.fullmatch(encoding)
    if general is not None:
        bits, letter, count = general.groups()
        kind, channels = f"{ {'U': 'u', 'S': 'i', 'F': 'f'}[letter] }{int(bits) // 8}", int(count)
    if not kind or kind == "f1":
        known = ", ".join(_NAMED_PIXELS)
        raise ConvertError(f"unknown encoding {encoding!r} of an image, known: {known}, and such as 32FC1")
    return np.dtype(kind), channels


def _of_length(name: str, values: NDArray[Any], count: int) -> NDArray[Any]:
    if len(values) != count:
        raise ConvertError(f"a point cloud with {count} points and {len(values)} values of {name}")
    return values


def _remembered(context: Context, name: str, make: Callable[[], Any]) -> Any:
    if name not in context.memory:
        context.memory[name] = make()
    return context.memory[name]


def _option(context: Context, name: str, default: float) -> float:
    value = context.options.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
        raise ConvertError(f"option {name} must be a number >= 0, got {value!r}")
    return float(value)


def _finite(what: str, *values: Any) -> None:
    for value in values:
        if not np.isfinite(value).all():
            raise ConvertError(f"{what}: not finite: {np.asarray(value).tolist()!s:.80}")


def _xyz(vector: Any) -> NDArray[np.float64]:
    return np.array([vector.x, vector.y, vector.z], np.float64)


def _unit(quaternion: Any) -> NDArray[np.float64]:
    q = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)
    _finite("orientation", q)
    norm = math.hypot(*q)
    if not 0.9 < norm < 1.1:  # rounded numbers of people are fine, zeros and angles are not
        raise ConvertError(f"orientation is no unit quaternion (x, y, z, w): {q.tolist()}")
    return q / norm


def _stamp_ns(message: Any, context: Context) -> int:
    stamp = message.header.stamp
    if stamp.sec < 0 or stamp.nanosec >= 1_000_000_000:
        raise ConvertError(f"a stamp of {stamp.sec} s and {stamp.nanosec} ns")
    return stamp.sec * 1_000_000_000 + stamp.nanosec or context.now_ns


def _thrust_n(message: Any, context: Context) -> float:
    if message.type_mask & _IGNORE_THRUST:
        raise ConvertError(f"type_mask {message.type_mask} ignores thrust, without which nothing flies")
    if not 0.0 <= message.thrust <= 1.0:  # also refuses nan
        raise ConvertError(f"thrust must be 0 to 1, got {message.thrust}")
    return float(message.thrust) * _option(context, "max_thrust_n", DEFAULT_MAX_THRUST_N)


def _velocity(message: Any, frame: str, stamp_ns: int, context: Context) -> messages.VelocityCommand:
    velocity, rate = _xyz(message.linear), _xyz(message.angular)
    _finite("velocity", velocity, rate)
    if rate[0] or rate[1]:
        raise ConvertError(
            f"angular.x and angular.y must be 0: only the heading can turn, got {rate.tolist()}"
        )
    kind = context.frames.kind_of(frame, context.vehicle)
    if kind is None:
        names = (
            f"{context.frames.body_of(context.vehicle)}, base_footprint, {context.frames.ros(frames.WORLD)}"
        )
        raise ConvertError(f"a velocity in frame {frame!r}, known: {names}")
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
        world = context.frames.ros(frames.WORLD)
        raise ConvertError(
            f"a pose in frame {frame!r}, known: {world}, {context.frames.odom_of(context.vehicle)}"
        )
    position = _xyz(point)
    _finite("position", position)
    return messages.PoseCommand(
        stamp_ns=_stamp_ns(message, context),
        position=position,
        yaw_rad=frames.yaw_rad(_unit(quaternion)),
        sequence=context.sequence,
    )
