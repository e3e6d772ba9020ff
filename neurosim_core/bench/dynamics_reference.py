# mypy: disable-error-code="no-untyped-call,attr-defined"
"""What the integrators are measured against: SciPy's DOP853 and Radau, and the free top of Jacobi."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipk

from neurosim_core.bench.dynamics_baselines import make_baselines
from neurosim_core.bench.dynamics_scenes import HOLD_NS, Errors, Flight, flight_errors, stacked
from neurosim_core.vehicle import MultirotorConfig, MultirotorState
from neurosim_core.vehicle.multirotor import make_airframe

Array = NDArray[np.float64]

Solver = Literal["DOP853", "Radau"]


class Derivative:
    """The equations of motion for one state on the host: the vehicle's own, at given rotor speeds."""

    def __init__(self, config: MultirotorConfig) -> None:
        model = make_airframe(config, "cpu")
        y, rate = (wp.zeros(n, dtype=wp.float64, device="cpu") for n in (17, 13))
        self._y, self._rate = y.numpy(), rate.numpy()
        self._launch = wp.launch(
            make_baselines(frozenset(config.terms())).derivative,
            dim=1,
            inputs=[*model, y],
            outputs=[rate],
            device="cpu",
            record_cmd=True,
        )
        self._memory = (model, y, rate)  # the launch knows addresses only

    def __call__(self, y: Array, rotor_speed: Array) -> Array:
        """Return d/dt of (position, velocity, orientation, body rate), shape [13]."""
        self._y[:13], self._y[13:] = y, rotor_speed
        self._launch.launch()
        return np.array(self._rate)


def solve(flight: Flight, solver: Solver = "DOP853", *, rtol: float = 3e-14) -> MultirotorState:
    """Solve a flight, restarted at each change of command, with the rotor speeds in closed form.

    Args:
        flight: What to fly.
        solver: Method of `scipy.integrate.solve_ivp`.
        rtol: Its relative tolerance.

    Returns:
        The states at the end of each hold, leading [K].

    Raises:
        ArithmeticError: The solver gave up.
    """
    config, derivative = flight.config, Derivative(flight.config)
    tau_s = config.motor_time_constant_s
    y, speed = np.concatenate(flight.start[:4]), flight.start.rotor_speed
    hold_s = HOLD_NS * 1e-9
    states = []
    for command in flight.commands:
        held = np.clip(command, config.rotor_speed_min_rad_s, config.rotor_speed_max_rad_s)
        start = speed

        def rotor_speed(t: float, held: Array = held, start: Array = start) -> Array:
            return held + (start - held) * (math.exp(-t / tau_s) if tau_s > 0.0 else 0.0)

        def rate(t: float, y: Array, rotor_speed: object = rotor_speed) -> Array:
            return derivative(y, rotor_speed(t))  # type: ignore[operator]

        solution = solve_ivp(
            rate,
            (0.0, hold_s),
            y,
            method=solver,
            t_eval=[hold_s],
            rtol=rtol,
            atol=0.1 * rtol,
            first_step=min(1e-4, 0.1 * tau_s) if tau_s > 0.0 else None,
        )
        if not solution.success:
            raise ArithmeticError(f"{solver} gave up on {flight.name}: {solution.message}")
        y, speed = solution.y[:, -1], rotor_speed(hold_s)
        y[6:10] /= np.linalg.norm(y[6:10])
        states.append(MultirotorState(y[0:3], y[3:6], y[6:10], y[10:13], speed))
    return stacked(states)


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """A solution, and how well it is known."""

    states: MultirotorState
    """At the end of each hold, leading [K]."""
    solver: Solver
    rtol: float
    checks: tuple[Check, ...]
    """The same with other solvers or tolerances."""

    @property
    def uncertainty(self) -> Errors:
        """Largest differences to a check."""
        known = [check.difference for check in self.checks]
        return Errors(
            position_m=max(d.position_m for d in known),
            attitude_rad=max(d.attitude_rad for d in known),
            body_rate_rad_s=max(d.body_rate_rad_s for d in known),
        )


@dataclass(frozen=True, kw_only=True)
class Check:
    """How far another solution is from the reference."""

    solver: Solver
    rtol: float
    difference: Errors


def make_reference(flight: Flight, *, stiff: bool = False, cross_check: bool) -> Reference:
    """Solve a flight, and solve it again at 10/3 of the tolerance.

    Args:
        flight: What to fly.
        stiff: Solve with Radau instead of DOP853, at 1e-11.
        cross_check: Check with the other of the two solvers as well, which may take ten times as long.
    """
    solver: Solver = "Radau" if stiff else "DOP853"
    other: Solver = "DOP853" if stiff else "Radau"
    rtol = _STIFF_RTOL if stiff else TIGHTEST[solver]
    states = solve(flight, solver, rtol=rtol)
    other_rtol = _STIFF_RTOL if stiff else TIGHTEST[other]
    checks = [(solver, _CHECK_FACTOR * rtol)] + ([(other, other_rtol)] if cross_check else [])
    return Reference(
        states=states,
        solver=solver,
        rtol=rtol,
        checks=tuple(
            Check(solver=s, rtol=tol, difference=flight_errors(solve(flight, s, rtol=tol), states))
            for s, tol in checks
        ),
    )


