"""What a benchmark says: a chapter of bars, tables and plots; and how its values read."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rich.table
from rich.console import Console
from rich.markdown import Markdown
from rich.measure import Measurement
from rich.text import Text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAME = re.compile(r"[a-z0-9]([a-z0-9_-]*[a-z0-9])?")
_UNKNOWN = "–"
_VERDICTS = {True: "met", False: "missed", None: "not measured here"}
_STYLES = {True: "green", False: "bold red", None: "yellow"}


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows under headings, which become `<name>.csv`."""

    name: str
    """Of the file, without `.csv`: lower-case letters, digits, - and _."""
    title: str
    columns: Mapping[str, str]
    """Key of a value in a row, which is also the head of its column in the file -> heading with unit."""
    rows: Sequence[Mapping[str, object]]
    """Values by key; a key that is missing, None and nan read as unknown."""
    note: str = ""
    """What must be known to read it, as Markdown."""

    def __post_init__(self) -> None:
        _check_name(self.name)
        for row in self.rows:
            if unknown := [key for key in row if key not in self.columns]:
                raise ValueError(
                    f"table {self.name!r} has no column {unknown[0]!r}, known: {[*self.columns]}"
                )


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A picture, which becomes `<name>.png`."""

    name: str
    """Of the file, without `.png`: lower-case letters, digits, - and _."""
    title: str
    draw: Callable[[Figure], None]
    """Adds axes to a figure, whose size and look are set; see `figures.save_plot`."""

    def __post_init__(self) -> None:
        _check_name(self.name)


@dataclass(frozen=True, kw_only=True)
class Bar:
    """Something that was promised, and what came of it."""

    text: str
    """What was promised, with its figure, as Markdown."""
    measured: str
    """What was measured, with unit; or why it was not."""
    met: bool | None
    """None: not measured here."""

    @property
    def verdict(self) -> str:
        """`met`, `missed` or `not measured here`."""
        return _VERDICTS[self.met]


@dataclass(frozen=True, kw_only=True)
class Chapter:
    """The answer to one question."""

    name: str
    """Short, unique in a report: lower-case letters, digits, - and _."""
    title: str
    summary: str
    """The answer in words, made from what was measured, as Markdown."""
    command: str
    """What to type to measure it again."""
    bars: Sequence[Bar] = ()
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()

    def __post_init__(self) -> None:
        _check_name(self.name)


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ValueError(f"name must be of lower-case letters, digits, - and _, got {name!r}")


def cell(value: object) -> str:
    """Return a value as people read it: 3 or 4 significant digits, thousands apart, unknown as a dash."""
    if hasattr(value, "item"):  # a scalar of NumPy
        value = value.item()
    if value is None:
        return _UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return _float(value)
    return str(value)


def _float(value: float) -> str:
    if math.isnan(value):
        return _UNKNOWN
    if math.isinf(value):
        return "∞" if value > 0.0 else "-∞"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.2e}".split("e")
        return f"{mantissa}e{int(exponent)}"
    return f"{value:,.0f}" if abs(value) >= 1e3 else f"{value:.4g}"


def is_number(value: object) -> bool:
    """Return whether a value stands to the right in its column."""
    value = value.item() if hasattr(value, "item") else value
    return isinstance(value, int | float) and not isinstance(value, bool)


def numeric_columns(table: Table) -> frozenset[str]:
    """Return the keys of the columns of which some values are numbers, and the others unknown."""
    known = {key: [v for row in table.rows if (v := row.get(key)) is not None] for key in table.columns}
    return frozenset(key for key, values in known.items() if values and all(map(is_number, values)))


def cells(table: Table) -> list[list[str]]:
    """Return the values of a table row by row, as people read them."""
    return [[cell(row.get(key)) for key in table.columns] for row in table.rows]


def save_table(table: Table, folder: Path) -> Path:
    """Write `<name>.csv`: the keys, then all digits of the values; return its path."""
    file = folder / f"{table.name}.csv"
    file.write_bytes(to_csv(table).encode("utf-8"))
    return file


def to_csv(table: Table) -> str:
    """Return a table as the text of a CSV file."""
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, list(table.columns))
    writer.writeheader()
    writer.writerows({key: _plain(value) for key, value in row.items()} for row in table.rows)
    return out.getvalue()


def _plain(value: object) -> Any:
    return value.item() if hasattr(value, "item") else value


def print_chapter(chapter: Chapter, console: Console) -> None:
    """Print a chapter without its plots."""
    console.rule(Text(chapter.title))
    console.print(Markdown(chapter.summary))
    for table in chapter.tables:
        console.print()
        print_table(table, console)
    if chapter.bars:
        console.print()
    for bar in chapter.bars:
        verdict = Text(bar.verdict, style=_STYLES[bar.met])
        console.print(verdict, Text(f"{bar.text}: {bar.measured}"), soft_wrap=True)


def print_table(table: Table, console: Console) -> None:
    """Print a table with its title and note; wider than the terminal rather than with broken words."""
    numeric = numeric_columns(table)
    grid = rich.table.Table(box=None, pad_edge=False, header_style="bold")
    rows = cells(table)
    for column, (key, heading) in enumerate(table.columns.items()):
        texts = [row[column] for row in rows]
        words = heading.split() if key in numeric else [w for text in (heading, *texts) for w in text.split()]
        grid.add_column(
            Text(heading),
            justify="right" if key in numeric else "left",
            min_width=max(map(len, [*words, *(texts if key in numeric else [])]), default=0),
        )
    for row in rows:
        grid.add_row(*map(Text, row))
    console.print(Text(table.title, style="bold"), soft_wrap=True)
    narrowest = Measurement.get(console, console.options.update(max_width=10_000), grid).minimum
    console.print(grid, highlight=False, width=max(narrowest, console.width), crop=False, soft_wrap=True)
    if table.note:
        console.print(Markdown(table.note), style="dim")
