"""Flights that break integrators: stiff motors, dust in a storm, next to no inertia, violent spin."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import ValidationError

from neurosim_core.bench import rotorpy_peer
from neurosim_core.bench.dynamics_methods import Flown, Method, fly
from neurosim_core.bench.dynamics_scenes import (
    Errors,
    Flight,
    at_rest,
    flight_errors,
    random_commands,
)
from neurosim_core.vehicle import MultirotorConfig, MultirotorState, preset

TIME_CONSTANTS_S = (1e-1, 1e-2, 5e-3, 1e-3, 5e-4, 3e-4, 1e-4, 1e-5, 1e-6, 0.0)
"""Of the motors, from sluggish to none [s]."""

_COUNT = 20
"""Commands of 10 ms in a flight of 0.2 s."""

Outcome = Literal["flown", "DynamicsError", "not finite", "too slow"]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One extreme flight."""

    name: str
    make: Callable[[], Flight]
    """Raises ValidationError where the product refuses the vehicle."""
    stiff: bool = False
    """Damped faster than the steps of an explicit reference would like."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """How one method fared on one extreme flight."""

    case: str
    method: str
    outcome: Outcome
    errors: Errors | None
    """Against the reference; None unless flown to the end."""
    cpu_s_per_s: float
    """CPU time per simulated second [s/s]."""
    redone_count: int = 0
    """Holds, of 20, that the product gave to its adaptive method."""
    evaluation_count: int = 0
    """Right-hand sides that the adaptive method evaluated."""


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A vehicle that the product refuses to make."""

    case: str
    message: str


def trial_of(trials: Iterable[Trial], method: str) -> Trial:
    """Return the trial of a method."""
    return next(trial for trial in trials if trial.method == method)


def trial_position_m(trial: Trial) -> float:
    """Position error [m]; infinite where the flight was not flown to its end."""
    return math.inf if trial.errors is None else trial.errors.position_m


def light(airframe: str, mass_kg: float) -> Flight:
    """Return a vehicle of another mass in a wind of 100 m/s, with quadratic drag."""
    drag = preset("hummingbird").parasitic_drag_kg_m
    config = preset(airframe, mass_kg=mass_kg, wind_m_s=(100.0, 0.0, 0.0), parasitic_drag_kg_m=drag)
    return _flight("mass", config)


def nimble(share: float) -> Flight:
    """Return a crazyflie with a share of its inertia."""
    inertia = np.array(preset("crazyflie").inertia_kg_m2) * share
    config = preset("crazyflie", inertia_kg_m2=tuple(map(tuple, inertia.tolist())))
    return _flight("inertia", config)


def slender(*moments: float) -> Flight:
    """Return a hummingbird with principal moments in the given ratio, 1e-4 kg m^2 the least, at 200 rad/s."""
    diagonal = 1e-4 * np.diag(moments)
    config = preset("hummingbird", inertia_kg_m2=tuple(map(tuple, diagonal.tolist())))
    return _flight("ratio", config, body_rate=np.full(3, 200.0 / np.sqrt(3.0)))


def bang_bang() -> Flight:
    """Return a crazyflie whose rotors are commanded to stop or to full speed, at random."""
    config = preset("crazyflie")
    choice = np.random.default_rng(3).choice([0.0, config.rotor_speed_max_rad_s], (_COUNT, 4))
    return Flight(name="bang-bang", config=config, start=at_rest(config), commands=choice)


def fast_spin() -> Flight:
    """Return a crazyflie at 200 rad/s about three axes."""
    return _flight("spin", preset("crazyflie"), body_rate=np.array([1.0, -1.0, 1.0]) * 200.0 / np.sqrt(3.0))


def through_vertical() -> Flight:
    """Return a crazyflie that pitches at 20 rad/s, through 90 degrees and on."""
    return _flight("pitch", preset("crazyflie"), body_rate=np.array([0.0, 20.0, 0.0]))


def motor(time_constant_s: float) -> Flight:
    """Return a hummingbird whose motors have the given time constant."""
    return _flight("motor", preset("hummingbird", motor_time_constant_s=time_constant_s))


