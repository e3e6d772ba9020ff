"""The chapter of `neurosim bench throughput`: what was promised, tables, plots."""

from __future__ import annotations

import dataclasses

from neurosim_core.bench.h200 import HOUSE_TRIANGLES, is_enough
from neurosim_core.bench.report import Bar, Chapter, Plot, Table
from neurosim_core.bench.throughput_plots import draw_parts, draw_steps
from neurosim_core.bench.throughput_result import (
    ADAPTIVE,
    BARE_CAST,
    EXACT,
    RAYS_ALONE,
    STAGES,
    Agreement,
    Comparison,
    ThroughputResult,
)

VGA, HD, DAVIS = (640, 480), (1280, 720), (346, 260)
FIRST_PER_S = 220.0
"""Whole steps a second of the first version at 346x260 in the house, on two cores of an AMD EPYC."""
_RMS_MAX = 1e-4
"""Of the difference of log radiance; a threshold is some 0.1 to 0.5."""

_WHOLE = "whole steps"


def throughput_chapter(result: ThroughputResult) -> Chapter:
    """Return the answer in words, tables and plots."""
    return Chapter(
        name="throughput",
        title="Throughput: whole steps a second, where their time goes, and what the device could do",
        summary=_summary(result),
        command=f"neurosim bench throughput{' --quick' if result.quick else ''}",
        bars=throughput_bars(result),
        tables=[
            _step_table(result),
            *([_split_table(result)] if result.split else []),
            _part_table(result),
            _comparison_table(result),
            _agreement_table(result),
        ],
        plots=[
            Plot(
                name="throughput-steps",
                title="Whole steps a second",
                draw=lambda figure: draw_steps(result, figure),
            ),
            Plot(
                name="throughput-parts",
                title="The parts of a step",
                draw=lambda figure: draw_parts(result, figure),
            ),
        ],
    )


def throughput_bars(result: ThroughputResult) -> list[Bar]:
    """Return what issue 7 promises, judged where it was measured on what it is promised for."""
    return [
        _step_bar(result, "640x480, whole step, exact, one vehicle", 18_000.0, VGA),
        _step_bar(
            result,
            "the same in the fastest mode with less than 1 % of error in the events",
            27_000.0,
            VGA,
        ),
        _step_bar(result, "1280x720, whole step, exact", 6_500.0, HD),
        _scan_bar(result),
        _loop_bar(result),
        Bar(
            text="1,024 worlds of 128x128 event cameras: 250,000 renders/s in total",
            measured="`neurosim bench worlds` measures it",
            met=None,
        ),
        _events_bar(result),
        *_determinism_bars(result),
        _laptop_bar(result),
    ]


def _judge(result: ThroughputResult, measured: float | None, least: float) -> bool | None:
    """Return whether a figure is enough; a lesser device than the bar is for does not miss it."""
    if measured is None or result.quick:
        return None
    return is_enough(result.device, measured, least)


def _place(result: ThroughputResult) -> str:
    """Return why a figure is not judged, if it is missing or too low; empty: it is."""
    if result.quick:
        return "needs a run without --quick"
    return "" if "H200" in result.device else "needs an H200"


def _is_house(result: ThroughputResult) -> bool:
    return result.is_house and result.scene_triangles >= HOUSE_TRIANGLES


def _step_bar(result: ThroughputResult, text: str, least: float, size: tuple[int, int]) -> Bar:
    text = f"{text}, in a house of 145,844 triangles, H200: at least {least:,.0f} /s"
    row = result.fastest(EXACT, *size)
    if row is None:
        return Bar(text=text, measured=_why(result, size), met=None)
    figure = row.steps_per_s or 0.0
    said = (
        f"{figure:,.0f} /s ({row.mode}, {row.instants} renders per launch; {result.scene}, "
        f"{result.scene_triangles:,} triangles)"
    )
    if not _is_house(result):
        return Bar(text=text, measured=f"needs --scene with the house; here {said}", met=None)
    met = _judge(result, figure, least)
    return Bar(text=text, measured=said if met is not None else f"{_place(result)}; here {said}", met=met)


