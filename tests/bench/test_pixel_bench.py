"""The test bench of event pixels: its promises hold, and each can be broken."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from neurosim_core.bench.pixel import measure_pixel, pixel_chapter
from neurosim_core.bench.pixel_bench import TestBench, make_pixel
from neurosim_core.bench.report import print_chapter

TestBench.__test__ = False  # a class of the product, whatever its name


@pytest.fixture(scope="module")
def result():
    return measure_pixel(quick=True, device="cpu")


def test_all_closed_forms_are_met(result):
    bars = pixel_chapter(result).bars
    assert len(bars) == 11
    assert [bar.text for bar in bars if not bar.met] == []


def scaled(curves, factor):
    """Return curves whose last one was measured wrong by a factor."""
    *others, last = curves
    return [*others, dataclasses.replace(last, measured=factor * last.measured)]


def wrong_preset(result):
    *others, last = result.presets
    return [*others, dataclasses.replace(last, threshold_off=1.03 * last.threshold_off)]


def wrong_jitter(result):
    ideal, mismatch, low_pass = result.jitter
    return [ideal, dataclasses.replace(mismatch, jitter_s=1.3 * mismatch.jitter_s), low_pass]


@pytest.mark.parametrize(
    ("field", "change", "broken"),
    [
        ("threshold", lambda r: scaled([r.threshold], 1.002)[0], "ramp: the rate of an ideal"),
        ("ramp", lambda r: scaled(r.ramp, 0.998), "ramp: rates are"),
        ("staircase", lambda r: scaled(r.staircase, 2.0), "step: as many events"),
        ("s_curve_distance", lambda r: 2.0, "step: S-curves"),
        ("latency", lambda r: scaled(r.latency, 1.002), "step: latency"),
        ("corner", lambda r: scaled(r.corner, 1.02), "sine: the gain"),
        ("jitter", wrong_jitter, "bar: delay, jitter"),
        ("dark", lambda r: scaled(r.dark, 1.2), "darkness: rates"),
        ("survival_distance", lambda r: 2.0, "darkness: intervals"),
        ("throughput", lambda r: scaled(r.throughput, 1.1), "readout: throughput"),
        ("wait", lambda r: scaled([r.wait], 1.2)[0], "readout: throughput"),
        ("presets", wrong_preset, "presets: the thresholds"),
    ],
)
def test_what_is_measured_wrong_breaks_its_promise(result, field, change, broken):
    bars = pixel_chapter(dataclasses.replace(result, **{field: change(result)})).bars
    missed = [bar.text for bar in bars if not bar.met]
    assert len(missed) == 1
    assert missed[0].startswith(broken)


def test_a_pixel_with_another_threshold_is_found_out():
    """The bench measures the pixels, not its own settings."""
    bench = TestBench(device="cpu", quick=True)
    log = np.array([0.0, 10.1]).reshape(2, 1, 1)
    counts = [len(bench.expose(make_pixel(threshold_on=c), log, [0.0, 1.0]).t) for c in (0.2, 0.21)]
    assert counts == [50, 48]


def test_every_plot_shows_what_was_measured(result):
    for plot in pixel_chapter(result).plots:
        figure = Figure()
        plot.draw(figure)
        for axes in figure.axes:
            assert axes.get_xlabel(), plot.name
            drawn = [line for line in axes.lines if np.isfinite(line.get_ydata()).any()]
            assert len(drawn) >= 2, plot.name  # marks and a closed form


def test_the_chapter_says_what_was_found(result):
    printed = io.StringIO()
    print_chapter(pixel_chapter(result), Console(file=printed, width=200))
    assert "11 of 11 closed forms are met" in printed.getvalue()
    assert "davis346" in printed.getvalue()
