"""Parts of messages of ROS 2, as plain records: stamps, headers, vectors, transforms."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.convert.context import Context, ConvertError

_SECONDS_MIN, _SECONDS_MAX = -(2**31), 2**31 - 1
record = functools.cache(cdr.record_class)
"""The class of plain records of a type, see `cdr.record_class`."""


def time_of(stamp_ns: int) -> Any:
    """Return a builtin_interfaces/Time.

    Raises:
        ConvertError: ROS has none for it: its seconds have 32 bits.
    """
    second, nanosecond = divmod(int(stamp_ns), 1_000_000_000)
    if not _SECONDS_MIN <= second <= _SECONDS_MAX:
        raise ConvertError(f"ROS has no time for a stamp of {stamp_ns} ns: seconds have 32 bits")
    return record("builtin_interfaces/msg/Time")(second, nanosecond)


def stamp_ns_of(time: Any) -> int:
    """Return the nanoseconds of a builtin_interfaces/Time."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def header(stamp_ns: int, frame: str, context: Context) -> Any:
    """Return a header with the name in ROS of a frame of Cortex."""
    return record("std_msgs/msg/Header")(time_of(stamp_ns), context.frames.ros(frame))


def vector(v: Iterable[float]) -> Any:
    """Return a geometry_msgs/Vector3."""
    return record("geometry_msgs/msg/Vector3")(*v)


def point(p: Iterable[float]) -> Any:
    """Return a geometry_msgs/Point."""
    return record("geometry_msgs/msg/Point")(*p)


def quaternion(q: Iterable[float]) -> Any:
    """Return a geometry_msgs/Quaternion of xyzw."""
    return record("geometry_msgs/msg/Quaternion")(*q)


def pose_of(position: Iterable[float], orientation: Iterable[float]) -> Any:
    """Return a geometry_msgs/Pose."""
    return record("geometry_msgs/msg/Pose")(point(position), quaternion(orientation))


def transform_record(
    stamp_ns: int, parent: str, child: str, translation: Iterable[float], rotation: Iterable[float]
) -> Any:
    """Return a geometry_msgs/TransformStamped between frames by their names in ROS."""
    return record("geometry_msgs/msg/TransformStamped")(
        record("std_msgs/msg/Header")(time_of(stamp_ns), parent),
        child,
        record("geometry_msgs/msg/Transform")(vector(translation), quaternion(rotation)),
    )


def status_record(
    level: int, name: str, message: str, hardware: str, values: Iterable[tuple[str, str]]
) -> Any:
    """Return a diagnostic_msgs/DiagnosticStatus."""
    pairs = [record("diagnostic_msgs/msg/KeyValue")(*value) for value in values]
    return record("diagnostic_msgs/msg/DiagnosticStatus")(level, name, message, hardware, pairs)
