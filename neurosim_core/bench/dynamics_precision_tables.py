"""The tables of error against run time: our methods, RotorPy, steps per second, and the references."""

from __future__ import annotations

import math

import numpy as np

from neurosim_core.bench import rotorpy_peer
from neurosim_core.bench.chapter import Table, cell
from neurosim_core.bench.dynamics_methods import DORMAND_PRINCE, FIXED_STEP, RKMK4
from neurosim_core.bench.dynamics_precision import Sample
from neurosim_core.bench.dynamics_result import DynamicsResult, PeerSample, cheapest_called
from neurosim_core.vehicle import TERMS

MS = 1e-3
"""A millisecond [s]."""


def at_one_ms_table(result: DynamicsResult) -> Table:
    """Return the table of errors at steps of 1 ms, or at rtol 1e-6."""
    rows = []
    for solved in result.flights:
        for method in (*FIXED_STEP, DORMAND_PRINCE):
            setting = MS if method.order is not None else 1e-6
            rows.append(_row(result.sample(solved.flight.name, method.name, setting)))
    return Table(
        name="dynamics-1-ms",
        title="Error at steps of 1 ms, or at rtol 1e-6",
        columns=_SAMPLE_COLUMNS,
        rows=rows,
        note=_SAMPLE_NOTE,
    )


def work_precision_table(result: DynamicsResult) -> Table:
    """Return the table of all samples: error against CPU time and step size."""
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


def order_table(result: DynamicsResult) -> Table:
    """Return the table of observed orders."""
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


def rotorpy_table(result: DynamicsResult) -> Table:
    """Return the table of RotorPy's flights, and ours called alike."""
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
            called = cheapest_called(result, peer)
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


def _setting(sample: Sample) -> str:
    if sample.method == RKMK4.name:
        return f"RKMK4, {1e3 * sample.setting:g} ms"
    return f"Dormand-Prince, rtol {sample.setting:g}"


def throughput_table(result: DynamicsResult) -> Table:
    """Return the table of steps per second."""
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


def terms_table(result: DynamicsResult) -> Table:
    """Return the table of what leaving out unused terms brings."""
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


def reference_table(result: DynamicsResult) -> Table:
    """Return the table of the flights, and of how well their references are known."""
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
