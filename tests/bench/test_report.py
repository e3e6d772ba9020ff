"""Reports: what chapters become on disk, on a page and in a terminal."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace

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
    panel,
    read_chapter,
)

ROWS = [
    {"method": "a <b>", "step [ms]": 1.0, "error [m]": np.float64(1.23456789e-7)},
    {"method": "a <b>", "step [ms]": 2.0, "error [m]": math.nan},
    {"method": "c", "step [ms]": 1.0, "note": "lost"},
]


def chapter(name: str = "flight") -> Chapter:
    errors = panel(
        ROWS, "step [ms]", "error [m]", by="method", title="errors", log="xy", y_lines={"limit": 1e-6}
    )
    points = Series(label="n", x=["one", "two"], y=[0, 1], style="points")
    marks = Panel(series=[points, Series(label="law", x=["one", "two"], y=[0, 1], style="law")])
    return Chapter(
        name=name,
        title="A <flight>",
        summary="First.\n\nSecond & last.",
        claims=[Claim("it flies", "Newton (1687)", "1 m", True), Claim("it lands", "same", "not", False)],
        tables=[Table(f"{name}-table", "Errors", ROWS, "A note.")],
        plots=[Plot(f"{name}-plot", "Errors", [errors, marks], 2)],
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
    told = "left in {}: report.html, landing.json, landing-table.csv, landing-plot.png"
    assert told.format(tmp_path / "r") in said.getvalue()


def test_a_chapter_survives_json(tmp_path):
    write_report([chapter()], tmp_path, Console(file=io.StringIO()))
    again = read_chapter(tmp_path, "flight")
    assert again.claims == chapter().claims
    assert again.tables[0].rows[0] == ROWS[0]
    assert again.tables[0].rows[1]["error [m]"] is None  # JSON has no nan
    (plot,) = json.loads((tmp_path / "flight.json").read_text())["plots"]
    assert plot["panels"][1]["series"][0]["x"] == ["one", "two"]
    assert draw_plot(again.plots[0]) == draw_plot(chapter().plots[0])
    assert read_chapter(tmp_path, "other") is None


def test_an_axis_of_names_shows_them():
    def drawn(x):
        return draw_plot(Plot("runs", "", [Panel(series=[Series(label="", x=x, y=[1.0, 2.0])])]))

    assert drawn(["IMU only", "all"]) != drawn([0, 1])


def test_the_page_escapes_and_counts():
    page = html_page([chapter()], {"flight-plot": "cGljdHVyZQ=="})
    assert "A &lt;flight&gt;" in page
    assert "a &lt;b&gt;" in page
    assert "<p>Second &amp; last.</p>" in page
    assert '<b class="met">1 met</b>, <b class="missed">1 missed</b>' in page
    assert 'src="data:image/png;base64,cGljdHVyZQ=="' in page
    assert "Newton (1687)" in page


def test_a_page_without_claims_does_not_speak_of_them():
    page = html_page([replace(chapter(), claims=[])], {"flight-plot": ""})
    assert page.count("<section") == 1
    assert "claim" not in page


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


def test_panels_of_rows_leave_gaps_and_take_further_series():
    rows = [{"m": "a", "x": 1, "y": 0.5}, {"m": "a", "x": 2, "y": "lost"}, {"m": "b", "x": None, "y": 1.0}]
    further = Series(label="law", x=[1], y=[1])
    drawn = panel(rows, "x", "y", by="m", y_min=0.0, series=[further])
    a, b, law = drawn.series
    assert (a.x, a.y) == ([1, 2], [0.5, None])
    assert b.x == []
    assert (law, drawn.x_label, drawn.y_label, drawn.y_min) == (further, "x", "y", 0.0)
