"""What small sensors measure, as standard messages; in Cortex their types are known by schema only."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.convert.context import Context, check_finite
from cortex_ros2_bridge.convert.records import header, record, vector

_INFRARED, _FIX, _GPS, _DIAGONAL_KNOWN = 1, 0, 1, 2


class Measurement(NamedTuple):
    """How a type goes out."""

    ros_type: str
    fields: frozenset[str]
    """Those that it must have in Cortex."""
    values: Callable[[Any], tuple[Any, ...]]
    """Returns the fields of the message in ROS after its header."""

    def convert(self, message: Any, context: Context) -> Buffer:
        """Convert to `ros_type`."""
        head = header(message.stamp_ns, message.frame_id or context.frame_id, context)
        return cdr.encode(record(self.ros_type)(head, *self.values(message)))


def _range(message: Any) -> tuple[Any, ...]:
    """Return the fields of a Range; -inf and inf are as in REP 117. Humble has no variance, the last."""
    limits = message.range_min_m, message.range_max_m
    return _INFRARED, message.field_of_view_rad, *limits, message.distance_m, 0.0


def _fluid_pressure(message: Any) -> tuple[Any, ...]:
    return message.pressure_pa, 0.0


def _magnetic_field(message: Any) -> tuple[Any, ...]:
    check_finite("magnetic field", message.field)
    return vector(message.field), np.zeros(9)


def _fix(message: Any) -> tuple[Any, ...]:
    """Return the fields of a NavSatFix: degrees; its velocity has no place there."""
    place = math.degrees(message.latitude_rad), math.degrees(message.longitude_rad), message.altitude_m
    check_finite("position", *place)
    status = record("sensor_msgs/msg/NavSatStatus")(_FIX, _GPS)
    return status, *place, np.diag(np.square(message.position_std)).reshape(-1), _DIAGONAL_KNOWN


MEASUREMENTS: Mapping[str, Measurement] = {
    "neurosim/Range": Measurement(
        "sensor_msgs/msg/Range",
        frozenset({"distance_m", "field_of_view_rad", "range_min_m", "range_max_m"}),
        _range,
    ),
    "neurosim/Pressure": Measurement(
        "sensor_msgs/msg/FluidPressure", frozenset({"pressure_pa"}), _fluid_pressure
    ),
    "neurosim/MagneticField": Measurement(
        "sensor_msgs/msg/MagneticField", frozenset({"field"}), _magnetic_field
    ),
    "neurosim/GpsFix": Measurement(
        "sensor_msgs/msg/NavSatFix",
        frozenset({"latitude_rad", "longitude_rad", "altitude_m", "position_std"}),
        _fix,
    ),
}
"""By the name of the type in Cortex. One whose fields differ goes out field by field, as others do."""
