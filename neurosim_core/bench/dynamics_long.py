# mypy: disable-error-code="no-untyped-call,attr-defined"
"""An hour of hover, still and turning, and of a free top: what drifts; float64 against float32."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.bench.dynamics_float32 import make_body_kernel
from neurosim_core.bench.dynamics_methods import Method, first_state
from neurosim_core.bench.dynamics_reference import FreeTop
from neurosim_core.bench.dynamics_scenes import at_rest, attitude_errors
from neurosim_core.vehicle import MultirotorConfig, MultirotorState, preset

Array = NDArray[np.float64]

STEP_S = 1e-3
"""Step of all long runs [s]."""
STAMPS_S = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 3600)
"""When the drift is looked at [s]."""


@dataclass(frozen=True, kw_only=True)
class Drift:
    """How far one method has drifted at each stamp; NaN where it was lost."""

    run: str
    """hover, spinning hover, free top or spin."""
    method: str
    stamps_s: tuple[int, ...]
    """[s]."""
    position_m: tuple[float, ...] = ()
    """Distance from where the vehicle should be [m]; empty for the free top."""
    attitude_rad: tuple[float, ...] = ()
    """Angle from the attitude that it should have [rad]."""
    energy: tuple[float, ...] = ()
    """Relative change of the kinetic energy; of the free top only."""
    momentum: tuple[float, ...] = ()
    """Change of the angular momentum in W, relative to its length; of the free top only."""
    cpu_s: float = math.nan
    """CPU time of the run [s]."""
    failure: str = ""
    """What the vehicle raised."""


def unforced(inertia_kg_m2: Sequence[float]) -> MultirotorConfig:
    """Return a body on which nothing acts, with the given principal moments."""
    return preset(
        "hummingbird",
        inertia_kg_m2=tuple(map(tuple, np.diag(inertia_kg_m2).tolist())),
        gravity_m_s2=0.0,
        thrust_coefficient_n_s2=0.0,
        torque_coefficient_n_m_s2=0.0,
        rotor_drag_kg=0.0,
        rotor_inflow_kg=0.0,
        translational_lift_kg_m=0.0,
        parasitic_drag_kg_m=(0.0, 0.0, 0.0),
        motor_time_constant_s=0.0,
    )


def measure_hover(method: Method, setting: float, stamps_s: Sequence[int]) -> Drift:
    """Hover with all of a hummingbird's terms."""
    config = preset("hummingbird")
    start = at_rest(config)
    states, cpu_s, failure = _run(method, setting, config, start, stamps_s)
    return Drift(
        run="hover",
        method=method.name,
        stamps_s=tuple(stamps_s),
        position_m=tuple(float(np.linalg.norm(s.position)) for s in states),
        attitude_rad=tuple(float(attitude_errors(s.orientation, start.orientation)) for s in states),
        cpu_s=cpu_s,
        failure=failure,
    )


def measure_spinning_hover(method: Method, setting: float, stamps_s: Sequence[int]) -> Drift:
    """Hover while turning about the vertical at 29 rad/s, without drag, which would slow the turn.

    No fixed point: attitude and the forces in W are rounded anew in each step. In closed form the body stays
    where it is and turns evenly.
    """
    without = {"rotor_drag_kg": 0.0, "rotor_inflow_kg": 0.0, "translational_lift_kg_m": 0.0}
    config = preset("hummingbird", parasitic_drag_kg_m=(0.0, 0.0, 0.0), **without)
    start = at_rest(config, body_rate=np.array([0.0, 0.0, _SPIN_RAD_S]))
    states, cpu_s, failure = _run(method, setting, config, start, stamps_s)
    return Drift(
        run="spinning hover",
        method=method.name,
        stamps_s=tuple(stamps_s),
        position_m=tuple(float(np.linalg.norm(s.position)) for s in states),
        attitude_rad=tuple(
            float(attitude_errors(s.orientation, _turned(stamp_s)))
            for stamp_s, s in zip(stamps_s, states, strict=True)
        ),
        cpu_s=cpu_s,
        failure=failure,
    )


def _turned(stamp_s: int) -> Array:
    half = 0.5 * math.remainder(_SPIN_RAD_S * stamp_s, 2.0 * math.tau)
    return np.array([0.0, 0.0, math.sin(half), math.cos(half)])


