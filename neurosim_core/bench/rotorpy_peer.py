"""RotorPy 3.0 on the same flights, as it is.

Its `Multirotor.step` calls `scipy.integrate.solve_ivp` with RK45 at its default tolerances (rtol 1e-3, atol
1e-6).

Reference: Folk, Paulos, Kumar (2023), RotorPy: A Python-based multirotor simulator with aerodynamics for
education and research, arXiv 2306.04485.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.dynamics_flights import HOLD_NS, Flight
from neurosim_core.bench.engine import MultirotorConfig

Array = NDArray[np.float64]

INSTALL = "RotorPy is not installed: pip install rotorpy==3.0.0"
_NAMES = ("x", "v", "q", "w", "rotor_speeds")


def rotorpy_version() -> str | None:
    """Return the version that is installed, or None."""
    return importlib.metadata.version("rotorpy") if importlib.util.find_spec("rotorpy") else None


def make_rotorpy_vehicle(config: MultirotorConfig) -> Any:
    """Return a vehicle of RotorPy with our parameters under its names.

    Raises:
        ValueError: RotorPy cannot have such a vehicle.
    """
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
    """Fly with RotorPy's vehicle.

    Args:
        flight: What to fly.
        step_s: Length of each of its steps [s]; a divisor of `HOLD_NS`.
        cpu_max_s: Give up after this CPU time [s].

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
