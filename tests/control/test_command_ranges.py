"""Ranges of commands: no finite command ends a run, and what is beyond is clamped or refused, and counted."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from controller_commands import command_of

from neurosim_core.control import MODES, Controller
from neurosim_core.vehicle import Multirotor, preset
from neurosim_core.vehicle.command_ranges import SPEED_CEILING_M_S, command_ranges, top_speed_m_s

COMMANDED = [mode for mode in MODES if mode != "path"]
LARGEST = np.finfo(np.float64).max
EXTREMES = [0.0, -0.0, LARGEST, -LARGEST, 5e-324, -5e-324, 2.2e-308, 1e154, -1e154, 1e200]
PERIOD_NS = 5_000_000


def random_commands(random: np.random.Generator, mode: str, count: int, width: int) -> np.ndarray:
    """Return finite rows: ordinary numbers, numbers of all magnitudes, and the extremes of float64."""
    shape = (count, width)
    magnitudes = 10.0 ** random.uniform(-307.0, 308.0, shape) * random.uniform(-1.7, 1.7, shape)
    kind = random.choice(3, shape, p=[0.5, 0.4, 0.1])
    rows = np.choose(
        kind, [random.normal(scale=30.0, size=shape), magnitudes, random.choice(EXTREMES, shape)]
    )
    if mode == "attitude":
        rows[np.abs(rows[:, 1:]).max(axis=1) <= 1e-6, 4] = 1.0  # a quaternion of zeros is refused
    return rows


def fly_random_commands(mode: str, airframe: str, *, vehicles: int, periods: int, device: str) -> Multirotor:
    """Fly each vehicle by its own random commands; raises if a run ends."""
    config = preset(airframe)
    batch = Multirotor(config, count=vehicles, device=device)
    controller = Controller(mode, config, count=vehicles, device=device)
    random = np.random.default_rng(7)
    for _ in range(periods):
        controller.set(random_commands(random, mode, vehicles, len(controller.layout)))
        controller.update(batch.arrays)
        batch.advance(PERIOD_NS)
    batch.check()  # raises DynamicsError for a vehicle that has ended
    return batch


@pytest.mark.parametrize("mode", COMMANDED)
def test_random_finite_commands_never_end_a_run(device: str, mode: str) -> None:
    batch = fly_random_commands(mode, "hummingbird", vehicles=1000, periods=20, device=device)
    state = batch.state
    assert all(np.isfinite(part).all() for part in state)


@pytest.mark.slow
@pytest.mark.parametrize("mode", COMMANDED)
@pytest.mark.parametrize("airframe", ["crazyflie", "hummingbird", "racer"])
def test_a_hundred_thousand_random_finite_commands_never_end_a_run(
    device: str, mode: str, airframe: str
) -> None:
    fly_random_commands(mode, airframe, vehicles=1000, periods=100, device=device)


@pytest.mark.parametrize(
    ("mode", "asked", "flown"),
    [
        ("motor_speeds", [2000.0, -5.0, 10.0, 1.0], [1500.0, 0.0, 10.0, 1.0]),
        ("rates", [1e9, 1.0, 2.0, 3.0], [40.0, 1.0, 2.0, 3.0]),
        ("rates", [5.0, 0.0, -1e200, 0.0], [5.0, 0.0, -4.0, 0.0]),
        ("attitude", [-1.0, 0.0, 0.0, 1e200, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0]),
        ("velocity", [3e300, 0.0, 4e300, 1e300], [6.0, 0.0, 8.0, 4.0]),
        ("position", [1e300, -60.0, 3.0, 0.1], [50.0, -50.0, 3.0, 0.1]),
    ],
)
def test_a_command_out_of_range_is_flown_as_the_nearest_within(
    device: str, caplog: pytest.LogCaptureFixture, mode: str, asked: list[float], flown: list[float]
) -> None:
    """The direction of a velocity and of a body rate stays."""
    limits = {"thrust_max_n": 40.0, "speed_max_m_s": 10.0, "body_rate_max_rad_s": 4.0, "position_max_m": 50.0}
    state = {
        "position": [0.0, 0.0, 1.0],
        "velocity": [0.5, 0.0, 0.0],
        "orientation": [0.0, 0.0, 0.0, 1.0],
        "body_rate": [0.1, 0.0, 0.0],
        "rotor_speed": 400.0 * np.ones(4),
    }
    controller = Controller(mode, preset("hummingbird", command_ranges=limits), device=device)
    with caplog.at_level(logging.WARNING):
        got = [command_of(controller, asked, **state) for _ in range(2)]
    assert controller.clamped_count == 2
    assert caplog.text.count("is out of range") == 1  # said once
    np.testing.assert_allclose(got[1], command_of(controller, flown, **state), rtol=1e-12)
    assert controller.clamped_count == 2
    strict = Controller(
        mode, preset("hummingbird", command_ranges={**limits, "beyond": "refuse"}), device=device
    )
    with pytest.raises(ValueError, match="is out of range"):
        strict.set(asked)
    strict.set(flown)


def test_ranges_are_those_of_the_vehicle() -> None:
    """Thrust of all rotors at full speed; the top speed balances thrust and drag in level flight."""
    config = preset("hummingbird")
    ranges = command_ranges(config)
    assert ranges.thrust_max_n == pytest.approx(4 * 5.57e-6 * 1500.0**2)
    speed = ranges.speed_max_m_s
    drag_n = 4 * 1.19e-4 * 1500.0 * speed + 0.5e-2 * speed**2
    assert np.hypot(drag_n, 0.5 * 9.81) == pytest.approx(ranges.thrust_max_n)
    assert top_speed_m_s(preset("racer")) == SPEED_CEILING_M_S  # it has no drag
    assert top_speed_m_s(preset("hummingbird", mass_kg=6.0)) == SPEED_CEILING_M_S  # it cannot hover


def test_both_ways_to_ask_agree() -> None:
    """`beyond` for many rows finds those that `excess` names."""
    random = np.random.default_rng(3)
    ranges = command_ranges(preset("crazyflie"))
    for mode, width in (("motor_speeds", 4), ("rates", 4), ("attitude", 5), ("velocity", 4), ("position", 4)):
        rows = random_commands(random, mode, 2000, width)
        expected = [bool(ranges.excess(mode, row.tolist())) for row in rows]
        assert 0 < sum(expected) < len(rows)
        np.testing.assert_array_equal(ranges.beyond(mode, rows), expected)
