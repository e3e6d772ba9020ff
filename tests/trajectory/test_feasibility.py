"""Bounds of what a path asks for: never below dense samples, tight, and met by the time scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.trajectory import feasibility
from neurosim_core.trajectory.feasibility import (
    GRAVITY_M_S2,
    FlightLimits,
    control_points,
    flight_bounds,
    time_factor,
)
from neurosim_core.trajectory.minsnap import minimum_snap
from neurosim_core.trajectory.path import Path


def random_path(seed: int, *, pace: float = 1.0, reach_m: float = 2.0) -> Path:
    rng = np.random.default_rng(seed)
    points = reach_m * rng.normal(size=(6, 3))
    return minimum_snap(points, np.cumsum([0, *(pace * 1e9 * rng.uniform(0.8, 1.5, 5)).astype(int)]))


def sampled(path: Path) -> tuple[float, float, float, float]:
    """Speed, largest thrust, smallest vertical thrust, tilt rate at 20,000 stamps, by their definitions."""
    s = path.evaluate(np.linspace(path.start_ns, path.end_ns, 20_000).astype(np.int64))
    thrust = s.acceleration + np.array([0.0, 0.0, GRAVITY_M_S2])
    size = np.linalg.norm(thrust, axis=1)
    tilt_rate = np.linalg.norm(np.cross(thrust, s.jerk), axis=1) / size**2  # |d/dt (thrust / |thrust|)|
    return (
        float(np.linalg.norm(s.velocity, axis=1).max()),
        float(size.max()) / GRAVITY_M_S2,
        float(thrust[:, 2].min()) / GRAVITY_M_S2,
        float(tilt_rate.max()),
    )


@pytest.mark.parametrize("seed", range(6))
def test_bounds_hold_and_are_tight(seed):
    path = random_path(seed)
    bounds = flight_bounds(path)
    speed, thrust_max, thrust_min, tilt_rate = sampled(path)
    rounding = 1.0 + 1e-12
    assert speed <= bounds.speed_m_s * rounding
    assert thrust_max <= bounds.thrust_to_weight_max * rounding
    assert thrust_min >= bounds.thrust_to_weight_min - 1e-12
    assert tilt_rate <= bounds.tilt_rate_rad_s * rounding
    # 16 parts a piece: the hull exceeds the curve by about (1/16)^2 of its variation
    assert bounds.speed_m_s <= 1.01 * speed
    assert bounds.thrust_to_weight_max <= 1.02 * thrust_max
    assert bounds.thrust_to_weight_min >= thrust_min - 0.02
    if thrust_min > 0.3:
        assert bounds.tilt_rate_rad_s <= 1.2 * tilt_rate


@pytest.mark.parametrize("parts", [1, 2, 4])
def test_bounds_hold_however_coarse(parts, monkeypatch):
    """Where the thrust axis swings by a radian within a part, its swing counts."""
    monkeypatch.setattr(feasibility, "_PARTS", parts)
    finite = 0
    for seed in range(40):
        path = random_path(seed, reach_m=1.0)
        bounds = flight_bounds(path)
        speed, thrust_max, thrust_min, tilt_rate = sampled(path)
        assert speed <= bounds.speed_m_s * (1.0 + 1e-12)
        assert thrust_max <= bounds.thrust_to_weight_max * (1.0 + 1e-12)
        assert thrust_min >= bounds.thrust_to_weight_min - 1e-12
        assert tilt_rate <= bounds.tilt_rate_rad_s * (1.0 + 1e-12)
        finite += np.isfinite(bounds.tilt_rate_rad_s)
    assert finite > 5


def test_a_tilted_jerk_along_the_thrust_counts():
    """Thrust (t - 1/2, 0, 3 + 14 t) turns fastest where it is weakest, at |thrust x jerk| / |thrust|^2."""
    east, up = [0.0, 0.0, -0.25, 1.0 / 6.0], [0.0, 0.0, 0.5 * (3.0 - 9.81), 14.0 / 6.0]
    path = Path(np.array([0, 10**9]), np.array([[east, [0.0] * 4, up, [0.0] * 4]]))
    rate = (0.5 * 14.0 + 3.0) / (0.25 + 9.0)
    assert sampled(path)[3] == pytest.approx(rate, rel=1e-9)
    assert rate <= flight_bounds(path).tilt_rate_rad_s <= 1.5 * rate


def test_control_points_lie_on_the_curve_at_the_ends_of_parts():
    path = random_path(1)
    hull = control_points(path.coefficients[:, :3], 4)
    assert hull.shape == (20, 8, 3)
    whole = path.coefficients[:, :3]
    assert hull[::4, 0] == pytest.approx(whole[:, :, 0], abs=1e-12)
    assert hull[3::4, -1] == pytest.approx(whole.sum(axis=2), abs=1e-10)
    assert hull[:-1, -1] == pytest.approx(hull[1:, 0], abs=1e-9)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    speed=st.floats(0.5, 20.0),
    thrust=st.floats(1.05, 4.0),
    upright=st.floats(0.0, 0.9),
    tilt_rate=st.floats(0.2, 10.0),
)
def test_the_time_factor_meets_the_limits(seed, speed, thrust, upright, tilt_rate):
    """At the factor every limit holds on dense samples; one per cent faster, some bound does not."""
    limits = FlightLimits(
        speed_max_m_s=speed,
        thrust_to_weight_max=thrust,
        thrust_to_weight_min=upright,
        tilt_rate_max_rad_s=tilt_rate,
    )
    path = random_path(seed)
    factor = time_factor(path.coefficients[:, :3], path.durations_s, limits)
    scaled = Path((path.knots_ns * factor).astype(np.int64), path.coefficients)
    found = sampled(scaled)
    assert found[0] <= speed
    assert found[1] <= thrust
    assert found[2] >= upright
    assert found[3] <= tilt_rate
    hasty = Path((path.knots_ns * (0.99 * factor)).astype(np.int64), path.coefficients)
    assert not flight_bounds(hasty).within(limits)


def test_time_factor_does_not_depend_on_the_pace_it_starts_from():
    limits = FlightLimits()
    slow, fast = random_path(3, pace=10.0), random_path(3, pace=0.1)
    times = [
        p.durations_s.sum() * time_factor(p.coefficients[:, :3], p.durations_s, limits) for p in (slow, fast)
    ]
    assert times[0] == pytest.approx(times[1], rel=3e-4)  # bisection stops at 1e-4


def test_rest_asks_for_the_weight():
    still = Path(np.array([0, 10**9]), np.array([[[1.0], [2.0], [3.0], [0.0]]]))
    bounds = flight_bounds(still)
    assert bounds.speed_m_s == 0.0
    assert bounds.thrust_to_weight_max == pytest.approx(1.0)
    assert bounds.thrust_to_weight_min == pytest.approx(1.0)
    assert bounds.tilt_rate_rad_s == 0.0


def test_free_fall_has_no_bounded_tilt_rate():
    falling = np.zeros((1, 4, 4))
    falling[0, 2, 2] = -0.5 * GRAVITY_M_S2
    falling[0, 0, 3] = 1.0
    assert flight_bounds(Path(np.array([0, 10**9]), falling)).tilt_rate_rad_s == np.inf
