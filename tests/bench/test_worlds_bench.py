"""The benchmark of many worlds, small: that it measures, and what it says of it."""

from __future__ import annotations

import dataclasses

import pytest
import warp as wp

from neurosim_core import cli
from neurosim_core.bench import commands, worlds
from neurosim_core.bench.report import write_report
from neurosim_core.bench.worlds import WorldsCase, WorldsResult, measure_worlds, worlds_chapter

CASE = WorldsCase(
    count=1024,
    width=128,
    height=128,
    renders_per_s=260_000.0,
    steps_per_s=32_500.0,
    events_per_s=1e7,
    dropped=0,
    alone_renders_per_s=13_000.0,
    cpu_ms=0.004,
    alone_cpu_ms=0.08,
    phases_ms={"flight": 0.5, "render": 20.0, "events": 2.0},
)


@pytest.fixture(scope="module")
def result():
    return measure_worlds(quick=True, device="cpu", width=32, height=24, worlds=[1, 3], seconds=0.05)


def test_what_is_measured(result):
    assert [(case.count, case.width, case.height) for case in result.cases] == [(1, 32, 24), (3, 32, 24)]
    for case in result.cases:
        assert case.renders_per_s == pytest.approx(8 * case.steps_per_s)
        assert case.alone_renders_per_s > 0.0
        assert case.events_per_s > 0.0
        assert min(case.cpu_ms, case.alone_cpu_ms) > 0.0
        assert set(case.phases_ms) == {"flight", "render", "events"}
        assert all(value > 0.0 for value in case.phases_ms.values())


def test_events_of_all_steps_are_counted():
    """Also of steps after which more follow, and of all worlds."""
    totals = wp.array([5, 1], dtype=wp.int64, device="cpu")
    for counts, dropped in (([3, 4], [0, 2]), ([0, 10], [1, 0])):
        arrays = [wp.array(values, dtype=wp.int32, device="cpu") for values in (counts, dropped)]
        wp.launch(worlds._tally, dim=2, inputs=arrays, outputs=[totals], device="cpu")
    assert totals.numpy().tolist() == [22, 4]


def test_a_report_of_it(result, tmp_path):
    chapter = worlds_chapter(result)
    write_report([chapter], tmp_path)
    assert (tmp_path / "worlds.csv").read_text(encoding="utf-8").count("\n") == 3
    assert [bar.met for bar in chapter.bars] == [None]


@pytest.mark.parametrize(
    ("renders_per_s", "device", "triangles", "dropped", "met"),
    [
        (250_000.0, "H200", 145_840, 0, True),
        (249_999.0, "H200", 145_840, 0, False),
        (250_000.0, "H200", 145_840, 1, False),
        (250_000.0, "H200", 80_000, 0, None),
        (249_999.0, "CPU", 145_840, 0, None),
        (250_000.0, "L40", 145_840, 0, True),
    ],
)
def test_the_bar_is_judged_where_it_is_flown(renders_per_s, device, triangles, dropped, met):
    case = dataclasses.replace(CASE, renders_per_s=renders_per_s, dropped=dropped)
    result = WorldsResult(device=device, scene="flat", triangles=triangles, cases=(case,))
    chapter = worlds_chapter(result)
    assert [bar.met for bar in chapter.bars] == [met]
    assert chapter.tables[0].rows[0]["ratio"] == pytest.approx(renders_per_s / 13_000.0)


def test_its_command(monkeypatch, capsys):
    """Numbers of worlds are read and told on; wrong ones are refused."""
    told = []

    def measure(options, progress):
        told.append(options)
        return worlds_chapter(WorldsResult(device="d", scene="s", triangles=1, cases=(CASE,)))

    study = next(s for s in commands.STUDIES if s.name == "worlds")
    monkeypatch.setattr(commands, "STUDIES", (dataclasses.replace(study, chapter=measure),))
    written = []
    monkeypatch.setattr(commands, "_write", lambda chapters, *_: written.extend(chapters))
    assert cli.main(["bench", "worlds", "--worlds", "1,16", "--seconds", "2", "--quick"]) == 0
    assert told == [{"quick": True, "worlds": [1, 16], "seconds": 2.0}]
    assert written[0].command == "neurosim bench worlds --quick --seconds 2.0 --worlds 1,16"
    for wrong in ("0", "1.5", "many"):
        with pytest.raises(SystemExit):
            cli.main(["bench", "worlds", "--worlds", wrong])
    assert "takes" in capsys.readouterr().err
