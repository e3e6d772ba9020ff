"""Closed-form paths against their closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import integrate

from neurosim_core.settings_file import ConfigError
from neurosim_core.trajectory.shapes import (
    CircleConfig,
    FigureEightConfig,
    HoverConfig,
    LineConfig,
    LissajousConfig,
    circle,
    figure_eight,
    hover,
    line,
    lissajous,
)

CENTER = np.array([1.0, -2.0, 1.5])


def phase(stamps_s: np.ndarray, *, omega: float, ramp_s: float, end_s: float) -> np.ndarray:
    """Integral, by quadrature, of a rate that rises as the degree-9 smoothstep and falls likewise."""

    def rate(t: np.ndarray) -> np.ndarray:
        x = np.clip(np.minimum(t, end_s - t) / ramp_s, 0.0, 1.0)
        return omega * x**5 * (126.0 - 420.0 * x + 540.0 * x**2 - 315.0 * x**3 + 70.0 * x**4)

    marks = np.array([0.0, ramp_s, end_s - ramp_s])
    total = []
    for t in stamps_s:
        ends = [*marks[marks < t], t]
        total.append(sum(integrate.fixed_quad(rate, a, b, n=10)[0] for a, b in itertools.pairwise(ends)))
    return np.array(total)


def test_circle_is_its_closed_form():
    config = CircleConfig(radius_m=1.5, speed_max_m_s=3.0, laps=3.0, ramp_s=2.0)
    path = circle(config, center=CENTER)
    stamps = np.linspace(0, path.end_ns, 1501).astype(np.int64)
    samples = path.evaluate(stamps)
    theta = phase(stamps * 1e-9, omega=2.0, ramp_s=2.0, end_s=path.end_ns * 1e-9)
    expected = CENTER + 1.5 * np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], axis=1)
    # the interpolation error of degree-9 pieces of 0.4 rad is below 1e-13; quadrature and rounding 1e-12
    assert np.abs(samples.position - expected).max() < 1e-11
    assert theta[-1] == pytest.approx(6.0 * math.pi, abs=1e-8)  # the end was rounded to a nanosecond
    assert np.linalg.norm(samples.velocity, axis=1).max() == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize("speed", [0.5, 9.0, 30.0])
def test_figure_eight_is_its_closed_form(speed):
    """Any point lies on x = a sin, y = b sin 2: y^2 = 4 b^2 (x/a)^2 (1 - (x/a)^2)."""
    config = FigureEightConfig(length_m=8.0, width_m=3.0, speed_max_m_s=speed, laps=2.5)
    path = figure_eight(config, center=CENTER)
    samples = path.evaluate(np.linspace(0, path.end_ns, 5001).astype(np.int64))
    x, y, z = ((samples.position - CENTER) / [4.0, 1.5, 1.0]).T
    assert np.abs(y**2 - 4.0 * x**2 * (1.0 - x**2)).max() < 1e-9
    assert np.abs(z).max() < 1e-12
    speeds = np.linalg.norm(samples.velocity, axis=1)
    # fastest in the middle: |(a, 2 b)| omega; sampling 5001 stamps may miss the peak by 1e-5
    assert speeds.max() <= speed * (1.0 + 1e-7)
    assert speeds.max() >= speed * (1.0 - 1e-4)


def test_lissajous_frequencies():
    config = LissajousConfig(
        amplitude_m=(1.0, 2.0, 0.5), cycles=(3, 2, 5), phase_rad=(0.1, 0.2, 0.3), laps=4.0
    )
    path = lissajous(config, center=CENTER)
    middle = path.evaluate(np.linspace(0.4 * path.end_ns, 0.6 * path.end_ns, 801).astype(np.int64))
    for axis, (size, cycles) in enumerate(zip((1.0, 2.0, 0.5), (3, 2, 5), strict=True)):
        # q'' = -(n omega)^2 q where the phase advances evenly
        q, qdd = middle.position[:, axis] - CENTER[axis], middle.acceleration[:, axis]
        omega = math.sqrt(-float(q @ qdd) / float(q @ q))
        assert qdd == pytest.approx(-(omega**2) * q, abs=1e-9 * omega**2)
        assert omega / cycles == pytest.approx(_omega(middle, CENTER), rel=1e-9)
        assert np.abs(q).max() <= size * (1.0 + 1e-12)


def _omega(samples, center):
    q, qdd = samples.position[:, 0] - center[0], samples.acceleration[:, 0]
    return math.sqrt(-float(q @ qdd) / float(q @ q)) / 3


@pytest.mark.parametrize("laps", [0.3, 1.0, 2.0])
def test_starts_and_ends_at_rest_and_is_smooth(laps):
    path = figure_eight(FigureEightConfig(laps=laps, yaw="travel"), center=CENTER)
    ends = path.evaluate([path.start_ns, path.end_ns])
    for name, size in (("velocity", 1e-9), ("acceleration", 1e-7), ("jerk", 1e-5), ("snap", 1e-2)):
        assert np.abs(getattr(ends, name)).max() < size, name  # rounding, amplified by 1 / (0.1 s)^order
    assert np.abs(ends.yaw_rate).max() < 1e-12
    inner = path.knots_ns[1:-1]
    before, after = path.evaluate(inner - 1), path.evaluate(inner)
    for name in (
        "position",
        "velocity",
        "acceleration",
        "jerk",
        "snap",
        "yaw",
        "yaw_rate",
        "yaw_acceleration",
    ):
        jump = np.abs(getattr(after, name) - getattr(before, name)).max()
        assert jump < 1e-4, name  # 1 ns of motion, and rounding of the snap


def test_laps_are_flown_whole():
    path = circle(CircleConfig(laps=2.25, radius_m=1.0), center=CENTER)
    assert path.length_m == pytest.approx(2.25 * 2.0 * math.pi, rel=1e-3)
    assert path.evaluate(path.end_ns).position[0] == pytest.approx(
        CENTER + np.array([0.0, 1.0, 0.0]), abs=1e-8
    )


def test_line_has_its_speed_half_way():
    config = LineConfig(start_m=(0.0, 0.0, 1.0), end_m=(3.0, 4.0, 1.0), speed_max_m_s=2.5)
    path = line(config)
    samples = path.evaluate(np.linspace(0, path.end_ns, 1001).astype(np.int64))
    speed = np.linalg.norm(samples.velocity, axis=1)
    assert speed.max() == pytest.approx(2.5, rel=1e-6)
    assert speed.argmax() == 500
    away = np.cross(samples.position - [0.0, 0.0, 1.0], [0.6, 0.8, 0.0])
    assert np.abs(away).max() < 1e-12


def test_hover_rests_for_ever():
    path = hover(HoverConfig(yaw=0.7), position=CENTER)
    samples = path.evaluate([-5, 0, 10**8, 10**18])
    assert (samples.position == CENTER).all()
    assert (samples.yaw == 0.7).all()
    assert not samples.velocity.any()
    assert (hover(HoverConfig(position_m=(1.0, 1.0, 1.0)), position=CENTER).evaluate(0).position == 1.0).all()


def test_travel_looks_along_the_circle():
    """At 1 rad/s the heading runs ahead of the tangent by half the lookahead: 0.15 rad."""
    path = circle(CircleConfig(radius_m=2.0, speed_max_m_s=2.0, laps=3.0, yaw="travel"), center=CENTER)
    middle = path.evaluate(np.linspace(0.3 * path.end_ns, 0.7 * path.end_ns, 300).astype(np.int64))
    tangent = np.unwrap(np.arctan2(middle.velocity[:, 1], middle.velocity[:, 0]))
    lead = middle.yaw - tangent
    assert lead - lead[0] == pytest.approx(np.zeros(300), abs=1e-6)
    assert math.remainder(lead[0] - 0.15, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-6)


def test_configuration_refuses_nonsense():
    with pytest.raises(ConfigError, match="end_m must differ"):
        LineConfig(start_m=(0.0, 0.0, 0.0), end_m=(0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="amplitude_m"):
        LissajousConfig(amplitude_m=(0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="greater than 0"):
        CircleConfig(radius_m=0.0)
