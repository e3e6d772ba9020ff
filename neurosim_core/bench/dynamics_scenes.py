"""The flights on which integrators are compared: a start and commands, each held 10 ms, the same for all."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim_core.control import PathFollower
from neurosim_core.trajectory import FigureEightConfig, figure_eight
from neurosim_core.vehicle import Multirotor, MultirotorConfig, MultirotorState, preset

Array = NDArray[np.float64]

HOLD_NS = 10_000_000
"""How long each command is held [ns]: a controller at 100 Hz."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """One open-loop flight of one vehicle."""

    name: str
    """Of its panel and rows."""
    config: MultirotorConfig
    """The vehicle."""
    start: MultirotorState
    """State at time 0, without the leading axis."""
    commands: Array
    """Rotor speeds [rad/s], shape [K, R]; command k holds from k to k + 1 times `HOLD_NS`."""

    @property
    def duration_s(self) -> float:
        """How long it lasts [s]."""
        return len(self.commands) * HOLD_NS * 1e-9


def at_rest(config: MultirotorConfig, **changes: object) -> MultirotorState:
    """Return the state of one hovering vehicle at the origin, with the given fields replaced."""
    hover = np.full(config.rotor_count, config.hover_rotor_speed_rad_s)
    state = MultirotorState(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), hover)
    return state._replace(**{name: np.asarray(value, dtype=np.float64) for name, value in changes.items()})


def random_commands(config: MultirotorConfig, count: int, *, share: float, seed: int) -> Array:
    """Return commands within a share of hover, evenly distributed, shape [count, R]."""
    noise = np.random.default_rng(seed).uniform(-share, share, (count, config.rotor_count))
    return np.asarray(config.hover_rotor_speed_rad_s * (1.0 + noise))


def hover() -> Flight:
    """Return 2 s of hover, which every method should keep to rounding."""
    config = preset("crazyflie")
    commands = np.full((200, 4), config.hover_rotor_speed_rad_s)
    return Flight(name="hover", config=config, start=at_rest(config), commands=commands)


def rotor_step() -> Flight:
    """Return 0.6 s after a step of 5 % in the command of one rotor."""
    config = preset("crazyflie")
    command = config.hover_rotor_speed_rad_s * np.array([1.05, 1.0, 1.0, 1.0])
    return Flight(name="rotor step", config=config, start=at_rest(config), commands=np.tile(command, (60, 1)))


def flip() -> Flight:
    """Return a roll of 0.75 s that reaches 700 deg/s: a torque, its opposite, and hover thrust between."""
    config = preset("crazyflie")
    left, hover_speed = np.array([1.0, -1.0, -1.0, 1.0]), config.hover_rotor_speed_rad_s
    share = np.zeros(75)
    share[5:20], share[55:70] = -_FLIP_SHARE, _FLIP_SHARE
    commands = hover_speed * (1.0 + share[:, None] * left)
    return Flight(name="flip", config=config, start=at_rest(config), commands=commands)


_FLIP_SHARE = 0.072
"""Half the difference between the commands left and right, as a share of hover: reaches 700 deg/s."""


def tumble() -> Flight:
    """Return 2 s that begin at 20 rad/s about three axes at once, with commands that change by 20 %."""
    config = preset("hummingbird")
    start = at_rest(config, velocity=(2.0, -1.0, 1.0), body_rate=(12.0, -11.0, 11.6))
    return Flight(
        name="tumble", config=config, start=start, commands=random_commands(config, 200, share=0.2, seed=4)
    )


def figure_eight_flight() -> Flight:
    """Return 5 s of a figure eight at 9 m/s, with the commands of our own controller in closed loop."""
    config = preset("hummingbird")
    shape = FigureEightConfig(length_m=6.0, width_m=3.0, speed_max_m_s=9.0, laps=4.0, ramp_s=2.0)
    follower = PathFollower(figure_eight(shape, center=np.zeros(3)), config)
    vehicle = Multirotor(config)
    commands = []
    for k in range(500):
        state = one(vehicle.state)
        commands.append(follower.command(stamp_ns=k * HOLD_NS, **state._asdict()))
        vehicle.step(commands[-1], HOLD_NS)
    return Flight(name="figure eight", config=config, start=at_rest(config), commands=np.array(commands))


SCENES: dict[str, Callable[[], Flight]] = {
    "hover": hover,
    "rotor step": rotor_step,
    "flip": flip,
    "tumble": tumble,
    "figure eight": figure_eight_flight,
}
"""What makes each flight, by name."""


def one(states: MultirotorState) -> MultirotorState:
    """Return the first vehicle of a batch."""
    return MultirotorState(*(rows[0] for rows in states))


def stacked(states: list[MultirotorState]) -> MultirotorState:
    """Return states one after the other, with a leading axis."""
    return MultirotorState(*(np.array(rows) for rows in zip(*states, strict=True)))


@dataclass(frozen=True, kw_only=True)
class Errors:
    """The largest differences of two flights over the ends of all holds."""

    position_m: float
    """Distance [m]."""
    attitude_rad: float
    """Angle between the attitudes [rad]."""
    body_rate_rad_s: float
    """Difference of the body rates [rad/s]."""

    @property
    def finite(self) -> bool:
        """Whether the flight stayed finite."""
        return math.isfinite(self.position_m + self.attitude_rad + self.body_rate_rad_s)


def flight_errors(flown: MultirotorState, exact: MultirotorState) -> Errors:
    """Compare two flights, states with a leading [K]; not finite where a flight is not."""
    with np.errstate(over="ignore", invalid="ignore"):
        return Errors(
            position_m=float(np.linalg.norm(flown.position - exact.position, axis=1).max()),
            attitude_rad=float(attitude_errors(flown.orientation, exact.orientation).max()),
            body_rate_rad_s=float(np.linalg.norm(flown.body_rate - exact.body_rate, axis=1).max()),
        )


def attitude_errors(first: Array, second: Array) -> Array:
    """Return the angles between unit quaternions [rad], shape [..., 4], exact for small ones.

    The relative rotation is conj(first) * second; its angle is 2 atan2(|vector part|, |scalar part|).
    """
    v, s, u, t = first[..., :3], first[..., 3:], second[..., :3], second[..., 3:]
    vector = np.linalg.norm(s * u - t * v - np.cross(v, u), axis=-1)
    scalar = np.abs(s * t + (v * u).sum(axis=-1, keepdims=True))[..., 0]
    return np.asarray(2.0 * np.arctan2(vector, scalar))
