"""The chapter on dynamics: what was promised, the tables, and the answer in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from neurosim_core.bench import rotorpy_peer
from neurosim_core.bench.chapter import Bar, Chapter, Table, cell
from neurosim_core.bench.dynamics_extremes import Trial
from neurosim_core.bench.dynamics_long import Drift
from neurosim_core.bench.dynamics_methods import DORMAND_PRINCE, EULER, FIXED_STEP, RK4, RKMK4
from neurosim_core.bench.dynamics_plots import dynamics_plots
from neurosim_core.bench.dynamics_precision import Sample
from neurosim_core.bench.dynamics_result import DynamicsResult, PeerSample
from neurosim_core.bench.dynamics_sweep import AT_ONCE, Sweep
from neurosim_core.bench.dynamics_throughput import Throughput
from neurosim_core.vehicle import TERMS

_MS = 1e-3
_POSITION_BARS_M = {"figure eight": 1e-6, "flip": 1e-10, "tumble": 1e-8}
_MOTOR_BAR_M = 1e-8
_EXTREME_BAR_M = 1e-5
_HOVER_BAR_M = 1e-4
_SINGLE_BAR_PER_S = 2e6
_PEER_BAR = 1000.0
_BATCH_BAR_PER_S = 3e6
_PRUNING_BAR = 1.5


def dynamics_chapter(result: DynamicsResult) -> Chapter:
    """Return the chapter on a measurement."""
    return Chapter(
        name="dynamics",
        title="Dynamics: error against run time, stiff and extreme flights",
        summary=_summary(result),
        command="neurosim bench dynamics" + (" --quick" if result.quick else ""),
        bars=_bars(result),
        tables=[
            _at_one_ms(result),
            _order(result),
            _rotorpy(result),
            _motor(result),
            _extremes(result),
            _sweep_table(result),
            _inputs(result),
            _long(result),
            _throughput(result),
            _terms(result),
            _reference(result),
            _work_precision(result),
        ],
        plots=dynamics_plots(result),
    )


def _summary(result: DynamicsResult) -> str:
    eight, naive = (_one_ms(result, "figure eight", m) for m in (RKMK4.name, RK4.name))
    euler = _one_ms(result, "figure eight", EULER.name)
    single, top = _single(result), _drift(result, "free top", RKMK4.name)
    flown = [t for t in _product_trials(result) if t.outcome == "flown"]
    lines = [
        f"At steps of 1 ms the default integrator flies 5 s of a 9 m/s figure eight with an error of "
        f"**{cell(eight.errors.position_m)} m** and {cell(eight.errors.attitude_rad)} rad; RK4 with the "
        f"motor in the state is off by {cell(naive.errors.position_m)} m and explicit Euler by "
        f"{cell(euler.errors.position_m)} m, on the same equations and commands.",
        f"One vehicle with every term makes **{single.steps_per_s / 1e6:.1f} M steps/s** on one core"
        + _peer_sentence(result)
        + ".",
        f"Of {len(_product_trials(result)) + len(result.refusals)} extreme flights (3 mg in a storm, a "
        f"millionth of the inertia, 200 rad/s) {len(flown)} are flown with at most "
        f"{cell(max(_position(t) for t in flown))} m of error"
        + (f", {len(result.refusals)} is refused as no physical body" if result.refusals else "")
        + f"; in {sum(t.redone_count > 0 for t in flown)} of them fixed steps tripped the guard and the "
        "adaptive method took over.",
        f"A free top is {cell(top.attitude_rad[-1])} rad off after {_hours(top.stamps_s[-1])}, with its "
        f"energy changed by {cell(top.energy[-1])}.",
    ]
    return " ".join(lines)


def _peer_sentence(result: DynamicsResult) -> str:
    ratio, theirs = _peer_ratio(result)
    if ratio is None or theirs is None:
        return ""
    return f", {ratio:,.0f} times as many as RotorPy {result.rotorpy} (RK45)" + _called_alike(result, theirs)


def _hours(seconds: int) -> str:
    return "1 h" if seconds == 3600 else f"{seconds} s"


# What was promised


def _bars(result: DynamicsResult) -> list[Bar]:
    bars = []
    for flight, limit_m in _POSITION_BARS_M.items():
        error_m = _one_ms(result, flight, RKMK4.name).errors.position_m
        bars.append(
            Bar(
                text=f"{flight} at 1 ms: position error <= {_power(limit_m)} m",
                measured=f"{cell(error_m)} m",
                met=error_m <= limit_m,
            )
        )
    return [
        *bars,
        _motor_bar(result),
        _extreme_bar(result),
        _sweep_bar(result),
        _input_bar(result),
        _hover_bar(result),
        _single_bar(result),
        _peer_bar(result),
        _batch_bar(result),
        _pruning_bar(result),
    ]


def _motor_bar(result: DynamicsResult) -> Bar:
    trials = [_of(m.trials, RKMK4.name) for m in result.motors]
    worst = max(trials, key=_position)
    taus = ", ".join(f"{m.time_constant_s:g}" for m in result.motors)
    return Bar(
        text=f"any motor time constant: position error <= {_power(_MOTOR_BAR_M)} m over 0.2 s at 1 ms",
        measured=f"{cell(_position(worst))} m at {worst.case}, of {taus} s",
        met=_position(worst) <= _MOTOR_BAR_M,
    )


def _extreme_bar(result: DynamicsResult) -> Bar:
    trials = _product_trials(result)
    flown = [t for t in trials if t.outcome == "flown"]
    failed = [t for t in trials if t.outcome == "DynamicsError"]
    measured = f"{len(flown)} flown, at most {cell(max(_position(t) for t in flown))} m"
    if typed := [t.case for t in failed] + [r.case for r in result.refusals]:
        measured += f"; typed errors: {', '.join(typed)}"
    return Bar(
        text=f"every extreme flight is finite and <= {_power(_EXTREME_BAR_M)} m off, or raises a typed error",
        measured=measured,
        met=len(flown) + len(failed) == len(trials) and max(map(_position, flown)) <= _EXTREME_BAR_M,
    )


def _sweep_bar(result: DynamicsResult) -> Bar:
    judged = [sweep for sweep in result.sweeps if sweep.name != AT_ONCE]
    worst = max(judged, key=_worst_m)
    return Bar(
        text=f"and between them, one parameter in fine steps: <= {_power(_EXTREME_BAR_M)} m",
        measured=f"{cell(_worst_m(worst))} m at {cell(float(worst.values[worst.worst]))}, {worst.name}; "
        f"{sum(len(sweep.values) for sweep in judged)} flights",
        met=_worst_m(worst) <= _EXTREME_BAR_M,
    )


def _worst_m(sweep: Sweep) -> float:
    """Largest error of a sweep [m]; infinite if a flight was held."""
    error_m = float(sweep.position_m[sweep.worst])
    return error_m if math.isfinite(error_m) else math.inf


def _input_bar(result: DynamicsResult) -> Bar:
    passed = [answer.input for answer in result.answers if not answer.error]
    return Bar(
        text="NaN, infinite and negative inputs raise typed errors",
        measured=f"{len(result.answers) - len(passed)} of {len(result.answers)}"
        + (f"; not {', '.join(passed)}" if passed else ""),
        met=not passed,
    )


def _hover_bar(result: DynamicsResult) -> Bar:
    still, spinning = (_drift(result, run, RKMK4.name) for run in ("hover", "spinning hover"))
    worst_m = max(still.position_m[-1], spinning.position_m[-1])
    return Bar(
        text=f"1 h of hover, still and turning at 29 rad/s: drift <= {_power(_HOVER_BAR_M)} m",
        measured=f"{cell(spinning.position_m[-1])} m turning, {cell(still.position_m[-1])} m still (a fixed "
        f"point) after {_hours(still.stamps_s[-1])}",
        met=worst_m <= _HOVER_BAR_M and still.stamps_s[-1] == spinning.stamps_s[-1] == 3600,
    )


def _single_bar(result: DynamicsResult) -> Bar:
    rate = _single(result).steps_per_s
    return Bar(
        text="one vehicle, all terms, 100 steps a call: >= 2 M steps/s on one core",
        measured=f"{rate / 1e6:.2f} M steps/s",
        met=rate >= _SINGLE_BAR_PER_S,
    )


def _peer_bar(result: DynamicsResult) -> Bar:
    text = (
        "the same rate is >= 1,000 x that of RotorPy's RK45, which has fewer terms and a larger error on the "
        "figure eight, both at 1 ms"
    )
    ratio, theirs = _peer_ratio(result)
    if ratio is None or theirs is None:
        return Bar(text=text, measured=f"RotorPy is not installed: {rotorpy_peer.INSTALL}", met=None)
    ours = _one_ms(result, "figure eight", RKMK4.name).errors.position_m
    return Bar(
        text=text,
        measured=f"{ratio:,.0f} x, {cell(ours)} m against {cell(theirs.errors.position_m)} m"
        + _called_alike(result, theirs),
        met=ratio >= _PEER_BAR and ours < theirs.errors.position_m,
    )


def _called_alike(result: DynamicsResult, theirs: PeerSample) -> str:
    """Return the ratio of one vehicle on the same flight, called from Python once a command, in words."""
    called = _cheapest_called(result, theirs)
    if called is None:
        return ""
    return f"; like for like, both called from Python: {theirs.cpu_s_per_s / called.cpu_s_per_s:,.0f} x"


def _batch_bar(result: DynamicsResult) -> Bar:
    rates = {(t.load, t.steps_per_call): t.steps_per_s for t in result.throughputs if t.vehicles == 4096}
    air, everything = rates["air and wind", 10], rates["everything", 10]
    return Bar(
        text="4096 vehicles, 10 steps a call: >= 3 M vehicle-steps/s on one core, with air and wind",
        measured=f"{air / 1e6:.2f} M vehicle-steps/s; {everything / 1e6:.2f} M with everything",
        met=air >= _BATCH_BAR_PER_S,
    )


def _pruning_bar(result: DynamicsResult) -> Bar:
    least, best = (choose(result.prunings, key=lambda p: p.gain) for choose in (min, max))
    return Bar(
        text="leaving out unused terms: >= 1.5 x for every vehicle",
        measured=f"{least.gain:.2f} x ({least.vehicle}) to {best.gain:.2f} x ({best.vehicle})",
        met=least.gain >= _PRUNING_BAR,
    )


def _peer_ratio(result: DynamicsResult) -> tuple[float | None, PeerSample | None]:
    """Return our rate of steps over that of RotorPy's RK45 at 1 ms on the figure eight, and its flight."""
    for peer in result.peers:
        if (peer.flight, peer.method) == ("figure eight", "RotorPy RK45, 1 ms"):
            return _single(result).steps_per_s * _MS * peer.cpu_s_per_s, peer
    return None, None