TIGHTEST: dict[Solver, float] = {"DOP853": 3e-14, "Radau": 1e-12}
"""Relative tolerances of the references; SciPy allows no less than 2.3e-14."""
_STIFF_RTOL = 1e-11  # of both solvers on stiff flights, which are judged at 1e-5 m
_CHECK_FACTOR = 10.0 / 3.0


@dataclass(frozen=True, kw_only=True)
class FreeTop:
    """An asymmetric body on which no torque acts, in closed form.

    Starts without body rate about axis 2, and turns about axis 3 without reversal. The momentum points along
    z of W. Body rates are Jacobi's elliptic functions; the precession about the momentum is a quadrature,
    done over one period and its remainder.

    Reference: Landau, Lifshitz (1976), Mechanics, section 37.
    """

    inertia_kg_m2: tuple[float, float, float] = (1.0e-3, 2.0e-3, 2.5e-3)
    """Principal moments, increasing [kg m^2]."""
    rate_1_rad_s: float = 9.0
    """Body rate about axis 1 at the start [rad/s]."""
    rate_3_rad_s: float = 17.0
    """Body rate about axis 3 at the start [rad/s]."""

    def __post_init__(self) -> None:
        i1, i2, i3 = self.inertia_kg_m2
        if not (0.0 < i1 < i2 < i3 and self.momentum**2 > 2.0 * self.energy_J * i2):
            raise ValueError(f"the moments must increase, and axis 3 must not reverse, got {self}")

    @property
    def energy_J(self) -> float:
        """Kinetic energy [J]."""
        i1, _, i3 = self.inertia_kg_m2
        return 0.5 * (i1 * self.rate_1_rad_s**2 + i3 * self.rate_3_rad_s**2)

    @property
    def momentum(self) -> float:
        """Angular momentum [kg m^2/s]."""
        i1, _, i3 = self.inertia_kg_m2
        return math.hypot(i1 * self.rate_1_rad_s, i3 * self.rate_3_rad_s)

    @property
    def _elliptic(self) -> tuple[float, float, float]:
        """Scale of time [rad/s], parameter m, and amplitude of the body rate about axis 2 [rad/s]."""
        i1, i2, i3 = self.inertia_kg_m2
        energy2, momentum2 = 2.0 * self.energy_J, self.momentum**2
        scale = math.sqrt((i3 - i2) * (momentum2 - energy2 * i1) / (i1 * i2 * i3))
        m = (i2 - i1) * (energy2 * i3 - momentum2) / ((i3 - i2) * (momentum2 - energy2 * i1))
        return scale, m, math.sqrt((energy2 * i3 - momentum2) / (i2 * (i3 - i2)))

    def body_rate(self, time_s: float | Array) -> Array:
        """Return w_WB in B [rad/s], shape [..., 3]."""
        scale, m, rate_2 = self._elliptic
        sn, cn, dn, _ = ellipj(scale * np.asarray(time_s) % (4.0 * ellipk(m)), m)
        return np.stack([self.rate_1_rad_s * cn, rate_2 * sn, self.rate_3_rad_s * dn], axis=-1)

    def orientation(self, time_s: float) -> Array:
        """Return q_WB, xyzw, shape [4]: precession, tilt and spin about z, x, z."""
        x, y, z = np.array(self.inertia_kg_m2) * self.body_rate(time_s) / self.momentum
        spin, tilt = math.atan2(x, y), math.acos(z)
        turn = Rotation.from_euler("ZXZ", [self._precession(time_s), tilt, spin])
        return np.asarray(turn.as_quat())

    def _precession(self, time_s: float) -> float:
        """Angle about the momentum since the start [rad]."""
        scale, m, _ = self._elliptic
        period_s = 2.0 * ellipk(m) / scale  # of the squares of the rates
        count, rest_s = divmod(time_s, period_s)
        return math.fmod(count * self._turned(period_s), math.tau) + self._turned(rest_s)

    def _turned(self, end_s: float) -> float:
        """Integral of the precession rate over no more than a period [rad], to rounding (Gauss-Legendre)."""
        nodes, weights = np.polynomial.legendre.leggauss(100)
        i1, i2, _ = self.inertia_kg_m2
        w1, w2, _ = self.body_rate(0.5 * end_s * (nodes + 1.0)).T
        rate = self.momentum * (i1 * w1**2 + i2 * w2**2) / ((i1 * w1) ** 2 + (i2 * w2) ** 2)
        return float(0.5 * end_s * (weights @ rate))
