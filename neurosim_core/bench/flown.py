"""A flight with slow and fast parts, flown once on a fine grid of time, to be looked at by many cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.clock import Rate, to_ns
from neurosim_core.config import SimulationConfig
from neurosim_core.control import CommandMode
from neurosim_core.packets import Odometry
from neurosim_core.simulation import Model, StartState, make_model, make_state, step
from neurosim_core.trace import Trace

SLOW_SHARE = 0.75
"""Share of the time before the manoeuvre."""
FAST_SHARE = 0.15
"""Share of the time of the manoeuvre: half of it there, half of it back; the rest is the recovery."""
_DRIFT_M_S = (0.12, 0.05, 0.0)
"""Velocity in W in the slow part."""
_YAW_RATE_RAD_S = 0.08
"""In the slow part."""
_DODGE_RAD_S = (10.0, 5.0, 1.0)
"""Body rates of the manoeuvre, 640 degrees a second; on the way back the opposite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Flown:
    """States of one vehicle at the ticks of a clock."""

    model: Model
    rate: Rate
    trace: Trace
    """Its slots are the ticks."""
    stamps_ns: NDArray[np.int64]
    """Shape [tick]."""


def fly(config: SimulationConfig, rate: Rate) -> Flown:
    """Drift slowly, dodge with a roll as fast as a flip, and recover.

    The states at the ticks of a rate depend on the rate in their last bits, as the integration stops at each:
    so it is flown once, and every camera of a comparison looks at the same states.

    Args:
        config: Scene, vehicle and duration; its sensors are replaced.
        rate: Ticks at which the state is wanted.
    """
    sensors = {"odometry": {"kind": "odometry", "rate_hz": rate.rate_hz}}
    settings = config.model_dump()
    settings.update(
        sensors=sensors, path={"kind": "hover"}, vehicle={**settings["vehicle"], "on_collision": "report"}
    )
    model = make_model(SimulationConfig.model_validate(settings))
    state = make_state(model, start=StartState(velocity=_DRIFT_M_S))
    rows = []
    end_ns = to_ns(config.duration_s)
    while state.stamp_ns < end_ns:
        command, mode = _command(model, state.stamp_ns / end_ns)
        for packet in step(model, state, command, mode=mode):
            if isinstance(packet, Odometry):
                rows.append(_row(packet))
        if state.failure is not None:
            raise state.failure
    stamps_ns = np.array(list(rate.stamps(0, end_ns + 1)))
    trace = Trace(
        capacity=len(stamps_ns), vehicle_count=1, rotor_count=model.airframe.rotor_count, device=model.device
    )
    states: Any = trace.states
    states.assign(np.array(rows)[: len(stamps_ns), None])
    return Flown(model=model, rate=rate, trace=trace, stamps_ns=stamps_ns)


def _command(model: Model, share: float) -> tuple[tuple[float, ...], CommandMode]:
    """Return what is commanded at a share of the flight."""
    weight_n = model.airframe.mass_kg * model.airframe.gravity_m_s2
    progress = (share - SLOW_SHARE) / FAST_SHARE
    if progress < 0.0:
        return (*_DRIFT_M_S, _YAW_RATE_RAD_S), "velocity"
    if progress < 1.0:
        sign = 1.0 if progress < 0.5 else -1.0
        return (weight_n, *(sign * rate for rate in _DODGE_RAD_S)), "rates"
    return (weight_n, 0.0, 0.0, 0.0, 1.0), "attitude"


def _row(packet: Odometry) -> NDArray[np.float64]:
    parts = (packet.position, packet.orientation, packet.velocity, packet.body_rate, packet.rotor_speed)
    return np.concatenate(parts)