# Tables


def _at_one_ms(result: DynamicsResult) -> Table:
    rows = []
    for solved in result.flights:
        for method in (*FIXED_STEP, DORMAND_PRINCE):
            setting = _MS if method.order is not None else 1e-6
            rows.append(_row(result.sample(solved.flight.name, method.name, setting)))
    return Table(
        name="dynamics-1-ms",
        title="Error at steps of 1 ms, or at rtol 1e-6",
        columns=_SAMPLE_COLUMNS,
        rows=rows,
        note=_SAMPLE_NOTE,
    )


def _work_precision(result: DynamicsResult) -> Table:
    return Table(
        name="dynamics-work-precision",
        title="Error against CPU time and step size: all samples",
        columns=_SAMPLE_COLUMNS,
        rows=[_row(sample) for sample in result.samples],
        note=_SAMPLE_NOTE,
    )


_SAMPLE_COLUMNS = {
    "flight": "flight",
    "method": "method",
    "step_ms": "step [ms]",
    "rtol": "rtol",
    "position_m": "position [m]",
    "attitude_rad": "attitude [rad]",
    "body_rate_rad_s": "body rate [rad/s]",
    "cpu_s_per_s": "CPU [s/s]",
    "failure": "raised",
}
_SAMPLE_NOTE = (
    "Largest errors over the ends of all holds of 10 ms, against SciPy's DOP853 at 3e-14. CPU is that of the "
    "launches per simulated second and vehicle, with copies of the vehicle beside it so that the launch "
    "itself counts for little. All methods are compiled by Warp and call the same right-hand side; RK4, "
    "explicit Euler and the midpoint rule integrate the rotor speeds as part of the state and are no part "
    "of the product. A dash as an error means that the flight did not stay finite."
)