def _why(result: ThroughputResult, size: tuple[int, int]) -> str:
    for row in result.rows:
        if row.study == "resolution" and row.mode == EXACT and (row.width, row.height) == size:
            return f"failed: {row.failure}"
    return _place(result) or "not among the sizes of this run"


def _scan_bar(result: ThroughputResult) -> Bar:
    scan = result.scan
    text = (
        "event scan alone, 640x480, stamped and interpolated, several per pixel, H200: at least 300,000 "
        "frames/s, and 10 times the naive kernel"
    )
    if scan.ours_per_s is None:
        return Bar(text=text, measured=f"failed: {scan.failure}", met=None)
    size = result.roofline.width, result.roofline.height
    said = f"{scan.ours_per_s:,.0f} frames/s at {size[0]}x{size[1]}, {_times(scan)} the naive kernel"
    if size != VGA or scan.ratio is None:
        return Bar(text=text, measured=f"{_place(result)}; here {said}", met=None)
    met = _judge(result, min(scan.ours_per_s / 300_000.0, scan.ratio / 10.0), 1.0)
    return Bar(text=text, measured=said if met is not None else f"{_place(result)}; here {said}", met=met)


def _loop_bar(result: ThroughputResult) -> Bar:
    loop = result.loop
    text = "one render and one scan per call, count read by the host each time: at least 1.5 times the naive"
    if loop.ratio is None or loop.ours_per_s is None:
        return Bar(text=text, measured=f"failed: {loop.failure}", met=None)
    at_once = result.loop_at_once
    said = (
        f"{loop.ours_per_s:,.0f} /s, {_times(loop)} the naive loop, with the count of the frame two before; "
        f"{_times(at_once)} with that of the frame just rendered"
    )
    met = _judge(result, loop.ratio, 1.5)
    return Bar(text=text, measured=said if met is not None else f"{_place(result)}; here {said}", met=met)


def _times(comparison: Comparison) -> str:
    return "unknown times" if comparison.ratio is None else f"{comparison.ratio:.2f} times"


def _events_bar(result: ThroughputResult) -> Bar:
    text = "events to the host, sorted, sustained, H200: at least 500 M events/s"
    if result.events_per_s is None:
        return Bar(text=text, measured=f"failed: {result.events_failure}", met=None)
    said = f"{1e-6 * result.events_per_s:,.1f} M events/s"
    met = _judge(result, result.events_per_s, 5e8)
    return Bar(text=text, measured=said if met is not None else f"{_place(result)}; here {said}", met=met)


def _determinism_bars(result: ThroughputResult) -> list[Bar]:
    again, *others = result.agreements
    bars = [
        Bar(
            text="the same bytes on every run",
            measured=again.failure
            or f"{again.event_counts[0] if again.event_counts else 0:,} events compared",
            met=again.same,
        )
    ]
    text = f"CPU and GPU agree up to rounding of radiance, quantified: an RMS below {_RMS_MAX:g}"
    both = [agreement for agreement in others if result.is_cuda]
    if not both:
        return [*bars, Bar(text=text, measured="needs a GPU", met=None)]
    met = None if both[0].rms is None else both[0].rms < _RMS_MAX
    return [*bars, Bar(text=text, measured=_said(both[0]), met=met)]


def _said(agreement: Agreement) -> str:
    if agreement.failure or agreement.event_counts is None:
        return f"failed: {agreement.failure}"
    here, there = agreement.event_counts
    return (
        f"RMS of log radiance {agreement.rms:.1e}, at most {agreement.largest:.1e}, "
        f"{agreement.beyond_share:.1e} of the pixels beyond 0.001; {here:,} and {there:,} events"
    )


