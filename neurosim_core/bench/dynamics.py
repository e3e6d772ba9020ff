"""Dynamics: error against run time, stiff and extreme flights.

SciPy judges the vehicle on equations of its own (`dynamics_oracle`); RotorPy stands beside it. Times are CPU
time of one core, the best of several repetitions; ratios are of times taken in one run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from neurosim_core.bench.dynamics_oracle import (
    EXTREMES,
    FLIGHTS,
    HOLD_NS,
    INSTALL_ROTORPY,
    MOTORS_S,
    Array,
    Flight,
    Reference,
    compare,
    fly_rotorpy,
    make_reference,
    rotorpy_version,
    short_flight,
)
from neurosim_core.bench.engine import DynamicsError, Multirotor
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Panel, Plot, Row, Table, cell, panel

RKMK4, DORMAND_PRINCE, CALLED = "RKMK4 (ours)", "Dormand-Prince (ours)", "ours, called from Python"
ROTORPY = "RotorPy RK45"
STEPS_S = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
"""Steps [s]."""
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
LIMITS_M = {"figure eight": 1e-6, "flip": 1e-10, "tumble": 1e-8}
"""Largest position errors at steps of 1 ms [m]."""
POSITION_M, ATTITUDE, CPU, STEP = "position [m]", "attitude [rad]", "CPU [s/s]", "step [ms]"
KNOWN = "reference known to [m]"
_ORACLE = "SciPy's DOP853 at rtol 3e-14 on equations of its own; Radau at 1e-11 where it is stiff"
_STEPS_PER_LAUNCH = 250
"""So that the 3 us of a launch count for little, copies of the vehicle fly beside it."""


def measure(options: Options) -> Chapter:
    """Measure, and return the chapter."""
    quick = options.quick
    samples: list[Row] = []
    peers: list[Row] = []
    for name in FLIGHTS:
        options.progress(name)
        of_flight, of_peers = options.stage(name, partial(_precise, name, quick))
        samples += of_flight
        peers += of_peers
    lagging = {tau_s: partial(short_flight, "hummingbird", motor_time_constant_s=tau_s) for tau_s in MOTORS_S}
    motors = _hard({f"{tau_s:g} s": (make, False) for tau_s, make in lagging.items()}, options)
    extremes = _hard(EXTREMES, options)
    claims = [
        *(_precision_claim(samples, flight, limit_m) for flight, limit_m in LIMITS_M.items()),
        _hard_claim("any motor time constant", motors, 1e-8),
        _hard_claim("every extreme flight that is flown", extremes, 1e-5),
        _peer_claim(peers),
    ]
    at_one_ms = [row for row in samples if row[STEP] == 1.0 or row["rtol"] == 1e-6]
    errors = {row["method"]: cell(_error_m(row)) for row in at_one_ms if row["flight"] == "figure eight"}
    sampled = "Largest errors over the ends of all holds of 10 ms. CPU is of launches, per simulated second."
    hard = (
        "Position errors [m] after steps of 1 ms, or at rtol 1e-6. RKMK4 (ours) is the vehicle as it is: "
        "holds in which its guard trips are flown again by Dormand-Prince. Not finite: NaN, or 1000 km off."
    )
    return Chapter(
        name="dynamics",
        title="Dynamics: error against run time, stiff and extreme flights",
        summary="At steps of 1 ms 5 s of a figure eight at 9 m/s end with position errors of "
        + ", ".join(f"{error} m by {method}" for method, error in errors.items())
        + f". Called alike from Python, against RotorPy's RK45: {claims[-1].measured}.\n\nExtreme flights (3 "
        f"mg in a storm, a millionth of the inertia, 200 rad/s): {claims[-2].measured}.",
        claims=claims,
        tables=[
            Table("dynamics-1-ms", "Error at steps of 1 ms, or at rtol 1e-6", at_one_ms, sampled),
            Table("dynamics-rotorpy", "RotorPy on the same flights", peers, "Ratios of CPU times."),
            Table("dynamics-motor", "Stiff motors, 0.2 s", _pivot(motors), hard),
            Table("dynamics-extremes", "Extreme flights, 0.2 s", _pivot(extremes), hard),
            Table("dynamics-work-precision", "Error against CPU time and step", samples, sampled),
        ],
        plots=_plots(samples, peers, motors),
    )


def _fly(
    flight: Flight, *, copies: int = 1, repetitions: int = 1, called: bool = False, **options: Any
) -> tuple[Array, Row]:
    """Fly the vehicle through all commands, and time the launches alone, or the checked calls from Python.

    Returns states at the end of each hold, shape [K, 13 + R], and CPU time and effort as part of a row.
    """
    vehicle = Multirotor(flight.config, count=copies, **options)
    vehicle.step(np.tile(flight.commands[0], (copies, 1)), HOLD_NS)  # compiles
    best_s, states, outcome = math.inf, np.empty(0), "flown"
    for _ in range(repetitions):
        vehicle.reset(*flight.start)
        rows, spent_ns = [], 0
        for command in flight.commands:
            if not called:
                vehicle.command(command)
            begin_ns = time.thread_time_ns()
            vehicle.step(command, HOLD_NS) if called else vehicle.advance(HOLD_NS)
            spent_ns += time.thread_time_ns() - begin_ns
            rows.append(np.concatenate([values[0] for values in vehicle.state]))
        best_s, states = min(best_s, 1e-9 * spent_ns / copies), np.array(rows)
    try:
        vehicle.check()
    except DynamicsError:
        outcome = "DynamicsError"
    row: Row = {CPU: best_s / flight.duration_s, "outcome": outcome}
    row["redone holds"] = int(vehicle.effort.redone_count[0])
    return states, row | {"evaluations": int(vehicle.effort.evaluation_count[0])}


def _row(flight: str, method: str, setting: float, states: Array, reference: Reference, **known: Any) -> Row:
    """Return a row of a flight as a method flew it; there are errors where it was flown to its end."""
    errors = compare(states, reference.states)
    adaptive = method == DORMAND_PRINCE
    row: Row = {"flight": flight, "method": method, STEP: None if adaptive else 1e3 * setting}
    row |= {"rtol": setting if adaptive else None, "outcome": "flown", **known}
    if not errors.finite and row["outcome"] == "flown":
        row["outcome"] = "not finite"
    if row["outcome"] == "flown":
        row |= {POSITION_M: errors.position_m, ATTITUDE: errors.attitude_rad}
        row |= {"body rate [rad/s]": errors.body_rate_rad_s, KNOWN: reference.uncertainty.position_m}
    return row


def _ours(flight: Flight, name: str, method: str, setting: float, known: Reference, repetitions: int) -> Row:
    if method == DORMAND_PRINCE:
        options: dict[str, Any] = {"integrator": "dormand_prince", "rtol": setting, "atol": 1e-2 * setting}
    else:
        options = {"max_step_ns": round(1e9 * setting)}
    steps = 8.0 if method == DORMAND_PRINCE else HOLD_NS * 1e-9 / setting  # adaptive steps are about so many
    copies = int(np.clip(round(_STEPS_PER_LAUNCH / steps), 1, 256)) if repetitions > 1 else 1
    states, measured = _fly(flight, copies=copies, repetitions=repetitions, **options)
    return _row(name, method, setting, states, known, **measured)


def _precise(name: str, quick: bool) -> tuple[list[Row], list[Row]]:
    """Fly one of `FLIGHTS` with every method and setting, and as RotorPy is called from Python."""
    flight = FLIGHTS[name]()
    known = make_reference(flight, cross_check=name == "flip" and not quick)
    settings = [(RKMK4, step_s) for step_s in (STEPS_S[:5] if quick else STEPS_S)]
    settings += [(DORMAND_PRINCE, rtol) for rtol in (TOLERANCES[1:6:2] if quick else TOLERANCES)]
    rows = [_ours(flight, name, method, value, known, 3 if quick else 5) for method, value in settings]
    peers = not quick or name == "figure eight"
    return rows, _peers(flight, known) if peers else []


def _peers(flight: Flight, known: Reference) -> list[Row]:
    """Fly RotorPy, and one vehicle of ours that is called from Python: once a command."""
    rows = []
    for step_s in (1e-3, 1e-2):
        states, measured = _fly(flight, repetitions=3, called=True, max_step_ns=round(1e9 * step_s))
        rows.append(_row(flight.name, CALLED, step_s, states, known, **{CPU: measured[CPU]}))
    for step_s in (1e-3, 1e-2) if rotorpy_version() else ():
        states, cpu_s = fly_rotorpy(flight, step_s)
        row = _row(flight.name, ROTORPY, step_s, states, known, **{CPU: cpu_s / flight.duration_s})
        exacter = [mine[CPU] for mine in rows[:2] if _error_m(mine) <= _error_m(row)]
        row["ratio to ours, no less exact"] = row[CPU] / min(exacter) if exacter else None
        rows.append(row)
    return rows


def _hard(cases: Mapping[str, tuple[Callable[[], Flight], bool]], options: Options) -> list[Row]:
    """Fly stiff and extreme flights by all methods, at 1 ms or rtol 1e-6; what is refused says why."""
    rows: list[Row] = []
    for name, (make, stiff) in cases.items():
        options.progress(name)
        rows += options.stage(name, partial(_hard_case, name, make, stiff, options.quick))
    return rows


def _hard_case(name: str, make: Callable[[], Flight], stiff: bool, quick: bool) -> list[Row]:
    try:
        flight = make()
    except ValueError as error:
        why = str(error).splitlines()[-1].strip()  # the line above says of which settings
        return [{"flight": name, "method": RKMK4, "outcome": f"refused: {why}"}]
    known = make_reference(flight, stiff=stiff)
    methods = ((RKMK4, 1e-3), (DORMAND_PRINCE, 1e-6))
    rows = [_ours(flight, name, method, setting, known, 1) for method, setting in methods]
    if rotorpy_version() and flight.config.motor_time_constant_s > 0.0 and not quick:
        states, cpu_s = fly_rotorpy(flight, 1e-3, cpu_max_s=5.0)
        outcome = "too slow" if cpu_s > 5.0 and not np.isfinite(states).all() else "flown"
        rows.append(_row(name, ROTORPY, 1e-3, states, known, outcome=outcome))
    return rows


def _precision_claim(samples: Sequence[Row], flight: str, limit_m: float) -> Claim:
    error_m = _error_m(_find(samples, flight, RKMK4))
    text = f"{flight} at steps of 1 ms: the position error is <= {cell(limit_m)} m"
    return Claim(text, _ORACLE, f"{cell(error_m)} m", error_m <= limit_m)


def _hard_claim(what: str, rows: Sequence[Row], limit_m: float) -> Claim:
    """Judge the vehicle: it flies within the limit, refuses, or raises; it is never silently wrong."""
    ours = [row for row in rows if row["method"] == RKMK4]
    flown = [row for row in ours if row["outcome"] == "flown"]
    raised = [row["flight"] for row in ours if row["outcome"].startswith(("DynamicsError", "refused"))]
    worst = max(flown, key=_error_m)
    redone = sum(row["redone holds"] > 0 for row in flown)
    text = f"{what}: the position error is <= {cell(limit_m)} m after 0.2 s at 1 ms; others raise errors"
    said = (
        f"{len(flown)} flown, at most {cell(_error_m(worst))} m ({worst['flight']}), {redone} of them with "
    )
    said += "adaptive steps where fixed ones tripped the guard"
    said += f"; errors raised: {', '.join(raised)}" if raised else ""
    return Claim(text, _ORACLE, said, _error_m(worst) <= limit_m and len(flown) + len(raised) == len(ours))


def _peer_claim(peers: Sequence[Row]) -> Claim:
    text = "figure eight, called from Python once a command: >= 10 times as fast as RotorPy at 1 ms, as exact"
    reference = "RotorPy 3.0, arXiv 2306.04485, in the same run"
    if rotorpy_version() is None:
        return Claim(text, reference, INSTALL_ROTORPY, None)
    ours, theirs = (_find(peers, "figure eight", method) for method in (CALLED, ROTORPY))
    ratio, exact = theirs[CPU] / ours[CPU], _error_m(ours) <= _error_m(theirs)
    said = f"{ratio:,.0f} times, {cell(_error_m(ours))} m against {cell(_error_m(theirs))} m"
    return Claim(text, reference, said, ratio >= 10.0 and exact)


def _find(rows: Iterable[Row], flight: str, method: str) -> Row:
    """Return the row of a method at 1 ms."""
    return next(row for row in rows if (row["flight"], row["method"], row[STEP]) == (flight, method, 1.0))


def _error_m(row: Row) -> float:
    return float(row.get(POSITION_M, math.inf))


def _pivot(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each flight, with the position error or the outcome of each method."""
    methods = dict.fromkeys(row["method"] for row in rows)
    found = []
    for flight in dict.fromkeys(row["flight"] for row in rows):
        mine = {row["method"]: row for row in rows if row["flight"] == flight}
        told: Row = {"flight": flight}
        told |= {m: mine[m].get(POSITION_M, mine[m]["outcome"]) if m in mine else None for m in methods}
        told["redone holds of 20"] = mine[RKMK4].get("redone holds")
        told["evaluations of Dormand-Prince"] = mine.get(DORMAND_PRINCE, {}).get("evaluations")
        found.append({**told, KNOWN: next((row[KNOWN] for row in mine.values() if KNOWN in row), None)})
    return found


