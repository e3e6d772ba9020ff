"""Steps a second: one vehicle and thousands, short calls and long, every term and those needed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurosim_core.vehicle import TERMS, Multirotor, MultirotorConfig, preset

STEP_NS = 1_000_000
"""Step of all figures [ns]."""


@dataclass(frozen=True, kw_only=True)
class Throughput:
    """How fast vehicles are moved, in steps of 1 ms, on one core."""

    call: str
    """`step` (checked, from the host's arrays) or `advance` (one launch)."""
    vehicles: int
    steps_per_call: int
    load: str
    """Key of `LOADS`: what acts on the vehicles."""
    terms: tuple[str, ...]
    """The terms that this takes; no others are compiled in."""
    steps_per_s: float
    """Steps of vehicles per second of CPU time; the best of the repetitions."""


@dataclass(frozen=True, kw_only=True)
class Pruning:
    """What leaving out terms brings on one vehicle."""

    vehicle: str
    terms: tuple[str, ...]
    """Those that it needs."""
    reduced_per_s: float
    """Steps per second with these terms."""
    full_per_s: float
    """Steps per second with all terms compiled in, unused ones with coefficients 0."""
    difference: float
    """Largest difference of the two states after a second, relative to the largest number in each field."""

    @property
    def gain(self) -> float:
        """Ratio of the two rates."""
        return self.reduced_per_s / self.full_per_s


def in_wind(**more: object) -> MultirotorConfig:
    """Return a hummingbird that needs every aerodynamic term, wind, motor lag and its full inertia."""
    inertia = ((3.65e-3, 2e-5, -1e-5), (2e-5, 3.68e-3, 1e-5), (-1e-5, 1e-5, 7.03e-3))
    return preset("hummingbird", flapping_kg_m=1e-5, wind_m_s=(2.0, -1.0, 0.5), inertia_kg_m2=inertia, **more)


def everything() -> MultirotorConfig:
    """Return the same with gusts, turbulence, a ground far below, and motors that are not alike."""
    return in_wind(
        gusts=({"velocity_m_s": (3.0, 0.0, 0.0), "start_s": 1.0, "rise_s": 2.0},),
        turbulence={"wind_20ft_m_s": 7.7},
        ground={"height_m": -1e6, "rotor_radius_m": 0.1},
        motor_time_constant_scale=(1.0, 1.05, 0.95, 1.0),
    )


LOADS: dict[str, Callable[[], MultirotorConfig]] = {"air and wind": in_wind, "everything": everything}
"""What may act on the vehicles."""


def measure_throughput(
    *, load: str, vehicles: int, steps_per_call: int, call: str, repetitions: int, cpu_s: float
) -> Throughput:
    """Time one way of calling.

    Args:
        load: Key of `LOADS`.
        vehicles: How many fly.
        steps_per_call: Steps of 1 ms that one call makes.
        call: `step` or `advance`.
        repetitions: How often.
        cpu_s: About how long each repetition takes [s].
    """
    vehicle = Multirotor(LOADS[load](), count=vehicles, max_step_ns=STEP_NS)
    rate = _best_rate(vehicle, steps_per_call, call, repetitions=repetitions, cpu_s=cpu_s)
    return Throughput(
        call=call,
        vehicles=vehicles,
        steps_per_call=steps_per_call,
        load=load,
        terms=vehicle.terms,
        steps_per_s=rate,
    )


def measure_pruning(name: str, config: MultirotorConfig, *, repetitions: int, cpu_s: float) -> Pruning:
    """Time one vehicle with the terms that it needs against the same with all terms; arguments as above."""
    reduced, full = Multirotor(config), Multirotor(config, terms=TERMS)
    rates: dict[Multirotor, float] = {reduced: 0.0, full: 0.0}
    for _ in range(repetitions):  # by turns, so that both see the same machine
        for vehicle in rates:
            rate = _best_rate(vehicle, 100, "advance", repetitions=1, cpu_s=cpu_s)
            rates[vehicle] = max(rates[vehicle], rate)
    return Pruning(
        vehicle=name,
        terms=reduced.terms,
        reduced_per_s=rates[reduced],
        full_per_s=rates[full],
        difference=_difference(reduced, full),
    )


def _difference(first: Multirotor, second: Multirotor) -> float:
    """Fly both for a second from the same start, and compare."""
    ends = []
    for vehicle in (first, second):
        vehicle.reset(velocity=(3.0, -2.0, 1.0), body_rate=(4.0, 5.0, -3.0))
        vehicle.step(_command(vehicle), 1_000_000_000)
        ends.append(vehicle.state)
    return max(float(np.abs(a - b).max() / np.abs(a).max()) for a, b in zip(*ends, strict=True))


def _command(vehicle: Multirotor) -> Any:
    return vehicle.config.hover_rotor_speed_rad_s * np.linspace(0.99, 1.01, vehicle.config.rotor_count)


def _best_rate(
    vehicle: Multirotor, steps_per_call: int, call: str, *, repetitions: int, cpu_s: float
) -> float:
    """Return the steps of vehicles per second of CPU time, the best of the repetitions."""
    duration_ns = steps_per_call * STEP_NS
    command = np.full((vehicle.count, vehicle.config.rotor_count), vehicle.config.hover_rotor_speed_rad_s)

    def spend(calls: int) -> float:
        vehicle.reset()
        begin = time.thread_time_ns()
        if call == "step":
            for _ in range(calls):
                vehicle.step(command, duration_ns)
        else:
            for _ in range(calls):
                vehicle.advance(duration_ns)
        return 1e-9 * (time.thread_time_ns() - begin)

    spend(2)  # compiled and in the caches
    calls = max(1, round(cpu_s / max(spend(3) / 3, 1e-9)))
    best_s = min(spend(calls) for _ in range(repetitions))
    vehicle.check()
    return calls * steps_per_call * vehicle.count / best_s


WAYS: Sequence[tuple[str, str, int, int]] = (
    ("air and wind", "step", 1, 1),
    ("air and wind", "step", 1, 100),
    ("air and wind", "advance", 1, 1),
    ("air and wind", "advance", 1, 10),
    ("air and wind", "advance", 1, 100),
    ("air and wind", "advance", 1, 1000),
    ("air and wind", "advance", 4096, 1),
    ("air and wind", "advance", 4096, 10),
    ("air and wind", "advance", 4096, 100),
    ("everything", "advance", 1, 100),
    ("everything", "advance", 4096, 10),
)
"""Load, call, number of vehicles and steps per call of each figure."""
