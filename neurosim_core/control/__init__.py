"""Control: geometric tracking on SE(3) in six command modes, for one vehicle or thousands."""

from neurosim_core.control.base import (
    ControllerConfig,
    ControllerContext,
    HostController,
    PathController,
    Se3ControllerConfig,
)
from neurosim_core.control.follow import FollowMode, PathFollower
from neurosim_core.control.modes import MODES, CommandMode, Controller, Mode, mode_kernel
from neurosim_core.control.se3 import Se3Config

__all__ = [
    "MODES",
    "CommandMode",
    "Controller",
    "ControllerConfig",
    "ControllerContext",
    "FollowMode",
    "HostController",
    "Mode",
    "PathController",
    "PathFollower",
    "Se3Config",
    "Se3ControllerConfig",
    "mode_kernel",
]
