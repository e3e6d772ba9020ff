# mypy: disable-error-code="no-untyped-call"
"""Extreme flights between those of the table: one parameter in fine steps, and all of them at random.

What fixed steps do silently wrong is worst just before the guard trips, which no round number hits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.dynamics_extremes import light, motor, nimble, several
from neurosim_core.bench.dynamics_scenes import HOLD_NS, Flight
from neurosim_core.vehicle import Multirotor

Array = NDArray[np.float64]

SWEEPS: dict[str, tuple[Callable[[float], Flight], float, float]] = {
    "mass of a crazyflie [kg], 100 m/s wind": (lambda x: light("crazyflie", x), 3e-6, 0.5),
    "mass of a hummingbird [kg], 100 m/s wind": (lambda x: light("hummingbird", x), 3e-6, 0.5),
    "inertia of a crazyflie, share": (nimble, 1e-6, 1.0),
    "motor time constant of a hummingbird [s]": (motor, 1e-6, 0.1),
}
"""Name -> flight at a value, first and last value; in equal ratios."""
AT_ONCE = "mass, inertia, motors, wind and drag at random, all at once"


@dataclass(frozen=True, kw_only=True, eq=False)
class Sweep:
    """The product on many flights."""

    name: str
    """Key of `SWEEPS`, or `AT_ONCE`."""
    values: Array
    """What was varied; of `AT_ONCE` the seed of each flight, shape [K]."""
    position_m: Array
    """Largest distance from adaptive steps at 1e-12 [m], shape [K]; NaN where a flight was held."""
    redone: NDArray[np.int64]
    """Holds, of 20, that were redone, shape [K]."""

    @property
    def worst(self) -> int:
        """Index of the largest error; of a flight that was held, if there is one."""
        return int(np.argmax(np.where(np.isfinite(self.position_m), self.position_m, np.inf)))


def sweep_worst_m(sweep: Sweep) -> float:
    """Largest error of a sweep [m]; infinite if a flight was held."""
    error_m = float(sweep.position_m[sweep.worst])
    return error_m if math.isfinite(error_m) else math.inf


def measure_sweep(name: str, count: int) -> Sweep:
    """Fly a sweep of `count` flights, and of those on both sides of the guard's edge, if it has one."""
    if name == AT_ONCE:
        values = np.arange(count, dtype=np.float64)
        flights = [several(seed) for seed in range(count)]
    else:
        make, first, last = SWEEPS[name]
        values = _with_edge(make, np.geomspace(first, last, count))
        flights = [make(float(value)) for value in values]
    measured = [silent_error(flight) for flight in flights]
    return Sweep(
        name=name,
        values=values,
        position_m=np.array([error for error, _ in measured]),
        redone=np.array([redone for _, redone in measured]),
    )


def _with_edge(make: Callable[[float], Flight], values: Array) -> Array:
    """Add the values on both sides of the guard's edge, where the last redone flight meets the next."""
    redone = [silent_error(make(float(value)))[1] > 0 for value in values]
    edges = [i for i in range(len(values) - 1) if redone[i] and not redone[i + 1]]
    if not edges:
        return values
    trips, passes = float(values[edges[-1]]), float(values[edges[-1] + 1])
    while passes > 1.001 * trips:
        middle = math.sqrt(trips * passes)
        if silent_error(make(middle))[1] > 0:
            trips = middle
        else:
            passes = middle
    return np.sort(np.append(values, (trips, passes)))


def silent_error(flight: Flight) -> tuple[float, int]:
    """Return how far the product is from its adaptive steps at 1e-12 at most [m], and the holds it redid.

    The adaptive steps are judged by SciPy in the table of extreme flights; they cost a thousandth of it.
    """
    product = Multirotor(flight.config)
    tight = Multirotor(flight.config, integrator="dormand_prince", rtol=1e-12, atol=1e-14)
    for vehicle in (product, tight):
        vehicle.reset(*flight.start)
    error = 0.0
    for command in flight.commands:
        for vehicle in (product, tight):
            vehicle.command(command)
            vehicle.advance(HOLD_NS)
        error = max(error, float(np.linalg.norm(product.state.position - tight.state.position)))
    held = product.arrays.status.numpy().any() or tight.arrays.status.numpy().any()
    return np.nan if held else error, int(product.effort.redone_count[0])