def _plots(samples: list[Row], peers: list[Row], motors: list[Row]) -> list[Plot]:
    def panels(rows: list[Row], x: str, y: str) -> list[Panel]:
        by_flight = {name: [row for row in rows if row["flight"] == name] for name in FLIGHTS}
        limits = {"log": "xy", "y_min": 1e-16, "y_max": 1e2}
        return [panel(r, x, y, by="method", title=f, **limits) for f, r in by_flight.items()]

    tau = "motor time constant [s]; 1e-7: none"
    stiff = [{**row, tau: float(row["flight"].split()[0]) or 1e-7} for row in motors]
    timed, stepped = [row for row in (*samples, *peers) if CPU in row], [row for row in samples if row[STEP]]
    steps = [*panels(stepped, STEP, POSITION_M), *panels(stepped, STEP, ATTITUDE)]
    lost = "Stiff motors, steps of 1 ms or rtol 1e-6; no mark: not finite, or too slow"
    motor = panel(stiff, tau, POSITION_M, by="method", log="xy", x_lines={"step": 1e-3})
    return [
        Plot("dynamics-work-precision", "Error against CPU time", panels(timed, CPU, POSITION_M), 2),
        Plot("dynamics-step", "Error against step size", steps, 4),
        Plot("dynamics-motor", lost, [motor]),
    ]