def _laptop_bar(result: ThroughputResult) -> Bar:
    text = (
        f"two CPU cores, 346x260, house: at least 4 times the first version's {FIRST_PER_S:g} /s "
        "(two cores of an AMD EPYC)"
    )
    rows = [row for mode in (EXACT, ADAPTIVE) if (row := result.row(mode, *DAVIS))]
    said = "; ".join(
        f"{row.mode} {row.steps_per_s:,.0f} /s, real-time factor {row.real_time_factor:.2f}" for row in rows
    )
    if result.is_cuda or result.quick or not rows:
        return Bar(text=text, measured="needs a CPU, without --quick", met=None)
    if not _is_house(result) or result.core_count != 2:
        return Bar(text=text, measured=f"needs two cores and --scene with the house; here {said}", met=None)
    best = max(row.steps_per_s or 0.0 for row in rows)
    return Bar(text=text, measured=said, met=best >= 4.0 * FIRST_PER_S)


def _summary(result: ThroughputResult) -> str:
    lines = [
        f"On {result.device}"
        + ("" if result.is_cuda else f", {result.core_count} cores")
        + f": physics, control, render, event scan, packets read back. {result.scene}, "
        f"{result.scene_triangles:,} triangles; a step is {1e3 / result.rate_hz:g} ms of flight.",
        "",
    ]
    if result.quick:
        lines += ["**Tiny pictures and scenes: these figures mean nothing.**", ""]
    for row in result.rows:
        if row.study == "resolution" and row.steps_per_s is not None:
            lines.append(
                f"- {row.width}x{row.height}, {row.mode}: {row.steps_per_s:,.0f} /s, real-time factor "
                f"{row.real_time_factor:.3g}."
            )
    slowest, step_us = result.roofline.slowest, result.roofline.step_us
    if slowest is not None and step_us is not None and slowest.per_step_us:
        lines.append(
            f"- A whole step takes {step_us / slowest.per_step_us:.2f} times its slowest part alone "
            f"({slowest.name}) at {result.roofline.width}x{result.roofline.height}."
        )
    return "\n".join(lines)


def _step_table(result: ThroughputResult) -> Table:
    return Table(
        name="throughput-steps",
        title="Whole steps a second",
        columns={
            "study": "varied",
            "mode": "mode",
            "scene": "scene",
            "triangles": "triangles",
            "width": "width [px]",
            "height": "height [px]",
            "instants": "renders per launch",
            "steps_per_s": "steps [1/s]",
            "slowest_per_s": "slowest",
            "fastest_per_s": "fastest",
            "real_time_factor": "real-time factor",
            "renders_per_step": "renders per step",
            "events_per_step": "events per step",
            "failure": "failed",
        },
        rows=[_blank(dataclasses.asdict(row)) for row in result.rows],
        note=f"Median of the repetitions, each past another part of the scene. A step is "
        f"{1e3 / result.rate_hz:g} ms. `{ADAPTIVE}` renders when something would move further than "
        f"{result.max_displacement_px:g} px, and where a launch ends. `{RAYS_ALONE}`: without shared walks, "
        "the same events to the last bit.",
    )


def _blank(row: dict[str, object]) -> dict[str, object]:
    return {key: value if value != "" else None for key, value in row.items()}


def _split_table(result: ThroughputResult) -> Table:
    assert result.split is not None
    split = result.split
    parts = {**{name: split.stages_us.get(name, 0.0) for name in STAGES}, "host": split.host_us}
    return Table(
        name="throughput-split",
        title="Where the time of a step goes",
        columns={"part": "part", "us": "time per step [us]", "share": "share [%]"},
        rows=[
            *({"part": name, "us": us, "share": 100.0 * us / split.step_us} for name, us in parts.items()),
            {"part": "all", "us": split.step_us, "share": 100.0},
        ],
        note=f"{split.width}x{split.height}, {split.instants} renders per launch, one launch at a time: "
        "nothing overlaps, so a run with two under way is faster than the sum. Host: what no part accounts "
        "for. "
        + (
            "Timed with CUDA events; waits of the host within `sort and decode` are part of it."
            if result.is_cuda
            else "Timed with the host's clock; nothing has to be copied."
        ),
    )


