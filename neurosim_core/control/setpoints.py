"""Setpoints of an external controller, as objects with names and units in place of bare rows."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim_core.control.modes import CommandMode


@dataclass(frozen=True, kw_only=True, eq=False)
class Setpoint:
    """A command, held until the next; one of the subclasses."""

    mode: ClassVar[CommandMode]
    """The command mode (`control.modes`)."""
    vector: ClassVar[int]
    """Which field is a vector; another one is a number."""

    def row(self) -> NDArray[np.float64]:
        """Return the setpoint as a row of its mode, shape [width], or rows of many worlds, [N, width].

        Fields stand side by side in their order.
        """
        columns = [np.asarray(getattr(self, field.name), dtype=np.float64) for field in fields(self)]
        columns = [
            np.atleast_1d(c) if index == self.vector else c[..., None] for index, c in enumerate(columns)
        ]
        shape = np.broadcast_shapes(*(column.shape[:-1] for column in columns))
        return np.concatenate([np.broadcast_to(c, (*shape, c.shape[-1])) for c in columns], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class MotorSpeeds(Setpoint):
    """Speeds of the rotors."""

    mode, vector = "motor_speeds", 0
    speed_rad_s: ArrayLike
    """Speed of each rotor [rad/s], shape [R] or [N, R]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyRates(Setpoint):
    """Collective thrust and body rates (CTBR)."""

    mode, vector = "rates", 1
    thrust_n: ArrayLike
    """Collective thrust [N], a number or shape [N]."""
    body_rate_rad_s: ArrayLike
    """w_WB in B [rad/s], shape [3] or [N, 3]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AttitudeThrust(Setpoint):
    """Collective thrust and attitude."""

    mode, vector = "attitude", 1
    thrust_n: ArrayLike
    """Collective thrust [N], a number or shape [N]."""
    orientation: ArrayLike
    """q_WB, xyzw, shape [4] or [N, 4]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Velocity(Setpoint):
    """Velocity and yaw rate."""

    mode, vector = "velocity", 0
    velocity_m_s: ArrayLike
    """v_WB in W [m/s], shape [3] or [N, 3]."""
    yaw_rate_rad_s: ArrayLike = 0.0
    """Yaw rate [rad/s], a number or shape [N]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Position(Setpoint):
    """Position and yaw."""

    mode, vector = "position", 0
    position_m: ArrayLike
    """p_WB [m], shape [3] or [N, 3]."""
    yaw_rad: ArrayLike = 0.0
    """Yaw [rad], a number or shape [N]."""
