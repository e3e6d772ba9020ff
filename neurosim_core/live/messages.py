"""Packets of sensors as messages of Cortex, and back: one message type for each packet type.

Well-known packets use the standard types of `cortex.messages`. The message type of any other packet is
derived from its fields, so that a new sensor needs no change here. A field of the packet becomes the field of
the same name; `sensor` is left out, as the topic says it, and `frame_id` names the frame of the sensor.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import cortex
from cortex import messages as msg
from neurosim_core import packets as pkt
from neurosim_core.live.topics import COMMANDS, WORLD_FRAME, body_frame, sensor_frame
from neurosim_core.record.header import SensorDescription
from neurosim_core.trajectory import Path

ClockNs = Callable[[int], int]
"""Returns what a sensor's clock shows at a simulated time [ns]."""

_TYPES: dict[type[pkt.Packet], type[Any]] = {
    pkt.Events: msg.Events,
    pkt.Image: msg.Image,
    pkt.PointCloud: msg.PointCloud,
    pkt.ImuSample: msg.Imu,
    pkt.Odometry: msg.Odometry,
    pkt.Collision: msg.Collision,
    pkt.Delivery: msg.Delivery,
}
"""The message type of each packet type; `message_type` adds those that it derives."""
_TIMES = ("stamp_ns", "start_ns")
"""Fields that the clock of a sensor applies to."""
_SCALARS = {"bool": bool, "str": str}


def message_type(packet: type[pkt.Packet]) -> type[Any]:
    """Return the message type that carries a packet type; derive it at the first call.

    The derived type is called `neurosim/NAME`. Its fields are `stamp_ns`, the packet's own in their order,
    `sequence` and `frame_id`. The schema of the packet gives their types, axes, units and frames.

    Raises:
        TypeError: A field has a type, or an array axes, that no message can have.
    """
    if packet not in _TYPES:
        annotations: dict[str, Any] = {"stamp_ns": Annotated[int, cortex.Unit("ns")]}
        annotations |= {field.name: _field_type(packet, field) for field in pkt.schema_of(packet).fields}
        annotations |= {"sequence": cortex.UInt64, "frame_id": str}
        namespace = {"__annotations__": annotations, "__doc__": packet.__doc__, "__module__": __name__}
        derived = type(packet.__name__, (), namespace)
        _TYPES[packet] = cortex.message(derived, name=f"neurosim/{packet.__name__}")
    return _TYPES[packet]


def _field_type(packet: type[pkt.Packet], field: pkt.FieldSchema) -> Any:
    """Return the annotation of a message field for a packet field."""
    if "..." in field.shape:
        raise TypeError(
            f"{packet.__name__}.{field.name}: the array needs axes, such as "
            "Annotated[NDArray[np.float32], FieldSpec('n', 3)]"
        )
    if field.shape:
        parameters = (field.dtype, *field.shape)
        base: Any = cortex.Array[parameters]
    else:
        base = _SCALARS.get(field.dtype, float if field.dtype.startswith("float") else int)
    has_unit = bool(field.unit or field.frame)
    return Annotated[base, cortex.Unit(field.unit, field.frame)] if has_unit else base


def to_message(packet: pkt.Packet, *, frame_id: str = "", clock_ns: ClockNs | None = None) -> Any:
    """Return a packet as a message.

    `frame_id`: name of the sensor's frame, for messages that have one. `clock_ns`: the sensor's clock; None:
    simulated time. Event times move by whole microseconds.
    """
    kind = message_type(type(packet))
    values: dict[str, Any] = {}
    for name in kind.__dataclass_fields__:  # `dataclasses.fields` takes longer, in every control period
        if name == "frame_id":
            values[name] = frame_id
            continue
        value = getattr(packet, name)
        if clock_ns is not None and name in _TIMES:
            value = clock_ns(value)
        elif type(value) is not np.ndarray and hasattr(value, "numpy"):  # an array on a device
            value = value.numpy()
        values[name] = value
    if isinstance(packet, pkt.Image) and packet.data.ndim == 2:
        values["data"] = packet.data[:, :, None]
    if isinstance(packet, pkt.Events) and clock_ns is not None:
        values["t"] = _on_clock(values["t"], packet, clock_ns)
    return kind(**values)


