"""Error against CPU time and step size on five flights, for every integrator, and the order that it shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from neurosim_core.bench.dynamics_methods import Method, fly
from neurosim_core.bench.dynamics_scenes import HOLD_NS, Errors, Flight, flight_errors
from neurosim_core.vehicle import MultirotorState

STEPS_S = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
"""Steps of the methods of fixed step [s]."""
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
"""Relative tolerances of the methods that choose their steps."""

_STEPS_PER_LAUNCH = 250  # so that the 3 us of a launch count for little: copies of the vehicle fly beside it
_ERROR_FLOOR = 3e-12  # [m, rad] nearer to the reference than this, rounding shows
_UNCERTAINTIES = 30.0  # likewise, in multiples of what is not known of the reference
_SLOPE_SPREAD = 0.2  # of the local slopes of an asymptotic range


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One method with one setting on one flight."""

    flight: str
    """Name of the flight."""
    method: str
    """Name of the method."""
    setting: float
    """Step [s], or relative tolerance."""
    errors: Errors
    """Against the reference."""
    cpu_s_per_s: float
    """CPU time per simulated second and vehicle [s/s]; the least of the repetitions."""
    failure: str = ""
    """What the vehicle raised; empty if it flew on."""


@dataclass(frozen=True, kw_only=True)
class OrderFit:
    """The order of a method on a flight, by least squares over its asymptotic range."""

    flight: str
    method: str
    order: int
    """What theory says."""
    position: float | None
    """Slope of the position error; None where fewer than three errors are asymptotic."""
    attitude: float | None
    """Slope of the attitude error, likewise."""
    position_steps_s: tuple[float, float] | None
    """Least and largest step of the fit in position [s]."""
    attitude_steps_s: tuple[float, float] | None
    """Least and largest step of the fit in attitude [s]."""


def measure_sample(
    method: Method, flight: Flight, exact: MultirotorState, setting: float, *, repetitions: int
) -> Sample:
    """Fly one flight with one method and setting."""
    step_count = HOLD_NS * 1e-9 / setting if method.order is not None else _ADAPTIVE_STEPS
    copies = int(np.clip(round(_STEPS_PER_LAUNCH / step_count), 1, 256))
    flyer = method.make(flight.config, copies, setting)
    flyer.vehicle.command(flight.commands[0])
    flyer.advance(HOLD_NS)  # compiled and in the caches
    flown = min((fly(flyer, flight) for _ in range(repetitions)), key=lambda flown: flown.cpu_s)
    return Sample(
        flight=flight.name,
        method=method.name,
        setting=setting,
        errors=flight_errors(flown.states, exact),
        cpu_s_per_s=flown.cpu_s / flight.duration_s,
        failure="" if flown.failure is None else f"DynamicsError: {flown.failure.term}",
    )


_ADAPTIVE_STEPS = 8
"""About as many steps a hold as a method takes that chooses them."""


def fit_order(samples: Iterable[Sample], method: Method, flight: str, *, uncertainty: Errors) -> OrderFit:
    """Fit log error against log step where the slope has settled: at the fine end, above rounding.

    Args:
        samples: Among others, those of the method on the flight.
        method: A method of fixed step.
        flight: Name of the flight.
        uncertainty: Of the reference.
    """
    rows = sorted((s for s in samples if s.method == method.name and s.flight == flight), key=_setting)
    steps = [s.setting for s in rows]
    position, position_steps = _slope(steps, [s.errors.position_m for s in rows], uncertainty.position_m)
    attitude, attitude_steps = _slope(steps, [s.errors.attitude_rad for s in rows], uncertainty.attitude_rad)
    assert method.order is not None
    return OrderFit(
        flight=flight,
        method=method.name,
        order=method.order,
        position=position,
        attitude=attitude,
        position_steps_s=position_steps,
        attitude_steps_s=attitude_steps,
    )


def _setting(sample: Sample) -> float:
    return sample.setting


def _slope(
    steps: Sequence[float], errors: Sequence[float], uncertainty: float
) -> tuple[float | None, tuple[float, float] | None]:
    """Fit the longest run of steps, from the finest whose error is no rounding, with slopes alike."""
    floor = max(_ERROR_FLOOR, _UNCERTAINTIES * uncertainty)
    usable = [(h, e) for h, e in zip(steps, errors, strict=True) if np.isfinite(e) and e > floor]
    h, e = np.log([row[0] for row in usable]), np.log([row[1] for row in usable])
    if len(usable) < 3:
        return None, None
    local = np.diff(e) / np.diff(h)
    settled = np.abs(local - local[0]) < _SLOPE_SPREAD
    count = 1 + (len(local) if settled.all() else int(np.argmin(settled)))
    if count < 3:
        return None, None
    slope = float(np.polyfit(h[:count], e[:count], 1)[0])
    return slope, (usable[0][0], usable[count - 1][0])