def _row(sample: Sample) -> dict[str, object]:
    fixed = sample.method in [method.name for method in FIXED_STEP]
    errors = sample.errors
    return {
        "flight": sample.flight,
        "method": sample.method,
        "step_ms": 1e3 * sample.setting if fixed else None,
        "rtol": None if fixed else sample.setting,
        "position_m": errors.position_m,
        "attitude_rad": errors.attitude_rad,
        "body_rate_rad_s": errors.body_rate_rad_s,
        "cpu_s_per_s": sample.cpu_s_per_s,
        "failure": sample.failure,
    }


def _order(result: DynamicsResult) -> Table:
    return Table(
        name="dynamics-order",
        title="Observed order: least-squares slopes of log error against log step",
        columns={
            "flight": "flight",
            "method": "method",
            "theory": "theory",
            "position": "position",
            "position_range": "over steps of [ms]",
            "attitude": "attitude",
            "attitude_range": "over steps of [ms]",
        },
        rows=[
            {
                "flight": fit.flight,
                "method": fit.method,
                "theory": fit.order,
                "position": fit.position,
                "position_range": _range_ms(fit.position_steps_s),
                "attitude": fit.attitude,
                "attitude_range": _range_ms(fit.attitude_steps_s),
            }
            for fit in result.orders
            if fit.flight != "hover"
        ],
        note="The range begins at the finest step whose error stands clear of rounding and of what is not "
        "known of the reference, and goes on as long as local slopes stay within 0.2 of the first. A dash: "
        "fewer than three such steps. Hover is left out: every method keeps it to rounding.",
    )


