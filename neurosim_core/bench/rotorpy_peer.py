"""RotorPy 3.0.0 on the same flights: as it is, and with explicit Euler as its users speed it up.

As it is: `Multirotor.step`, which calls `scipy.integrate.solve_ivp` with RK45 at its default tolerances (rtol
1e-3, atol 1e-6). With explicit Euler: its right-hand side `_s_dot_fn`, one evaluation a step, the quaternion
normalised and the rotor speeds limited after each.

Reference: Folk, Paulos, Kumar (2023), RotorPy: A Python-based multirotor simulator with aerodynamics for
education and research, arXiv 2306.04485.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import time
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.dynamics_baselines import KNOWN_TERMS
from neurosim_core.bench.dynamics_methods import Flown
from neurosim_core.bench.dynamics_reference import Derivative
from neurosim_core.bench.dynamics_scenes import HOLD_NS, Flight, stacked
from neurosim_core.vehicle import MultirotorConfig, MultirotorState

Array = NDArray[np.float64]
Integrator = Literal["RK45", "explicit Euler"]

INSTALL = "pip install rotorpy==3.0.0"
"""How to get it."""


USES: tuple[tuple[Integrator, float], ...] = (("RK45", 1e-3), ("RK45", 1e-2), ("explicit Euler", 1e-3))
"""Integrators and steps [s] with which it is compared: as it is at two steps, and as it is made fast."""


def rotorpy_version() -> str | None:
    """Return the version that is installed, or None."""
    if importlib.util.find_spec("rotorpy") is None:
        return None
    return importlib.metadata.version("rotorpy")


def quad_params(config: MultirotorConfig) -> dict[str, Any]:
    """Return a vehicle's parameters under RotorPy's names.

    Raises:
        ValueError: RotorPy cannot have such a vehicle.
    """
    if config.motor_time_constant_s == 0.0 or config.gravity_m_s2 != 9.81:
        raise ValueError("RotorPy divides by the motor time constant and knows one gravity, 9.81 m/s^2")
    if unknown := set(config.terms()) - KNOWN_TERMS:
        raise ValueError(f"RotorPy flies without {sorted(unknown)} here")
    if config.rotor_thrust_scale or config.rotor_torque_scale:
        raise ValueError("RotorPy's rotors are all alike")
    inertia = np.array(config.inertia_kg_m2)
    return {
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


def derivative_difference(config: MultirotorConfig, *, count: int = 50, seed: int = 0) -> float:
    """Return how far RotorPy's accelerations are from ours on random states, relative to the largest of each.

    Args:
        config: A vehicle without bounds below on its rotors.
        count: Number of states.
        seed: Of the states.
    """
    from rotorpy.vehicles.multirotor import Multirotor

    rng = np.random.default_rng(seed)
    theirs, ours = Multirotor(quad_params(config)), Derivative(config)
    worst = 0.0
    for _ in range(count):
        q = rng.normal(size=4)
        y = np.concatenate([10.0 * rng.normal(size=6), q / np.linalg.norm(q), 5.0 * rng.normal(size=3)])
        speed = rng.uniform(0.0, config.rotor_speed_max_rad_s, config.rotor_count)
        rate = theirs._s_dot_fn(0.0, np.concatenate([y, config.wind_m_s, speed]), speed)[:13]
        for part in (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)):
            error = np.abs(ours(y, speed)[part] - rate[part]).max() / np.abs(rate[part]).max()
            worst = max(worst, float(error))
    return worst


def fly_rotorpy(flight: Flight, integrator: Integrator, *, step_s: float, cpu_max_s: float = np.inf) -> Flown:
    """Fly with RotorPy's vehicle.

    Args:
        flight: What to fly.
        integrator: RK45 as it is, or explicit Euler.
        step_s: Length of each of its steps [s]; a divisor of `HOLD_NS`.
        cpu_max_s: Give up after this CPU time [s].

    Returns:
        States and CPU time. Where it gave up or failed, the rest of the states is NaN, and the time is that
        of what it flew, scaled to the whole flight.
    """
    from rotorpy.vehicles.multirotor import Multirotor

    vehicle = Multirotor(quad_params(flight.config))
    step = _rk45_step if integrator == "RK45" else _euler_step
    names = ("x", "v", "q", "w", "rotor_speeds")
    state = {
        **{name: np.array(value) for name, value in zip(names, flight.start, strict=True)},
        "wind": np.array(flight.config.wind_m_s),
    }
    step_count = round(HOLD_NS * 1e-9 / step_s)
    states: list[MultirotorState] = []
    stopped = False
    begin = time.process_time()
    for command in flight.commands:
        try:
            for _ in range(step_count):
                state = step(vehicle, state, command, step_s)
        except ValueError:  # what SciPy and its rotations raise for NaN and zero norm
            break
        states.append(MultirotorState(*(np.array(state[name]) for name in names)))
        if stopped := time.process_time() - begin > cpu_max_s:
            break
    cpu_s = (time.process_time() - begin) * len(flight.commands) / max(len(states), 1)
    lost = MultirotorState(*(np.full_like(value, np.nan) for value in flight.start))
    states += [lost] * (len(flight.commands) - len(states))
    return Flown(states=stacked(states), cpu_s=cpu_s, stopped=stopped)


def _rk45_step(vehicle: Any, state: dict[str, Array], command: Array, step_s: float) -> dict[str, Array]:
    moved: dict[str, Array] = vehicle.step(state, {"cmd_motor_speeds": command}, step_s)
    return moved


def _euler_step(vehicle: Any, state: dict[str, Array], command: Array, step_s: float) -> dict[str, Array]:
    command = np.clip(command, vehicle.rotor_speed_min, vehicle.rotor_speed_max)
    s = vehicle._pack_state(state)
    moved: dict[str, Array] = vehicle._unpack_state(s + step_s * vehicle._s_dot_fn(0.0, s, command))
    moved["q"] = moved["q"] / np.linalg.norm(moved["q"])
    moved["rotor_speeds"] = np.clip(moved["rotor_speeds"], vehicle.rotor_speed_min, vehicle.rotor_speed_max)
    return moved
