"""The pictures of the chapter on dynamics."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neurosim_core.bench.chapter import Plot
from neurosim_core.bench.dynamics_methods import (
    DORMAND_PRINCE,
    EULER,
    FIXED_STEP,
    MIDPOINT,
    RK4,
    RKMK4,
)
from neurosim_core.bench.dynamics_result import DynamicsResult
from neurosim_core.bench.figures import COLORS, MARKERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLES: dict[str, dict[str, Any]] = {
    RKMK4.name: {"color": COLORS[0], "marker": MARKERS[0], "linewidth": 2.4, "zorder": 5},
    DORMAND_PRINCE.name: {"color": COLORS[5], "marker": MARKERS[3], "linewidth": 2.0, "zorder": 4},
    RK4.name: {"color": COLORS[1], "marker": MARKERS[1]},
    MIDPOINT.name: {"color": COLORS[2], "marker": MARKERS[2]},
    EULER.name: {"color": COLORS[3], "marker": MARKERS[4]},
}
"""Of each method, the same in all pictures; ours are thicker."""

_ROTORPY_MARKERS = {
    "RotorPy RK45, 1 ms": "*",
    "RotorPy RK45, 10 ms": "P",
    "RotorPy explicit Euler, 1 ms": "X",
}
_PANELS = {"hover": "hover: all keep it to rounding"}
"""Titles of panels that are not the name of the flight."""
_ERROR_MIN = 1e-16  # errors below are drawn here


def dynamics_plots(result: DynamicsResult) -> list[Plot]:
    """Return the plots of a measurement."""
    return [
        Plot(
            name="dynamics-work-precision",
            title="Position error against CPU time",
            draw=functools.partial(_draw_work_precision, result, "position_m", "position error [m]"),
        ),
        Plot(
            name="dynamics-work-precision-attitude",
            title="Attitude error against CPU time",
            draw=functools.partial(_draw_work_precision, result, "attitude_rad", "attitude error [rad]"),
        ),
        Plot(
            name="dynamics-step",
            title="Error against step size: position, attitude and body rate",
            draw=functools.partial(_draw_steps, result),
        ),
        Plot(
            name="dynamics-motor",
            title="Stiff motors: position error after 0.2 s of random commands, steps of 1 ms",
            draw=functools.partial(_draw_motors, result),
        ),
        Plot(name="dynamics-drift", title="An hour of flight", draw=functools.partial(_draw_drift, result)),
    ]


def _draw_work_precision(result: DynamicsResult, field: str, label: str, figure: Figure) -> None:
    """Draw one field of the errors, a panel a flight."""
    figure.set_size_inches(8.0, 6.4)
    panels = figure.subplots(2, 3, sharex=True).ravel()
    for axes, solved in zip(panels, result.flights, strict=False):
        name = solved.flight.name
        for method, style in _STYLES.items():
            rows = [s for s in result.samples if (s.flight, s.method) == (name, method)]
            errors = _shown([getattr(s.errors, field) for s in rows])
            axes.plot([s.cpu_s_per_s for s in rows], errors, label=method, **style)
        for peer in result.peers:
            if peer.flight == name and peer.method in _ROTORPY_MARKERS:
                axes.plot(
                    [peer.cpu_s_per_s],
                    _shown([getattr(peer.errors, field)]),
                    linestyle="none",
                    color="black",
                    marker=_ROTORPY_MARKERS[peer.method],
                    markersize=8,
                    label=peer.method,
                )
        _mark_reference(axes, getattr(solved.reference.uncertainty, field))
        axes.set(xscale="log", yscale="log", ylim=(0.5 * _ERROR_MIN, 1e2), title=_PANELS.get(name, name))
        axes.yaxis.set_major_locator(_decades(3))
    for axes in panels[::3]:
        axes.set_ylabel(label)
    for axes in panels[2:5]:
        axes.set_xlabel("CPU [s per simulated s]")
        axes.tick_params(labelbottom=True)
    _legend(figure, panels[5], panels[: len(result.flights)])


def _decades(step: int) -> Any:
    from matplotlib.ticker import LogLocator

    return LogLocator(base=10.0**step, numticks=20)


def _shown(errors: Sequence[float]) -> list[float]:
    """Return errors as they are drawn: none below the least, and none where a flight was lost."""
    return [max(e, _ERROR_MIN) if np.isfinite(e) and e < 1e3 else np.nan for e in errors]


def _mark_reference(axes: Axes, uncertainty: float) -> None:
    axes.axhspan(
        1e-30,
        max(uncertainty, _ERROR_MIN),
        color="0.85",
        zorder=0,
        label="below what is known of the reference",
    )


def _legend(figure: Figure, place: Axes, panels: Sequence[Axes]) -> None:
    """Put one legend of all panels where no panel is."""
    entries = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    place.axis("off")
    place.legend(entries.values(), entries.keys(), loc="center", frameon=False, borderaxespad=0.0)


def _draw_steps(result: DynamicsResult, figure: Figure) -> None:
    figure.set_size_inches(8.0, 7.2)
    flights = [s.flight.name for s in result.flights if s.flight.name != "hover"]
    rows = (
        ("position_m", "position error [m]"),
        ("attitude_rad", "attitude error [rad]"),
        ("body_rate_rad_s", "body rate error [rad/s]"),
    )
    panels = figure.subplots(len(rows), len(flights), sharex=True, sharey="row")
    for line, (field, label) in zip(panels, rows, strict=True):
        for axes, flight in zip(line, flights, strict=True):
            for method in reversed(FIXED_STEP):
                samples = [s for s in result.samples if (s.flight, s.method) == (flight, method.name)]
                errors = _shown([getattr(s.errors, field) for s in samples])
                axes.plot(
                    [1e3 * s.setting for s in samples], errors, label=method.name, **_STYLES[method.name]
                )
            axes.set(xscale="log", yscale="log", ylim=(1e-14, 1e2))
            axes.yaxis.set_major_locator(_decades(3))
            for order, from_ms, error in ((1, 0.1, 1e-1), (2, 0.1, 3e-5), (4, 2.5, 1e-13)):
                h_ms = np.array([from_ms, 4.0 * from_ms])
                guide = error * np.array([1.0, 4.0**order])
                axes.plot(h_ms, guide, color="0.45", linewidth=1.0, marker="", linestyle=":")
        line[0].set_ylabel(label)
    for axes, flight in zip(panels[0], flights, strict=True):
        axes.set_title(flight)
    for axes in panels[-1]:
        axes.set_xlabel("step [ms]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=len(labels),
        frameon=False,
        title="dotted: slopes 1, 2 and 4",
        title_fontsize=8,
    )


def _draw_motors(result: DynamicsResult, figure: Figure) -> None:
    axes = figure.subplots()
    instant_s = 1e-7  # where a time constant of 0 is drawn
    lost = 1e1
    for method in [trial.method for trial in result.motors[0].trials]:
        style = _STYLES.get(method, {"color": "black", "marker": "*"})
        taus, errors, lost_taus = [], [], []
        for m in result.motors:
            trial = next((t for t in m.trials if t.method == method), None)
            if trial is None or trial.outcome == "too slow":
                continue
            at_s = m.time_constant_s or instant_s
            if m.time_constant_s == 0.0:  # not joined to the others
                taus.append(at_s)
                errors.append(np.nan)
            taus.append(at_s)
            errors.append(np.nan if trial.errors is None else max(trial.errors.position_m, _ERROR_MIN))
            if trial.errors is None:
                lost_taus.append(at_s)
        axes.plot(taus, errors, label=method, **style)
        axes.plot(lost_taus, [lost * _SPREAD.get(method, 1.0)] * len(lost_taus), **{**style, "linestyle": ""})
    axes.axhspan(2.0, 300.0, color="0.93", zorder=0)
    axes.text(0.13, 20.0, "not finite", va="center", ha="left", size=8, color="0.35")
    axes.axvline(1e-3, color="0.6", linewidth=1.0, linestyle=":")
    axes.text(9e-4, 3e-16, "step", ha="left", size=8, color="0.35")
    axes.set(
        xscale="log",
        yscale="log",
        ylim=(0.7 * _ERROR_MIN, 300.0),
        xlim=(0.6, 0.5 * instant_s),
        xlabel="motor time constant [s]",
        ylabel="position error [m]",
    )
    ticks = [10.0**k for k in range(-1, -7, -1)]
    axes.set_xticks([*ticks, instant_s], [f"$10^{{{round(np.log10(t))}}}$" for t in ticks] + ["0"])
    axes.yaxis.set_major_locator(_decades(2))
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


_SPREAD = {EULER.name: 0.4, RK4.name: 1.3, MIDPOINT.name: 4.0}
"""Factors that keep marks in the band of lost flights apart."""


def _draw_drift(result: DynamicsResult, figure: Figure) -> None:
    figure.set_size_inches(8.0, 6.4)
    panels = figure.subplots(2, 2, sharex=True)
    top = [d for d in result.drifts if d.run == "free top"]
    for axes, field, title, label in (
        (panels[0, 0], "attitude_rad", "free top, 19 rad/s: attitude", "error [rad]"),
        (panels[0, 1], "energy", "free top: energy", "relative change"),
        (panels[1, 0], "momentum", "free top: momentum in W", "relative change"),
    ):
        for drift in top:
            axes.plot(
                drift.stamps_s, _shown(getattr(drift, field)), label=drift.method, **_STYLES[drift.method]
            )
        axes.set(title=title, ylabel=label)
    panels[0, 0].legend(fontsize=6.5)
    axes = panels[1, 1]
    for drift in result.drifts:
        if drift.run == "hover":
            axes.plot(
                drift.stamps_s,
                _shown(drift.position_m),
                label=f"hover: {drift.method}",
                **_STYLES[drift.method],
            )
    formats = [d for d in result.drifts if d.run == "spin"]
    for drift, color, marker in zip(formats, (COLORS[6], COLORS[4], COLORS[1]), "vsX", strict=False):
        axes.plot(
            drift.stamps_s,
            _shown(drift.position_m),
            label=f"spin: {drift.method}",
            color=color,
            marker=marker,
            linestyle="--",
        )
    axes.set(title="hover: position; spin: number formats", ylabel="drift [m]")
    axes.legend(fontsize=6.5)
    for axes in panels.ravel():
        axes.set(xscale="log", yscale="log")
        axes.yaxis.set_major_locator(_decades(3))
    for axes in panels[1]:
        axes.set_xlabel("time [s]")