def _part_table(result: ThroughputResult) -> Table:
    roof = result.roofline
    rows: list[dict[str, object]] = [
        {
            "part": part.name,
            "us": part.per_step_us,
            "per_s": None if not part.per_step_us else 1e6 / part.per_step_us,
            "megabytes": None if part.bytes_per_step is None else 1e-6 * part.bytes_per_step,
            "gigabytes_per_s": part.gigabytes_per_s,
            "of_copy": None
            if part.gigabytes_per_s is None or not roof.copy_gigabytes_per_s
            else 100.0 * part.gigabytes_per_s / roof.copy_gigabytes_per_s,
            "mrays_per_s": None if part.rays_per_s is None else 1e-6 * part.rays_per_s,
            "failure": part.failure or None,
        }
        for part in roof.parts
    ]
    whole = roof.step_us
    rows.append({"part": _WHOLE, "us": whole, "per_s": None if not whole else 1e6 / whole})
    rows.append({"part": "ceiling: copy in memory", "gigabytes_per_s": roof.copy_gigabytes_per_s})
    if roof.host_gigabytes_per_s is not None:
        rows.append({"part": "ceiling: copy to the host", "gigabytes_per_s": roof.host_gigabytes_per_s})
    return Table(
        name="throughput-parts",
        title="Each part alone, beside the whole and the ceilings",
        columns={
            "part": "part",
            "us": "time per step [us]",
            "per_s": "per second",
            "megabytes": "counted [MB]",
            "gigabytes_per_s": "[GB/s]",
            "of_copy": "of the copy [%]",
            "mrays_per_s": "rays [M/s]",
            "failure": "failed",
        },
        rows=rows,
        note=f"{roof.width}x{roof.height}, {roof.instants} renders per launch. Counted: every array that the "
        f"part must read or write, once; triangles and textures are not. `{BARE_CAST}` is a part of the "
        "render: the same rays, depth only, nothing shaded.",
    )


def _comparison_table(result: ThroughputResult) -> Table:
    return Table(
        name="throughput-naive",
        title="Our event camera and a naive one, on the same frames",
        columns={
            "what": "what",
            "ours": "ours [frames/s]",
            "naive": "naive [frames/s]",
            "ratio": "ratio",
            "ours_events": "events per frame",
            "naive_events": "of the naive",
            "failure": "failed",
        },
        rows=[
            {
                "what": row.name,
                "ours": row.ours_per_s,
                "naive": row.naive_per_s,
                "ratio": row.ratio,
                "ours_events": row.ours_events,
                "naive_events": row.naive_events,
                "failure": row.failure or None,
            }
            for row in (result.scan, result.loop, result.loop_at_once)
        ],
        note="Naive: one frame per call, at most one event per pixel and frame, stamped at the frame, an "
        "atomic per warp, and the host reads the count each time. Ours: the exact law, crossing times "
        f"interpolated, alone {result.roofline.instants} frames per launch, and in the loop sorted and "
        "handed out each 16 frames; there a call reads the count of the frame two before, while two render, "
        "or that of its own frame. The renders of all loops are graphs that are replayed; the median of five "
        "rounds in turn counts. "
        "Events reach the host, sorted, at "
        + (
            f"{1e-6 * result.events_per_s:,.1f} M/s (each pixel fires in each frame)."
            if result.events_per_s is not None
            else f"an unknown rate ({result.events_failure})."
        ),
    )


def _agreement_table(result: ThroughputResult) -> Table:
    return Table(
        name="throughput-agreement",
        title="The same flight twice",
        columns={
            "what": "what",
            "same": "same bytes",
            "events": "events",
            "events_other": "of the other",
            "rms": "RMS of log radiance",
            "largest": "largest difference",
            "beyond_share": "pixels beyond 0.001",
            "failure": "failed",
        },
        rows=[
            {
                "what": row.what,
                "same": row.same,
                "events": row.event_counts[0] if row.event_counts else None,
                "events_other": row.event_counts[1] if row.event_counts else None,
                "rms": row.rms,
                "largest": row.largest,
                "beyond_share": row.beyond_share,
                "failure": row.failure or None,
            }
            for row in result.agreements
        ],
        note="A flight past pillars: all bytes of its events, and the log radiance of its last launch.",
    )
