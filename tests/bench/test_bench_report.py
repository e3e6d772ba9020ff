"""Reports: what is in the files, that any text survives, and how values read."""

from __future__ import annotations

import base64
import csv
import io
import math
import os
import re
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rich.console import Console

import neurosim_core
from neurosim_core.bench import machine, report
from neurosim_core.bench.chapter import cell, print_table, save_table
from neurosim_core.bench.figures import draw_plot
from neurosim_core.bench.report import Bar, Chapter, Plot, Table, print_chapter, write_report

NASTY = '<script>alert("x")</script> & | `a` <b>'


def draw(figure):
    axes = figure.subplots()
    axes.loglog([1e-3, 1e-2], [1e-9, 1e-5], label="order 4")
    axes.legend()


def chapter(name="one", **changes):
    table = Table(
        name=f"{name}-table",
        title=f"Table of {NASTY}",
        columns={"method": "method", "error_m": "error [m]", "steps": "steps"},
        rows=[
            {"method": NASTY, "error_m": 3.25e-9, "steps": np.int64(123456)},
            {"method": "euler", "error_m": math.nan},
        ],
        note="Each row is *one* run.",
    )
    values = {
        "title": f"Chapter {NASTY}",
        "summary": f"It is **fast**. {NASTY}\n\n- first\n- second",
        "command": "neurosim bench one --out 'a & b'",
        "bars": [
            Bar(text="error `<= 1e-6` m", measured="3.2e-9 m", met=True),
            Bar(text="2 M steps/s", measured=NASTY, met=False),
            Bar(text="on a GPU", measured="there is none", met=None),
        ],
        "tables": [table],
        "plots": [Plot(name=f"{name}-plot", title="Error & step", draw=draw)],
    }
    return Chapter(name=name, **{**values, **changes})


class Reader(HTMLParser):
    """Collects the text of a page by tag, its tags and the attributes of those."""

    def __init__(self) -> None:
        super().__init__()
        self.tags, self.texts, self.open = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in {"meta", "link", "img", "br"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag  # well formed

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))

    def text(self, tag=None):
        return " ".join(data for t, data in self.texts if tag in (None, t))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "deep" / "out"
    page = write_report([chapter(), chapter("two", bars=())], folder, title="Numbers & more")
    reader = Reader()
    reader.feed(page.read_text(encoding="utf-8"))
    assert not reader.open
    return folder, page, reader


def test_every_table_and_plot_becomes_a_file(written):
    folder, page, _ = written
    names = {f"{n}-{kind}" for n in ("one", "two") for kind in ("table.csv", "plot.png")}
    assert {p.name for p in folder.iterdir()} == names | {"report.md", "report.html"}
    assert page == folder / "report.html"


def test_the_page_needs_no_other_file(written):
    folder, _, reader = written
    assert not [tag for tag, _ in reader.tags if tag == "script"]
    links = [a.get("src") or a.get("href") for _, a in reader.tags if a.get("src") or a.get("href")]
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "url(" not in reader.text("style")
    pictures = [a["src"] for tag, a in reader.tags if tag == "img"]
    files = [a["href"] for _, a in reader.tags if a.get("download") == "one-table.csv"]
    assert base64.b64decode(files[0].partition(",")[2]) == (folder / "one-table.csv").read_bytes()
    assert base64.b64decode(pictures[0].partition(",")[2]) == (folder / "one-plot.png").read_bytes()


def test_text_is_shown_as_it_was_written(written):
    """Wherever it stands: titles, summaries, bars and cells."""
    _, _, reader = written
    for tag, text in (("h2", f"Chapter {NASTY}"), ("h3", f"Table of {NASTY} "), ("td", NASTY)):
        assert text in [data for t, data in reader.texts if t == tag], tag
    assert '<script>alert("x")</script>' in reader.text("p")
    assert "fast" in [data for t, data in reader.texts if t == "strong"]
    assert "neurosim bench one --out 'a & b'" in reader.text("code")
    assert reader.text("h1") == "Numbers & more"


