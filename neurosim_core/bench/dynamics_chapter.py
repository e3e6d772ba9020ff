"""The chapter on dynamics: what was promised, and the answer in words."""

from __future__ import annotations

from neurosim_core.bench import rotorpy_peer
from neurosim_core.bench.chapter import Bar, Chapter, cell
from neurosim_core.bench.dynamics_extreme_tables import (
    extremes_table,
    inputs_table,
    long_runs_table,
    motor_table,
    sweep_table,
)
from neurosim_core.bench.dynamics_extremes import Trial, trial_of, trial_position_m
from neurosim_core.bench.dynamics_long import Drift
from neurosim_core.bench.dynamics_methods import EULER, RK4, RKMK4
from neurosim_core.bench.dynamics_plots import dynamics_plots
from neurosim_core.bench.dynamics_precision import Sample
from neurosim_core.bench.dynamics_precision_tables import (
    MS,
    at_one_ms_table,
    order_table,
    reference_table,
    rotorpy_table,
    terms_table,
    throughput_table,
    work_precision_table,
)
from neurosim_core.bench.dynamics_result import DynamicsResult, PeerSample, cheapest_called
from neurosim_core.bench.dynamics_sweep import AT_ONCE, sweep_worst_m
from neurosim_core.bench.dynamics_throughput import Throughput

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
            at_one_ms_table(result),
            order_table(result),
            rotorpy_table(result),
            motor_table(result),
            extremes_table(result),
            sweep_table(result),
            inputs_table(result),
            long_runs_table(result),
            throughput_table(result),
            terms_table(result),
            reference_table(result),
            work_precision_table(result),
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
        f"{cell(max(trial_position_m(t) for t in flown))} m of error"
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
    trials = [trial_of(m.trials, RKMK4.name) for m in result.motors]
    worst = max(trials, key=trial_position_m)
    taus = ", ".join(f"{m.time_constant_s:g}" for m in result.motors)
    return Bar(
        text=f"any motor time constant: position error <= {_power(_MOTOR_BAR_M)} m over 0.2 s at 1 ms",
        measured=f"{cell(trial_position_m(worst))} m at {worst.case}, of {taus} s",
        met=trial_position_m(worst) <= _MOTOR_BAR_M,
    )


def _extreme_bar(result: DynamicsResult) -> Bar:
    trials = _product_trials(result)
    flown = [t for t in trials if t.outcome == "flown"]
    failed = [t for t in trials if t.outcome == "DynamicsError"]
    measured = f"{len(flown)} flown, at most {cell(max(trial_position_m(t) for t in flown))} m"
    if typed := [t.case for t in failed] + [r.case for r in result.refusals]:
        measured += f"; typed errors: {', '.join(typed)}"
    return Bar(
        text=f"every extreme flight is finite and <= {_power(_EXTREME_BAR_M)} m off, or raises a typed error",
        measured=measured,
        met=len(flown) + len(failed) == len(trials) and max(map(trial_position_m, flown)) <= _EXTREME_BAR_M,
    )


def _sweep_bar(result: DynamicsResult) -> Bar:
    judged = [sweep for sweep in result.sweeps if sweep.name != AT_ONCE]
    worst = max(judged, key=sweep_worst_m)
    return Bar(
        text=f"and between them, one parameter in fine steps: <= {_power(_EXTREME_BAR_M)} m",
        measured=f"{cell(sweep_worst_m(worst))} m at {cell(float(worst.values[worst.worst]))}, {worst.name}; "
        f"{sum(len(sweep.values) for sweep in judged)} flights",
        met=sweep_worst_m(worst) <= _EXTREME_BAR_M,
    )


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
    called = cheapest_called(result, theirs)
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
            return _single(result).steps_per_s * MS * peer.cpu_s_per_s, peer
    return None, None


# Looking things up


def _power(value: float) -> str:
    """Return a power of ten as people write it: 1e-6."""
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _one_ms(result: DynamicsResult, flight: str, method: str) -> Sample:
    return result.sample(flight, method, MS)


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
    return [trial_of(extreme.trials, RKMK4.name) for extreme in result.extremes]