def several(seed: int) -> Flight:
    """Return a vehicle with all that is extreme at once, drawn in equal ratios, the seed deciding which.

    Mass 3 mg to 0.5 kg, wind 1 to 100 m/s, motors 1 us to 0.1 s, inertia 1e-4 to 1 times its own, drag 0.1 to
    10 times a hummingbird's.
    """
    rng = np.random.default_rng(seed)
    name = ("crazyflie", "hummingbird")[seed % 2]
    drag = 10.0 ** rng.uniform(-1.0, 1.0) * np.array(preset("hummingbird").parasitic_drag_kg_m)
    inertia = 10.0 ** rng.uniform(-4.0, 0.0) * np.array(preset(name).inertia_kg_m2)
    config = preset(
        name,
        mass_kg=10.0 ** rng.uniform(-5.5, -0.3),
        wind_m_s=(10.0 ** rng.uniform(0.0, 2.0), 0.0, 0.0),
        motor_time_constant_s=10.0 ** rng.uniform(-6.0, -1.0),
        inertia_kg_m2=tuple(map(tuple, inertia.tolist())),
        parasitic_drag_kg_m=tuple(drag.tolist()),
    )
    return _flight("several", config)


def _flight(name: str, config: MultirotorConfig, **start: object) -> Flight:
    commands = random_commands(config, _COUNT, share=0.1, seed=7)
    return Flight(name=name, config=config, start=at_rest(config, **start), commands=commands)


CASES = (
    *(
        Case(
            name=f"mass {label}, 100 m/s wind, quadratic drag",
            make=functools.partial(light, "crazyflie", mass_kg),
        )
        for label, mass_kg in (
            ("30 g", 3e-2),
            ("5.3 g", 5.3e-3),
            ("3 g", 3e-3),
            ("0.3 g", 3e-4),
            ("30 mg", 3e-5),
            ("3 mg", 3e-6),
        )
    ),
    Case(
        name="mass 9.5 g, the same with a hummingbird's rotors",
        make=functools.partial(light, "hummingbird", 9.5e-3),
    ),
    Case(
        name="mass 3 mg, the same with a hummingbird's rotors",
        make=functools.partial(light, "hummingbird", 3e-6),
        stiff=True,
    ),
    *(
        Case(name=f"inertia x {share:g}", make=functools.partial(nimble, share), stiff=share < 1e-3)
        for share in (1.0, 1e-2, 1e-4, 1e-6)
    ),
    Case(name="inertia 1:10:100, 200 rad/s", make=functools.partial(slender, 1.0, 10.0, 100.0)),
    Case(name="inertia 1:10:10.9, 200 rad/s", make=functools.partial(slender, 1.0, 10.0, 10.9)),
    Case(name="inertia 1:100:100.9, 200 rad/s", make=functools.partial(slender, 1.0, 100.0, 100.9)),
    Case(name="bang-bang commands", make=bang_bang),
    Case(name="200 rad/s about three axes", make=fast_spin),
    Case(name="pitch through 90 degrees at 20 rad/s", make=through_vertical),
)
"""The extreme flights."""


def make_flight(case: Case) -> Flight | Refusal:
    """Return the flight of a case, or what the product says against its vehicle."""
    try:
        return case.make()
    except ValidationError as error:
        return Refusal(case=case.name, message=error.errors()[0]["msg"].removeprefix("Value error, "))


def measure_trials(
    name: str,
    flight: Flight,
    exact: MultirotorState,
    methods: Sequence[tuple[Method, float]],
    *,
    rotorpy_cpu_max_s: float,
) -> list[Trial]:
    """Fly one extreme flight with every method, each with its setting, and with RotorPy if it is there.

    Args:
        name: Of the case.
        flight: What to fly.
        exact: Its reference.
        methods: Methods and their settings.
        rotorpy_cpu_max_s: CPU time after which RotorPy is stopped [s]; 0 leaves it out.
    """
    trials = []
    for method, setting in methods:
        flyer = method.make(flight.config, 1, setting)
        fly(flyer, flight)  # compiled
        flown = fly(flyer, flight)
        trial = _trial(name, method.name, flown, flight, exact)
        trials.append(trial)
    if (
        rotorpy_cpu_max_s > 0.0
        and flight.config.motor_time_constant_s > 0.0
        and rotorpy_peer.rotorpy_version()
    ):
        flown = rotorpy_peer.fly_rotorpy(flight, "RK45", step_s=1e-3, cpu_max_s=rotorpy_cpu_max_s)
        trials.append(_trial(name, "RotorPy RK45, 1 ms", flown, flight, exact))
    return trials


def _trial(case: str, method: str, flown: Flown, flight: Flight, exact: MultirotorState) -> Trial:
    errors = flight_errors(flown.states, exact)
    outcome: Outcome = "flown"
    if flown.failure is not None:
        outcome = "DynamicsError"
    elif flown.stopped:
        outcome = "too slow"
    elif not errors.finite or errors.position_m > 1e6:
        outcome = "not finite"
    return Trial(
        case=case,
        method=method,
        outcome=outcome,
        errors=errors if outcome == "flown" else None,
        cpu_s_per_s=flown.cpu_s / flight.duration_s,
        redone_count=flown.redone_count,
        evaluation_count=flown.evaluation_count,
    )
