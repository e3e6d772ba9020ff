"""The flights on which integrators are compared: a start and commands, each held 10 ms, the same for all."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench import engine

Array = NDArray[np.float64]

HOLD_NS = 10_000_000
"""How long each command is held [ns]: a controller at 100 Hz."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """One open-loop flight of one vehicle."""

    name: str
    config: engine.MultirotorConfig
    start: engine.MultirotorState
    """State at time 0, of one vehicle."""
    commands: Array
    """Rotor speeds [rad/s], shape [K, R]; command k holds from k to k + 1 times `HOLD_NS`."""

    @property
    def duration_s(self) -> float:
        """How long it lasts [s]."""
        return len(self.commands) * HOLD_NS * 1e-9

    def held(self, hold: int) -> Array:
        """Return a command within the range of the rotors [rad/s], shape [R]."""
        config = self.config
        limits = config.rotor_speed_min_rad_s, config.rotor_speed_max_rad_s
        return np.asarray(np.clip(self.commands[hold], *limits))


def at_rest(config: engine.MultirotorConfig, **changes: Any) -> engine.MultirotorState:
    """Return the state of one hovering vehicle at the origin, with the given fields replaced."""
    hover = np.full(config.rotor_count, config.hover_rotor_speed_rad_s)
    state = engine.MultirotorState(
        np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), hover
    )
    return state._replace(**{name: np.asarray(value, dtype=np.float64) for name, value in changes.items()})


def _commands(config: engine.MultirotorConfig, count: int, *, share: float, seed: int) -> Array:
    """Return commands within a share of hover, evenly distributed, shape [count, R]."""
    noise = np.random.default_rng(seed).uniform(-share, share, (count, config.rotor_count))
    return np.asarray(config.hover_rotor_speed_rad_s * (1.0 + noise))


def flip() -> Flight:
    """Return a roll of 0.75 s that reaches 700 deg/s: a torque, its opposite, and hover thrust between."""
    config = engine.preset("crazyflie")
    left, share = np.array([1.0, -1.0, -1.0, 1.0]), np.zeros(75)
    share[5:20], share[55:70] = -0.072, 0.072
    commands = config.hover_rotor_speed_rad_s * (1.0 + share[:, None] * left)
    return Flight(name="flip", config=config, start=at_rest(config), commands=commands)


def tumble() -> Flight:
    """Return 2 s that begin at 20 rad/s about three axes at once, with commands that change by 20 %."""
    config = engine.preset("hummingbird")
    start = at_rest(config, velocity=(2.0, -1.0, 1.0), body_rate=(12.0, -11.0, 11.6))
    commands = _commands(config, 200, share=0.2, seed=4)
    return Flight(name="tumble", config=config, start=start, commands=commands)


def figure_eight_flight() -> Flight:
    """Return 5 s of a figure eight at 9 m/s, with the commands of the SE(3) controller in closed loop."""
    config = engine.preset("hummingbird")
    shape = engine.FigureEightConfig(length_m=6.0, width_m=3.0, speed_max_m_s=9.0, laps=4.0, ramp_s=2.0)
    follower = engine.PathFollower(engine.figure_eight(shape, center=np.zeros(3)), config)
    vehicle = engine.Multirotor(config)
    commands = []
    for k in range(500):
        state = engine.MultirotorState(*(rows[0] for rows in vehicle.state))
        commands.append(follower.command(stamp_ns=k * HOLD_NS, **state._asdict()))
        vehicle.step(commands[-1], HOLD_NS)
    return Flight(name="figure eight", config=config, start=at_rest(config), commands=np.array(commands))


FLIGHTS: dict[str, Callable[[], Flight]] = {
    "flip": flip,
    "tumble": tumble,
    "figure eight": figure_eight_flight,
}


def short_flight(
    airframe: str,
    *,
    inertia: Any = None,
    body_rate: Any = (0.0, 0.0, 0.0),
    bang_bang: bool = False,
    **changes: Any,
) -> Flight:
    """Return 0.2 s of a preset with changed parameters, with commands within 10 % of hover.

    The inertia is a matrix, or its diagonal [kg m^2]. With `bang_bang` rotors are commanded to stop or to
    full speed instead, at random.
    """
    if inertia is not None:
        matrix = np.diag(inertia) if np.ndim(inertia) == 1 else inertia
        changes["inertia_kg_m2"] = tuple(map(tuple, matrix.tolist()))
    config = engine.preset(airframe, **changes)
    commands = _commands(config, 20, share=0.1, seed=7)
    if bang_bang:
        commands = np.random.default_rng(3).choice([0.0, config.rotor_speed_max_rad_s], (20, 4))
    start = at_rest(config, body_rate=body_rate)
    return Flight(name=f"{airframe}, changed", config=config, start=start, commands=commands)


def _case(airframe: str, *, stiff: bool = False, **changes: Any) -> tuple[Callable[[], Flight], bool]:
    return functools.partial(short_flight, airframe, **changes), stiff


MOTORS_S = (1e-1, 1e-2, 5e-3, 1e-3, 5e-4, 3e-4, 1e-4, 1e-5, 1e-6, 0.0)
"""Time constants of motors, from sluggish to none [s]."""

_FAST = 200.0 / math.sqrt(3.0)
_STORM: dict[str, Any] = {
    "wind_m_s": (100.0, 0.0, 0.0),
    "parasitic_drag_kg_m": engine.preset("hummingbird").parasitic_drag_kg_m,
}
_INERTIA = np.array(engine.preset("crazyflie").inertia_kg_m2)
_MASSES_KG = {"30 g": 3e-2, "5.3 g": 5.3e-3, "3 g": 3e-3, "0.3 g": 3e-4, "30 mg": 3e-5, "3 mg": 3e-6}
_RATIOS = {"1:10:100": (1.0, 10.0, 100.0), "1:10:10.9": (1.0, 10.0, 10.9), "1:100:100.9": (1.0, 100.0, 100.9)}
EXTREMES: dict[str, tuple[Callable[[], Flight], bool]] = {
    **{
        f"mass {label}, 100 m/s wind, quadratic drag": _case("crazyflie", mass_kg=mass_kg, **_STORM)
        for label, mass_kg in _MASSES_KG.items()
    },
    "mass 9.5 g, a hummingbird's rotors": _case("hummingbird", mass_kg=9.5e-3, **_STORM),
    "mass 3 mg, a hummingbird's rotors": _case("hummingbird", mass_kg=3e-6, stiff=True, **_STORM),
    **{
        f"inertia x {share:g}": _case("crazyflie", inertia=_INERTIA * share, stiff=share < 1e-3)
        for share in (1.0, 1e-2, 1e-4, 1e-6)
    },
    **{
        f"inertia {name}, 200 rad/s": _case("hummingbird", inertia=1e-4 * np.array(of), body_rate=[_FAST] * 3)
        for name, of in _RATIOS.items()
    },
    "bang-bang commands": _case("crazyflie", bang_bang=True),
    "200 rad/s about three axes": _case("crazyflie", body_rate=(_FAST, -_FAST, _FAST)),
    "pitch through 90 degrees at 20 rad/s": _case("crazyflie", body_rate=(0.0, 20.0, 0.0)),
}
"""Name -> what makes the flight (a ValueError where the vehicle is refused), and whether it is stiff."""
