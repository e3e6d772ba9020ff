"""The study of events against run time: closed forms of its parts, and what its small version must find."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from neurosim_core.sensors.rig import EventSensorConfig

from neurosim_core.bench import events as study_of
from neurosim_core.bench.chapter import Chapter
from neurosim_core.bench.events import measure_events
from neurosim_core.bench.events_chapter import events_chapter
from neurosim_core.bench.events_result import EventStudy, Score, falls, saving, timing_gain


@pytest.fixture(scope="module")
def quick() -> EventStudy:
    """Return a small study in which the promises hold: single rays, but as many columns as that allows.

    The fewer the columns, the less moves by a pixel, and the more of the adaptive renders are ends of
    packets.
    """
    return measure_events(quick=True, device="cpu", width=96, samples_per_pixel=1)


def score(scheme: str, render_count: int, distance: float, median_us: float, setting: float = 0.0) -> Score:
    return Score(
        scheme=scheme,
        setting=setting or float(render_count),
        render_count=render_count,
        slow_render_count=0,
        choice_s=0.5 if scheme == "adaptive" else 0.0,
        render_s=1e-3 * render_count,
        event_count=1000,
        missing_count=int(distance),
        spurious_count=0,
        distance=distance,
        median_us=median_us,
        high_us=0.0,
        worst_us=0.0,
        histogram=(),
    )


def study(*scores: Score) -> EventStudy:
    return EventStudy(
        quick=True,
        scene="",
        scene_file=None,
        device="cpu",
        width=1,
        height=1,
        samples_per_pixel=1,
        duration_s=1.0,
        reference_hz=1e5,
        reference_count=1000,
        scores=scores,
    )


def test_savings_are_read_from_the_curve_of_fixed_rates():
    """Fixed rates have the error 1e5 / renders: for an error of 50 they need 2000, and adaptive 500.

    A render takes 1 ms, and choosing 0.5 s: 2 s of a fixed rate against 1 s.
    """
    curve = [score("fixed", n, 1e5 / n, 1.0) for n in (500, 1000, 4000)]
    better = score("adaptive", 500, 50.0, 1.0, setting=0.2)
    beyond = [
        score("adaptive", n, error, 1.0, setting=px) for n, error, px in ((9000, 1.0, 0.1), (9, 900.0, 2.0))
    ]
    found = study(*curve, better, *beyond)
    assert saving(found, found.error, lambda s: s.render_count) == pytest.approx({0.2: 4.0})
    assert saving(found, found.error, lambda s: s.run_s) == pytest.approx({0.2: 2.0})
    chapter = events_chapter(found)
    assert "left out, as no fixed rate here is as bad or as good: 2, 0.1 px" in chapter.bars[0].measured
    row = next(row for row in chapter.tables[0].rows if row["setting"] == 0.2)
    assert (row["choice"], row["render"], row["run"]) == pytest.approx((0.5, 0.5, 1.0))
    assert (row["fewer"], row["faster"]) == pytest.approx((4.0, 2.0))


def test_a_choice_that_costs_more_than_it_saves_is_said():
    curve = [score("fixed", n, 1e5 / n, 1.0) for n in (100, 1000, 4000)]
    found = study(*curve, score("adaptive", 100, 500.0, 1.0, setting=0.5))
    assert "At 0.5 px it does not pay here" in events_chapter(found).summary  # 0.6 s against 0.2 s


def test_the_timing_of_the_naive_scheme_is_compared_at_the_same_number_of_renders():
    """Adaptive sampling has the error 1e6 / renders^2, a fixed rate twice that."""
    ours = [score("adaptive", n, 1.0, 1e6 / n**2) for n in (100, 1000)]
    fixed = [score("fixed", n, 1.0, 2e6 / n**2) for n in (50, 500)]
    naive = [score("naive", n, 1.0, 500.0) for n in (50, 500)]
    found = study(*ours, *fixed, *naive)
    assert timing_gain(found, "adaptive", lambda s: s.median_us) == pytest.approx({500.0: 500.0 / 4.0})
    assert timing_gain(found, "fixed", lambda s: s.median_us) == pytest.approx(
        {50.0: 500.0 / 800.0, 500.0: 62.5}
    )
    assert timing_gain(study(*naive), "adaptive", lambda s: s.median_us) == {}


@pytest.mark.parametrize(
    ("renders", "naive_us", "met"), [(500, 5.1, [True, True]), (1001, 4.9, [False, False])]
)
def test_bars_are_missed_where_the_figures_say_so(renders, naive_us, met):
    """Fixed rates need 2000 renders for the error of the adaptive ones."""
    curve = [score("fixed", n, 1e5 / n, 1.0) for n in (500, 1000, 4000)]
    ours = [
        score("adaptive", renders, 50.0, 1.0, setting=0.2),
        score("adaptive", 9000, 1.0, 1.0, setting=0.1),
    ]
    found = study(*curve, *ours, score("naive", 4000, 1.0, naive_us))
    assert [bar.met for bar in events_chapter(found).bars[:2]] == [None, None]  # quick
    assert [b.met for b in events_chapter(dataclasses.replace(found, quick=False)).bars[:2]] == met


def test_an_error_that_does_not_fall_is_seen():
    scores = [score("fixed", n, error, 1.0) for n, error in ((100, 9.0), (200, 5.0), (400, 5.5))]
    assert not falls(study(*scores), "fixed")
    assert falls(study(*scores[:2]), "fixed")


def test_the_naive_camera_fires_once_a_frame_and_forgets_the_rest(device):
    """A ramp of 0.5 a frame is two thresholds of 0.2, and fires once; one of 0.1 fires every second frame."""
    config = EventSensorConfig.model_validate({"lens": {"width": 3, "height": 1, "horizontal_fov_rad": 1.0}})
    camera = study_of._NaiveCamera(config, device)
    slopes = np.array([0.5, -0.11, 0.0], dtype=np.float32)
    frames = np.arange(5, dtype=np.float32)[:, None, None] * slopes
    camera.reset(wp.array(frames[0], dtype=float, device=device))
    stamps_ns = np.arange(1, 5) * 1_000_000
    t, x, y, polarity = camera.feed(wp.array(frames[1:], dtype=float, device=device), stamps_ns)
    assert t.tolist() == [1000, 2000, 2000, 3000, 4000, 4000]
    assert x.tolist() == [0, 0, 1, 0, 0, 1]
    assert polarity.tolist() == [1, 1, 0, 1, 1, 0]
    assert not y.any()


def test_more_renders_give_less_error(quick):
    assert falls(quick, "fixed")
    assert falls(quick, "adaptive")
    assert quick.reference_count > 1000


def test_adaptive_sampling_renders_where_the_vehicle_is_fast(quick):
    finest = quick.of("adaptive")[-1]
    fixed = quick.of("fixed")[-1]
    assert finest.slow_render_count < 0.6 * finest.render_count
    assert fixed.slow_render_count == pytest.approx(0.75 * fixed.render_count, rel=0.02)


def test_adaptive_sampling_needs_half_the_renders_for_the_same_error(quick):
    """At 1 px, two thirds of its renders are ends of packets, which a fixed rate of 250 Hz does not have."""
    saved = saving(quick, quick.error, lambda s: s.render_count)
    fine = {px: factor for px, factor in saved.items() if px <= 0.5}
    assert len(fine) >= 3
    assert min(fine.values()) >= 2.0
    assert min(saved.values()) > 1.2


def test_the_naive_scheme_stamps_five_times_worse_for_as_many_renders(quick):
    gain = timing_gain(quick, "adaptive", lambda s: s.median_us)
    assert len(gain) >= 2
    assert min(gain.values()) >= 5.0


def test_run_times_are_those_of_the_renders_and_the_choice(quick):
    for s in quick.scores:
        assert s.run_s == s.choice_s + s.render_s
        assert s.render_s > 0.0
        assert (s.choice_s > 0.0) == (s.scheme == "adaptive")
    fixed, naive = quick.of("fixed"), quick.of("naive")
    assert [s.render_s for s in fixed] == [s.render_s for s in naive]


def test_the_naive_scheme_is_worse_at_every_rate(quick):
    for ours, naive in zip(quick.of("fixed"), quick.of("naive"), strict=True):
        assert naive.render_count == ours.render_count
        assert naive.distance > 1.5 * ours.distance
        assert naive.median_us > 1.5 * ours.median_us


def test_counts_add_up(quick):
    for s in quick.scores:
        matched = quick.reference_count - s.missing_count
        assert s.event_count - s.spurious_count == matched == sum(s.histogram)


def test_the_chapter_says_what_was_measured(quick):
    chapter = events_chapter(quick)
    assert isinstance(chapter, Chapter)
    assert len(chapter.tables[0].rows) == len(quick.scores)
    assert f"{quick.reference_count:,} events" in chapter.summary
    none = dataclasses.replace(quick, scores=tuple(s for s in quick.scores if s.scheme == "fixed"))
    assert saving(none, none.error, lambda s: s.run_s) == {}
    assert "not measured" in events_chapter(none).summary


@pytest.mark.parametrize("scene", [None, Path("my house.glb")])
def test_the_command_of_the_chapter_measures_the_same_elsewhere(scene):
    found = dataclasses.replace(study(), scene_file=scene)
    said = events_chapter(found).command
    options = "--device cpu --width 1 --height 1"
    file = "" if scene is None else "--scene 'my house.glb' "
    assert said == f"neurosim bench events --quick {file}{options}"


def test_the_plots_can_be_drawn(quick):
    figure_of = pytest.importorskip("matplotlib.figure")
    for plot in events_chapter(quick).plots:
        figure = figure_of.Figure()
        plot.draw(figure)
        assert all(axes.get_xlabel() and axes.get_ylabel() and axes.get_legend() for axes in figure.axes)
