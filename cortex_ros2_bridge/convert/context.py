"""The context of conversions besides the message, and the error of what they refuse."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import messages
from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.frames import FrameNames
from cortex_ros2_bridge.options import OPTIONS, check_option


class ConvertError(ValueError):
    """A message cannot be used; the text says why."""


@dataclass(kw_only=True)
class Context:
    """What the conversion of one route needs besides the message; whoever converts keeps it up to date.

    Raises:
        ValueError: An option is not what it must be.
    """

    frames: FrameNames = field(default_factory=FrameNames)
    """Names of frames in ROS."""
    vehicle: str = ""
    """Whose message it is: "drone" for /drone/imu."""
    frame_id: str = ""
    """Frame of a message that does not name its own, as Cortex calls it, such as "drone/imu"."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the route, see `options.OPTIONS`."""
    camera_info: messages.CameraInfo | None = None
    """Newest calibration of the camera."""
    odometry: messages.Odometry | None = None
    """Newest state of the vehicle, to turn velocities that are given in its body frame."""
    max_thrust_n: float | None = None
    """Thrust of the vehicle at full speed of its rotors [N]; None: the simulator does not say."""
    ranges: messages.CommandRanges | None = None
    """What the vehicle can be asked for; None: the simulator does not say."""
    excess: str = ""
    """What of the last command was out of range and has been clamped; empty if nothing was."""
    now_ns: int = 0
    """Newest time that is known [ns]; commands without a stamp get it."""
    sequence: int = 0
    """Messages that were sent before."""
    memory: dict[str, Any] = field(default_factory=dict)
    """What a conversion keeps from message to message."""

    def __post_init__(self) -> None:
        for name, value in self.options.items():
            check_option(name, value)

    def option(self, name: str) -> Any:
        """Return an option of the route, or its default."""
        return self.options.get(name, OPTIONS[name].default)

    def within(self, what: str, value: NDArray[np.float64], limit: str, unit: str) -> NDArray[np.float64]:
        """Return a part of a command, clamped to its range.

        Args:
            what: Name of the part, for people.
            value: Finite numbers, any shape; the length of "velocity" and "body rate" is limited, the size of
                each element of the others.
            limit: Option that sets the limit.
            unit: Of the numbers, for people.

        Raises:
            ConvertError: The value is out of range, and that is refused.
        """
        field, fallback = _LIMITS[limit]
        highest = self.option(limit)
        if highest is None:
            highest = fallback if self.ranges is None else getattr(self.ranges, field)
        size = math.hypot(*value.tolist()) if what in _VECTORS else float(np.abs(value).max(initial=0.0))
        if size <= highest:
            return value
        excess = f"a {what} of {size:.6g} {unit} is out of range: up to {highest:.6g} {unit}"
        beyond = self.option("beyond")
        if beyond == "refuse" or (beyond is None and self.ranges is not None and self.ranges.refuse):
            raise ConvertError(excess)
        self.excess = excess
        if what in _VECTORS:
            largest = float(np.abs(value).max())
            direction = value / largest  # the length itself may be beyond float64
            size = math.hypot(*direction.tolist()) * (1.0 + 1e-14)  # not beyond by a rounding
            return np.asarray(direction * (highest / size))
        return np.asarray(np.clip(value, -highest, highest))


_VECTORS = ("velocity", "body rate")
_LIMITS = {
    "max_speed_rad_s": ("rotor_speed_max_rad_s", math.inf),
    "max_speed_m_s": ("speed_max_m_s", 100.0),
    "max_rate_rad_s": ("body_rate_max_rad_s", 34.9),
    "max_position_m": ("position_max_m", 10_000.0),
}
"""By option: where the simulator says the limit of its vehicle, and what holds if it does not."""

Out = Callable[[Any, Context], "Buffer | None"]
"""Makes CDR of a message of Cortex; None: there is nothing to send now."""
In = Callable[[Buffer, Context], Any]
"""Makes a message of Cortex of CDR; None: the message of ROS is meant for another route."""


def check_finite(what: str, *values: Any) -> None:
    """Raise `ConvertError` unless all numbers are finite."""
    for value in values:
        if not np.isfinite(value).all():
            raise ConvertError(f"{what}: not finite: {np.asarray(value).tolist()!s:.80}")