def test_the_page_sums_up_what_was_promised(written):
    _, _, reader = written
    assert re.search(r"1 met\s*,\s+1 missed\s*,\s+1 not measured here", reader.text())
    assert "nothing was promised" in reader.text("td")  # the second chapter
    verdicts = [a["class"] for tag, a in reader.tags if tag == "td" and "verdict" in a.get("class", "")]
    assert verdicts == ["verdict met", "verdict missed", "verdict open"]
    ids = {a["id"] for _, a in reader.tags if "id" in a}
    assert {a["href"][1:] for tag, a in reader.tags if tag == "a" and "download" not in a} <= ids


def test_the_page_says_on_what_it_was_measured(written):
    _, _, reader = written
    facts = reader.text("dd")
    for part in ("cores", "Neurosim", "Python", "numpy", "scipy", "warp-lang"):
        assert part in facts
    assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d", facts)


def test_markdown_has_the_same(written):
    text = (written[0] / "report.md").read_text(encoding="utf-8")
    lines = text.splitlines()
    assert lines[0] == "# Numbers & more"
    assert "![Error & step](one-plot.png)" in lines
    row = next(line for line in lines if line.startswith("| \\<script>"))
    assert row == r'| \<script>alert("x")\</script> & \| `a` \<b> | 3.25e-9 | 123,456 |'
    assert "| euler | – | – |" in lines
    assert "| method | error [m] | steps |" in lines
    assert lines[lines.index("| method | error [m] | steps |") + 1] == "| --- | ---: | ---: |"
    for row in (line for line in lines if line.startswith("|")):
        assert row.endswith("|")


def test_plots_are_1200_px_wide_and_drawn():
    with Image.open(io.BytesIO(draw_plot(Plot(name="p", title="t", draw=draw), notes=["a", "b"]))) as image:
        assert image.size == (1200, 720)
        assert np.asarray(image.convert("L")).std() > 5.0


def test_the_look_of_plots_is_theirs_alone():
    import matplotlib

    before = dict(matplotlib.rcParams)
    matplotlib.rcParams["axes.facecolor"] = "red"  # of a user; it must neither show nor be lost
    try:
        data = draw_plot(Plot(name="p", title="t", draw=draw))
        assert matplotlib.rcParams["axes.facecolor"] == "red"
    finally:
        matplotlib.rcParams.update(before)
    with Image.open(io.BytesIO(data)) as image:
        assert image.convert("RGB").getpixel((600, 400)) != (255, 0, 0)


def test_without_matplotlib_the_report_says_what_is_not_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "can_draw", lambda: False)
    page = write_report([chapter()], tmp_path)
    assert not list(tmp_path.glob("*.png"))
    assert "matplotlib is not installed" in page.read_text(encoding="utf-8")
    assert "(Error & step: not drawn)" in (tmp_path / "report.md").read_text(encoding="utf-8")


@given(
    st.lists(
        st.tuples(
            st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"])),
            st.floats(allow_nan=False),
            st.integers(),
        ),
        max_size=8,
    )
)
def test_csv_files_give_back_what_went_in(tmp_path_factory, rows):
    """All digits of floats, any text, NumPy scalars as numbers."""
    table = Table(
        name="t",
        title="",
        columns={"a": "A", "b": "B", "c": "C"},
        rows=[{"a": text, "b": np.float64(number), "c": count} for text, number, count in rows],
    )
    file = save_table(table, tmp_path_factory.mktemp("csv"))
    with file.open(newline="", encoding="utf-8") as lines:
        read = [(row["a"], float(row["b"]), int(row["c"])) for row in csv.DictReader(lines)]
    assert read == rows


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (math.nan, "–"),
        (np.float32("nan"), "–"),
        (math.inf, "∞"),
        (-math.inf, "-∞"),
        (True, "yes"),
        (np.False_, "no"),
        (1234567, "1,234,567"),
        (0.0, "0"),
        (0.123456, "0.1235"),
        (-12.3456, "-12.35"),
        (12345.6, "12,346"),
        (1.5e-7, "1.50e-7"),
        (-2e9, "-2.00e9"),
        ("RK4", "RK4"),
    ],
)
def test_how_values_read(value, text):
    assert cell(value) == text


