"""One renderer of reports: chapters as a terminal shows them, as PNG, and as one HTML page.

matplotlib draws, jinja2 makes the page, rich prints. The page needs no other file: pictures and tables are
inside it.
"""

from __future__ import annotations

import base64
import importlib.util
import io
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import rich.table
from rich.console import Console
from rich.text import Text

from neurosim_core.bench.report import (
    Chapter,
    Panel,
    Plot,
    Series,
    Table,
    cell,
    is_numeric,
    table_to_csv,
    write_chapter,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

VERDICTS = {True: "met", False: "missed", None: "not measured here"}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of series, in turn.

Reference: Okabe and Ito (2008), Color Universal Design, without its yellow, which is faint on white.
"""
MARKERS = "os^DvPX"
"""Of series, in turn: no difference is shown by colour alone."""

_FOLDED_ROWS = 24
_PANEL_IN = {1: (8.0, 4.6), 2: (4.6, 3.8), 3: (3.6, 3.3)}
"""Width and height of a panel by the number of panels in a row [inch]."""
_LOOK: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "font.size": 9,
    "grid.alpha": 0.25,
    "legend.fontsize": 8,
    "lines.markersize": 5,
}


def print_chapter(chapter: Chapter, console: Console) -> None:
    """Print summary, tables and claims."""
    console.rule(Text(chapter.title))
    console.print(Text(chapter.summary))
    for table in chapter.tables:
        console.print()
        print_table(table, console)
    styles = {True: "green", False: "bold red", None: "yellow"}
    for claim in chapter.claims:
        verdict = Text(VERDICTS[claim.met], style=styles[claim.met])
        console.print(verdict, Text(f"{claim.text}: {claim.measured} ({claim.reference})"), soft_wrap=True)


def print_table(table: Table, console: Console) -> None:
    """Print a table with its title and note; it may be wider than the terminal."""
    grid = rich.table.Table(box=None, pad_edge=False, header_style="bold")
    rows = [[cell(row.get(key)) for key in table.headings] for row in table.rows]
    for column, heading in enumerate(table.headings):
        side: Literal["left", "right"] = "right" if is_numeric(table, heading) else "left"
        wrapped = textwrap.fill(heading, 12)
        longest = max(map(len, [*wrapped.split(), *(row[column] for row in rows)]))
        grid.add_column(Text(wrapped), justify=side, min_width=longest)
    for row in rows:
        grid.add_row(*map(Text, row))
    console.print(Text(table.title, style="bold"))
    console.print(grid, highlight=False, crop=False, soft_wrap=True)
    if table.note:
        console.print(Text(table.note, style="dim"))


def write_report(chapters: Sequence[Chapter], out: str | Path, console: Console) -> None:
    """Write the last chapter with its tables and plots, and `report.html` of all; say so.

    Args:
        chapters: What the page says; chapters, tables and plots have unique names.
        out: Folder; made if need be.
        console: Where to say it. Without matplotlib and jinja2 there are no plots and no page, and it is
            said.
    """
    folder = Path(out)
    write_chapter(chapters[-1], folder)
    if not all(importlib.util.find_spec(name) for name in ("matplotlib", "jinja2")):
        lack = "no plots and no page: matplotlib and jinja2 are missing; pip install -e '.[view]'"
        console.print(lack, style="yellow", markup=False)
        return
    pictures = {}
    for chapter in chapters:
        for plot in chapter.plots:
            file = folder / f"{plot.name}.png"
            if chapter is chapters[-1] or not file.exists():
                file.write_bytes(draw_plot(plot))
            pictures[plot.name] = base64.b64encode(file.read_bytes()).decode("ascii")
    page = folder / "report.html"
    page.write_text(html_page(chapters, pictures), encoding="utf-8")
    console.print(f"left in {folder}: report.html, chapters, tables, plots", soft_wrap=True)


def html_page(chapters: Sequence[Chapter], pictures: Mapping[str, str]) -> str:
    """Return the page of chapters; pictures are PNG in base64, by the name of the plot."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["cell"] = cell
    template = (Path(__file__).parent / "page.html.j2").read_text(encoding="utf-8")
    verdicts = [claim.met for chapter in chapters for claim in chapter.claims]
    return environment.from_string(template).render(
        title="Neurosim: the numbers",
        chapters=chapters,
        pictures=pictures,
        verdicts=VERDICTS,
        counts={met: verdicts.count(met) for met in VERDICTS},
        is_numeric=is_numeric,
        csv=lambda table: base64.b64encode(table_to_csv(table).encode()).decode("ascii"),
        folded_rows=_FOLDED_ROWS,
    )


def draw_plot(plot: Plot) -> bytes:
    """Return a plot as PNG. One legend below all panels names each series once."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(plot.columns, len(plot.panels))
    rows = math.ceil(len(plot.panels) / columns)
    labels = list(dict.fromkeys(s.label for p in plot.panels for s in p.series))
    alone = len(labels) > len(COLOURS)  # then each panel has colours and a legend of its own
    width, height = _PANEL_IN[min(columns, 3)]
    with matplotlib.rc_context(cast(Any, {**matplotlib.rcParamsDefault, **_LOOK})):
        legend_in = 0.22 * math.ceil(len(labels) / (2 * columns)) + 0.4
        figure = Figure(figsize=(width * columns, height * rows + legend_in), dpi=130, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(plot.title, x=0.01, ha="left", fontsize=11)
        places = figure.subplots(
            rows, columns, squeeze=False, sharex=plot.shared_axes, sharey=plot.shared_axes
        ).ravel()
        for axes, panel in zip(places, plot.panels, strict=False):
            own = list(dict.fromkeys(series.label for series in panel.series if series.style != "law"))
            _draw_panel(axes, panel, own if alone else labels)
            if alone:
                axes.legend()
            if plot.shared_axes:
                axes.tick_params(labelbottom=True, labelleft=True)
        for axes in places[len(plot.panels) :]:
            axes.axis("off")
        if not alone:
            _draw_legend(figure, list(places), columns)
        data = io.BytesIO()
        figure.savefig(data, format="png")
    return data.getvalue()


def _draw_panel(axes: Axes, panel: Panel, labels: Sequence[str]) -> None:
    for series in panel.series:
        number = labels.index(series.colour_of or series.label)
        look: dict[str, Any] = {"color": COLOURS[number % len(COLOURS)], "label": series.label}
        x, y = _finite(series.x), _finite(series.y)
        line = {"line": "-", "dashed": "--", "points": "none", "law": "-"}[series.style]
        if series.style == "law":
            look |= {"label": "_", "linewidth": 1.0}
        marker = "" if series.style == "law" else MARKERS[number % len(MARKERS)]
        axes.plot(x, y, linestyle=line, marker=marker, **look)
        _name_points(axes, series, x, y)
    for draw, lines in ((axes.axvline, panel.x_lines), (axes.axhline, panel.y_lines)):
        for label, place in lines.items():
            draw(place, color="0.45", linestyle=":", linewidth=1.2, label=label)
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    axes.set(xscale=panel.x_scale, yscale=panel.y_scale)
    if panel.x_ticks is not None:
        axes.set_xticks(list(panel.x_ticks.values()), list(panel.x_ticks), minor=False)
        axes.minorticks_off()
    if panel.y_ticks is not None:
        axes.set_yticks(list(panel.y_ticks.values()), list(panel.y_ticks))
    for axis, ticks in ((axes.xaxis, panel.x_ticks), (axes.yaxis, panel.y_ticks)):
        if axis.get_scale() == "log" and ticks is None:
            _plain_ticks(axis)
    axes.set_ylim(panel.y_min, panel.y_max)


def _plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis of one or two decades at 1, 2 and 5, and one of more at decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    if low > 0.0 and high < 100.0 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _name_points(axes: Axes, series: Series, x: Sequence[float], y: Sequence[float]) -> None:
    for name, place in zip(series.names, zip(x, y, strict=True), strict=False):
        axes.annotate(name, place, (4, 4), textcoords="offset points", fontsize=7)


def _finite(values: Sequence[float | None]) -> list[float]:
    return [math.nan if value is None or not math.isfinite(value) else float(value) for value in values]


def _draw_legend(figure: Figure, places: Sequence[Axes], columns: int) -> None:
    entries = {
        label: handle
        for axes in places
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        if not label.startswith("_")
    }
    if entries:
        figure.legend(
            entries.values(), entries.keys(), loc="outside lower center", ncols=2 * columns, frameon=False
        )
