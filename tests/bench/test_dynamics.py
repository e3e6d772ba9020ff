"""`neurosim bench dynamics` on a small extent: errors and orders, never times; the chapter."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from neurosim_core.bench import rotorpy_peer
from neurosim_core.bench.chapter import cell, cells
from neurosim_core.bench.dynamics import QUICK, dynamics_chapter, measure_dynamics
from neurosim_core.bench.dynamics_methods import DORMAND_PRINCE, EULER, FIXED_STEP, MIDPOINT, RK4, RKMK4
from neurosim_core.bench.dynamics_result import DynamicsResult
from neurosim_core.bench.dynamics_sweep import AT_ONCE, SWEEPS
from neurosim_core.bench.figures import draw_plot

SMALL = dataclasses.replace(
    QUICK,
    steps_s=(5e-3, 2e-3, 1e-3, 5e-4),
    tolerances=(1e-6,),
    repetitions=1,
    cross_checked=("rotor step",),
    peers=("rotor step",),
    time_constants_s=(1e-1, 1e-4, 0.0),
    cases=(
        "mass 3 mg, 100 m/s wind, quadratic drag",
        "inertia 1:10:100, 200 rad/s",
        "pitch through 90 degrees at 20 rad/s",
    ),
    sweep_count=12,
    hover_stamps_s=(1, 10),
    top_stamps_s=(1, 10),
    formats_stamps_s=(1, 10),
    cpu_s=0.001,
)


@pytest.fixture(scope="module")
def result() -> DynamicsResult:
    return measure_dynamics(extent=SMALL)


@pytest.fixture(scope="module")
def chapter(result):
    return dynamics_chapter(result)


# Errors and orders


@pytest.mark.parametrize(("flight", "bar_m"), [("figure eight", 1e-6), ("flip", 1e-10), ("tumble", 1e-8)])
def test_our_method_keeps_its_bars_at_1_ms(flight, bar_m, result):
    assert result.sample(flight, RKMK4.name, 1e-3).errors.position_m <= bar_m


def test_hover_is_kept_by_all(result):
    for sample in result.samples:
        if sample.flight == "hover":
            assert sample.errors.position_m < 1e-10  # rounding of up to 4000 steps


@pytest.mark.parametrize("flight", ["rotor step", "flip", "tumble", "figure eight"])
def test_the_flights_tell_the_methods_apart(flight, result):
    """Each of them: Euler is the worst, ours at least as good as RK4."""
    error = {m.name: result.sample(flight, m.name, 1e-3).errors.position_m for m in FIXED_STEP}
    assert error[RKMK4.name] <= error[RK4.name] < error[MIDPOINT.name] < error[EULER.name]


@pytest.mark.parametrize(
    ("method", "order", "tolerance"),
    [(EULER, 1, 0.1), (MIDPOINT, 2, 0.05), (RK4, 4, 0.2), (RKMK4, 4, 0.2)],
    ids=lambda value: getattr(value, "name", value),
)
def test_observed_order(method, order, tolerance, result):
    """Whatever the flight that has an asymptotic range; flip and tumble do for every method."""
    fits = [f for f in result.orders if f.method == method.name]
    slopes = {f.flight: (f.position, f.attitude) for f in fits if f.flight != "hover"}
    assert None not in slopes["flip"]
    assert slopes["tumble"][0] is not None
    for flight, pair in slopes.items():
        for slope in pair:
            assert slope is None or slope == pytest.approx(order, abs=tolerance), flight


def test_references_agree(result):
    """DOP853 at two tolerances on all flights, Radau on one."""
    for solved in result.flights:
        uncertainty = solved.reference.uncertainty
        assert uncertainty.position_m < 1e-10  # a hundredth of the errors that are judged with it
        assert uncertainty.attitude_rad < 1e-11
    solvers = {s.flight.name: {c.solver for c in s.reference.checks} for s in result.flights}
    assert solvers["rotor step"] == {"DOP853", "Radau"}


def test_any_motor_is_flown_right(result):
    for motor in result.motors:
        ours = next(t for t in motor.trials if t.method == RKMK4.name)
        assert ours.outcome == "flown"
        assert ours.errors.position_m < 1e-8
    stiff = result.motors[1]
    outcomes = {t.method: t.outcome for t in stiff.trials}
    assert outcomes[RK4.name] == outcomes[EULER.name] == "not finite"  # 1 ms against 0.1 ms


def test_extremes_and_refusals(result):
    assert [r.case for r in result.refusals] == ["inertia 1:10:100, 200 rad/s"]
    assert "no body has principal moments" in result.refusals[0].message
    dust = next(e for e in result.extremes if e.case.startswith("mass 3 mg"))
    ours = next(t for t in dust.trials if t.method == RKMK4.name)
    assert ours.redone_count >= 1
    for extreme in result.extremes:
        for trial in extreme.trials:
            if trial.method in (RKMK4.name, DORMAND_PRINCE.name):
                assert trial.errors.position_m < 1e-5


def test_long_runs(result):
    by_run = {(d.run, d.method): d for d in result.drifts}
    assert by_run["hover", RKMK4.name].position_m[-1] < 1e-10
    turning = by_run["spinning hover", RKMK4.name]
    assert 0.0 < turning.position_m[-1] < 1e-10  # no fixed point: rounding moves it
    assert turning.attitude_rad[-1] < 1e-9
    top = by_run["free top", RKMK4.name]
    assert top.attitude_rad[-1] < 3e-8  # 7.5e-9 after 10 s
    assert top.energy[-1] < 1e-9
    conserving = by_run["free top", MIDPOINT.name]
    assert max(conserving.energy[-1], conserving.momentum[-1]) < 1e-12  # to rounding
    assert conserving.attitude_rad[-1] > 1e-3  # and yet
    double, single = by_run["spin", "float64, 1 ms"], by_run["spin", "float32, 1 ms"]
    assert single.position_m[-1] > 1e6 * double.position_m[-1]


def test_leaving_out_terms_changes_nothing(result):
    for pruning in result.prunings:
        assert pruning.difference < 1e-12


# The chapter


def test_chapter_has_every_flight_and_method(chapter, result):
    rows = {(row["flight"], row["method"]) for row in table(chapter, "dynamics-1-ms").rows}
    names = [m.name for m in (*FIXED_STEP, DORMAND_PRINCE)]
    assert rows == {(s.flight.name, name) for s in result.flights for name in names}
    everything = table(chapter, "dynamics-work-precision")
    assert len(everything.rows) == 5 * (4 * len(SMALL.steps_s) + len(SMALL.tolerances))
    orders = table(chapter, "dynamics-order").rows
    assert {(row["flight"], row["method"]) for row in orders} == {
        (s.flight.name, m.name) for s in result.flights for m in FIXED_STEP if s.flight.name != "hover"
    }


def test_chapter_has_every_stiff_and_extreme_flight(chapter):
    motor = table(chapter, "dynamics-motor")
    assert [row["time_constant_s"] for row in motor.rows] == list(SMALL.time_constants_s)
    assert motor.rows[1]["rk4_quaternion"] == "not finite"
    assert {row["case"] for row in table(chapter, "dynamics-extremes").rows} == set(SMALL.cases)
    runs = {(row["run"], row["method"]) for row in table(chapter, "dynamics-long").rows}
    assert {("free top", m.name) for m in (*FIXED_STEP, DORMAND_PRINCE)} < runs
    assert {("hover", RKMK4.name), ("spin", "float32, 1 ms"), ("spin", "float64, 1 ms")} < runs


def test_tables_name_only_columns_that_they_have(chapter):
    for a_table in chapter.tables:
        assert a_table.rows
        assert len(cells(a_table)) == len(a_table.rows)


def test_bars_are_judged_by_what_was_measured(chapter, result):
    verdicts = {bar.text: bar for bar in chapter.bars}
    assert len(verdicts) == 12
    flip = verdicts["flip at 1 ms: position error <= 1e-10 m"]
    assert flip.met
    assert cell(result.sample("flip", RKMK4.name, 1e-3).errors.position_m) in flip.measured
    hover = next(bar for text, bar in verdicts.items() if "hover" in text)
    assert not hover.met  # it was not an hour
    extremes = next(bar for text, bar in verdicts.items() if "extreme" in text)
    assert "inertia 1:10:100" in extremes.measured


def test_sweeps_are_fine_and_judged(chapter, result):
    rows = {row["sweep"]: row for row in table(chapter, "dynamics-sweep").rows}
    assert [*rows] == [*SWEEPS, AT_ONCE]
    for sweep in result.sweeps:
        edge = 2 if sweep.name.startswith(("mass of", "inertia of")) else 0
        assert len(sweep.values) == SMALL.sweep_count * (2 if sweep.name == AT_ONCE else 1) + edge
        assert rows[sweep.name]["worst_m"] == np.nanmax(sweep.position_m)
        if sweep.name != AT_ONCE:
            assert sweep.position_m.max() < 1e-5
    masses = result.sweeps[0]
    first = int(np.argmax(masses.redone == 0))  # both sides of the guard's edge
    assert 1.0 < masses.values[first] / masses.values[first - 1] < 1.001
    assert masses.redone[first - 1] > 0
    for spoilt in (2e-5, np.nan):
        position_m = masses.position_m.copy()
        position_m[3] = spoilt
        sweeps = (dataclasses.replace(masses, position_m=position_m), *result.sweeps[1:])
        worse = dynamics_chapter(dataclasses.replace(result, sweeps=sweeps))
        bar = next(bar for bar in worse.bars if "fine steps" in bar.text)
        assert bar.met is False
        assert cell(float(masses.values[3])) in bar.measured


def test_inputs_that_mean_nothing_are_refused(chapter, result):
    rows = table(chapter, "dynamics-inputs").rows
    assert len(rows) == len(result.answers) > 60
    assert {row["error"] for row in rows} == {"ValidationError", "ValueError", "TypeError", "DynamicsError"}
    assert all(row["message"] for row in rows)
    accepted = dataclasses.replace(result.answers[0], error="", message="")
    worse = dynamics_chapter(dataclasses.replace(result, answers=(accepted, *result.answers[1:])))
    bar = next(bar for bar in worse.bars if "typed errors" in bar.text and "negative" in bar.text)
    assert bar.met is False
    assert accepted.input in bar.measured


def test_the_least_gain_of_leaving_terms_out_is_judged(result):
    first, *rest = result.prunings
    slow = dataclasses.replace(first, reduced_per_s=1.4 * first.full_per_s)
    worse = dynamics_chapter(dataclasses.replace(result, prunings=(slow, *rest)))
    bar = next(bar for bar in worse.bars if "unused terms" in bar.text)
    assert bar.met is False
    assert bar.measured.startswith("1.40 x")


def test_a_bad_measurement_misses_its_bar(result):
    samples = tuple(
        dataclasses.replace(s, errors=dataclasses.replace(s.errors, position_m=2e-8)) for s in result.samples
    )
    worse = dynamics_chapter(dataclasses.replace(result, samples=samples))
    verdicts = {bar.text.split(" at")[0]: bar.met for bar in worse.bars[:3]}
    assert verdicts == {"figure eight": True, "flip": False, "tumble": False}


def test_a_lost_flight_misses_the_bar_of_extremes(result):
    first, *rest = result.extremes
    lost = tuple(
        dataclasses.replace(t, outcome="not finite", errors=None) if t.method == RKMK4.name else t
        for t in first.trials
    )
    worse = dataclasses.replace(result, extremes=(dataclasses.replace(first, trials=lost), *rest))
    bar = next(bar for bar in dynamics_chapter(worse).bars if "extreme" in bar.text)
    assert bar.met is False


def test_chapter_says_when_rotorpy_is_missing(result):
    without = dataclasses.replace(
        result,
        rotorpy=None,
        derivative_differences={},
        peers=tuple(p for p in result.peers if p.method.startswith("ours")),
    )
    chapter = dynamics_chapter(without)
    rows = table(chapter, "dynamics-rotorpy").rows
    assert sum("pip install rotorpy==3.0.0" in str(row["method"]) for row in rows) == 5
    bar = next(bar for bar in chapter.bars if "RotorPy" in bar.text)
    assert bar.met is None
    assert rotorpy_peer.INSTALL in bar.measured


def test_measuring_without_rotorpy(monkeypatch):
    monkeypatch.setattr(rotorpy_peer, "rotorpy_version", lambda: None)
    extent = dataclasses.replace(
        SMALL,
        flights=("rotor step",),
        steps_s=(1e-3,),
        cross_checked=(),
        time_constants_s=(0.1,),
        cases=(),
        stiff_peer_cpu_s=1.0,
    )
    result = measure_dynamics(extent=extent)
    assert result.rotorpy is None
    assert result.derivative_differences == {}
    methods = [p.method for p in result.peers] + [t.method for t in result.motors[0].trials]
    assert methods
    assert not [m for m in methods if "RotorPy" in m]


def test_rotorpy_flies_beside(result, chapter):
    pytest.importorskip("rotorpy")
    assert max(result.derivative_differences.values()) < 1e-12
    errors = {p.method: p.errors for p in result.peers}
    assert errors["RotorPy RK45, 1 ms"].position_m < 1e-12  # slow motors: at rounding
    assert errors["RotorPy RK45, 10 ms"].position_m < 1e-8
    assert 1e-3 < errors["RotorPy explicit Euler, 1 ms"].position_m < 1e-1
    # the same equations and the same method: the same errors as our baseline
    baseline = result.sample("rotor step", EULER.name, 1e-3).errors
    assert errors["RotorPy explicit Euler, 1 ms"].position_m == pytest.approx(baseline.position_m, rel=1e-9)
    rows = {row["method"]: row for row in table(chapter, "dynamics-rotorpy").rows}
    assert rows["RotorPy RK45, 1 ms"]["ours"] == "none as exact"
    match = rows["RotorPy RK45, 10 ms"]
    assert match["ratio"] == pytest.approx(match["cpu_s_per_s"] / match["ours_cpu_s_per_s"])


def test_summary_is_made_of_what_was_measured(chapter, result):
    eight = result.sample("figure eight", RKMK4.name, 1e-3)
    assert cell(eight.errors.position_m) in chapter.summary
    assert not math.isnan(eight.cpu_s_per_s)


def test_plots_are_drawn(chapter):
    pytest.importorskip("matplotlib")
    assert [plot.name for plot in chapter.plots] == [
        "dynamics-work-precision",
        "dynamics-work-precision-attitude",
        "dynamics-step",
        "dynamics-motor",
        "dynamics-drift",
    ]
    for plot in chapter.plots:
        assert draw_plot(plot).startswith(b"\x89PNG")


def table(chapter, name):
    return next(t for t in chapter.tables if t.name == name)