def to_packet(message: Any, sensor: str) -> pkt.Packet:
    """Return a message as the packet of a sensor; its arrays are not copied.

    Args:
        message: Of a type that `message_type` returns. Odometry has no rotor speeds: the packet has none.
        sensor: Name of the sensor.

    Raises:
        TypeError: No packet has this message type.
    """
    kind = next((packet for packet, known in _TYPES.items() if known is type(message)), None)
    if kind is None:
        raise TypeError(f"no packet for a message of type {type(message).__name__}")
    names = {field.name for field in dataclasses.fields(kind)} - {"sensor"}
    values = {f.name: getattr(message, f.name) for f in dataclasses.fields(message) if f.name in names}
    if kind is pkt.Odometry:
        values["rotor_speed"] = np.zeros(0)
    if kind is pkt.Image and message.data.shape[2] == 1:
        values["data"] = message.data[:, :, 0]
    return kind(**values, sensor=sensor)


def rotor_speeds(packet: pkt.Odometry, *, clock_ns: ClockNs | None = None) -> msg.RotorSpeeds:
    """Return the rotor speeds of an odometry packet, which `msg.Odometry` does not have."""
    stamp_ns = packet.stamp_ns if clock_ns is None else clock_ns(packet.stamp_ns)
    return msg.RotorSpeeds(stamp_ns=stamp_ns, speed=packet.rotor_speed, sequence=packet.sequence)


def _on_clock(t_us: NDArray[np.int64], packet: pkt.Events, clock_ns: ClockNs) -> NDArray[np.int64]:
    """Move event times to a sensor's clock: linear between the ends of the window."""
    begin, end = packet.start_ns, packet.stamp_ns
    shift = [clock_ns(begin) - begin, clock_ns(end) - end]
    shift_us = np.floor(np.interp(t_us * 1000, [begin, end], shift) / 1000)
    return np.asarray(t_us + shift_us.astype(np.int64))


_COMMAND_FIELDS: Mapping[str, Mapping[str, int | slice]] = {
    "motor_speeds": {"speed": slice(None)},
    "rates": {"thrust_n": 0, "body_rate": slice(1, 4)},
    "attitude": {"thrust_n": 0, "orientation": slice(1, 5)},
    "velocity": {"velocity": slice(0, 3), "yaw_rate_rad_s": 3},
    "position": {"position": slice(0, 3), "yaw_rad": 3},
}
"""Where the fields of each command message lie in the row of setpoints, see `control.modes.MODES`."""


def setpoint_of(mode: str, command: Any) -> NDArray[np.float64]:
    """Return a command as a row of setpoints, laid out as in `control.modes.MODES`; shape [n]."""
    parts = [np.atleast_1d(getattr(command, name)) for name in _COMMAND_FIELDS[mode]]
    return np.concatenate(parts, dtype=np.float64)


def command_of(mode: str, setpoint: ArrayLike, *, stamp_ns: int, sequence: int = 0) -> Any:
    """Return the command for a row of setpoints; the inverse of `setpoint_of`.

    `mode`: one of `topics.COMMANDS`. `setpoint`: row as in `control.modes.MODES`. `stamp_ns`: time of the
    state that the command answers [ns].
    """
    if mode not in COMMANDS:
        raise ValueError(f"unknown command mode {mode!r}, known: {', '.join(COMMANDS)}")
    row = np.array(setpoint, dtype=np.float64)
    values = {
        name: float(row[place]) if isinstance(place, int) else row[place]
        for name, place in _COMMAND_FIELDS[mode].items()
    }
    return COMMANDS[mode](**values, stamp_ns=stamp_ns, sequence=sequence)


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
        distortion_model=lens.distortion_model,
        distortion=np.array(lens.distortion, dtype=np.float64),
        frame_id=sensor_frame(vehicle, sensor),
    )


def mount_transform(vehicle: str, sensor: SensorDescription) -> msg.Transform:
    """Return the pose of a sensor on its vehicle."""
    return msg.Transform(
        stamp_ns=0,
        parent=body_frame(vehicle),
        child=sensor_frame(vehicle, sensor),
        translation=np.array(sensor.position, dtype=np.float64),
        rotation=np.array(sensor.orientation, dtype=np.float64),
    )


def path_message(path: Path, *, end_ns: int, count: int = 1001) -> msg.Path:
    """Return a planned path from its start to `end_ns`, at `count` equal intervals of time."""
    stamps = np.linspace(0, end_ns, count).astype(np.int64)
    return msg.Path(stamp_ns=0, time_ns=stamps, position=path.evaluate(stamps).position, frame_id=WORLD_FRAME)
