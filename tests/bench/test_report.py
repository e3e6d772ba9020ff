"""Reports: what chapters become on disk, on a page and in a terminal."""

from __future__ import annotations

import csv
import io
import json
import math

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from neurosim_core.bench.render_report import draw_plot, html_page, print_chapter, write_report
from neurosim_core.bench.report import (
    Chapter,
    Claim,
    Panel,
    Plot,
    Series,
    Table,
    cell,
    lines,
    read_chapter,
)

ROWS = [
    {"method": "a <b>", "step [ms]": 1.0, "error [m]": np.float64(1.23456789e-7)},
    {"method": "a <b>", "step [ms]": 2.0, "error [m]": math.nan},
    {"method": "c", "step [ms]": 1.0, "note": "lost"},
]


def chapter(name: str = "flight") -> Chapter:
    panel = Panel(
        title="errors",
        x_label="step",
        y_label="error",
        series=lines(ROWS, "step [ms]", "error [m]", by="method"),
        x_scale="log",
        y_scale="log",
        y_lines={"limit": 1e-6},
    )
    marks = Panel(
        series=[Series(label="n", x=[3, 4], y=[0, 1], style="points")], y_ticks={"one": 0, "two": 1}
    )
    return Chapter(
        name=name,
        title="A <flight>",
        summary="First.\n\nSecond & last.",
        claims=[Claim("it flies", "Newton (1687)", "1 m", True), Claim("it lands", "same", "not", False)],
        tables=[Table(f"{name}-table", "Errors", ROWS, "A note.")],
        plots=[Plot(f"{name}-plot", "Errors", [panel, marks], 2)],
        facts={"date": "today"},
    )


def test_a_report_on_disk(tmp_path):
    """Each chapter is JSON and CSV with all digits, each plot a picture; the page holds all so far."""
    said = io.StringIO()
    chapters = []
    for name in ("flight", "landing"):
        chapters.append(chapter(name))
        write_report(chapters, tmp_path / "r", Console(file=said))
        page = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
        assert page.count("<section") == 1 + len(chapters)
    with (tmp_path / "r" / "flight-table.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert rows[0]["error [m]"] == "1.23456789e-07"
    with Image.open(tmp_path / "r" / "landing-plot.png") as drawn:
        assert np.asarray(drawn.convert("L")).std() > 5.0
    assert "left in" in said.getvalue()


def test_a_chapter_survives_json(tmp_path):
    write_report([chapter()], tmp_path, Console(file=io.StringIO()))
    again = read_chapter(tmp_path, "flight")
    assert again.claims == chapter().claims
    assert again.tables[0].rows[0] == ROWS[0]
    assert again.tables[0].rows[1]["error [m]"] is None  # JSON has no nan
    (plot,) = json.loads((tmp_path / "flight.json").read_text())["plots"]
    assert plot["panels"][1]["y_ticks"]["two"] == 1.0
    assert draw_plot(again.plots[0]) == draw_plot(chapter().plots[0])
    assert read_chapter(tmp_path, "other") is None


def test_the_page_escapes_and_counts():
    page = html_page([chapter()], {"flight-plot": "cGljdHVyZQ=="})
    assert "A &lt;flight&gt;" in page
    assert "a &lt;b&gt;" in page
    assert "<p>Second &amp; last.</p>" in page
    assert '<b class="met">1 met</b>, <b class="missed">1 missed</b>' in page
    assert 'src="data:image/png;base64,cGljdHVyZQ=="' in page
    assert "Newton (1687)" in page


def test_the_terminal_shows_every_digit_of_a_cell_and_every_claim():
    said = io.StringIO()
    print_chapter(chapter(), Console(file=said, width=30))
    text = said.getvalue()
    assert "1.23e-7" in text
    assert "missed it lands: not (same)" in text
    assert "…" not in text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (math.nan, "–"),
        (math.inf, "∞"),
        (True, "yes"),
        (12345, "12,345"),
        (0.0, "0"),
        (0.12345, "0.1235"),
        (1234.4, "1,234"),
        (1e-5, "1.00e-5"),
        (2.5e7, "2.50e7"),
        (np.float32(0.5), "0.5"),
        ("text", "text"),
    ],
)
def test_cells(value, text):
    assert cell(value) == text


def test_lines_leave_gaps_and_have_a_floor():
    rows = [{"m": "a", "x": 1, "y": 0.0}, {"m": "a", "x": 2, "y": "lost"}, {"m": "b", "x": None, "y": 1.0}]
    a, b = lines(rows, "x", "y", by="m", y_floor=1e-9)
    assert (a.x, a.y) == ([1, 2], [1e-9, None])
    assert b.x == []


@pytest.mark.parametrize("make", [lambda n: Table(n, "", []), lambda n: Plot(n, "", []), chapter])
@pytest.mark.parametrize("name", ["", "A", "a/b", "../a", "a.csv", "-a"])
def test_names_that_are_no_files_are_refused(make, name):
    with pytest.raises(ValueError, match="name must be of lower-case letters"):
        make(name)
