"""The ranges of a vehicle's commands, from its physics or from the settings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.settings import BaseConfig

if TYPE_CHECKING:
    from neurosim_core.vehicle.airframe import MultirotorConfig

SPEED_CEILING_M_S = 100.0
"""Highest default of `speed_max_m_s`: a model without drag has no top speed of its own [m/s]."""

Range = Annotated[float, Field(gt=0.0, le=1e6)]


class CommandRangesConfig(BaseConfig):
    """The largest commands that a vehicle accepts; null derives a limit from its physics."""

    beyond: Literal["clamp", "refuse"] = "clamp"
    """Response to a finite command beyond its range. clamp: the vehicle flies the nearest command within it,
    and the clamped commands are counted; refuse: the previous command stays in force."""
    thrust_max_n: Range | None = None
    """Largest collective thrust [N]; null: that of all rotors at their highest speed."""
    speed_max_m_s: Range | None = None
    """Largest norm of a velocity [m/s]; null: the level top speed, at which drag takes all horizontal thrust,
    and 100 m/s at most."""
    body_rate_max_rad_s: Range = 34.9
    """Largest norm of a body rate, and largest yaw rate [rad/s]; 2,000 degrees/s is the full scale of the
    usual gyroscopes. The gain `body_rate_max_rad_s` may limit a body rate further."""
    position_max_m: Range = 10_000.0
    """Largest absolute value of each coordinate of a position [m]."""


class _Part(NamedTuple):
    """A part of a setpoint row that has one range."""

    name: str
    unit: str
    begin: int
    end: int | None
    limit: str
    """Field of `CommandRanges`."""
    low_is_zero: bool = False
    """Whether the range begins at 0, instead of at minus the limit."""
    is_vector: bool = False
    """Whether the length is limited, instead of each element."""


_THRUST = _Part("thrust", "N", 0, 1, "thrust_max_n", low_is_zero=True)
_PARTS: dict[str, tuple[_Part, ...]] = {
    "motor_speeds": (_Part("rotor speed", "rad/s", 0, None, "rotor_speed_max_rad_s", low_is_zero=True),),
    "rates": (_THRUST, _Part("body rate", "rad/s", 1, 4, "body_rate_max_rad_s", is_vector=True)),
    "attitude": (_THRUST,),
    "velocity": (
        _Part("velocity", "m/s", 0, 3, "speed_max_m_s", is_vector=True),
        _Part("yaw rate", "rad/s", 3, 4, "body_rate_max_rad_s"),
    ),
    "position": (_Part("position", "m", 0, 3, "position_max_m"),),
    "path": (),
}


@dataclass(frozen=True, kw_only=True)
class CommandRanges:
    """The ranges of one vehicle, all known."""

    refuse: bool
    """Whether commands beyond are refused, instead of clamped."""
    rotor_speed_max_rad_s: float
    """Rotor speed [rad/s]."""
    thrust_max_n: float
    """Collective thrust [N]."""
    speed_max_m_s: float
    """Length of a velocity [m/s]."""
    body_rate_max_rad_s: float
    """Length of a body rate, and size of a yaw rate [rad/s]."""
    position_max_m: float
    """Size of each coordinate of a position [m]."""

    def excess(self, mode: str, row: list[float]) -> str:
        """Say what of a finite setpoint (`control.modes.MODES`) is beyond its range; empty: nothing is."""
        for part in _PARTS[mode]:
            limit = getattr(self, part.limit)
            numbers = row[part.begin : part.end]
            low = 0.0 if part.low_is_zero else -limit
            if part.is_vector:
                fits = math.hypot(*numbers) <= limit
            else:
                fits = all(low <= number <= limit for number in numbers)
            if not fits:
                shown = ", ".join(f"{number:.6g}" for number in numbers)
                span = f"up to {limit:.6g}" if part.is_vector else f"from {low:.6g} to {limit:.6g}"
                return f"a {part.name} of {shown} {part.unit} is out of range: {span} {part.unit}"
        return ""

    def beyond(self, mode: str, rows: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which setpoints are out of range, shape [N]; arguments as for `excess`, rows [N, W]."""
        if len(rows) == 1:  # in every control period: ufuncs take ten times as long
            return np.array([self.excess(mode, rows[0].tolist()) != ""])
        found = np.zeros(len(rows), np.bool_)
        for part in _PARTS[mode]:
            limit = getattr(self, part.limit)
            numbers = rows[:, part.begin : part.end]
            if part.is_vector:
                within = np.clip(numbers, -2.0 * limit, 2.0 * limit)  # squares of large numbers overflow
                found |= np.linalg.norm(within, axis=1) > limit
            else:
                low = 0.0 if part.low_is_zero else -limit
                found |= ((numbers < low) | (numbers > limit)).any(axis=1)
        return found


def command_ranges(vehicle: MultirotorConfig) -> CommandRanges:
    """Return what a vehicle can be asked for."""
    config = vehicle.command_ranges
    return CommandRanges(
        refuse=config.beyond == "refuse",
        rotor_speed_max_rad_s=vehicle.rotor_speed_max_rad_s,
        thrust_max_n=vehicle.thrust_max_n if config.thrust_max_n is None else config.thrust_max_n,
        speed_max_m_s=top_speed_m_s(vehicle) if config.speed_max_m_s is None else config.speed_max_m_s,
        body_rate_max_rad_s=config.body_rate_max_rad_s,
        position_max_m=config.position_max_m,
    )


def top_speed_m_s(vehicle: MultirotorConfig) -> float:
    """Return the speed of level flight at which drag takes all horizontal thrust [m/s].

    All rotors are at their highest speed: k v + c v^2 = sqrt(T^2 - (m g)^2) with the rotors' drag k and the
    frame's larger horizontal drag c, both as if the body were level. `SPEED_CEILING_M_S` at most.
    """
    surplus = vehicle.thrust_max_n**2 - vehicle.hover_thrust_n**2
    if not surplus > 0.0:  # it cannot hover; what it is asked for is not its limit
        return SPEED_CEILING_M_S
    push_n = math.sqrt(surplus)
    linear = vehicle.rotor_count * vehicle.rotor_drag_kg * vehicle.rotor_speed_max_rad_s
    square = max(vehicle.parasitic_drag_kg_m[:2])
    resistance = linear + math.sqrt(linear**2 + 4.0 * square * push_n)  # 2 push / v at equilibrium
    return float(min(2.0 * push_n / resistance, SPEED_CEILING_M_S)) if resistance > 0.0 else SPEED_CEILING_M_S
