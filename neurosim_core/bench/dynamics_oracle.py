"""What the integrators of the vehicle are judged by: SciPy on equations of its own.

`Equations` states the equations of motion a second time, in NumPy, independently of the kernels of the
vehicle, and SciPy solves them to rounding.

Reference: Svacha, Mohta, Kumar (2017), Improving quadrotor trajectory tracking by compensating for
aerodynamic effects.
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from neurosim_core.bench.dynamics_flights import HOLD_NS, Flight
from neurosim_core.bench.engine import MultirotorConfig

Array = NDArray[np.float64]
Solver = Literal["DOP853", "Radau"]

POSITION, VELOCITY, ORIENTATION, BODY_RATE = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
"""Where each part stands in a state; rotor speeds follow."""
_HOLD_S = HOLD_NS * 1e-9


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

    Args:
        flight: What to fly.
        solver: Method of `scipy.integrate.solve_ivp`.
        rtol: Its relative tolerance; the absolute one is a tenth of it.

    Returns:
        States at the end of each hold, shape [K, 13 + R].

    Raises:
        ArithmeticError: The solver gave up.
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

    Args:
        flight: What to fly.
        stiff: Damped so fast that an explicit solver takes tiny steps.
        cross_check: Compare with Radau at 1e-12, which takes ten times as long, instead of DOP853 at 1e-13.
    """
    solver: Solver = "Radau" if stiff else "DOP853"
    rtol = 1e-11 if stiff else 3e-14
    states = solve(flight, solver, rtol)
    again = solve(flight, "Radau", 1e-12) if cross_check else solve(flight, solver, rtol * 10.0 / 3.0)
    return Reference(states, compare(again, states))
