"""The study of events against renders: closed forms of its parts, and what its small version must find."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from neurosim_core.bench import events as study_of
from neurosim_core.bench.chapter import Chapter
from neurosim_core.bench.events import (
    EventStudy,
    Score,
    events_chapter,
    falls,
    measure_events,
    renders_saved,
    timing_gain,
)
from neurosim_core.sensors.rig import EventSensorConfig


@pytest.fixture(scope="module")
def quick() -> EventStudy:
    return measure_events(quick=True, device="cpu")


def score(scheme: str, render_count: int, distance: float, median_us: float, setting: float = 0.0) -> Score:
    return Score(
        scheme=scheme,
        setting=setting or float(render_count),
        render_count=render_count,
        slow_render_count=0,
        choice_s=0.0,
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
        device="cpu",
        width=1,
        height=1,
        samples_per_pixel=1,
        duration_s=1.0,
        reference_hz=1e5,
        reference_count=1000,
        render_ms=1.0,
        scores=scores,
    )


def test_renders_saved_are_read_from_the_curve_of_fixed_rates():
    """Fixed rates have the error 1e5 / renders: for an error of 50 they need 2000, and adaptive 500."""
    curve = [score("fixed", n, 1e5 / n, 1.0) for n in (500, 1000, 4000)]
    better = score("adaptive", 500, 50.0, 1.0, setting=0.2)
    beyond = score("adaptive", 9000, 1.0, 1.0, setting=0.1)
    found = study(*curve, better, beyond)
    assert renders_saved(found, found.error) == pytest.approx({0.2: 4.0})


def test_the_timing_of_the_naive_scheme_is_compared_at_the_same_number_of_renders():
    """Adaptive sampling has the error 1e6 / renders^2."""
    ours = [score("adaptive", n, 1.0, 1e6 / n**2) for n in (100, 1000)]
    naive = [score("naive", n, 1.0, 500.0) for n in (50, 500)]
    assert timing_gain(study(*ours, *naive)) == pytest.approx({500.0: 500.0 / 4.0})


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


def test_adaptive_sampling_needs_fewer_renders_for_the_same_error(quick):
    saved = renders_saved(quick, quick.error)
    assert saved
    assert min(saved.values()) > 1.2


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
    assert renders_saved(none, none.error) == {}