def _range_ms(steps_s: tuple[float, float] | None) -> str | None:
    return None if steps_s is None else f"{1e3 * steps_s[0]:g} to {1e3 * steps_s[1]:g}"


def _rotorpy(result: DynamicsResult) -> Table:
    rows: list[dict[str, object]] = []
    for peer in result.peers:
        row: dict[str, object] = {
            "flight": peer.flight,
            "method": peer.method,
            "position_m": peer.errors.position_m,
            "attitude_rad": peer.errors.attitude_rad,
            "cpu_s_per_s": peer.cpu_s_per_s,
        }
        if peer.method.startswith("RotorPy"):
            match = _cheapest(result, peer)
            row["ours"] = "none as exact" if match is None else _setting(match)
            row["ours_cpu_s_per_s"] = None if match is None else match.cpu_s_per_s
            row["ratio"] = None if match is None else peer.cpu_s_per_s / match.cpu_s_per_s
            called = _cheapest_called(result, peer)
            row["ratio_called"] = None if called is None else peer.cpu_s_per_s / called.cpu_s_per_s
        rows.append(row)
    if result.rotorpy is None:
        text = f"RotorPy is not installed: {rotorpy_peer.INSTALL}"
        rows += [{"flight": s.flight.name, "method": text} for s in result.flights]
    return Table(
        name="dynamics-rotorpy",
        title="RotorPy on the same flights, one vehicle called from Python",
        columns={
            "flight": "flight",
            "method": "method",
            "position_m": "position [m]",
            "attitude_rad": "attitude [rad]",
            "cpu_s_per_s": "CPU [s/s]",
            "ours": "ours, no less exact",
            "ours_cpu_s_per_s": "its CPU [s/s]",
            "ratio": "ratio",
            "ratio_called": "ratio, ours called alike",
        },
        rows=rows,
        note=_rotorpy_note(result),
    )


