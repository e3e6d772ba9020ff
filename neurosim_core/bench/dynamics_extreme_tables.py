"""The tables of stiff and extreme flights, of inputs that mean nothing, and of long runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from neurosim_core.bench.chapter import Table
from neurosim_core.bench.dynamics_extremes import Trial, trial_of, trial_position_m
from neurosim_core.bench.dynamics_methods import DORMAND_PRINCE, RKMK4
from neurosim_core.bench.dynamics_result import DynamicsResult
from neurosim_core.bench.dynamics_sweep import AT_ONCE, sweep_worst_m


def motor_table(result: DynamicsResult) -> Table:
    """Return the table of stiff motors."""
    methods = _methods(t for m in result.motors for t in m.trials)
    return Table(
        name="dynamics-motor",
        title="Stiff motors: position error [m] over 0.2 s of random commands",
        columns={
            "time_constant_s": "motor time constant [s]",
            **methods,
            "evaluation_count": "evaluations of Dormand-Prince",
            "reference_m": "reference known to [m]",
        },
        rows=[
            {
                "time_constant_s": m.time_constant_s,
                **_pivot(m.trials),
                "evaluation_count": trial_of(m.trials, DORMAND_PRINCE.name).evaluation_count,
                "reference_m": m.reference.uncertainty.position_m,
            }
            for m in result.motors
        ],
        note="Hummingbird, new commands within 10 % of hover every 10 ms, steps of 1 ms or rtol 1e-6. The "
        "reference has the lag in closed form. RotorPy cannot have a time constant of 0; *too slow*: "
        "stopped after 5 s of CPU time.",
    )


def extremes_table(result: DynamicsResult) -> Table:
    """Return the table of extreme flights."""
    methods = _methods(t for e in result.extremes for t in e.trials)
    rows: list[dict[str, object]] = [
        {
            "case": e.case,
            **_pivot(e.trials),
            "attitude_rad": _attitude(trial_of(e.trials, RKMK4.name)),
            "redone_count": trial_of(e.trials, RKMK4.name).redone_count,
            "evaluation_count": trial_of(e.trials, DORMAND_PRINCE.name).evaluation_count,
            "reference_m": e.reference.uncertainty.position_m,
        }
        for e in result.extremes
    ]
    rows += [{"case": r.case, _key(RKMK4.name): "refused: ValueError"} for r in result.refusals]
    return Table(
        name="dynamics-extremes",
        title="Extreme flights: position error [m] over 0.2 s",
        columns={
            "case": "flight",
            **methods,
            "attitude_rad": "attitude, RKMK4 [rad]",
            "redone_count": "redone holds of 20",
            "evaluation_count": "evaluations of Dormand-Prince",
            "reference_m": "reference known to [m]",
        },
        rows=rows,
        note="Steps of 1 ms, or rtol 1e-6. *RKMK4 (ours)* is the product as it is: holds of 10 ms in which "
        "its guard trips are flown again by Dormand-Prince, and counted. *not finite*: NaN, or 1000 km "
        "off. " + " ".join(f"Refused, {r.case}: {r.message}." for r in result.refusals),
    )


def sweep_table(result: DynamicsResult) -> Table:
    """Return the table of extreme flights in fine steps of one parameter."""
    return Table(
        name="dynamics-sweep",
        title="Extreme flights in fine steps: the product against its adaptive steps at 1e-12",
        columns={
            "sweep": "what is varied",
            "count": "flights",
            "median_m": "position, median [m]",
            "worst_m": "worst [m]",
            "worst_at": "at",
            "worst_redone": "redone holds of 20 there",
            "redone_share": "flights with redone holds",
        },
        rows=[
            {
                "sweep": s.name,
                "count": len(s.values),
                "median_m": float(np.nanmedian(s.position_m)),
                "worst_m": sweep_worst_m(s),
                "worst_at": None if s.name == AT_ONCE else float(s.values[s.worst]),
                "worst_redone": int(s.redone[s.worst]),
                "redone_share": float((s.redone > 0).mean()),
            }
            for s in result.sweeps
        ],
        note="Values in equal ratios. Fixed steps are worst just before the guard trips. Not judged: the "
        "last row, where several things are extreme at once and the guard, which is no estimate of "
        "accuracy, may let more pass; `integrator: dormand_prince` holds its tolerance there.",
    )


def inputs_table(result: DynamicsResult) -> Table:
    """Return the table of inputs that mean nothing, with the errors that they raise."""
    return Table(
        name="dynamics-inputs",
        title="Inputs that mean nothing, and what the vehicle says",
        columns={"input": "input", "error": "error", "message": "message"},
        rows=[
            {"input": a.input, "error": a.error or "none: accepted", "message": a.message}
            for a in result.answers
        ],
        note="Given to `MultirotorConfig`, `Multirotor.reset` and `.step`; the last two reach the device and "
        "are found there: the vehicle is held at its last good state.",
    )


def _methods(trials: Iterable[Trial]) -> dict[str, str]:
    """Return columns for all methods, in order."""
    return {_key(trial.method): trial.method for trial in trials}


def _key(method: str) -> str:
    """Return the key of a method's column: letters and digits only."""
    return "_".join("".join(c if c.isalnum() else " " for c in method.lower()).split())


def _pivot(trials: Sequence[Trial]) -> dict[str, object]:
    return {_key(t.method): trial_position_m(t) if t.outcome == "flown" else t.outcome for t in trials}


def long_runs_table(result: DynamicsResult) -> Table:
    """Return the table of what has drifted at the end of long runs."""
    return Table(
        name="dynamics-long",
        title="Long runs: what has drifted at the end",
        columns={
            "run": "run",
            "method": "method",
            "duration_s": "after [s]",
            "position_m": "position [m]",
            "attitude_rad": "attitude [rad]",
            "energy": "energy, relative",
            "momentum": "momentum in W, relative",
            "cpu_s": "CPU [s]",
        },
        rows=[
            {
                "run": d.run,
                "method": d.method,
                "duration_s": d.stamps_s[-1],
                "position_m": d.position_m[-1] if d.position_m else None,
                "attitude_rad": d.attitude_rad[-1],
                "energy": d.energy[-1] if d.energy else None,
                "momentum": d.momentum[-1] if d.momentum else None,
                "cpu_s": d.cpu_s,
            }
            for d in result.drifts
        ],
        note="Steps of 1 ms; Dormand-Prince in intervals of 0.1 s, at rtol 1e-6 in hover and 1e-10 for the "
        "top. *hover*: a hummingbird with all its terms at a fixed point, so that rounding is all there "
        "is. *spinning hover*: the product turning at 29 rad/s, without drag. "
        "*free top*: moments 1 : 2 : 2.5 at 19 rad/s, against Jacobi's elliptic functions; a dash: "
        "lost. *spin*: hover while turning at 29 rad/s, in two formats of number by one RK4 kernel of the "
        "study; most of what float32 drifts is a thrust that cannot be rounded to the weight. The "
        "product's kernels are float64 throughout.",
    )


def _attitude(trial: Trial) -> float | None:
    return None if trial.errors is None else trial.errors.attitude_rad
