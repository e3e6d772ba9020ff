"""Inputs that mean nothing, given to the vehicle: what it says to each of them."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurosim_core.vehicle import (
    DynamicsError,
    Multirotor,
    preset,
)

_MS = 1_000_000
_NAN, _INF = math.nan, math.inf
_SCALARS = (
    "mass_kg",
    "thrust_coefficient_n_s2",
    "torque_coefficient_n_m_s2",
    "rotor_drag_kg",
    "rotor_inflow_kg",
    "translational_lift_kg_m",
    "flapping_kg_m",
    "motor_time_constant_s",
    "rotor_speed_min_rad_s",
    "rotor_speed_max_rad_s",
    "gravity_m_s2",
)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What came of an input."""

    input: str
    """What was given, and where."""
    error: str
    """Type of the error; empty if there was none."""
    message: str
    """Its first line that says why."""


def measure_inputs() -> tuple[Answer, ...]:
    """Give each input, and note the answer."""
    return tuple(_ask(name, give) for name, give in _inputs())


def _ask(name: str, give: Callable[[], object]) -> Answer:
    try:
        give()
    except (ValueError, TypeError, DynamicsError) as error:
        details = getattr(error, "errors", None)
        text = details()[0]["msg"] if callable(details) else str(error)
        return Answer(input=name, error=type(error).__name__, message=text.splitlines()[0])
    return Answer(input=name, error="", message="")


Question = tuple[str, Callable[[], object]]
"""What is given, in words, and how."""


def _inputs() -> Iterator[Question]:
    def made(**parameters: Any) -> Callable[[], object]:
        return functools.partial(preset, "hummingbird", **parameters)

    for name in _SCALARS:
        for bad in (_NAN, _INF, -1.0):
            yield f"{name}: {bad:g}", made(**{name: bad})
    for bad in (_NAN, _INF, -1.0, 0.0):
        inertia = tuple(map(tuple, np.diag(np.full(3, bad)).tolist()))
        yield f"inertia_kg_m2: {bad:g}", made(inertia_kg_m2=inertia)
    yield "mass_kg: 0", made(mass_kg=0.0)
    for bad in (_NAN, _INF):
        yield f"wind_m_s: {bad:g}", made(wind_m_s=(bad, 0.0, 0.0))
    for bad in (_NAN, _INF, -1.0):
        yield f"parasitic_drag_kg_m: {bad:g}", made(parasitic_drag_kg_m=(bad, 0.0, 0.0))
        gust = {"velocity_m_s": (1.0, 0.0, 0.0), "start_s": 0.0, "rise_s": bad}
        yield f"gusts.rise_s: {bad:g}", made(gusts=(gust,))
        yield f"turbulence.wind_20ft_m_s: {bad:g}", made(turbulence={"wind_20ft_m_s": bad})
        yield f"ground.stiffness_n_m: {bad:g}", made(ground={"stiffness_n_m": bad})
    yield from _states()


def _states() -> Iterator[Question]:
    vehicle = Multirotor(preset("hummingbird"))
    widths = {"position": 3, "velocity": 3, "orientation": 4, "body_rate": 3, "rotor_speed": 4}
    for name, width in widths.items():
        for bad in (_NAN, _INF):
            row: Any = {name: np.full(width, bad)}
            yield f"reset({name}): {bad:g}", functools.partial(vehicle.reset, **row)
    yield "reset(orientation): 0", functools.partial(vehicle.reset, orientation=np.zeros(4))
    yield "reset(rotor_speed): -1", functools.partial(vehicle.reset, rotor_speed=np.full(4, -1.0))
    for bad in (_NAN, _INF):
        yield f"step(command): {bad:g}", functools.partial(vehicle.step, np.full(4, bad), _MS)
    for duration in (0, -1, 0.5):
        step: Any = vehicle.step
        yield f"step(duration_ns): {duration:g}", functools.partial(step, np.ones(4), duration)
    yield "a NaN among commands on the device", _nan_on_the_device
    yield "a velocity of 1e150 m/s", _beyond_all_speeds


def _nan_on_the_device() -> None:
    vehicle = Multirotor(preset("hummingbird"))
    commands: Any = vehicle.arrays.rotor_speed_command
    commands.assign(np.full((1, 4), _NAN))
    vehicle.advance(_MS)
    vehicle.check()


def _beyond_all_speeds() -> None:
    vehicle = Multirotor(preset("hummingbird"))
    vehicle.reset(velocity=(1e150, 0.0, 0.0))
    vehicle.step(np.full(4, 500.0), _MS)
