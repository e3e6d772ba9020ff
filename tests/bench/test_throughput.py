"""The benchmark of throughput, small: that it measures, judges, and that its naive rival is what it says."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import warp as wp
from matplotlib.figure import Figure
from neurosim_core.simulation import make_model, refit

from neurosim_core.bench import commands, throughput
from neurosim_core.bench import step as step_bench
from neurosim_core.bench.naive_events import NaiveEventCamera
from neurosim_core.bench.report import Bar, Chapter, write_report
from neurosim_core.bench.step import measure_steps
from neurosim_core.bench.throughput import measure_throughput
from neurosim_core.bench.throughput_chapter import throughput_bars, throughput_chapter
from neurosim_core.bench.throughput_plots import draw_steps
from neurosim_core.bench.throughput_result import (
    ADAPTIVE,
    EXACT,
    LOOP,
    LOOP_AT_ONCE,
    RAYS_ALONE,
    SCAN,
    STAGES,
    Agreement,
    Comparison,
    Part,
    Roofline,
    Split,
    StepRow,
    ThroughputResult,
)
from neurosim_core.bench.throughput_scene import hall
from neurosim_core.sensors.events import EventCamera, EventCameraConfig

THRESHOLD = 0.2


@pytest.fixture(scope="module")
def made():
    """Let the two models of a small run be made once: of the apartment and of the hall."""
    models = {}

    def make(config, *, scene=None):
        kind = "apartment" if scene is None else "hall"
        if kind not in models:
            models[kind] = make_model(config, scene=scene)
        return refit(models[kind], config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(throughput, "make_model", make)
        yield models


@pytest.fixture(scope="module")
def result(made):
    return measure_throughput(quick=True, device="cpu")


def test_every_row_has_a_figure(result):
    assert not [row.failure for row in result.rows if row.failure]
    assert {row.study for row in result.rows} == {"resolution", "launch", "triangles"}
    assert {row.mode for row in result.rows} >= {EXACT, ADAPTIVE}
    for row in result.rows:
        assert 0.0 < row.slowest_per_s <= row.steps_per_s <= row.fastest_per_s
        assert row.real_time_factor == pytest.approx(row.steps_per_s / result.rate_hz)
        if row.mode == ADAPTIVE:
            assert row.renders_per_step < 1.0
        else:
            assert row.renders_per_step == 1.0
    assert any(row.events_per_step > 1.0 for row in result.rows)
    triangles = [row.triangles for row in result.rows if row.study == "triangles"]
    assert triangles == sorted(set(triangles))


def test_shares_of_a_step_add_up(result):
    split = result.split
    assert not result.split_failure
    assert set(split.stages_us) <= set(STAGES)
    assert {"physics", "render", "scan", "sort and decode"} <= set(split.stages_us)
    assert sum(split.stages_us.values()) + split.host_us == pytest.approx(split.step_us)
    assert split.host_us > 0.0  # stages do not overlap


def test_every_part_is_measured_alone(result):
    assert not [part.failure for part in result.roofline.parts if part.failure]
    assert all(part.per_step_us > 0.0 for part in result.roofline.parts)
    rays = [part.rays_per_step for part in result.roofline.parts if part.rays_per_step]
    assert rays == [result.roofline.width * result.roofline.height] * 2
    assert result.roofline.copy_gigabytes_per_s > 0.0
    for comparison in (result.scan, result.loop, result.loop_at_once):
        assert not comparison.failure
        assert comparison.ratio > 0.0
        assert comparison.ours_events > 0.0
    assert result.events_per_s > 0.0


def test_a_flight_repeats_and_traversals_agree(result):
    again, *others = result.agreements
    assert again.same is True
    assert again.event_counts[0] == again.event_counts[1] > 0
    for other in others:
        assert not other.failure
        assert other.rms < 1e-3  # rounding of hits, far below an event
        assert 0 < other.event_counts[0] < 1.1 * other.event_counts[1]


def test_its_report_is_written(result, tmp_path):
    chapter = throughput_chapter(result)
    write_report([chapter], tmp_path)
    tables = {table.name for table in chapter.tables}
    assert {path.stem for path in tmp_path.glob("*.csv")} == tables
    assert {path.stem for path in tmp_path.glob("*.png")} == {plot.name for plot in chapter.plots}
    assert "needs a run without --quick" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_what_fails_is_said_in_its_row_and_ends_nothing(made, monkeypatch, tmp_path):
    def broken(*_, **__):
        raise RuntimeError("no steps today")

    monkeypatch.setattr(throughput, "time_steps", broken)
    monkeypatch.setattr(throughput.frame_loops, "compare_loops", broken)
    for name in ("measure_split", "scan_alone", "events_to_host_per_s", "Views"):
        monkeypatch.setattr(throughput.stages, name, broken)
    result = measure_throughput(quick=True, device="cpu")
    assert {row.failure for row in result.rows} == {"RuntimeError: no steps today"}
    assert result.split is None
    assert "no steps today" in result.split_failure
    assert "no steps today" in result.loop.failure
    assert result.events_per_s is None
    write_report([throughput_chapter(result)], tmp_path)
    said = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert said.count("no steps today") >= len(result.rows) + 2


# --- the naive camera


def naive_events(frames, device):
    """Return (frame, y, x, polarity) of the naive camera, as a set."""
    height, width = frames.shape[1:]
    camera = NaiveEventCamera(
        width=width, height=height, threshold_on=THRESHOLD, threshold_off=THRESHOLD, device=device
    )
    camera.reset(wp.array(frames[0], dtype=float, device=device))
    found = set()
    for number, frame in enumerate(frames[1:], 1):
        count = camera.feed(wp.array(frame, dtype=float, device=device), number)
        x, y, t, polarity = camera.events(count)
        assert len(x) == count
        assert (t == number).all()
        found |= {(number, *map(int, event)) for event in zip(y, x, polarity, strict=True)}
    return found


def lawful_events(frames):
    """Return the same of the event camera, a crossing counted in the frame that it comes before."""
    height, width = frames.shape[1:]
    config = EventCameraConfig(threshold_on=THRESHOLD, threshold_off=THRESHOLD)
    camera = EventCamera(config, width=width, height=height, device="cpu")
    camera.reset(frames[0], 0)
    events = camera.feed(frames[1:], np.arange(1, len(frames)) * 1_000_000).numpy()
    frame = -(-events.t // 1000)  # a millisecond apart; a crossing on a frame is its own
    return [tuple(map(int, e)) for e in zip(frame, events.y, events.x, events.polarity, strict=True)]


def test_where_one_event_fires_the_naive_camera_sees_what_the_law_says(device):
    """Every pixel changes once, at some frame, by less than two thresholds; some by less than one."""
    rng = np.random.default_rng(3)
    height, width, count = 24, 40, 9
    step = rng.uniform(1.05, 1.9, (height, width)) * rng.choice([-1, 1], (height, width)) * THRESHOLD
    step[rng.random((height, width)) < 0.3] *= 0.45
    at = rng.integers(1, count, (height, width))
    base = rng.uniform(-2.0, 2.0, (height, width))
    frames = (base + step * (np.arange(count)[:, None, None] >= at)).astype(np.float32)
    lawful = lawful_events(frames)
    assert len(lawful) > 500
    assert naive_events(frames, device) == set(lawful)
    assert len(lawful) == len(set(lawful))


def test_the_naive_camera_forgets_and_swings(device):
    """What the law does not do: one event for a step of three thresholds, and one for a swing below one."""
    leap = np.array([0.0, 3.2 * THRESHOLD], dtype=np.float32)[:, None, None]
    assert len(naive_events(leap, device)) == 1
    assert len(lawful_events(leap)) == 3
    swing = np.array([0.0, -0.6, 0.6, -0.6], dtype=np.float32)[:, None, None] * THRESHOLD
    assert naive_events(swing, device) == {(2, 0, 0, 1), (3, 0, 0, 0)}
    assert lawful_events(swing) == []


# --- the hall


@pytest.mark.parametrize("count", [2_000, 20_000, 150_000])
def test_a_hall_has_about_as_many_triangles_as_asked_for(count):
    scene = hall(count)
    assert 0.85 * count < len(scene.faces) <= 1.02 * count
    corners = scene.vertices[scene.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    assert area.min() > 0.0
    walls = 2 * (20 * 12 + 20 * 4 + 12 * 4)
    pillars = 15 * 2 * math.pi * 0.35 * 4
    assert area.sum() == pytest.approx(walls + pillars, rel=0.05)  # ripples, and polygons for circles
    outwards = scene.normals[scene.faces].mean(axis=1)
    assert ((normal * outwards).sum(axis=1) > 0.0).all()  # faces look where their normals point


def test_a_hall_is_the_same_on_every_call_and_not_less_than_its_shapes():
    one, two = hall(3_000), hall(3_000)
    assert one.vertices.tobytes() == two.vertices.tobytes()
    assert one.materials[0].texture.srgb.tobytes() == two.materials[0].texture.srgb.tobytes()
    with pytest.raises(ValueError, match="at least 1000"):
        hall(10)


# --- adaptive steps


def test_steps_that_are_not_rendered_count(result, made, monkeypatch):
    monkeypatch.setattr(step_bench, "make_model", lambda config: refit(made["hall"], config))
    times = measure_steps(
        device="cpu",
        width=24,
        height=16,
        instants=8,
        step_count=64,
        repetitions=1,
        max_displacement_px=5.0,
    )
    assert times.renders_per_step < 0.6
    assert times.real_time_factor == pytest.approx(times.median / 1000.0)


# --- the bars


def made_up(device="NVIDIA H200", *, scale=1.0, **changes):
    """Return a result that just meets every bar of a GPU, times a factor."""
    rows = [
        row(EXACT, 640, 480, 27_000 * scale),
        row(RAYS_ALONE, 640, 480, 18_000 * scale),
        row(EXACT, 1280, 720, 6_500 * scale),
        row(EXACT, 346, 260, 200 * scale),
        row(ADAPTIVE, 346, 260, 880 * scale),
    ]
    result = ThroughputResult(
        device=device,
        is_cuda="NVIDIA" in device,
        quick=False,
        core_count=2,
        scene="house",
        scene_triangles=145_840,
        is_house=True,
        rate_hz=1000.0,
        max_displacement_px=0.5,
        rows=tuple(rows),
        split=Split(width=640, height=480, instants=16, step_us=50.0, stages_us={"render": 40.0}),
        split_failure="",
        roofline=Roofline(
            width=640,
            height=480,
            instants=16,
            step_us=50.0,
            parts=(Part(name="render", per_step_us=40.0, bytes_per_step=2e6, rays_per_step=307_200),),
            copy_gigabytes_per_s=4000.0,
            host_gigabytes_per_s=50.0,
        ),
        scan=Comparison(name=SCAN, ours_per_s=300_000.0 * scale, naive_per_s=30_000.0),
        loop=Comparison(name=LOOP, ours_per_s=15_000.0 * scale, naive_per_s=10_000.0),
        loop_at_once=Comparison(name=LOOP_AT_ONCE, ours_per_s=12_000.0 * scale, naive_per_s=10_000.0),
        events_per_s=5e8 * scale,
        events_failure="",
        agreements=(
            Agreement(what="again", same=True, event_counts=(5, 5), rms=0.0, largest=0.0, beyond_share=0.0),
            Agreement(what="CPU", event_counts=(5, 5), rms=1e-7, largest=1e-6, beyond_share=0.0),
        ),
    )
    return dataclasses.replace(result, **changes)


def row(mode, width, height, steps_per_s):
    return StepRow(
        study="resolution",
        mode=mode,
        scene="house",
        width=width,
        height=height,
        instants=16,
        steps_per_s=steps_per_s,
        slowest_per_s=steps_per_s,
        fastest_per_s=steps_per_s,
        real_time_factor=1e-3 * steps_per_s,
    )


def verdicts(result):
    return [bar.met for bar in throughput_bars(result)]


GPU = [True, True, True, True, True, None, True, True, True, None]


@pytest.mark.parametrize(("scale", "shown"), [(1.0, True), (100.0, False)])
def test_real_time_is_in_the_legend_where_its_line_is_on_the_axis(scale, shown):
    figure = Figure()
    draw_steps(made_up(scale=scale), figure)
    axes = figure.axes[0]
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert ("real time" in texts) is shown
    assert {EXACT, RAYS_ALONE, ADAPTIVE} <= set(texts)
    low, high = axes.get_ylim()
    assert (low <= 1000.0 <= high) == shown


def test_bars_of_a_gpu():
    assert verdicts(made_up()) == GPU
    assert verdicts(made_up(scale=0.99)) == [v and i in (0, 7, 8) if v else v for i, v in enumerate(GPU)]


def test_a_bar_takes_the_fastest_launch():
    rows = [*made_up(scale=0.5).rows, dataclasses.replace(row(EXACT, 640, 480, 28_000), study="launch")]
    exact, fast, *_ = throughput_bars(made_up(rows=tuple(rows)))
    assert exact.met is fast.met is True
    assert "28,000 /s (exact, 16 renders per launch" in exact.measured


def test_a_lesser_device_meets_bars_and_misses_none():
    assert verdicts(made_up("NVIDIA RTX 4090")) == GPU
    others = verdicts(made_up("NVIDIA RTX 4090", scale=0.5))
    assert others == [None] * 7 + [True, True, None]
    assert (
        "needs an H200; here 13,500 /s" in throughput_bars(made_up("NVIDIA RTX 4090", scale=0.5))[0].measured
    )


def test_bars_of_a_laptop():
    cpu = made_up("Some CPU", scale=1.0, agreements=made_up().agreements[:1])
    assert verdicts(cpu)[-3:] == [True, None, True]
    slow = made_up("Some CPU", scale=0.9, agreements=made_up().agreements[:1])
    assert verdicts(slow)[-1] is False
    assert "adaptive 792 /s, real-time factor 0.79" in throughput_bars(slow)[-1].measured
    assert verdicts(dataclasses.replace(slow, core_count=8))[-1] is None


def test_bars_of_the_house_need_the_house():
    for changes in ({"is_house": False}, {"scene_triangles": 80_000}):
        bars = throughput_bars(made_up(**changes))
        assert [bar.met for bar in bars[:3]] == [None] * 3
        assert "needs --scene" in bars[0].measured


def test_bars_say_what_failed():
    failed = StepRow(
        study="resolution", mode=EXACT, scene="house", width=640, height=480, instants=16, failure="out of it"
    )
    result = made_up(
        rows=(failed,),
        scan=Comparison(name=SCAN, failure="out of it"),
        loop=Comparison(name=LOOP, failure="out of it"),
        events_per_s=None,
        events_failure="out of it",
        agreements=(Agreement(what="again", failure="out of it"),),
    )
    bars = throughput_bars(result)
    assert not [bar for bar in bars if bar.met]
    assert sum("out of it" in bar.measured for bar in bars) == 6


def test_render_is_followed_by_throughput_where_a_device_is_named(monkeypatch, tmp_path):
    told = []

    def study(name, **more):
        def measure(options, _progress):
            told.append((name, dict(options)))
            bar = Bar(text="it is", measured="so", met=True)
            return Chapter(name=name, title=name, summary="", command=f"neurosim bench {name}", bars=[bar])

        return commands.Study(name=name, help="", description="", chapter=measure, **more)

    own = study("first", options=frozenset({"device"}), then="second")
    monkeypatch.setattr(commands, "STUDIES", (own, study("second", options=frozenset({"device", "scene"}))))
    from neurosim_core import cli

    out = ["--out", str(tmp_path)]
    assert cli.main(["bench", "first", *out]) == 0
    assert [name for name, _ in told] == ["first"]
    told.clear()
    assert cli.main(["bench", "first", "--device", "cpu", *out]) == 0
    assert told == [(n, {"quick": False, "device": "cpu"}) for n in ("first", "second")]
    assert next(s for s in commands.STUDIES if s.name == "first").then == "second"
