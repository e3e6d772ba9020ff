# mypy: disable-error-code="no-untyped-call,attr-defined,union-attr"
"""The integrators that are compared, called alike: a command, then an advance by one compiled launch."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp

from neurosim_core.bench.dynamics_baselines import make_baselines
from neurosim_core.bench.dynamics_scenes import HOLD_NS, Flight, stacked
from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig, MultirotorState
from neurosim_core.vehicle.multirotor import make_airframe


class Flyer(Protocol):
    """A batch of vehicles and what moves them."""

    vehicle: Multirotor
    """Its arrays hold state and commands."""

    def advance(self, duration_ns: int) -> None:
        """Move all vehicles with the commands in the arrays; as cheap as `Multirotor.advance`."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """One integrator."""

    name: str
    """Of its line and rows."""
    order: int | None
    """Order in the step size; None where the method chooses its steps."""
    make: Callable[[MultirotorConfig, int, float], Flyer]
    """Makes a flyer from a vehicle, a number of copies, and the step [s] or the tolerance."""


class _Product:
    """The product's vehicle as it is."""

    def __init__(self, vehicle: Multirotor) -> None:
        self.vehicle = vehicle

    def advance(self, duration_ns: int) -> None:
        self.vehicle.advance(duration_ns)


def _fixed(config: MultirotorConfig, count: int, step_s: float) -> Flyer:
    return _Product(Multirotor(config, count=count, max_step_ns=round(step_s * 1e9)))


def _adaptive(config: MultirotorConfig, count: int, rtol: float) -> Flyer:
    return _Product(
        Multirotor(config, count=count, integrator="dormand_prince", rtol=rtol, atol=_ATOL_PER_RTOL * rtol)
    )


_ATOL_PER_RTOL = 1e-2  # as in the product's defaults


class _Baseline:
    """A baseline's kernel on the arrays of a vehicle."""

    def __init__(self, kernel: str, config: MultirotorConfig, count: int, step_s: float) -> None:
        if config.rotor_count != 4:
            raise ValueError(f"the baselines are for 4 rotors, got {config.rotor_count}")
        self.vehicle = Multirotor(config, count=count)
        self._kernel = getattr(make_baselines(frozenset(self.vehicle.terms)), kernel)
        self._step_s = step_s
        self._launches: dict[int, Any] = {}

    def advance(self, duration_ns: int) -> None:
        launch = self._launches.get(duration_ns)
        if launch is None:
            launch = self._launches[duration_ns] = self._record(duration_ns)
        launch.launch()

    def _record(self, duration_ns: int) -> Any:
        step_count = -(-duration_ns // round(self._step_s * 1e9))
        a = self.vehicle.arrays
        return wp.launch(
            self._kernel,
            dim=self.vehicle.count,
            inputs=[
                *make_airframe(self.vehicle.config, self.vehicle.device),
                self.vehicle.config.motor_time_constant_s,
                duration_ns * 1e-9 / step_count,
                step_count,
                a.rotor_speed_command,
            ],
            outputs=[a.position, a.velocity, a.orientation, a.body_rate, a.rotor_speed],
            device=self.vehicle.device,
            record_cmd=True,
        )


def _baseline(kernel: str) -> Callable[[MultirotorConfig, int, float], Flyer]:
    return lambda config, count, step_s: _Baseline(kernel, config, count, step_s)


EULER = Method(name="explicit Euler", order=1, make=_baseline("euler"))
MIDPOINT = Method(name="implicit midpoint", order=2, make=_baseline("midpoint"))
RK4 = Method(name="RK4, quaternion", order=4, make=_baseline("rk4"))
RKMK4 = Method(name="RKMK4 (ours)", order=4, make=_fixed)
DORMAND_PRINCE = Method(name="Dormand-Prince (ours)", order=None, make=_adaptive)

FIXED_STEP = (EULER, MIDPOINT, RK4, RKMK4)
"""Methods whose setting is the step."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Flown:
    """A flight as a method flew it."""

    states: MultirotorState
    """At the end of each hold, leading [K]; what is not finite stays in it."""
    cpu_s: float
    """CPU time of the launches, per vehicle [s]."""
    failure: DynamicsError | None = None
    """What the vehicle raised: from there on it is held."""
    redone_count: int = 0
    """Holds that the product gave to its adaptive method."""
    evaluation_count: int = 0
    """Right-hand sides that the adaptive method evaluated."""
    stopped: bool = False
    """Whether it took too long and was given up."""


def fly(flyer: Flyer, flight: Flight) -> Flown:
    """Fly from the start through all commands, and time the launches alone."""
    vehicle = flyer.vehicle
    vehicle.reset(*flight.start)
    states, spent_ns = [], 0
    for command in flight.commands:
        vehicle.command(command)
        begin = time.thread_time_ns()
        flyer.advance(HOLD_NS)
        spent_ns += time.thread_time_ns() - begin
        states.append(first_state(vehicle))
    try:
        vehicle.check()
        failure = None
    except DynamicsError as error:
        failure = error
    effort = vehicle.effort
    return Flown(
        states=stacked(states),
        cpu_s=1e-9 * spent_ns / vehicle.count,
        failure=failure,
        redone_count=int(effort.redone_count[0]),
        evaluation_count=int(effort.evaluation_count[0]),
    )


def first_state(vehicle: Multirotor) -> MultirotorState:
    """Return a copy of the state of the first vehicle on a CPU."""
    a = vehicle.arrays
    return MultirotorState(
        *(np.array(x.numpy()[0]) for x in (a.position, a.velocity, a.orientation, a.body_rate, a.rotor_speed))
    )


def fly_called(flight: Flight, *, step_s: float) -> Flown:
    """Fly one vehicle through the checked form, `Multirotor.step`, once a command, and time all of it."""
    vehicle = Multirotor(flight.config, max_step_ns=round(step_s * 1e9))
    vehicle.step(flight.commands[0], HOLD_NS)  # compiled
    vehicle.reset(*flight.start)
    states, spent_ns = [], 0
    for command in flight.commands:
        begin = time.thread_time_ns()
        vehicle.step(command, HOLD_NS)
        spent_ns += time.thread_time_ns() - begin
        states.append(first_state(vehicle))
    return Flown(states=stacked(states), cpu_s=1e-9 * spent_ns)