def _rotorpy_note(result: DynamicsResult) -> str:
    note = (
        "RotorPy: `Multirotor.step` with `solve_ivp` (RK45) as it is, one call a step; and one evaluation "
        "of its right-hand side a step, as those do who find it too slow. *Ours*, in the first columns: "
        "one call of `Multirotor.step` a command of 10 ms, with all checks and copies of that call. *Ours, "
        "no less exact*: the cheapest of our settings in the table of all samples whose position error is "
        "no larger, and the CPU time of its launches; the last column compares with *ours* as called in "
        "the rows above, where that is no less exact. *None as exact*: where motors are slow, RK45 at 1 ms "
        "is at rounding."
    )
    if result.derivative_differences:
        worst = max(result.derivative_differences.values())
        note += (
            f" RotorPy's right-hand side differs from ours by {cell(worst)} relative, on 50 random states."
        )
    return note


def _cheapest(result: DynamicsResult, peer: PeerSample) -> Sample | None:
    """Return the cheapest of our samples on a flight that is no less exact in position."""
    ours = [
        s
        for s in result.samples
        if s.flight == peer.flight
        and s.method in (RKMK4.name, DORMAND_PRINCE.name)
        and s.errors.position_m <= peer.errors.position_m
    ]
    return min(ours, key=lambda s: s.cpu_s_per_s, default=None)


def _cheapest_called(result: DynamicsResult, peer: PeerSample) -> PeerSample | None:
    """Return the cheapest flight of one vehicle of ours, called once a command, that is no less exact."""
    ours = [
        p
        for p in result.peers
        if p.flight == peer.flight
        and p.method.startswith("ours")
        and p.errors.position_m <= peer.errors.position_m
    ]
    return min(ours, key=lambda p: p.cpu_s_per_s, default=None)


def _setting(sample: Sample) -> str:
    if sample.method == RKMK4.name:
        return f"RKMK4, {1e3 * sample.setting:g} ms"
    return f"Dormand-Prince, rtol {sample.setting:g}"


def _motor(result: DynamicsResult) -> Table:
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
                "evaluation_count": _of(m.trials, DORMAND_PRINCE.name).evaluation_count,
                "reference_m": m.reference.uncertainty.position_m,
            }
            for m in result.motors
        ],
        note="Hummingbird, new commands within 10 % of hover every 10 ms, steps of 1 ms or rtol 1e-6. The "
        "reference has the lag in closed form. RotorPy cannot have a time constant of 0; *too slow*: "
        "stopped after 5 s of CPU time.",
    )


