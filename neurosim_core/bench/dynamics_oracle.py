"""The flights on which integrators are compared, and what judges these: SciPy on equations of its own.

A flight is a start and commands, each held 10 ms, the same for all; RotorPy flies them beside the vehicle.
`Equations` states the equations of motion a second time, in NumPy, independently of the kernels of the
vehicle, and SciPy solves them to rounding. RotorPy 3.0 flies as it is: its `Multirotor.step` calls
`scipy.integrate.solve_ivp` with RK45 at its default tolerances (rtol 1e-3, atol 1e-6).

References: Svacha, Mohta, Kumar (2017), Improving quadrotor trajectory tracking by compensating for
aerodynamic effects; Folk, Paulos, Kumar (2023), RotorPy: A Python-based multirotor simulator with
aerodynamics for education and research, arXiv 2306.04485.
"""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from neurosim_core.bench import engine
from neurosim_core.bench.engine import MultirotorConfig

Array = NDArray[np.float64]
Solver = Literal["DOP853", "Radau"]

HOLD_NS = 10_000_000
"""How long each command is held [ns]: a controller at 100 Hz."""
_HOLD_S = HOLD_NS * 1e-9
POSITION, VELOCITY, ORIENTATION, BODY_RATE = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
"""Where each part stands in a state; rotor speeds follow."""
INSTALL_ROTORPY = "RotorPy is not installed: pip install rotorpy==3.0.0"
_NAMES = ("x", "v", "q", "w", "rotor_speeds")
"""What RotorPy calls the parts of a state."""


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
        """Duration [s]."""
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


