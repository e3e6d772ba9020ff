"""The test bench of event pixels: claims that hold, and that see planted faults."""

from __future__ import annotations

import math

import numpy as np
import pytest

from neurosim_core.bench import pixel
from neurosim_core.bench.options import Options
from neurosim_core.bench.pixel import TestBench, make_pixel, make_preset, rate_hz

BENCH = TestBench(device="cpu", quick=True)


def test_the_chapter_meets_its_claims():
    chapter = pixel.measure(Options(quick=True, device="cpu"))
    assert [claim.text for claim in chapter.claims if not claim.met] == []
    assert len(chapter.plots[0].panels) == len(chapter.claims) - 1  # a pattern each; noise is in the table
    assert {row["light [lux]"] for row in chapter.tables[0].rows} == {0.1, 161.0, 1000.0, 3000.0}


@pytest.mark.parametrize(
    ("pattern", "fault"),
    [(pixel.ramp, {"threshold_on": 0.2005}), (pixel.latency, {"threshold_on": 0.201})],
)
def test_a_planted_fault_is_seen(pattern, fault, monkeypatch):
    assert all(claim.met for claim in pixel.claims_of(pattern(BENCH)))
    monkeypatch.setattr(pixel, "make_pixel", lambda **settings: make_pixel(**{**settings, **fault}))
    assert not all(claim.met for claim in pixel.claims_of(pattern(BENCH)))


def test_noise_that_its_source_does_not_have_is_seen(monkeypatch):
    assert all(row["within"] for row in pixel.measure_noise_figures(BENCH))
    plain = make_preset("gen3", shot_noise={"rate_hz": 5.0}, readout=None)
    monkeypatch.setattr(pixel, "make_preset", lambda *_, **__: plain)
    assert not all(row["within"] for row in pixel.measure_noise_figures(BENCH))


def test_rates_are_from_the_first_to_the_last_event_of_a_pixel():
    def rate(rise: float) -> float:
        return rate_hz(BENCH.expose(make_pixel(), np.array([0.0, rise]).reshape(2, 1, 1), [0.0, 1.0]))

    assert rate(2.1) == pytest.approx(10.5, rel=1e-4)
    assert math.isnan(rate(0.25))  # one event only
