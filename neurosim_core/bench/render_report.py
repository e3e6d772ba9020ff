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
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import rich.table
from rich.console import Console
from rich.text import Text

from neurosim_core.bench.report import (
    Chapter,
    Panel,
    Plot,
    Table,
    cell,
    is_numeric,
    table_to_csv,
    write_chapter,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VERDICTS = {True: "met", False: "missed", None: "not measured here"}
_FOLDED_ROWS = 24
_PANEL_IN = {1: (8.0, 4.8), 2: (4.6, 4.0), 3: (3.6, 3.6)}
"""Width and height of a panel by the number of panels in a row [inch]."""
_COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"]
"""Of series, in turn, each with a marker of its own: no difference is shown by colour alone.

Reference: Okabe and Ito (2008), Color Universal Design, without its yellow, which is faint on white.
"""
_LOOK: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.titlesize": 10,
    "font.size": 9,
    "grid.alpha": 0.25,
    "legend.fontsize": 7,
    "lines.markersize": 5,
}
_LINES = {"line": "-", "dashed": "--", "points": "none"}


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
    for heading in table.headings:
        side: Literal["left", "right"] = "right" if is_numeric(table, heading) else "left"
        wrapped = textwrap.fill(heading, 12)
        longest = max(map(len, [*wrapped.split(), *(cell(row.get(heading)) for row in table.rows)]))
        grid.add_column(Text(wrapped), justify=side, min_width=longest)
    for row in table.rows:
        grid.add_row(*(Text(cell(row.get(heading))) for heading in table.headings))
    console.print(Text(table.title, style="bold"))
    console.print(grid, highlight=False, crop=False, soft_wrap=True)
    if table.note:
        console.print(Text(table.note, style="dim"))


def write_report(chapters: Sequence[Chapter], out: str | Path, console: Console) -> None:
    """Write the last chapter with its tables and plots, and `report.html` of all; say so.

    Chapters, tables and plots have unique names. Plots and page need matplotlib and jinja2.
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
    newest = chapters[-1]
    left = ["report.html", f"{newest.name}.json", *(f"{table.name}.csv" for table in newest.tables)]
    left += [f"{plot.name}.png" for plot in newest.plots]
    console.print(f"left in {folder}: {', '.join(left)}", soft_wrap=True)


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
    """Return a plot as PNG."""
    import matplotlib
    from cycler import cycler
    from matplotlib.figure import Figure

    look = {**_LOOK, "axes.prop_cycle": cycler(color=_COLOURS, marker=list("os^DvPX"))}
    columns = min(plot.columns, len(plot.panels))
    rows = math.ceil(len(plot.panels) / columns)
    width, height = _PANEL_IN[min(columns, 3)]
    with matplotlib.rc_context(cast(Any, {**matplotlib.rcParamsDefault, **look})):
        figure = Figure(figsize=(width * columns, height * rows + 0.3), dpi=130, layout="constrained")
        figure.suptitle(plot.title, x=0.01, ha="left", fontsize=11)
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, panel in zip(places, plot.panels, strict=False):
            _draw_panel(axes, panel)
        for axes in places[len(plot.panels) :]:
            axes.axis("off")
        _add_legends(figure, places[: len(plot.panels)])
        data = io.BytesIO()
        figure.savefig(data, format="png")
    return data.getvalue()


def _draw_panel(axes: Axes, panel: Panel) -> None:
    from matplotlib.ticker import LogLocator

    for series in panel.series:
        x, y = (np.array([math.nan if v is None else v for v in values]) for values in (series.x, series.y))
        if "y" in panel.log:
            y = np.where(y > 0.0, y, math.nan)  # else a line to 0 falls vertically, as if at the last mark
        if series.style == "law":
            axes.plot(x, y, color=axes.lines[-1].get_color(), marker="none", linewidth=1.0)
        else:
            axes.plot(x, y, linestyle=_LINES[series.style], label=series.label)
    for draw, marks in ((axes.axvline, panel.x_lines), (axes.axhline, panel.y_lines)):
        for label, at in marks.items():
            draw(at, color="0.45", linestyle=":", linewidth=1.2, label=label, marker="none")
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    if "x" in panel.log:  # setting a scale forgets the names on an axis of names
        axes.set(xscale="log")
    axes.set(yscale="log" if "y" in panel.log else "linear", ylim=(panel.y_min, panel.y_max))
    for axis in (axes.xaxis, axes.yaxis):
        low, high = sorted(axis.get_view_interval())
        if axis.get_scale() == "log":
            axis.set_minor_formatter("")
            if high < 100.0 * low:  # one or two decades
                axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.set_major_formatter("{x:g}")


def _add_legends(figure: Figure, panels: Iterable[Axes]) -> None:
    """Name the lines in each panel, or below all panels if they have the same."""
    found = [(axes, *axes.get_legend_handles_labels()) for axes in panels]
    _, handles, labels = found[0]
    if len(found) > 1 and len(labels) > 1 and all(its == labels for _, _, its in found):
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
        return
    for axes, _, its in found:
        if len(its) > 1:
            axes.legend()
