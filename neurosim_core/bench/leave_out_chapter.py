"""The chapter of `neurosim bench leave-out`: what was promised, the answer in words, tables, a plot."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

import numpy as np

from neurosim_core.bench.figures import COLORS
from neurosim_core.bench.leave_out_cases import ALL, ALL_FILE, EVENTS, EVENTS_PLAIN, IMU, IMU_FILE, Case
from neurosim_core.bench.leave_out_probe import LIBRARIES, Probe
from neurosim_core.bench.leave_out_result import EQUAL_BAR, LeaveOutResult
from neurosim_core.bench.report import Bar, Chapter, Plot, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SAMPLER = (
    "sample_texture",
    "sample_finest",
    "sample_nearest",
    "shade_textured_packet",
    "see_textured_packet",
)
_RGB = "_to_srgb"


def leave_out_chapter(result: LeaveOutResult) -> Chapter:
    """Return the answer in words, tables and a plot."""
    return Chapter(
        name="leave-out",
        title="What a scene does not need is left out",
        summary=_summary(result),
        command=f"neurosim bench leave-out{' --quick' if result.quick else ''}",
        bars=_bars(result),
        tables=[_count_table(result), _term_table(result), _library_table(result), _difference_table(result)],
        plots=[
            Plot(
                name="leave-out",
                title="What runs take, few parts to many",
                draw=lambda figure: _draw(result, figure),
            )
        ],
    )


def _summary(result: LeaveOutResult) -> str:
    least, most = result.probes[IMU], result.probes[ALL]
    worst = max(d.largest for d in result.differences if d.precision == "float64")
    return (
        "Each case flew in a process of its own, on the CPU, with launches, allocations and imports counted "
        "as they happened. For a simulated second (sensors and control included) a flight with an IMU alone "
        f"takes {1e3 * _best_s(least):,.0f} ms of CPU time, one with every sensor and term "
        f"{1e3 * _best_s(most):,.0f} ms, {_best_s(most) / _best_s(least):,.0f} times as much; set-up takes "
        f"{least.setup_s:.1f} s and {most.setup_s:.1f} s, Warp's arrays {least.array_bytes / 2**20:.1f} MiB "
        f"and {most.array_bytes / 2**20:.1f} MiB. Dynamics and IMUs without the terms that they do not need "
        f"differ from the full ones with zeros by {worst:.1e} at most."
    )


def _best_s(probe: Probe) -> float:
    """Return CPU time per simulated second [s], the best of the repetitions."""
    return min(probe.flight_s)


def _bars(result: LeaveOutResult) -> list[Bar]:
    imu, events, plain = (result.probes[name] for name in (IMU, EVENTS, EVENTS_PLAIN))
    blind = [(case.title, result.probes[case.name]) for case in result.cases if case.name in (IMU, IMU_FILE)]
    imported = [f"{name} ({title})" for title, probe in blind for name in _scene_libraries(probe)]
    needed = _scene_libraries(result.probes[ALL_FILE])
    pictures, texels = (sum(getattr(p, k) for _, p in blind) for k in ("picture_count", "texture_bytes"))
    rgb = [name for name, probe in ((EVENTS, events), (EVENTS_PLAIN, plain)) if _computes_rgb(probe)]
    sampled = [name for name in _SAMPLER if name in plain.shader_functions]
    return [
        Bar(
            text="a run with an IMU only allocates no image",
            measured=f"{pictures} of {imu.array_count} arrays, {texels} bytes of texture",
            met=pictures == texels == 0,
        ),
        Bar(
            text="a run with an IMU only imports no library for scenes: apartment, glTF",
            measured=(", ".join(imported) or f"none of {', '.join(LIBRARIES['scene'])}")
            + f"; to look at the same file takes {', '.join(needed) or 'none'}",
            met=not imported and bool(needed),
        ),
        Bar(
            text="a run with events only computes no RGB",
            measured=f"computed in: {', '.join(rgb)}" if rgb else "not in the code of its kernels",
            met=not rgb,
        ),
        Bar(
            text="a scene without textures compiles no sampler",
            measured=", ".join(sampled)
            or "not in the code of its kernels; the apartment's has "
            + ", ".join(name for name in _SAMPLER if name in events.shader_functions),
            met=not sampled and any(name in events.shader_functions for name in _SAMPLER),
        ),
        Bar(
            text=f"reduced kernels equal the full ones with coefficients of zero: {EQUAL_BAR:g} in float64, "
            "else exactly",
            measured="; ".join(f"{d.kernel} {d.largest:.1e}" for d in result.differences),
            met=all(d.largest <= d.bar for d in result.differences),
        ),
    ]


def _scene_libraries(probe: Probe) -> list[str]:
    """Return the libraries for scenes that a run has imported."""
    return [name for name in LIBRARIES["scene"] if name in probe.libraries] + ["Embree"] * probe.embree


def _computes_rgb(probe: Probe) -> bool:
    """Whether a ray caster turns light into colours, or any cast is asked for them."""
    return _RGB in probe.shader_functions or any("rgb" in terms for terms in probe.terms.values())


def _count_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out",
        title="Launches, memory and time",
        columns={
            "case": "run",
            "kernels": "kernels",
            "launch_count": "launches",
            "launches_per_s": "launches per simulated second",
            "array_count": "arrays",
            "array_mib": "their size [MiB]",
            "picture_mib": "of pictures [MiB]",
            "texture_mib": "texels on the host [MiB]",
            "flight_allocations_per_s": "allocations per s in flight",
            "resident_mib": "most memory of the process [MiB]",
            "setup_s": "set-up [s of CPU]",
            "cpu_ms": "CPU time per simulated second, best [ms]",
            "cpu_median_ms": "median [ms]",
            "full_cpu_ms": "with everything on, best [ms]",
        },
        rows=[
            {
                "case": case.title,
                "kernels": len(probe.kernels),
                "launch_count": probe.launch_count,
                "launches_per_s": probe.launches_per_s,
                "array_count": probe.array_count,
                "array_mib": probe.array_bytes / 2**20,
                "picture_mib": probe.picture_bytes / 2**20,
                "texture_mib": probe.texture_bytes / 2**20,
                "flight_allocations_per_s": probe.flight_allocations_per_s,
                "resident_mib": probe.resident_bytes / 2**20,
                "setup_s": probe.setup_s,
                "cpu_ms": 1e3 * _best_s(probe),
                "cpu_median_ms": 1e3 * statistics.median(probe.flight_s),
                "full_cpu_ms": 1e3 * _best_s(result.probes[case.full]),
            }
            for case, probe in _rows(result)
        ],
        note="On the CPU, in a process for each run. Slices of one launch count once. Arrays are those that "
        "Warp allocates in the set-up, in flight those of its second half; pictures are arrays with the rows "
        "and columns of a camera. CPU time is that of all threads, with all that sensors and control take: "
        f"best and median of {len(result.probes[IMU].flight_s)} flights in one process.",
    )


def _term_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out-terms",
        title="Terms that are compiled in",
        columns={"case": "run", "part": "part", "terms": "terms"},
        rows=[
            {"case": case.title, "part": part, "terms": ", ".join(terms) or "none"}
            for case, probe in _rows(result)
            for part, terms in probe.terms.items()
        ],
    )


def _library_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out-libraries",
        title="Libraries that are imported",
        columns={"case": "run", **{kind: kind for kind in LIBRARIES}, "embree": "Embree loaded"},
        rows=[
            {
                "case": case.title,
                "embree": probe.embree,
                **{
                    kind: ", ".join(name for name in names if name in probe.libraries) or "none"
                    for kind, names in LIBRARIES.items()
                },
            }
            for case, probe in _rows(result)
        ],
        note="Of " + ", ".join(name for names in LIBRARIES.values() for name in names) + ". Rooms are read "
        "from glTF; files of other formats are read by trimesh, also where nobody looks.",
    )


def _difference_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out-differences",
        title="Reduced kernels against full ones with coefficients of zero",
        columns={
            "kernel": "kernel",
            "reduced": "terms of the reduced one",
            "full": "of the full one",
            "precision": "precision",
            "largest": "largest difference",
            "bar": "allowed",
        },
        rows=[vars(difference) for difference in result.differences],
        note="Dynamics and IMU: a second under random commands; positions, velocities, attitudes and rates; "
        "specific forces and rates. Pixels: pictures that wander at random; every event, to its stamp.",
    )


def _rows(result: LeaveOutResult) -> list[tuple[Case, Probe]]:
    return [(case, result.probes[case.name]) for case in result.cases]


def _draw(result: LeaveOutResult, figure: Figure) -> None:
    """Draw time, launches and memory of each run beside each other."""
    panels = figure.subplots(1, 3, sharey=True)
    titles = [case.title for case in result.cases]
    figures = (
        ("CPU time per simulated second [ms]", [1e3 * _best_s(probe) for _, probe in _rows(result)]),
        ("launches per simulated second", [probe.launches_per_s for _, probe in _rows(result)]),
        ("Warp arrays [MiB]", [probe.array_bytes / 2**20 for _, probe in _rows(result)]),
    )
    for axes, color, (label, values) in zip(panels, COLORS, figures, strict=False):
        axes.plot(values, np.arange(len(titles)), "o", color=color)  # on a log axis, bars have no length
        for row, value in enumerate(values):
            text = f"{value:,.3g}" if value < 1e3 else f"{value:,.0f}"
            axes.annotate(text, (value, row), (8, 0), textcoords="offset points", va="center")
        axes.set(xscale="log", xlabel=label, xlim=(0.5 * min(values), 8.0 * max(values)))
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks(np.arange(len(titles)), titles)
    panels[0].invert_yaxis()