def test_what_is_printed():
    console = Console(width=60, record=True, file=io.StringIO())
    print_chapter(chapter(), console)
    said = console.export_text()
    for part in (
        "It is fast.",
        "123,456",
        "3.25e-9",
        "met error",
        "missed 2 M steps/s",
        "not measured here on",
    ):
        assert part in said


def test_numbers_are_printed_whole():
    """A terminal that is too narrow breaks lines, not numbers."""
    columns = {f"column_{k}": f"a long heading {k}" for k in range(12)}
    table = Table(name="t", title="t", columns=columns, rows=[dict.fromkeys(columns, 1234567)])
    console = Console(width=40, record=True, file=io.StringIO())
    print_table(table, console)
    assert console.export_text().count("1,234,567") == 12


@pytest.mark.parametrize("name", ["", "A", "a b", "../a", "a/b", "-a", "a."])
def test_names_that_are_no_files_are_refused(name):
    with pytest.raises(ValueError, match="name must be of lower-case letters"):
        Table(name=name, title="", columns={}, rows=[])
    with pytest.raises(ValueError, match="name must be of lower-case letters"):
        Plot(name=name, title="", draw=draw)


def test_rows_must_fit_their_table():
    with pytest.raises(ValueError, match="table 't' has no column 'b', known: \\['a'\\]"):
        Table(name="t", title="", columns={"a": "A"}, rows=[{"a": 1, "b": 2}])


def test_names_must_differ(tmp_path):
    with pytest.raises(ValueError, match="two chapters have the name 'one'"):
        write_report([chapter(), chapter()], tmp_path)
    with pytest.raises(ValueError, match="two plots have the name 'one-plot'"):
        write_report([chapter(), chapter("two", plots=chapter().plots)], tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_commit_is_that_of_the_checkout(tmp_path, monkeypatch):
    """With a note if files differ from it; nothing where the package is in no checkout."""
    package = tmp_path / "neurosim_core" / "__init__.py"
    package.parent.mkdir()
    package.write_text("")
    monkeypatch.setattr(neurosim_core, "__file__", str(package))
    assert machine.commit() == ""

    def git(*arguments):
        identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *identity, *arguments], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    git("init", "-q")
    git("add", "-A")
    git("commit", "-q", "-m", "first")
    name = git("rev-parse", "HEAD")[:10]
    assert machine.commit() == name
    package.write_text("changed = True")
    assert machine.commit() == f"{name} with changes"
    monkeypatch.setenv("PATH", str(tmp_path))  # no git
    assert machine.commit() == ""


@pytest.mark.parametrize("rest", ["", " 0 0\nintr 5"])
def test_time_that_the_host_took_is_said(tmp_path, rest):
    statistics = tmp_path / "stat"
    second = os.sysconf("SC_CLK_TCK")
    statistics.write_text(f"cpu 1 2 3 4 5 6 7 {10 * second}{rest}\n")
    steal_time = machine.StealTime(statistics)
    statistics.write_text(f"cpu 9 9 9 9 9 9 9 {10 * second + second // 2}{rest}\n")
    assert steal_time.notes() == ["0.50 s of CPU time were taken by other machines of its host meanwhile"]


@pytest.mark.parametrize("text", [None, "", "cpu 1 2 3", "cpu 1 2 3 4 5 6 7 many"])
def test_where_nobody_knows_what_the_host_took_nothing_is_said(tmp_path, text):
    statistics = tmp_path / "stat"
    if text is not None:
        statistics.write_text(text)
    assert machine.StealTime(statistics).notes() == []
