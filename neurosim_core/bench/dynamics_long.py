"""An hour of hover, still and turning, and of a free top: what drifts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neurosim_core.bench.dynamics_flights import at_rest
from neurosim_core.bench.dynamics_oracle import BODY_RATE, ORIENTATION, POSITION
from neurosim_core.bench.engine import Multirotor, preset
from neurosim_core.bench.options import Progress
from neurosim_core.bench.report import Row

_METHODS: dict[str, dict[str, Any]] = {
    "RKMK4 (ours)": {},
    "Dormand-Prince (ours)": {"integrator": "dormand_prince", "rtol": 1e-10, "atol": 1e-12},
}
_MOMENTS = np.array([1.0e-3, 2.0e-3, 2.5e-3])
_NO_DRAG: dict[str, Any] = {
    "rotor_drag_kg": 0.0,
    "rotor_inflow_kg": 0.0,
    "translational_lift_kg_m": 0.0,
    "parasitic_drag_kg_m": (0.0, 0.0, 0.0),
}
_NO_FORCE: dict[str, Any] = {
    "gravity_m_s2": 0.0,
    "thrust_coefficient_n_s2": 0.0,
    "torque_coefficient_n_m_s2": 0.0,
    "motor_time_constant_s": 0.0,
    "inertia_kg_m2": tuple(map(tuple, np.diag(_MOMENTS).tolist())),
}


def measure_drifts(quick: bool, progress: Progress) -> list[Row]:
    """Hover for an hour, still and turning without drag, and turn as an asymmetric top on which nothing acts.

    A vehicle that hovers stays where it is; a free top keeps its energy, and its momentum in W.
    """
    stamps_s = (1, 10, 100, 3600) if quick else (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 3600)
    runs = (
        ("hover", preset("hummingbird"), (0.0, 0.0, 0.0)),
        ("spinning hover", preset("hummingbird", **_NO_DRAG), (0.0, 0.0, 29.0)),
        ("free top", preset("hummingbird", **_NO_DRAG, **_NO_FORCE), (9.0, 0.0, 17.0)),
    )
    rows = []
    for method, options in _METHODS.items():
        for run, config, body_rate in runs:
            progress(f"an hour of {run} with {method}")
            vehicle, stamp_s = Multirotor(config, **options), 0
            vehicle.reset(*at_rest(config, body_rate=body_rate))
            momentum_W, energy = _MOMENTS * body_rate, _MOMENTS @ np.square(body_rate)
            for end_s in stamps_s:
                for _ in range(10 * (end_s - stamp_s)):
                    vehicle.advance(100_000_000)
                vehicle.check()
                stamp_s = end_s
                state = np.concatenate([values[0] for values in vehicle.state])
                row: Row = {"run": run, "method": method, "after [s]": stamp_s}
                if run == "free top":
                    moment_W = Rotation.from_quat(state[ORIENTATION]).apply(_MOMENTS * state[BODY_RATE])
                    row["energy, relative"] = abs(_MOMENTS @ state[BODY_RATE] ** 2 / energy - 1.0)
                    length = math.hypot(*momentum_W)
                    row["momentum, relative"] = math.hypot(*(moment_W - momentum_W)) / length
                else:
                    row["position [m]"] = math.hypot(*state[POSITION])
                rows.append(row)
    return rows
