"""What flies the figure eight of the bridge's benchmark, in one process and through DDS."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.control import PathFollower
from neurosim_core.trajectory import Path
from neurosim_core.trajectory.path import PathCursor

MAX_THRUST_N = 20.0
GRAVITY_M_S2 = 9.81
DURATION_S = 4.0
SETTINGS: dict[str, Any] = {
    "duration_s": DURATION_S,
    "device": "cpu",
    "scene": {"kind": "apartment", "rooms": 2},
    "vehicle": {"on_collision": "report"},
    "path": {"kind": "figure_eight", "speed_max_m_s": 2.5, "ramp_s": 1.0, "center_m": [0.0, 0.0, 1.2]},
    "control": {"rate_hz": 100},
    "sensors": {"imu": {"kind": "imu", "rate_hz": 100}},
    "live": {"mode": "lockstep", "command_deadline_s": 60.0, "command_timeout_s": 5.0},
}

Law = Callable[..., np.ndarray]


def flight_config(live_mode: str = "lockstep") -> SimulationConfig:
    """Return the settings of a flight, in lockstep or streaming."""
    return load_config(settings_of(live_mode))


def settings_of(live_mode: str) -> dict[str, Any]:
    """Return the settings of a flight as YAML has them."""
    return {**SETTINGS, "live": {**SETTINGS["live"], "mode": live_mode}}


def make_law(mode: str, settings: SimulationConfig, path: Path) -> Law:
    """Return a function of a state, by names; position and velocity in W, xyzw, rates in B.

    motor_speeds: the geometric controller of `neurosim_core.control`. attitude: its outer loop, in Python.
    """
    airframe = settings.vehicle.airframe()
    if mode == "motor_speeds":
        return PathFollower(path, airframe, settings.control.gains, mode="motor_speeds").command
    gains, cursor = settings.control.gains, PathCursor(path)

    def attitude(*, stamp_ns: int, position: Any, velocity: Any, orientation: Any, **_: Any) -> np.ndarray:
        point = cursor.at(stamp_ns)
        force = point["acceleration"] + np.array([0.0, 0.0, GRAVITY_M_S2])
        force = force + gains.position_gain_per_s2 * (point["position"] - position)
        force = force + gains.velocity_gain_per_s * (point["velocity"] - velocity)
        x, y, z, w = orientation
        up = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
        thrust_n = float(np.clip(airframe.mass_kg * force @ up, 0.0, MAX_THRUST_N))
        # The shortest turn from the vertical to the force, after one about the vertical.
        axis = force / np.linalg.norm(force)
        tilt = np.array([-axis[1], axis[0], 0.0, 1.0 + axis[2]])
        tilt /= np.linalg.norm(tilt)
        half = 0.5 * float(point["yaw"])
        s, c = math.sin(half), math.cos(half)
        a, b, _, d = tilt
        return np.array([thrust_n, a * c + b * s, b * c - a * s, d * s, d * c])

    return attitude


class Errors:
    """Distance from a path, over a flight."""

    def __init__(self, path: Path) -> None:
        self._cursor = PathCursor(path)
        self.squares: list[float] = []

    def add(self, stamp_ns: int, position: Any) -> None:
        """Take in where the vehicle was."""
        self.squares.append(float(np.sum((self._cursor.at(stamp_ns)["position"] - position) ** 2)))

    @property
    def rms_m(self) -> float:
        """Root of the mean square [m]."""
        return math.sqrt(sum(self.squares) / len(self.squares))
