"""The result of a benchmark, as plain data: chapters of claims, tables and plots, and their files.

Nothing here draws: `render_report` turns chapters into a terminal's tables, pictures and a page.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from pydantic import TypeAdapter
from pydantic_core import to_json

Row: TypeAlias = dict[str, Any]
"""Values of a table by heading, which says the unit."""
Values: TypeAlias = Sequence[float | str | None]
"""Numbers or names of categories; None stands for a value that is unknown or not finite."""
Style = Literal["line", "dashed", "points", "law"]


@dataclass(frozen=True)
class Table:
    """Rows under headings; becomes `<name>.csv`."""

    name: str
    title: str
    rows: Sequence[Mapping[str, Any]]
    """Values by heading, which says the unit; a value that is missing, None or nan reads as unknown."""
    note: str = ""
    """Remarks for the reader."""

    @property
    def headings(self) -> list[str]:
        """Return the headings of all rows, in order of appearance."""
        return list(dict.fromkeys(heading for row in self.rows for heading in row))


@dataclass(frozen=True, kw_only=True)
class Series:
    """One line of a panel."""

    label: str
    x: Values
    y: Values
    style: Style = "line"
    """`law`: a thin line in the colour of the series before it, which the legend does not name."""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Axes with series on them."""

    title: str = ""
    x_label: str = ""
    y_label: str = ""
    series: Sequence[Series] = ()
    log: Literal["", "x", "y", "xy"] = ""
    """Axes that are logarithmic."""
    x_lines: Mapping[str, float] = field(default_factory=dict)
    y_lines: Mapping[str, float] = field(default_factory=dict)
    """Vertical and horizontal lines: label -> x or y."""
    y_min: float | None = None
    y_max: float | None = None


@dataclass(frozen=True)
class Plot:
    """Panels beside each other; becomes `<name>.png`."""

    name: str
    title: str
    panels: Sequence[Panel]
    columns: int = 3
    """The most panels in a row."""


@dataclass(frozen=True)
class Claim:
    """A statement with a limit, where the limit comes from, and what was measured."""

    text: str
    reference: str
    """The law, closed form, publication or independent program that the limit rests on."""
    measured: str
    """The measured value with its unit, or why there is none."""
    met: bool | None
    """None: not measured here."""


@dataclass(frozen=True, kw_only=True)
class Chapter:
    """The answer to one question; becomes `<name>.json`."""

    name: str
    """Unique in a report."""
    title: str
    summary: str
    """The answer in words; paragraphs are separated by an empty line."""
    claims: Sequence[Claim] = ()
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    """Term -> text: when, by which command, on which machine, with which versions."""


def chapter_to_json(chapter: Chapter) -> str:
    """Return a chapter as JSON; numbers that are not finite become null."""
    plain = to_json(chapter, indent=1, inf_nan_mode="null", fallback=lambda number: number.item())
    return plain.decode("utf-8")


def table_to_csv(table: Table) -> str:
    """Return a table as CSV: the keys, then all digits of the values."""
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, table.headings)
    writer.writeheader()
    for row in table.rows:
        writer.writerow({k: v.item() if isinstance(v, np.generic) else v for k, v in row.items()})
    return out.getvalue()


def panel(rows: Sequence[Mapping[str, Any]], x: str, y: str, *, by: str, **more: Any) -> Panel:
    """Return a panel with a line through the rows of each value of the column `by`.

    What is no number in the column `y` leaves a gap; `more` are fields of `Panel`, whose `series` are added.
    """
    found = []
    for name in dict.fromkeys(row[by] for row in rows):
        mine = [row for row in rows if row[by] == name and row.get(x) is not None]
        ys = [value if isinstance(value := row.get(y), float | int) else None for row in mine]
        found.append(Series(label=str(name), x=[row[x] for row in mine], y=ys))
    return Panel(**{"x_label": x, "y_label": y, **more, "series": [*found, *more.get("series", ())]})


def cell(value: object) -> str:
    """Return a value as people read it: 3 or 4 significant digits, thousands apart, unknown as a dash."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if not isinstance(value, float):
        return str(value)
    if math.isinf(value):
        return "∞" if value > 0.0 else "-∞"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.2e}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")
    return f"{value:,.0f}" if abs(value) >= 1e3 else f"{value:.4g}"


def is_numeric(table: Table, heading: str) -> bool:
    """Return whether all known values of a column are numbers, of which there are some."""
    known = [value for row in table.rows if (value := row.get(heading)) is not None]
    return bool(known) and all(
        isinstance(v, int | float | np.number) and not isinstance(v, bool) for v in known
    )


def write_chapter(chapter: Chapter, folder: Path) -> None:
    """Write `<chapter>.json` and `<table>.csv`; the folder is made if need be, and files are replaced."""
    folder.mkdir(parents=True, exist_ok=True)
    for table in chapter.tables:
        (folder / f"{table.name}.csv").write_text(table_to_csv(table), encoding="utf-8", newline="")
    (folder / f"{chapter.name}.json").write_text(chapter_to_json(chapter), encoding="utf-8")


def read_chapter(folder: str | Path, name: str) -> Chapter | None:
    """Return the chapter that `write_chapter` left in a folder, or None."""
    file = Path(folder) / f"{name}.json"
    return TypeAdapter(Chapter).validate_json(file.read_text(encoding="utf-8")) if file.exists() else None