def _extremes(result: DynamicsResult) -> Table:
    methods = _methods(t for e in result.extremes for t in e.trials)
    rows: list[dict[str, object]] = [
        {
            "case": e.case,
            **_pivot(e.trials),
            "attitude_rad": _attitude(_of(e.trials, RKMK4.name)),
            "redone_count": _of(e.trials, RKMK4.name).redone_count,
            "evaluation_count": _of(e.trials, DORMAND_PRINCE.name).evaluation_count,
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


def _sweep_table(result: DynamicsResult) -> Table:
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
                "worst_m": _worst_m(s),
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


def _inputs(result: DynamicsResult) -> Table:
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
    return {_key(t.method): _position(t) if t.outcome == "flown" else t.outcome for t in trials}


def _long(result: DynamicsResult) -> Table:
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


def _throughput(result: DynamicsResult) -> Table:
    return Table(
        name="dynamics-throughput",
        title="Steps of 1 ms per second of CPU time",
        columns={
            "load": "what acts",
            "terms": "terms",
            "call": "call",
            "vehicles": "vehicles",
            "steps_per_call": "steps a call",
            "steps_per_s": "vehicle-steps/s",
        },
        rows=[
            {
                "load": t.load,
                "terms": len(t.terms),
                "call": t.call,
                "vehicles": t.vehicles,
                "steps_per_call": t.steps_per_call,
                "steps_per_s": t.steps_per_s,
            }
            for t in result.throughputs
        ],
        note="One core. `advance` launches one kernel on arrays; `step` also copies the command from NumPy, "
        "waits, and checks. *air and wind*: motor lag, rotor drag, translational lift, flapping, parasitic "
        "drag, wind, full inertia. *everything*: gusts, turbulence, ground, ground effect and unlike motors "
        "as well.",
    )


def _terms(result: DynamicsResult) -> Table:
    return Table(
        name="dynamics-terms",
        title="What leaving out unused terms brings: one vehicle, 100 steps a call",
        columns={
            "vehicle": "vehicle",
            "terms": "terms in use",
            "reduced_per_s": "only these [steps/s]",
            "full_per_s": f"all {len(TERMS)} compiled in [steps/s]",
            "gain": "gain",
            "difference": "difference of the states, relative",
        },
        rows=[
            {
                "vehicle": p.vehicle,
                "terms": ", ".join(p.terms) or "none",
                "reduced_per_s": p.reduced_per_s,
                "full_per_s": p.full_per_s,
                "gain": p.gain,
                "difference": p.difference,
            }
            for p in result.prunings
        ],
    )


def _reference(result: DynamicsResult) -> Table:
    rows = []
    for solved in result.flights:
        flight, reference = solved.flight, solved.reference
        differences = {c.solver: c.difference.position_m for c in reference.checks}
        rows.append(
            {
                "flight": flight.name,
                "duration_s": flight.duration_s,
                "speed_max_m_s": float(np.linalg.norm(reference.states.velocity, axis=1).max()),
                "rate_max_deg_s": math.degrees(
                    float(np.linalg.norm(reference.states.body_rate, axis=1).max())
                ),
                "dop853_m": differences.get("DOP853"),
                "radau_m": differences.get("Radau"),
            }
        )
    return Table(
        name="dynamics-reference",
        title="The flights, and how well their references are known",
        columns={
            "flight": "flight",
            "duration_s": "duration [s]",
            "speed_max_m_s": "largest speed [m/s]",
            "rate_max_deg_s": "largest body rate [deg/s]",
            "dop853_m": "DOP853 at 1e-13 differs by [m]",
            "radau_m": "Radau at 1e-12 differs by [m]",
        },
        rows=rows,
        note="References are SciPy's DOP853 at rtol 3e-14, restarted at each command, with the rotor "
        "speeds in closed form. The figure eight is flown with commands of our SE(3) controller, recorded "
        "in closed loop; all methods then get the same commands."
        + ("" if not result.quick else " A dash: not solved in the quick version."),
    )


# Looking things up


def _power(value: float) -> str:
    """Return a power of ten as people write it: 1e-6."""
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _one_ms(result: DynamicsResult, flight: str, method: str) -> Sample:
    return result.sample(flight, method, _MS)


def _single(result: DynamicsResult) -> Throughput:
    """Return one vehicle with everything, 100 steps a call."""
    return next(
        t
        for t in result.throughputs
        if (t.load, t.call, t.vehicles, t.steps_per_call) == ("everything", "advance", 1, 100)
    )


def _drift(result: DynamicsResult, run: str, method: str) -> Drift:
    return next(d for d in result.drifts if (d.run, d.method) == (run, method))


def _product_trials(result: DynamicsResult) -> list[Trial]:
    return [_of(extreme.trials, RKMK4.name) for extreme in result.extremes]


def _of(trials: Iterable[Trial], method: str) -> Trial:
    return next(trial for trial in trials if trial.method == method)


def _position(trial: Trial) -> float:
    """Position error [m]; infinite where the flight was not flown to its end."""
    return math.inf if trial.errors is None else trial.errors.position_m


def _attitude(trial: Trial) -> float | None:
    return None if trial.errors is None else trial.errors.attitude_rad
