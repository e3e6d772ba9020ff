"""Messages of Cortex to messages of ROS 2, as CDR, and back: a table of pure functions (`registry.RULES`).

Stamps are the same numbers on both sides: simulated time. What is given in another frame or by another
convention in ROS is said at each function. What cannot be used is refused, with a reason.
"""

from cortex_ros2_bridge.convert import camera, commands, events, robot, simulator, state
from cortex_ros2_bridge.convert.context import Context, ConvertError
from cortex_ros2_bridge.convert.registry import RULES, from_ros, share, to_ros
from cortex_ros2_bridge.convert.state import static_transforms, transform_of

__all__ = [
    "RULES",
    "Context",
    "ConvertError",
    "camera",
    "commands",
    "events",
    "from_ros",
    "robot",
    "share",
    "simulator",
    "state",
    "static_transforms",
    "to_ros",
    "transform_of",
]
