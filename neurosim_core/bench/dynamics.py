"""Dynamics: error against run time, order, stiff and extreme flights, an hour of flight, steps a second.

`measure_dynamics` measures; `dynamics_chapter` says what came of it. Times are CPU time of one core, the best
of several repetitions; ratios are of times taken in one run.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from neurosim_core.bench import rotorpy_peer
from neurosim_core.bench.dynamics_chapter import dynamics_chapter
from neurosim_core.bench.dynamics_extremes import (
    CASES,
    TIME_CONSTANTS_S,
    Refusal,
    make_flight,
    measure_trials,
    motor,
)
from neurosim_core.bench.dynamics_inputs import measure_inputs
from neurosim_core.bench.dynamics_long import (
    STAMPS_S,
    STEP_S,
    Drift,
    measure_formats,
    measure_hover,
    measure_spinning_hover,
    measure_top,
)
from neurosim_core.bench.dynamics_methods import (
    DORMAND_PRINCE,
    EULER,
    FIXED_STEP,
    MIDPOINT,
    RK4,
    RKMK4,
    Method,
    fly_called,
)
from neurosim_core.bench.dynamics_precision import STEPS_S, TOLERANCES, Sample, fit_order, measure_sample
from neurosim_core.bench.dynamics_reference import FreeTop, make_reference
from neurosim_core.bench.dynamics_result import DynamicsResult, Extreme, PeerSample, SolvedFlight, StiffMotor
from neurosim_core.bench.dynamics_scenes import SCENES, flight_errors
from neurosim_core.bench.dynamics_sweep import AT_ONCE, SWEEPS, Sweep, measure_sweep
from neurosim_core.bench.dynamics_throughput import (
    WAYS,
    Pruning,
    Throughput,
    measure_pruning,
    measure_throughput,
)
from neurosim_core.vehicle import preset

__all__ = ["QUICK", "Extent", "dynamics_chapter", "measure_dynamics"]

Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Extent:
    """How much is measured."""

    flights: tuple[str, ...] = tuple(SCENES)
    """Which of `SCENES`; the chapter needs the last three."""
    steps_s: tuple[float, ...] = STEPS_S
    """Divisors of `HOLD_NS`; 1 ms must be among them."""
    tolerances: tuple[float, ...] = TOLERANCES
    """1e-6 must be among them."""
    repetitions: int = 5
    cross_checked: tuple[str, ...] = tuple(SCENES)
    """Flights whose reference is checked with Radau."""
    peers: tuple[str, ...] = tuple(SCENES)
    """Flights that RotorPy flies."""
    peer_repetitions: int = 3
    time_constants_s: tuple[float, ...] = TIME_CONSTANTS_S
    stiff_peer_cpu_s: float = 5.0
    """CPU time that RotorPy gets for a stiff or extreme flight [s]."""
    cases: tuple[str, ...] = tuple(case.name for case in CASES)
    """Which extreme flights."""
    sweep_count: int = 200
    """Flights of each sweep; twice as many at random."""
    check_extremes: bool = True
    """Check the references of stiff and extreme flights with a second solver."""
    hover_stamps_s: tuple[int, ...] = STAMPS_S
    """When the drift of hover is looked at [s]; the chapter wants an hour."""
    top_stamps_s: tuple[int, ...] = STAMPS_S
    formats_stamps_s: tuple[int, ...] = STAMPS_S
    cpu_s: float = 0.5
    """Of one repetition of a throughput [s]."""


QUICK = Extent(
    steps_s=STEPS_S[:5],
    tolerances=(1e-4, 1e-6, 1e-8),
    repetitions=3,
    cross_checked=("rotor step", "flip"),
    peers=("rotor step", "figure eight"),
    peer_repetitions=1,
    time_constants_s=(1e-1, 1e-3, 1e-4, 1e-6, 0.0),
    stiff_peer_cpu_s=0.0,
    sweep_count=25,
    check_extremes=False,
    hover_stamps_s=(1, 10, 100, 3600),
    top_stamps_s=(1, 10, 100, 600),
    formats_stamps_s=(1, 10, 100),
    cpu_s=0.1,
)


def measure_dynamics(
    *, quick: bool = False, progress: Progress | None = None, extent: Extent | None = None
) -> DynamicsResult:
    """Measure everything that the chapter tells.

    Args:
        quick: A small version, in less than 40 s; figures of time are rough.
        progress: Told what is measured next.
        extent: How much is measured, if it is neither the whole nor the small version.
    """
    extent = extent or (QUICK if quick else Extent())
    say = progress or (lambda _: None)
    flights = _solve_flights(extent, say)
    samples = _sweep(extent, flights, say)
    extremes, refusals = _extremes(extent, say)
    return DynamicsResult(
        quick=quick,
        rotorpy=rotorpy_peer.rotorpy_version(),
        derivative_differences=_derivative_differences(),
        flights=flights,
        samples=samples,
        orders=tuple(
            fit_order(samples, method, f.flight.name, uncertainty=f.reference.uncertainty)
            for f in flights
            for method in FIXED_STEP
        ),
        peers=_peers(extent, flights, say),
        motors=_motors(extent, say),
        extremes=extremes,
        refusals=refusals,
        sweeps=_sweeps(extent, say),
        answers=measure_inputs(),
        drifts=_drifts(extent, say),
        throughputs=_throughputs(extent, say),
        prunings=_prunings(extent, say),
    )


def _solve_flights(extent: Extent, say: Progress) -> tuple[SolvedFlight, ...]:
    solved = []
    for name in extent.flights:
        say(f"reference of {name}")
        flight = SCENES[name]()
        solved.append(
            SolvedFlight(
                flight=flight, reference=make_reference(flight, cross_check=name in extent.cross_checked)
            )
        )
    return tuple(solved)


def _sweep(extent: Extent, flights: Sequence[SolvedFlight], say: Progress) -> tuple[Sample, ...]:
    samples = []
    for f in flights:
        settings = [(method, step_s) for method in FIXED_STEP for step_s in extent.steps_s]
        settings += [(DORMAND_PRINCE, rtol) for rtol in extent.tolerances]
        for method, setting in settings:
            say(f"{f.flight.name} with {method.name}")
            samples.append(
                measure_sample(method, f.flight, f.reference.states, setting, repetitions=extent.repetitions)
            )
    return tuple(samples)


def _derivative_differences() -> dict[str, float]:
    if rotorpy_peer.rotorpy_version() is None:
        return {}
    vehicles = ("crazyflie", "hummingbird")
    return {name: rotorpy_peer.derivative_difference(preset(name)) for name in vehicles}


def _peers(extent: Extent, flights: Sequence[SolvedFlight], say: Progress) -> tuple[PeerSample, ...]:
    """Fly RotorPy, and one vehicle of ours that is called just as often."""
    peers = []
    for f in flights:
        if f.flight.name not in extent.peers:
            continue
        ours = {
            f"ours, {1e3 * step_s:g} ms": functools.partial(fly_called, f.flight, step_s=step_s)
            for step_s in (1e-3, 1e-2)
        }
        theirs = {
            f"RotorPy {integrator}, {1e3 * step_s:g} ms": functools.partial(
                rotorpy_peer.fly_rotorpy, f.flight, integrator, step_s=step_s
            )
            for integrator, step_s in rotorpy_peer.USES
            if rotorpy_peer.rotorpy_version() is not None
        }
        for method, fly in {**ours, **theirs}.items():
            say(f"{f.flight.name} with {method}")
            runs = [fly() for _ in range(extent.peer_repetitions)]
            peers.append(
                PeerSample(
                    flight=f.flight.name,
                    method=method,
                    errors=flight_errors(runs[0].states, f.reference.states),
                    cpu_s_per_s=min(run.cpu_s for run in runs) / f.flight.duration_s,
                )
            )
    return tuple(peers)


_STIFF_METHODS: tuple[tuple[Method, float], ...] = (
    *((method, 1e-3) for method in FIXED_STEP),
    (DORMAND_PRINCE, 1e-6),
)
"""Methods of the stiff and the extreme flights, with step or tolerance."""


def _motors(extent: Extent, say: Progress) -> tuple[StiffMotor, ...]:
    motors = []
    for time_constant_s in extent.time_constants_s:
        say(f"motor time constant {time_constant_s:g} s")
        flight = motor(time_constant_s)
        reference = make_reference(flight, cross_check=extent.check_extremes)
        trials = measure_trials(
            f"{time_constant_s:g} s",
            flight,
            reference.states,
            _STIFF_METHODS,
            rotorpy_cpu_max_s=extent.stiff_peer_cpu_s,
        )
        motors.append(StiffMotor(time_constant_s=time_constant_s, reference=reference, trials=tuple(trials)))
    return tuple(motors)


def _extremes(extent: Extent, say: Progress) -> tuple[tuple[Extreme, ...], tuple[Refusal, ...]]:
    extremes, refusals = [], []
    for case in CASES:
        if case.name not in extent.cases:
            continue
        say(case.name)
        flight = make_flight(case)
        if isinstance(flight, Refusal):
            refusals.append(flight)
            continue
        reference = make_reference(flight, stiff=case.stiff, cross_check=extent.check_extremes)
        trials = measure_trials(
            case.name,
            flight,
            reference.states,
            _STIFF_METHODS,
            rotorpy_cpu_max_s=extent.stiff_peer_cpu_s,
        )
        extremes.append(Extreme(case=case.name, reference=reference, trials=tuple(trials)))
    return tuple(extremes), tuple(refusals)


def _sweeps(extent: Extent, say: Progress) -> tuple[Sweep, ...]:
    sweeps = []
    for name in (*SWEEPS, AT_ONCE):
        say(name)
        sweeps.append(measure_sweep(name, extent.sweep_count * (2 if name == AT_ONCE else 1)))
    return tuple(sweeps)


def _drifts(extent: Extent, say: Progress) -> tuple[Drift, ...]:
    drifts = []
    for method, setting in ((RKMK4, STEP_S), (DORMAND_PRINCE, 1e-6)):
        say(f"long hover with {method.name}")
        drifts.append(measure_hover(method, setting, extent.hover_stamps_s))
        drifts.append(measure_spinning_hover(method, setting, extent.hover_stamps_s))
    tops = ((EULER, STEP_S), (MIDPOINT, STEP_S), (RK4, STEP_S), (RKMK4, STEP_S), (DORMAND_PRINCE, 1e-10))
    for method, setting in tops:
        say(f"free top with {method.name}")
        drifts.append(measure_top(method, setting, extent.top_stamps_s, FreeTop()))
    say("float32 against float64")
    return (*drifts, *measure_formats(extent.formats_stamps_s))


def _throughputs(extent: Extent, say: Progress) -> tuple[Throughput, ...]:
    throughputs = []
    for load, call, vehicles, steps_per_call in WAYS:
        say(f"{vehicles} vehicles, {steps_per_call} steps a call, {load}")
        throughputs.append(
            measure_throughput(
                load=load,
                vehicles=vehicles,
                steps_per_call=steps_per_call,
                call=call,
                repetitions=extent.repetitions,
                cpu_s=extent.cpu_s,
            )
        )
    return tuple(throughputs)


def _prunings(extent: Extent, say: Progress) -> tuple[Pruning, ...]:
    say("terms left out")
    configs = {
        "hummingbird": preset("hummingbird"),
        "crazyflie": preset("crazyflie"),
        "racer": preset("racer"),
        "racer without motor lag": preset("racer", motor_time_constant_s=0.0),
    }
    return tuple(
        measure_pruning(name, config, repetitions=extent.repetitions, cpu_s=extent.cpu_s)
        for name, config in configs.items()
    )
