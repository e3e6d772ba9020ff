"""What conversions know besides a message, and what they refuse."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

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

    def remembered(self, name: str, make: Callable[[], Any]) -> Any:
        """Return what is kept under a name; made when it is first asked for."""
        if name not in self.memory:
            self.memory[name] = make()
        return self.memory[name]


Out = Callable[[Any, Context], "Buffer | None"]
"""Makes CDR of a message of Cortex; None: there is nothing to send now."""
In = Callable[[Buffer, Context], Any]
"""Makes a message of Cortex of CDR; None: the message of ROS is meant for another route."""


def check_finite(what: str, *values: Any) -> None:
    """Raise `ConvertError` unless all numbers are finite."""
    for value in values:
        if not np.isfinite(value).all():
            raise ConvertError(f"{what}: not finite: {np.asarray(value).tolist()!s:.80}")
