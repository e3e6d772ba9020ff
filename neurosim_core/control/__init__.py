"""Control: geometric tracking on SE(3) in six command modes, for one vehicle or thousands."""

from neurosim_core.control.follow import FollowMode, PathFollower
from neurosim_core.control.modes import MODES, CommandMode, Controller, Mode, make_controller, mode_kernel
from neurosim_core.control.se3 import Se3Config

__all__ = [
    "MODES",
    "CommandMode",
    "Controller",
    "FollowMode",
    "Mode",
    "PathFollower",
    "Se3Config",
    "make_controller",
    "mode_kernel",
]