def measure_top(method: Method, setting: float, stamps_s: Sequence[int], top: FreeTop) -> Drift:
    """Turn a free body, and compare it with its closed form."""
    config = unforced(top.inertia_kg_m2)
    start = at_rest(config, orientation=top.orientation(0.0), body_rate=top.body_rate(0.0))
    states, cpu_s, failure = _run(method, setting, config, start, stamps_s)
    inertia = np.array(top.inertia_kg_m2)
    momentum = np.array([0.0, 0.0, top.momentum])
    energy_drift, momentum_drift, attitude = [], [], []
    for stamp_s, s in zip(stamps_s, states, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            energy_drift.append(abs(0.5 * float(inertia @ s.body_rate**2) / top.energy_J - 1.0))
        lost = not (np.isfinite(s.orientation).all() and np.isfinite(s.body_rate).all())
        L_W = np.full(3, np.nan) if lost else Rotation.from_quat(s.orientation).apply(inertia * s.body_rate)
        momentum_drift.append(float(np.linalg.norm(L_W - momentum) / top.momentum))
        attitude.append(
            math.nan if lost else float(attitude_errors(s.orientation, top.orientation(float(stamp_s))))
        )
    return Drift(
        run="free top",
        method=method.name,
        stamps_s=tuple(stamps_s),
        attitude_rad=tuple(attitude),
        energy=tuple(energy_drift),
        momentum=tuple(momentum_drift),
        cpu_s=cpu_s,
        failure=failure,
    )


def _run(
    method: Method,
    setting: float,
    config: MultirotorConfig,
    start: MultirotorState,
    stamps_s: Sequence[int],
) -> tuple[list[MultirotorState], float, str]:
    """Return the states at some stamps with the command of the start, the CPU time [s], and what failed."""
    flyer = method.make(config, 1, setting)
    flyer.vehicle.command(start.rotor_speed)
    flyer.advance(_INTERVAL_NS)  # compiled
    flyer.vehicle.reset(*start)
    states, stamp_s, spent_ns = [], 0, 0
    for end_s in stamps_s:
        begin = time.thread_time_ns()
        for _ in range((end_s - stamp_s) * 1_000_000_000 // _INTERVAL_NS):
            flyer.advance(_INTERVAL_NS)
        spent_ns += time.thread_time_ns() - begin
        stamp_s = end_s
        states.append(first_state(flyer.vehicle))
    status = int(flyer.vehicle.arrays.status.numpy()[0])
    return states, 1e-9 * spent_ns, "" if status == 0 else "DynamicsError"


_INTERVAL_NS = 100_000_000


_SPIN_RAD_S = 29.0


def measure_formats(stamps_s: Sequence[int]) -> list[Drift]:
    """Hover while turning about the vertical at 29 rad/s, in float64 and in float32, with the study's kernel.

    In closed form the body stays where it is and turns evenly. The torque that keeps the rate is 0 here, and
    the thrust is that of four rotors at hover speed, in the format's own arithmetic.
    """
    drifts = []
    for scalar, dtype in ((wp.float64, np.float64), (wp.float32, np.float32)):
        for step_s in (STEP_S, 0.1 * STEP_S) if dtype is np.float32 else (STEP_S,):
            drifts.append(_measure_format(scalar, dtype, step_s, stamps_s))
    return drifts


def _measure_format(scalar: Any, dtype: Any, step_s: float, stamps_s: Sequence[int]) -> Drift:
    config = preset("hummingbird")
    speed = dtype(config.hover_rotor_speed_rad_s)
    thrust = dtype(4.0) * dtype(config.thrust_coefficient_n_s2) * speed * speed / dtype(config.mass_kg)
    vec3 = wp.types.vector(length=3, dtype=scalar)
    quat = wp.types.quaternion(dtype=scalar)
    position, velocity, body_rate = (wp.zeros(1, dtype=vec3, device="cpu") for _ in range(3))
    orientation: Any = wp.array([[0.0, 0.0, 0.0, 1.0]], dtype=quat, device="cpu")
    body_rate.assign(np.array([[0.0, 0.0, _SPIN_RAD_S]]))
    inertia = np.diag(np.array(config.inertia_kg_m2))
    launch = wp.launch(
        make_body_kernel(scalar),
        dim=1,
        inputs=[
            vec3(0.0, 0.0, float(thrust)), vec3(0.0, 0.0, 0.0), vec3(*inertia), config.gravity_m_s2, step_s,
            round(1.0 / step_s),
        ],
        outputs=[position, velocity, orientation, body_rate],
        device="cpu",
        record_cmd=True,
    )  # fmt: skip
    distances, angles, stamp_s, begin = [], [], 0, time.thread_time_ns()
    for end_s in stamps_s:
        for _ in range(end_s - stamp_s):
            launch.launch()
        stamp_s = end_s
        distances.append(float(np.linalg.norm(position.numpy()[0].astype(np.float64))))
        exact = _turned(end_s)
        q = orientation.numpy()[0].astype(np.float64)
        angles.append(float(attitude_errors(q / np.linalg.norm(q), exact)))
    return Drift(
        run="spin",
        method=f"{scalar.__name__}, {1e3 * step_s:g} ms",
        stamps_s=tuple(stamps_s),
        position_m=tuple(distances),
        attitude_rad=tuple(angles),
        cpu_s=1e-9 * (time.thread_time_ns() - begin),
    )
