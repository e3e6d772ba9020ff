"""Measurements of small sensors, as standard messages; in Cortex their types are known by schema only."""

from __future__ import annotations

import inspect
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
    values: Callable[..., tuple[Any, ...]]
    """Takes fields of the message in Cortex, and returns those in ROS after the header."""

    @property
    def fields(self) -> frozenset[str]:
        """Those that it must have in Cortex."""
        return frozenset(inspect.signature(self.values).parameters)

    def convert(self, message: Any, context: Context) -> Buffer:
        """Convert to `ros_type`."""
        head = header(message.stamp_ns, message.frame_id or context.frame_id, context)
        given = {name: getattr(message, name) for name in self.fields}
        return cdr.encode(record(self.ros_type)(head, *self.values(**given)))


def _range(
    field_of_view_rad: float, range_min_m: float, range_max_m: float, distance_m: float
) -> tuple[Any, ...]:
    """Return the fields of a Range; -inf and inf are as in REP 117. Humble has no variance, the last."""
    return _INFRARED, field_of_view_rad, range_min_m, range_max_m, distance_m, 0.0


def _fluid_pressure(pressure_pa: float) -> tuple[Any, ...]:
    return pressure_pa, 0.0


def _magnetic_field(field: Any) -> tuple[Any, ...]:
    check_finite("magnetic field", field)
    return vector(field), np.zeros(9)


def _fix(latitude_rad: float, longitude_rad: float, altitude_m: float, position_std: Any) -> tuple[Any, ...]:
    """Return the fields of a NavSatFix: degrees; its velocity has no place there."""
    place = math.degrees(latitude_rad), math.degrees(longitude_rad), altitude_m
    check_finite("position", *place)
    status = record("sensor_msgs/msg/NavSatStatus")(_FIX, _GPS)
    return status, *place, np.diag(np.square(position_std)).reshape(-1), _DIAGONAL_KNOWN


MEASUREMENTS: Mapping[str, Measurement] = {
    "neurosim/Range": Measurement("sensor_msgs/msg/Range", _range),
    "neurosim/Pressure": Measurement("sensor_msgs/msg/FluidPressure", _fluid_pressure),
    "neurosim/MagneticField": Measurement("sensor_msgs/msg/MagneticField", _magnetic_field),
    "neurosim/GpsFix": Measurement("sensor_msgs/msg/NavSatFix", _fix),
}
"""By the name of the type in Cortex. One whose fields differ goes out field by field, as others do."""
