"""What an outside controller asks for, as objects with names and units in place of bare rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim_core.control.modes import CommandMode


@dataclass(frozen=True, kw_only=True, eq=False)
class Setpoint:
    """A command, held until the next; one of the subclasses."""

    mode: ClassVar[CommandMode]
    """The command mode (`control.modes`)."""

    def row(self) -> NDArray[np.float64]:
        """Return the setpoint as a row of its mode, shape [width], or rows of many worlds, [N, width]."""
        raise NotImplementedError(f"{type(self).__name__} must say what its row is")


@dataclass(frozen=True, kw_only=True, eq=False)
class MotorSpeeds(Setpoint):
    """Speeds of the rotors."""

    mode = "motor_speeds"
    speed_rad_s: ArrayLike
    """Speed of each rotor [rad/s], shape [R] or [N, R]."""

    def row(self) -> NDArray[np.float64]:
        """Return the speeds."""
        return np.asarray(self.speed_rad_s, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyRates(Setpoint):
    """Collective thrust and body rates (CTBR)."""

    mode = "rates"
    thrust_n: ArrayLike
    """Collective thrust [N], a number or shape [N]."""
    body_rate_rad_s: ArrayLike
    """w_WB in B [rad/s], shape [3] or [N, 3]."""

    def row(self) -> NDArray[np.float64]:
        """Return thrust, then rates."""
        return _row(self.thrust_n, self.body_rate_rad_s, vector=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class AttitudeThrust(Setpoint):
    """Collective thrust and attitude."""

    mode = "attitude"
    thrust_n: ArrayLike
    """Collective thrust [N], a number or shape [N]."""
    orientation: ArrayLike
    """q_WB, xyzw, shape [4] or [N, 4]."""

    def row(self) -> NDArray[np.float64]:
        """Return thrust, then the quaternion."""
        return _row(self.thrust_n, self.orientation, vector=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Velocity(Setpoint):
    """Velocity and yaw rate."""

    mode = "velocity"
    velocity_m_s: ArrayLike
    """v_WB in W [m/s], shape [3] or [N, 3]."""
    yaw_rate_rad_s: ArrayLike = 0.0
    """Yaw rate [rad/s], a number or shape [N]."""

    def row(self) -> NDArray[np.float64]:
        """Return velocity, then yaw rate."""
        return _row(self.velocity_m_s, self.yaw_rate_rad_s, vector=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Position(Setpoint):
    """Position and yaw."""

    mode = "position"
    position_m: ArrayLike
    """p_WB [m], shape [3] or [N, 3]."""
    yaw_rad: ArrayLike = 0.0
    """Yaw [rad], a number or shape [N]."""

    def row(self) -> NDArray[np.float64]:
        """Return position, then yaw."""
        return _row(self.position_m, self.yaw_rad, vector=0)


def _row(*parts: ArrayLike, vector: int) -> NDArray[np.float64]:
    """Return the parts of a row side by side: one is a vector [..., width], the other a number [...]."""
    columns = [np.asarray(part, dtype=np.float64) for part in parts]
    columns = [c if index == vector else c[..., None] for index, c in enumerate(columns)]
    shape = np.broadcast_shapes(*(column.shape[:-1] for column in columns))
    return np.concatenate([np.broadcast_to(c, (*shape, c.shape[-1])) for c in columns], axis=-1)
