"""The plots of `neurosim bench throughput`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from neurosim_core.bench.chapter import cell
from neurosim_core.bench.figures import COLORS, MARKERS, plain_ticks
from neurosim_core.bench.throughput_result import BARE_CAST, STAGES, StepRow, ThroughputResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RATE_AXIS = "steps [1/s]"


def draw_steps(result: ThroughputResult, figure: Figure) -> None:
    """Draw steps a second over the size of the picture, of the scene and of a launch."""
    figure.set_size_inches(10.0, 4.4)
    left, middle, right = figure.subplots(1, 3)
    rows = [row for row in result.rows if row.steps_per_s]
    by_size = [row for row in rows if row.study == "resolution"]
    for place, mode in enumerate(dict.fromkeys(row.mode for row in by_size)):
        line = [row for row in by_size if row.mode == mode]
        _line(left, line, lambda row: row.width * row.height, label=mode, place=place)
    if by_size:
        sizes = sorted({(row.width, row.height) for row in by_size}, key=lambda size: size[0] * size[1])
        left.set_xscale("log")
        left.set_xticks([w * h for w, h in sizes], [f"{w}x{h}" for w, h in sizes], rotation=30)
        left.minorticks_off()
    left.set(title="size of the picture", ylabel=_RATE_AXIS)
    hall = [row for row in rows if row.study == "triangles"]
    _line(middle, hall, lambda row: row.triangles or 0, label="", place=0)
    middle.set(title=f"triangles{_size(hall)}", xscale="log", xlabel="triangles of a hall")
    if hall:
        counts = [row.triangles or 0 for row in hall]
        middle.set_xticks(counts, [f"{1e-3 * count:,.0f} k" for count in counts])
        middle.minorticks_off()
    launches = [row for row in rows if row.study == "launch"]
    _line(right, launches, lambda row: row.instants, label="", place=0)
    right.set(title=f"renders per launch{_size(launches)}", xscale="log", xlabel="renders per launch")
    if launches:
        right.set_xticks([row.instants for row in launches], [str(row.instants) for row in launches])
        right.minorticks_off()
    for axes, shown in ((left, by_size), (middle, hall), (right, launches)):
        if not shown:
            axes.text(0.5, 0.5, "not measured", ha="center", transform=axes.transAxes)
            continue
        axes.set_yscale("log")
        figures = [x for row in shown for x in (row.slowest_per_s, row.fastest_per_s) if x]
        axes.set_ylim(0.7 * min(figures), 1.6 * max(figures))
        plain_ticks(axes.yaxis)
    if by_size:
        slowest, fastest = left.get_ylim()
        if slowest <= result.rate_hz <= fastest:
            left.axhline(result.rate_hz, color="0.5", ls="--", lw=1.0, marker="", label="real time")
        left.legend()


def _size(rows: Sequence[StepRow]) -> str:
    return f", {rows[0].width}x{rows[0].height}" if rows else ""


def _line(
    axes: Axes, rows: Sequence[StepRow], abscissa: Callable[[StepRow], int], *, label: str, place: int
) -> None:
    """Draw medians, and how far the repetitions are from them."""
    medians = [row.steps_per_s or 0.0 for row in rows]
    below = [m - (row.slowest_per_s or m) for m, row in zip(medians, rows, strict=True)]
    above = [(row.fastest_per_s or m) - m for m, row in zip(medians, rows, strict=True)]
    axes.errorbar(
        [abscissa(row) for row in rows],
        medians,
        yerr=[below, above],
        label=label,
        color=COLORS[place],
        marker=MARKERS[place],
        capsize=3.0,
    )


def draw_parts(result: ThroughputResult, figure: Figure) -> None:
    """Draw where the time of a step goes, and what each part takes alone."""
    upper, lower = figure.subplots(2, 1, height_ratios=(1.0, 2.2))
    _draw_split(result, upper)
    _draw_alone(result, lower)


def _draw_split(result: ThroughputResult, axes: Axes) -> None:
    split = result.split
    axes.set_title("one launch after another")
    axes.set_yticks([])
    if split is None:
        axes.text(0.5, 0.5, "not measured", ha="center", transform=axes.transAxes)
        return
    parts = {**{name: split.stages_us.get(name, 0.0) for name in STAGES}, "host": split.host_us}
    begin = 0.0
    for color, (name, us) in zip(COLORS, parts.items(), strict=False):
        share = us / split.step_us
        axes.barh(0, us, left=begin, color=color, label=f"{name} {share:.1%}")
        begin += us
    axes.set(xlabel=f"time of a step at {split.width}x{split.height} [us]", xlim=(0.0, 1.001 * split.step_us))
    axes.set_ylim(-0.5, 1.5)
    axes.grid(visible=False)
    axes.legend(ncols=6, loc="upper left", handlelength=1.0, columnspacing=1.0, frameon=False)


def _draw_alone(result: ThroughputResult, axes: Axes) -> None:
    roof = result.roofline
    bars: list[tuple[str, float]] = [
        (part.name, part.per_step_us) for part in roof.parts if part.per_step_us is not None
    ]
    if roof.step_us is not None:
        bars.append(("whole step, overlapped", roof.step_us))
    axes.set_title("each part alone")
    if not bars:
        axes.text(0.5, 0.5, "not measured", ha="center", transform=axes.transAxes)
        return
    colors: list[Any] = [COLORS[5] if name == BARE_CAST else COLORS[0] for name, _ in bars]
    colors[-1] = COLORS[1] if roof.step_us is not None else colors[-1]
    places = range(len(bars))
    axes.barh(places, [us for _, us in bars], color=colors)
    axes.set_yticks(places, [name for name, _ in bars])
    for place, (_, us) in zip(places, bars, strict=True):
        axes.text(us, place, f" {cell(us)} us, {cell(1e6 / us)} /s", va="center", fontsize=7)
    longest = max(us for _, us in bars)
    axes.set(xlabel="time of a step [us]", xscale="log")
    axes.set_xlim(0.5 * min(us for _, us in bars), 8.0 * longest)
    axes.grid(visible=False, axis="y")
    axes.invert_yaxis()
