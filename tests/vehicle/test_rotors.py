"""Rotors that are not alike: thrust and torque of each, against the equations rotor by rotor."""

from __future__ import annotations

import numpy as np
import pytest
from multirotor_oracle import angle, derivative, solve

from neurosim_core.control import Controller
from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import TERMS, Multirotor, MultirotorState, preset

MS = 1_000_000
UNLIKE = {
    "rotor_thrust_scale": (1.0, 0.9, 1.1, 0.8),
    "rotor_torque_scale": (1.0, 1.2, 0.7, 1.0),
}


def one(state: MultirotorState) -> MultirotorState:
    return MultirotorState(*(rows[0] for rows in state))


def test_derivatives_of_unlike_rotors(device):
    rng = np.random.default_rng(2)
    config = preset("hummingbird", flapping_kg_m=1e-4, wind_m_s=(3.0, -1.0, 2.0), **UNLIKE)
    q = rng.normal(size=(10, 4))
    states = MultirotorState(
        rng.normal(size=(10, 3)),
        5.0 * rng.normal(size=(10, 3)),
        q / np.linalg.norm(q, axis=1, keepdims=True),
        5.0 * rng.normal(size=(10, 3)),
        rng.uniform(0.0, 1500.0, (10, 4)),
    )
    vehicle = Multirotor(config, count=10, device=device, terms=TERMS)
    vehicle.reset(*states)
    expected = np.array([derivative(config, np.concatenate(s[:4]), s[4]) for s in zip(*states, strict=True)])
    found = vehicle.acceleration
    assert found.linear == pytest.approx(expected[:, 3:6], rel=1e-12, abs=1e-11)
    assert found.angular == pytest.approx(expected[:, 10:13], rel=1e-12, abs=1e-11)


@pytest.mark.parametrize("integrator", ["rkmk4", "dormand_prince"])
def test_flight_on_unlike_rotors(integrator, device):
    config = preset("hummingbird", **UNLIKE)
    vehicle = Multirotor(config, device=device, integrator=integrator, rtol=1e-9, atol=1e-11)
    start = one(vehicle.state)
    held = config.hover_rotor_speed_rad_s * (1.0 + np.random.default_rng(5).uniform(-0.2, 0.2, (6, 4)))
    exact = solve(config, start, held, 0.01)
    for command, expected in zip(held, exact, strict=True):
        vehicle.step(command, 10 * MS)
        state = one(vehicle.state)
        assert state.rotor_speed == pytest.approx(expected.rotor_speed, rel=1e-13)
        assert state.position == pytest.approx(expected.position, abs=1e-9)
        assert angle(state.orientation, expected.orientation) < 1e-8
    assert vehicle.effort.redone_count.tolist() == [0]


def test_scales_of_one_change_nothing(device):
    alike = dict.fromkeys(UNLIKE, (1.0, 1.0, 1.0, 1.0))
    ends = []
    for override in ({}, alike):
        vehicle = Multirotor(preset("hummingbird", **override), device=device)
        vehicle.step((500.0, 520.0, 480.0, 510.0), 50 * MS)
        ends.append(np.concatenate(one(vehicle.state)))
    assert np.array_equal(*ends)


def test_a_controller_knows_its_rotors(device):
    """It hovers level on unlike rotors; on wrong beliefs about them it would tilt at once."""
    config = preset("hummingbird", rotor_thrust_scale=(1.0, 0.8, 1.1, 0.9), motor_time_constant_s=0.0)
    vehicle = Multirotor(config, device=device)
    controller = Controller("attitude", config, device=device)
    weight = config.mass_kg * config.gravity_m_s2
    controller.setpoint.assign([[weight, 0.0, 0.0, 0.0, 1.0]])
    controller.update(vehicle.arrays)
    vehicle.advance(MS)
    assert np.abs(vehicle.state.body_rate).max() < 1e-12
    assert np.abs(vehicle.acceleration.linear).max() < 1e-9


@pytest.mark.parametrize("name", list(UNLIKE))
@pytest.mark.parametrize(
    ("value", "message"),
    [
        ((1.0, 1.0), r"must have one entry for each of 4 rotors, or none, got 2"),
        ((1.0, 1.0, 1.0, -0.1), "greater than or equal to 0"),
        ((1.0, 1.0, 1.0, np.nan), "finite number"),
        ((1.0, 1.0, 1.0, np.inf), "finite number"),
    ],
)
def test_scales_are_checked(name, value, message):
    with pytest.raises(ConfigError, match=message):
        preset("hummingbird", **{name: value})
