"""Reports of benchmarks: tables as CSV, plots as PNG, and one page to read, as Markdown and as HTML."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neurosim_core.bench.chapter import (
    Bar,
    Chapter,
    Plot,
    Table,
    cells,
    numeric_columns,
    print_chapter,
    save_table,
)
from neurosim_core.bench.figures import can_draw, draw_plot, save_plot
from neurosim_core.bench.machine import accelerators, command_line, hardware, now, versions
from neurosim_core.bench.page import html_page
from neurosim_core.install import install_hint

if TYPE_CHECKING:
    from rich.console import Console

_SPECIAL = re.compile(r"(?=\||<[A-Za-z/!?])")
"""Places in a cell that need a backslash: a bar, and what begins a tag."""

__all__ = ["Bar", "Chapter", "Plot", "Table", "print_chapter", "save_files", "write_report"]


def write_report(chapters: Sequence[Chapter], folder: Path, *, title: str = "Neurosim: the numbers") -> Path:
    """Leave a report: `<table>.csv`, `<plot>.png`, `report.md` and `report.html`, which needs no other file.

    Plots are left out where matplotlib is not installed; the report says so.

    Args:
        chapters: What it says.
        folder: Where to leave it; made if need be, files of these names are replaced.
        title: Of the whole.

    Returns:
        The path of `report.html`.

    Raises:
        ValueError: Two chapters, two tables or two plots have one name.
    """
    _check_unique("chapters", [chapter.name for chapter in chapters])
    _check_unique("tables", [table.name for chapter in chapters for table in chapter.tables])
    _check_unique("plots", [plot.name for chapter in chapters for plot in chapter.plots])
    folder.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, bytes] = {}
    for chapter in chapters:
        for table in chapter.tables:
            save_table(table, folder)
        for plot in chapter.plots if can_draw() else ():
            pictures[plot.name] = draw_plot(plot)
            (folder / f"{plot.name}.png").write_bytes(pictures[plot.name])
    facts = _facts()
    (folder / "report.md").write_text(
        _markdown(chapters, pictures, title=title, facts=facts), encoding="utf-8"
    )
    page = folder / "report.html"
    page.write_text(html_page(chapters, pictures, title=title, facts=facts), encoding="utf-8")
    return page


def save_files(
    folder: Path,
    console: Console,
    *,
    tables: Sequence[Table],
    plots: Sequence[Plot] = (),
    notes: Sequence[str] = (),
) -> None:
    """Leave tables and plots without a report around them, and say so.

    Args:
        folder: Where to; made if need be, files of these names are replaced.
        console: Where to say it.
        tables: What becomes `<name>.csv`.
        plots: What becomes `<name>.png`, where matplotlib is installed.
        notes: Lines on machine and versions, below each plot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made = [save_table(table, folder) for table in tables]
    for plot in plots:
        if can_draw():
            made.append(save_plot(plot, folder, notes=notes))
        else:
            missing = f"{plot.name}.png is left out: {install_hint('view')}"
            console.print(missing, style="yellow", markup=False)
    console.print(f"left in {', '.join(map(str, made))}", markup=False, highlight=False, soft_wrap=True)


def _check_unique(kind: str, names: Sequence[str]) -> None:
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"two {kind} have the name {twice[0]!r}")


def _facts() -> dict[str, str]:
    facts = {"date": now(), "machine": hardware()}
    if devices := accelerators():
        facts["GPU"] = ", ".join(devices)
    facts["versions"] = ", ".join(f"{name} {version}" for name, version in versions().items())
    return {**facts, "command": f"`{command_line()}`"}


def _markdown(
    chapters: Sequence[Chapter], pictures: Mapping[str, bytes], *, title: str, facts: Mapping[str, str]
) -> str:
    blocks = [f"# {title}", "\n".join(f"- {term}: {text}" for term, text in facts.items())]
    promised = [[chapter.title, b.verdict, b.text, b.measured] for chapter in chapters for b in chapter.bars]
    if promised:
        blocks.append(_grid(["chapter", "verdict", "promised", "measured"], promised))
    for chapter in chapters:
        blocks += [f"## {chapter.title}", f"`{chapter.command}`", chapter.summary]
        for plot in chapter.plots:
            drawn = plot.name in pictures
            blocks.append(f"![{plot.title}]({plot.name}.png)" if drawn else f"({plot.title}: not drawn)")
        for table in chapter.tables:
            numeric = numeric_columns(table)
            numbers = [key in numeric for key in table.columns]
            blocks += [
                f"### {table.title}",
                _grid(list(table.columns.values()), cells(table), numbers=numbers),
                f"[{table.name}.csv]({table.name}.csv)",
            ]
            if table.note:
                blocks.append(table.note)
    return "\n\n".join(blocks) + "\n"


def _grid(
    headings: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Sequence[bool] | None = None
) -> str:
    """Return a Markdown table."""
    rule = ["---:" if right else "---" for right in numbers or [False] * len(headings)]
    return "\n".join(_line(row) for row in (headings, rule, *rows))


def _line(texts: Sequence[str]) -> str:
    escaped = (" ".join(_SPECIAL.sub(r"\\", text).split()) for text in texts)
    return f"| {' | '.join(escaped)} |"