def _cross(a: Any, b: Any) -> Array:
    """Return the cross product along the first axis; `numpy.cross` takes several times as long."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class Equations:
    """Equations of motion of a vehicle with R rotors: wind without gusts and turbulence, and no ground."""

    def __init__(self, config: MultirotorConfig) -> None:
        self._config = config
        self._inertia = np.array(config.inertia_kg_m2)
        self._inertia_inverse = np.linalg.inv(self._inertia)
        self._hub = np.array(config.rotor_position_m).T
        self._thrust = config.thrust_coefficients_n_s2
        self._torque = config.torque_coefficients_n_m_s2 * np.array(config.rotor_direction)
        self._drag = np.array([[config.rotor_drag_kg], [config.rotor_drag_kg], [config.rotor_inflow_kg]])
        self._parasitic = np.array(config.parasitic_drag_kg_m)
        self._wind = np.array(config.wind_m_s)
        self.time_constant_s = np.full(config.rotor_count, config.motor_time_constant_s)
        """Of the motors [s], shape [R]."""

    def rate(self, y: Array, speed: Array) -> Array:
        """Return d/dt of position, velocity, orientation and body rate.

        Args:
            y: p_WB [m], v_WB [m/s], q_WB (xyzw, of any length), w_WB in B [rad/s], shape [13].
            speed: Rotor speeds [rad/s], shape [R].
        """
        config, velocity, q, w = self._config, y[VELOCITY], y[ORIENTATION], y[BODY_RATE]
        unit = q / np.sqrt(q @ q)
        u, s = unit[:3], unit[3]

        def turn(v: Array, sign: float) -> Array:
            twice = 2.0 * sign * _cross(u, v)
            return np.asarray(v + s * twice + sign * _cross(u, twice))

        air = turn(velocity - self._wind, -1.0)
        flow = air[:, None] + _cross(w[:, None], self._hub)
        force = -speed * self._drag * flow
        force[2] += self._thrust * speed**2 + config.translational_lift_kg_m * (flow[0] ** 2 + flow[1] ** 2)
        torque = _cross(self._hub, force).sum(axis=1)
        torque[2] += self._torque @ speed**2
        torque[0] -= config.flapping_kg_m * (speed @ flow[1])
        torque[1] += config.flapping_kg_m * (speed @ flow[0])
        total = force.sum(axis=1) - np.sqrt(air @ air) * self._parasitic * air
        acceleration = turn(total, 1.0) / config.mass_kg
        acceleration[2] -= config.gravity_m_s2
        angular = self._inertia_inverse @ (torque - _cross(w, self._inertia @ w))
        turning = np.append(0.5 * (q[3] * w + _cross(q[:3], w)), -0.5 * (q[:3] @ w))
        return np.concatenate([velocity, acceleration, turning, angular])


def solve(flight: Flight, solver: Solver, rtol: float) -> Array:
    """Solve a flight, restarted at each change of command, with the rotor speeds in closed form.

    The absolute tolerance is a tenth of the relative one. Returns states at the end of each hold, shape
    [K, 13 + R]; raises ArithmeticError where the solver gives up.
    """
    equations = Equations(flight.config)
    tau_s = equations.time_constant_s
    slowest_s = tau_s.max()
    decay_rate = np.divide(1.0, tau_s, out=np.full_like(tau_s, np.inf), where=tau_s > 0.0)
    y, speed = np.concatenate(flight.start[:4]), flight.start.rotor_speed
    states = []
    for hold in range(len(flight.commands)):
        held, first = flight.held(hold), speed

        def rotor_speed(t: float, held: Array = held, first: Array = first) -> Array:
            with np.errstate(invalid="ignore"):
                return np.asarray(held + (first - held) * np.nan_to_num(np.exp(-t * decay_rate)))

        def rate(t: float, y: Array, rotor_speed: Any = rotor_speed) -> Array:
            with np.errstate(over="ignore", invalid="ignore"):  # of steps that the solver tries and refuses
                return equations.rate(y, rotor_speed(t))

        solution = solve_ivp(
            rate, (0.0, _HOLD_S), y, method=solver, t_eval=[_HOLD_S], rtol=rtol, atol=0.1 * rtol,
            first_step=min(1e-4, 0.1 * slowest_s) if slowest_s > 0.0 else None,
        )  # fmt: skip
        if not solution.success:
            raise ArithmeticError(f"{solver} gave up on {flight.name}: {solution.message}")
        y, speed = solution.y[:, -1], rotor_speed(_HOLD_S)
        y[ORIENTATION] /= np.linalg.norm(y[ORIENTATION])
        states.append(np.concatenate([y, speed]))
    return np.array(states)


class Errors(NamedTuple):
    """The largest differences of two flights over the ends of all holds."""

    position_m: float
    attitude_rad: float
    body_rate_rad_s: float

    @property
    def finite(self) -> bool:
        """Whether the flight stayed finite, and within 1000 km."""
        return math.isfinite(sum(self)) and self.position_m < 1e6


def compare(flown: Array, exact: Array) -> Errors:
    """Compare two flights, states of shape [K, 13 + R]; not finite where one is not."""
    difference = flown - exact
    if not np.isfinite(difference).all():
        return Errors(math.nan, math.nan, math.nan)
    turns = (Rotation.from_quat(states[:, ORIENTATION]) for states in (flown, exact))
    largest = (np.linalg.norm(difference[:, part], axis=1).max() for part in (POSITION, BODY_RATE))
    (first, second), (position_m, body_rate_rad_s) = turns, largest
    attitude_rad = (first.inv() * second).magnitude().max()
    return Errors(float(position_m), float(attitude_rad), float(body_rate_rad_s))


class Reference(NamedTuple):
    """A solution, and how well it is known."""

    states: Array
    """At the end of each hold, shape [K, 13 + R]."""
    uncertainty: Errors
    """Difference of a solution at 10/3 of the tolerance, or of the other solver."""


def make_reference(flight: Flight, *, stiff: bool = False, cross_check: bool = False) -> Reference:
    """Solve a flight by DOP853 at rtol 3e-14, or by Radau at 1e-11 where it is stiff, and solve it again.

    A cross-check is by Radau at 1e-12, which takes ten times as long as DOP853 at 1e-13.
    """
    solver: Solver = "Radau" if stiff else "DOP853"
    rtol = 1e-11 if stiff else 3e-14
    states = solve(flight, solver, rtol)
    again = solve(flight, "Radau", 1e-12) if cross_check else solve(flight, solver, rtol * 10.0 / 3.0)
    return Reference(states, compare(again, states))


def rotorpy_version() -> str | None:
    """Return the version that is installed, or None."""
    return importlib.metadata.version("rotorpy") if importlib.util.find_spec("rotorpy") else None


def make_rotorpy_vehicle(config: MultirotorConfig) -> Any:
    """Return a vehicle of RotorPy with our parameters under its names."""
    from rotorpy.vehicles.multirotor import Multirotor

    if config.motor_time_constant_s == 0.0 or config.gravity_m_s2 != 9.81:
        raise ValueError("RotorPy divides by the motor time constant and knows one gravity, 9.81 m/s^2")
    inertia = np.array(config.inertia_kg_m2)
    return Multirotor(
        {
            "mass": config.mass_kg,
            **{f"I{'xyz'[i]}{'xyz'[j]}": inertia[i, j] for i in range(3) for j in range(i, 3)},
            **{f"c_D{axis}": c for axis, c in zip("xyz", config.parasitic_drag_kg_m, strict=True)},
            "num_rotors": config.rotor_count,
            "rotor_pos": {f"r{k + 1}": np.array(r) for k, r in enumerate(config.rotor_position_m)},
            "rotor_directions": np.array(config.rotor_direction),
            "rotor_speed_min": config.rotor_speed_min_rad_s,
            "rotor_speed_max": config.rotor_speed_max_rad_s,
            "k_eta": config.thrust_coefficient_n_s2,
            "k_m": config.torque_coefficient_n_m_s2,
            "k_d": config.rotor_drag_kg,
            "k_z": config.rotor_inflow_kg,
            "k_h": config.translational_lift_kg_m,
            "k_flap": config.flapping_kg_m,
            "tau_m": config.motor_time_constant_s,
        }
    )


def fly_rotorpy(flight: Flight, step_s: float, *, cpu_max_s: float = np.inf) -> tuple[Array, float]:
    """Fly with RotorPy's vehicle, in steps that divide `HOLD_NS`, and give up after some CPU time.

    Returns:
        States at the end of each hold, shape [K, 13 + R], NaN from where it gave up or failed; and the CPU
        time of the whole flight [s], scaled up from what was flown.
    """
    vehicle = make_rotorpy_vehicle(flight.config)
    state = {name: np.array(value) for name, value in zip(_NAMES, flight.start, strict=True)}
    state["wind"] = np.array(flight.config.wind_m_s)
    states = np.full((len(flight.commands), 13 + flight.config.rotor_count), np.nan)
    begin_s, flown = time.process_time(), 0
    for command in flight.commands:
        try:
            for _ in range(round(HOLD_NS * 1e-9 / step_s)):
                state = vehicle.step(state, {"cmd_motor_speeds": command}, step_s)
        except ValueError:  # SciPy and its rotations raise it for NaN and zero norm
            break
        states[flown] = np.concatenate([state[name] for name in _NAMES])
        flown += 1
        if time.process_time() - begin_s > cpu_max_s:
            break
    return states, (time.process_time() - begin_s) * len(states) / max(flown, 1)
