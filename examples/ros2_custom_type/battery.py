"""A message type of one's own, and how it crosses to ROS 2 and back: this file is all that is needed.

    cortex-ros2-bridge --converter examples/ros2_custom_type/battery.py

or, in an installed package, in pyproject.toml:

    [project.entry-points."cortex_ros2_bridge.converters"]
    battery = "my_package.battery"
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from cortex import Array, Unit, message
from cortex_ros2_bridge.convert import Context, ConvertError, from_ros, to_ros
from cortex_ros2_bridge.msgs import BatteryState


@message(name="my_robot/Battery")
class Battery:
    """The battery of a vehicle."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the measurement [ns]."""
    cell_voltage: Annotated[Array["float32", "cells"], Unit("V")]
    """Voltage of each cell [V], shape [cells]."""
    current_a: Annotated[float, Unit("A")]
    """Current that is drawn [A]."""


@to_ros(Battery, "sensor_msgs/msg/BatteryState", name="{topic}_state")
def state_of(battery: Battery, context: Context) -> Any:
    """Return a sensor_msgs/BatteryState; ROS counts a discharging current as negative."""
    if not len(battery.cell_voltage):
        raise ConvertError("a battery without cells")
    state = BatteryState(cell_voltage=battery.cell_voltage, current=-battery.current_a, present=True)
    state.header.stamp.sec, state.header.stamp.nanosec = divmod(battery.stamp_ns, 1_000_000_000)
    state.header.frame_id = context.frames.body_of(context.vehicle)
    state.voltage = float(battery.cell_voltage.sum())
    return state


@from_ros("sensor_msgs/msg/BatteryState", Battery, name="{topic}_state")
def battery_of(state: Any, context: Context) -> Battery:
    """Return the battery of a sensor_msgs/BatteryState."""
    stamp = state.header.stamp
    voltage = np.array(state.cell_voltage, np.float32)
    return Battery(stamp.sec * 1_000_000_000 + stamp.nanosec, voltage, -state.current)
