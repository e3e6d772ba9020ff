"""A heading that follows travel: within its rate everywhere, at rest at the ends, smooth between."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from neurosim_core.trajectory import heading
from neurosim_core.trajectory.feasibility import control_points, derivative
from neurosim_core.trajectory.heading import follow_travel
from neurosim_core.trajectory.minsnap import minimum_snap
from neurosim_core.trajectory.path import Path


def yaw_rate_bound(path: Path) -> float:
    """Convex hull of the yaw rate: an upper bound everywhere."""
    rate = derivative(path.coefficients[:, 3:], 1) / path.durations_s[:, None, None]
    return float(np.abs(control_points(rate, 8)).max())


def test_looks_along_a_straight_line():
    way = math.radians(150.0)
    end = [5.0 * math.cos(way), 5.0 * math.sin(way), 0.5]
    path = follow_travel(
        minimum_snap([[0.0, 0.0, 0.0], end], [0, 4 * 10**9]), lookahead_s=0.5, rate_max_rad_s=1.0
    )
    yaw = path.evaluate(np.linspace(0, path.end_ns, 400).astype(np.int64)).yaw
    assert yaw == pytest.approx(np.full(400, way), abs=1e-9)


def test_positions_stay_as_they_are():
    path = minimum_snap([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 1.0]], [0, 10**9, 2 * 10**9 + 1])
    turned = follow_travel(path, lookahead_s=0.5, rate_max_rad_s=1.0)
    stamps = np.linspace(0, path.end_ns, 1000).astype(np.int64)
    assert turned.evaluate(stamps).position == pytest.approx(path.evaluate(stamps).position, abs=1e-12)
    assert turned.evaluate(stamps).snap == pytest.approx(path.evaluate(stamps).snap, rel=1e-8, abs=1e-7)


def test_turns_back_at_the_limit():
    """There and back again: half a turn takes pi / rate, and little more."""
    there = [[0.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.0, 0.1, 0.0]]
    there_and_back = minimum_snap(there, [0, 8 * 10**9, 16 * 10**9])
    path = follow_travel(there_and_back, lookahead_s=0.3, rate_max_rad_s=0.5)
    samples = path.evaluate(np.linspace(0, path.end_ns, 16_001).astype(np.int64))
    assert abs(samples.yaw[-1] - samples.yaw[0]) == pytest.approx(math.pi, abs=0.05)
    assert 0.499 <= np.abs(samples.yaw_rate).max() <= 0.5 * (1.0 + 1e-12)
    turning = np.flatnonzero(np.abs(samples.yaw_rate) > 0.01)
    assert 2.0 * math.pi <= (turning[-1] - turning[0]) * 1e-3 <= 2.0 * math.pi + 1.5


@pytest.mark.parametrize("step_max", [0.025, 0.075])
def test_the_limited_heading_is_the_nearest(step_max):
    """Against SciPy's bounded least squares in the steps as unknowns."""
    k = np.arange(150)
    values = np.where(k > 60, 3.0, 0.0) + 0.3 * np.sin(0.05 * k) + np.where(k > 110, -1.0, 0.0)
    limits = np.full(150, step_max)
    limits[0] = np.inf
    oracle = optimize.lsq_linear(np.tril(np.ones((150, 150))), values, bounds=(-limits, limits), max_iter=500)
    limited = heading._nearest_with_slope(values, step_max)
    assert np.abs(np.diff(limited)).max() <= step_max * (1.0 + 1e-12)
    assert limited == pytest.approx(np.cumsum(oracle.x), abs=0.02)  # ADMM stops at about 0.01 rad


def test_a_vertical_path_keeps_its_heading():
    path = minimum_snap([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]], [0, 2 * 10**9])
    assert not follow_travel(path, lookahead_s=0.5, rate_max_rad_s=1.0).coefficients[:, 3].any()


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    rate=st.floats(0.2, 5.0),
    lookahead=st.floats(0.05, 2.0),
    pace=st.floats(0.05, 2.0),
)
def test_rate_is_bounded_and_ends_rest(seed, rate, lookahead, pace):
    rng = np.random.default_rng(seed)
    points = 2.0 * rng.normal(size=(5, 3))
    knots = np.cumsum([0, *(1e9 * pace * rng.uniform(0.5, 2.0, 4)).astype(int)])
    path = follow_travel(minimum_snap(points, knots), lookahead_s=lookahead, rate_max_rad_s=rate)
    assert yaw_rate_bound(path) <= rate * (1.0 + 1e-6)  # knots are rounded to nanoseconds
    ends = path.evaluate([path.start_ns, path.end_ns])
    assert np.abs(ends.yaw_rate).max() < 1e-8 * rate
    inner = path.knots_ns[1:-1]
    before, after = path.evaluate(inner - 1), path.evaluate(inner)
    assert np.abs(after.yaw_rate - before.yaw_rate).max() < 1e-5 * rate / min(pace, 1.0)
