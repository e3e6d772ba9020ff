# mypy: disable-error-code="attr-defined"
"""Following a path from outside of the simulation: the state of one vehicle in, a command out."""

from __future__ import annotations

import math
import operator
from typing import Literal, get_args

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.control.base import (
    ControllerConfig,
    ControllerContext,
    PathController,
    Se3ControllerConfig,
)
from neurosim_core.control.modes import Controller
from neurosim_core.control.se3 import Se3Config
from neurosim_core.frames import heading_rad
from neurosim_core.trajectory.path import Path, PathCursor
from neurosim_core.vehicle.airframe import MultirotorConfig
from neurosim_core.vehicle.arrays import MultirotorArrays, allocate_arrays

FollowMode = Literal["motor_speeds", "velocity", "position"]
"""What a follower commands: the rotors themselves, or setpoints for whatever flies the vehicle."""
_YAW_RATE_PER_RAD = 2.0
"""How fast an error of the heading is closed in mode velocity [1/s]."""


class PathFollower:
    """Keeps one vehicle on its path: a command for each state, in microseconds.

    motor_speeds: what the controller of the settings commands; the bits are those of a flight in one process.
    velocity: velocity and yaw rate of the path, and what brings the vehicle back to it, limited by
    `correction_speed_max_m_s`.
    position: position and yaw of the path. The vehicle lags behind a moving setpoint.

    A state before the last one begins a new episode. Not for several threads at once.

    Attributes:
        path: What is followed.
        mode: What a command is, as in `control.modes.MODES`.
    """

    def __init__(
        self,
        path: Path,
        airframe: MultirotorConfig,
        gains: Se3Config | None = None,
        *,
        mode: FollowMode = "motor_speeds",
        controller: ControllerConfig | None = None,
    ) -> None:
        """Make the controller.

        Args:
            path: What is followed.
            airframe: What the vehicle is taken for.
            gains: Of the geometric controller, and for corrections in mode velocity.
            mode: What is commanded.
            controller: What flies in mode motor_speeds; None: the geometric controller.

        Raises:
            ValueError: There is no such mode.
        """
        if mode not in get_args(FollowMode):
            raise ValueError(f"unknown mode {mode!r}, known: {', '.join(get_args(FollowMode))}")
        self.path = path
        self.mode = mode
        self._gains = gains or Se3Config()
        self._cursor = PathCursor(path)
        # the state of the vehicle as a controller reads it, and views of the same memory to write it
        self._feedback = allocate_arrays(1, airframe.rotor_count, wp.get_device("cpu"))
        self._host = {name: getattr(self._feedback, name).numpy() for name in MultirotorArrays.vars}
        self._controller: PathController | None = None
        self._all = wp.ones(1, dtype=wp.int32, device="cpu")
        if mode == "motor_speeds":
            settings = controller or Se3ControllerConfig(gains=self._gains)
            context = ControllerContext(airframe=airframe, paths=[path], device="cpu")
            self._controller = settings.make(context)
            if isinstance(self._controller, Controller):
                self._controller.update(self._feedback)  # compiled here rather than at the first command

    def command(
        self,
        *,
        stamp_ns: int,
        position: ArrayLike,
        velocity: ArrayLike,
        orientation: ArrayLike,
        body_rate: ArrayLike,
        rotor_speed: ArrayLike,
    ) -> NDArray[np.float64]:
        """Return the command for a state, a row as in `control.modes.MODES`.

        Args:
            stamp_ns: Time of the state, at which the path is evaluated [ns].
            position: p_WB [m], shape [3].
            velocity: v_WB in W [m/s], shape [3].
            orientation: q_WB, xyzw, shape [4].
            body_rate: w_WB in B [rad/s], shape [3].
            rotor_speed: Speed of each rotor [rad/s], shape [R].

        Raises:
            TypeError: The stamp is no integer.
            ValueError: A shape does not fit, or what the command is made of is not finite.
        """
        if self.mode == "position":
            return self._position(self._cursor.at(stamp_ns))
        if self._controller is None:
            command = self._velocity(self._cursor.at(stamp_ns), position, orientation)
        else:
            host, stamp_ns = self._host, operator.index(stamp_ns)
            host["position"][0] = position
            host["velocity"][0] = velocity
            host["orientation"][0] = orientation
            host["body_rate"][0] = body_rate
            host["rotor_speed"][0] = rotor_speed
            if stamp_ns < host["stamp_ns"][0]:
                self._controller.begin(self._all)
            host["stamp_ns"][0] = stamp_ns
            self._controller.update(self._feedback)
            command = np.array(host["rotor_speed_command"][0])
        if not math.isfinite(sum(command.tolist())):
            raise ValueError(f"no finite command follows from the state at {stamp_ns} ns: it is not finite")
        return command

    def error_m(self, stamp_ns: int, position: ArrayLike) -> float:
        """Return how far a position is from where the path is at a stamp [m].

        Args:
            stamp_ns: Time since the start of the path [ns].
            position: p_WB [m], shape [3].
        """
        return math.dist(self._cursor.at(stamp_ns)["position"], np.asarray(position))

    def _position(self, point: np.void) -> NDArray[np.float64]:
        return np.array([*point["position"], point["yaw"]])

    def _velocity(self, point: np.void, position: ArrayLike, orientation: ArrayLike) -> NDArray[np.float64]:
        gains = self._gains
        correction = (gains.position_gain_per_s2 / gains.velocity_gain_per_s) * (point["position"] - position)
        speed_m_s = math.hypot(*correction)
        if speed_m_s > gains.correction_speed_max_m_s:
            correction *= gains.correction_speed_max_m_s / speed_m_s
        turn_rad = math.remainder(float(point["yaw"]) - heading_rad(orientation), math.tau)
        yaw_rate_rad_s = float(point["yaw_rate"]) + _YAW_RATE_PER_RAD * turn_rad
        return np.array([*(point["velocity"] + correction), yaw_rate_rad_s])
