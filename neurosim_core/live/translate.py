"""Packets of the simulator to messages of Cortex, and back: the same numbers, other records."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortex import messages as msg
from neurosim_core import packets as pkt
from neurosim_core.live.topics import COMMANDS, WORLD_FRAME, body_frame, sensor_frame
from neurosim_core.record.header import SensorDescription
from neurosim_core.sensors.rig import EventSensorConfig
from neurosim_core.trajectory import Path

_PIXEL_EVENTS_HZ = 100.0
"""How often a pixel of an event camera may fire, on the average of all, in fast flight [Hz]: 80 were seen."""
_EVENT_BYTES = 13
"""Of one event in a message: x, y, t and polarity [bytes]."""
_OTHER_BYTES = 4096
"""More than all else in a message of events [bytes]."""
_RESERVE_MAX_BYTES = 8 << 20
"""The largest message that memory is reserved for [bytes]: a ring holds at least four."""


def message_type(kind: str) -> type[Any]:
    """Return the message that carries the packets of a kind of sensor.

    Raises:
        KeyError: There is no such kind.
    """
    return {
        "event_camera": msg.Events,
        "rgb": msg.Image,
        "depth": msg.Image,
        "imu": msg.Imu,
        "odometry": msg.Odometry,
    }[kind]


def expected_bytes(sensor: object) -> int:
    """Return what the messages of a sensor will hardly be larger than [bytes]; 0 if that is not known.

    Known of event cameras: on the average of all, pixels hardly fire more than a hundred times a second.
    """
    if not isinstance(sensor, EventSensorConfig):
        return 0
    window_s = sensor.packets.stamp_ns(1) * 1e-9
    count = _PIXEL_EVENTS_HZ * window_s * sensor.lens.width * sensor.lens.height
    return min(round(count) * _EVENT_BYTES + _OTHER_BYTES, _RESERVE_MAX_BYTES)


def to_message(
    packet: pkt.Packet, *, frame_id: str = "", clock_ns: Callable[[int], int] | None = None
) -> Any:
    """Return a packet as a message.

    Args:
        packet: Of any type but `Delivery`; its arrays are taken over, not copied.
        frame_id: Name of the sensor's frame, where the message has one.
        clock_ns: Gives what the sensor's clock shows at a simulated time [ns]; None: the same. The times of
            events are moved by whole microseconds.

    Raises:
        TypeError: There is no message for the packet.
    """
    stamp_ns = packet.stamp_ns if clock_ns is None else clock_ns(packet.stamp_ns)
    if isinstance(packet, pkt.Events):
        arrays = packet.numpy()
        t, start_ns = arrays.t, packet.start_ns
        if clock_ns is not None:
            t = _on_clock(t, packet, clock_ns)
            start_ns = clock_ns(start_ns)
        return msg.Events(
            stamp_ns=stamp_ns,
            x=arrays.x,
            y=arrays.y,
            t=t,
            polarity=arrays.polarity,
            width=packet.width,
            height=packet.height,
            start_ns=start_ns,
            dropped_count=packet.dropped_count,
            frame_id=frame_id,
            sequence=packet.sequence,
        )
    if isinstance(packet, pkt.Image):
        data = packet.data if packet.data.ndim == 3 else packet.data[:, :, None]
        return msg.Image(
            stamp_ns=stamp_ns,
            data=data,
            encoding=packet.encoding,
            frame_id=frame_id,
            sequence=packet.sequence,
        )
    if isinstance(packet, pkt.ImuSample):
        return msg.Imu(
            stamp_ns=stamp_ns,
            specific_force=packet.specific_force,
            angular_rate=packet.angular_rate,
            sequence=packet.sequence,
        )
    if isinstance(packet, pkt.Odometry):
        return msg.Odometry(
            stamp_ns=stamp_ns,
            position=packet.position,
            orientation=packet.orientation,
            velocity=packet.velocity,
            body_rate=packet.body_rate,
            sequence=packet.sequence,
        )
    if isinstance(packet, pkt.Collision):
        return msg.Collision(
            stamp_ns=stamp_ns,
            position=packet.position,
            clearance_m=packet.clearance_m,
            sequence=packet.sequence,
        )
    raise TypeError(f"no message carries a {type(packet).__name__}")


def rotor_speeds(packet: pkt.Odometry, *, clock_ns: Callable[[int], int] | None = None) -> msg.RotorSpeeds:
    """Return the rotor speeds of an odometry packet, which `msg.Odometry` does not have."""
    stamp_ns = packet.stamp_ns if clock_ns is None else clock_ns(packet.stamp_ns)
    return msg.RotorSpeeds(stamp_ns=stamp_ns, speed=packet.rotor_speed, sequence=packet.sequence)


def to_packet(message: Any, sensor: str, *, rotor_speed: ArrayLike = ()) -> pkt.Packet:
    """Return a message as the packet of a sensor; its arrays are not copied.

    Args:
        message: Events, Image, Imu, Odometry or Collision.
        sensor: Name of the sensor.
        rotor_speed: Speeds to put into an odometry packet [rad/s], shape [R].

    Raises:
        TypeError: There is no packet for the message.
    """
    header: dict[str, Any] = {
        "stamp_ns": message.stamp_ns,
        "sequence": message.sequence,
        "sensor": sensor,
    }
    if isinstance(message, msg.Events):
        return pkt.Events(
            **header,
            t=message.t,
            x=message.x,
            y=message.y,
            polarity=message.polarity,
            width=message.width,
            height=message.height,
            start_ns=message.start_ns,
            dropped_count=message.dropped_count,
        )
    if isinstance(message, msg.Image):
        one_channel = message.data.ndim == 3 and message.data.shape[2] == 1
        encoding: Any = message.encoding
        data = message.data[:, :, 0] if one_channel else message.data
        return pkt.Image(**header, data=data, encoding=encoding)
    if isinstance(message, msg.Imu):
        return pkt.ImuSample(
            **header, specific_force=message.specific_force, angular_rate=message.angular_rate
        )
    if isinstance(message, msg.Odometry):
        return pkt.Odometry(
            **header,
            position=message.position,
            orientation=message.orientation,
            velocity=message.velocity,
            body_rate=message.body_rate,
            rotor_speed=np.asarray(rotor_speed, dtype=np.float64),
        )
    if isinstance(message, msg.Collision):
        return pkt.Collision(**header, position=message.position, clearance_m=message.clearance_m)
    raise TypeError(f"no packet for a {type(message).__name__}")


def setpoint_of(mode: str, command: Any) -> NDArray[np.float64]:
    """Return a command as a row of setpoints, laid out as in `control.modes.MODES`; shape [n]."""
    if mode == "motor_speeds":
        return np.array(command.speed, dtype=np.float64)
    if mode == "rates":
        return np.array([command.thrust_n, *command.body_rate])
    if mode == "attitude":
        return np.array([command.thrust_n, *command.orientation])
    if mode == "velocity":
        return np.array([*command.velocity, command.yaw_rate_rad_s])
    return np.array([*command.position, command.yaw_rad])


def command_of(mode: str, setpoint: ArrayLike, *, stamp_ns: int, sequence: int = 0) -> Any:
    """Return the command for a row of setpoints; the inverse of `setpoint_of`.

    Args:
        mode: One of `topics.COMMANDS`.
        setpoint: Row as in `control.modes.MODES`.
        stamp_ns: Time of the state that the command answers [ns].
        sequence: Counts the commands.
    """
    row = np.array(setpoint, dtype=np.float64)
    header: dict[str, Any] = {"stamp_ns": stamp_ns, "sequence": sequence}
    if mode == "motor_speeds":
        return msg.MotorCommand(speed=row, **header)
    if mode == "rates":
        return msg.RateThrustCommand(thrust_n=float(row[0]), body_rate=row[1:4], **header)
    if mode == "attitude":
        return msg.AttitudeCommand(thrust_n=float(row[0]), orientation=row[1:5], **header)
    if mode == "velocity":
        return msg.VelocityCommand(velocity=row[:3], yaw_rate_rad_s=float(row[3]), **header)
    if mode == "position":
        return msg.PoseCommand(position=row[:3], yaw_rad=float(row[3]), **header)
    raise ValueError(f"unknown command mode {mode!r}, known: {', '.join(COMMANDS)}")


def camera_info(vehicle: str, sensor: SensorDescription) -> msg.CameraInfo | None:
    """Return the calibration of a camera; None for other sensors."""
    lens = sensor.intrinsics
    if lens is None:
        return None
    return msg.CameraInfo(
        stamp_ns=0,
        width=lens.width,
        height=lens.height,
        matrix=np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]]),
        distortion_model="",
        distortion=np.zeros(0),
        frame_id=sensor_frame(vehicle, sensor.name, sensor.kind),
    )


def mount_transform(vehicle: str, sensor: SensorDescription) -> msg.Transform:
    """Return where a sensor sits on its vehicle."""
    return msg.Transform(
        stamp_ns=0,
        parent=body_frame(vehicle),
        child=sensor_frame(vehicle, sensor.name, sensor.kind),
        translation=np.array(sensor.position, dtype=np.float64),
        rotation=np.array(sensor.orientation, dtype=np.float64),
    )


def path_message(path: Path, *, end_ns: int, count: int = 1001) -> msg.Path:
    """Return a planned path from its start to `end_ns`, at `count` equal intervals of time."""
    stamps = np.linspace(0, end_ns, count).astype(np.int64)
    return msg.Path(stamp_ns=0, time_ns=stamps, position=path.evaluate(stamps).position, frame_id=WORLD_FRAME)


def _on_clock(
    t_us: NDArray[np.int64], packet: pkt.Events, clock_ns: Callable[[int], int]
) -> NDArray[np.int64]:
    """Move event times to a sensor's clock: linear between the ends of the window."""
    begin, end = packet.start_ns, packet.stamp_ns
    shift = [clock_ns(begin) - begin, clock_ns(end) - end]
    moved: NDArray[np.int64] = t_us + np.floor(np.interp(t_us * 1000, [begin, end], shift) / 1000).astype(
        np.int64
    )
    return moved
