"""Adaptive steps: alone to a tolerance, and as what redoes intervals that fixed steps cannot resolve."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import warp as wp
from multirotor_oracle import NO_AERO, angle, solve

from neurosim_core import load_config, sim
from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig, MultirotorState, preset

MS = 1_000_000
HUMMINGBIRD = preset("hummingbird")
ADAPTIVE = {"integrator": "dormand_prince"}
ISOLATED = {"gravity_m_s2": 0.0, "thrust_coefficient_n_s2": 0.0, "torque_coefficient_n_m_s2": 0.0, **NO_AERO}


def one(state: MultirotorState) -> MultirotorState:
    return MultirotorState(*(rows[0] for rows in state))


def commands(seed: int = 7, count: int = 3) -> np.ndarray:
    spread = np.random.default_rng(seed).uniform(-0.1, 0.1, (count, 4))
    return HUMMINGBIRD.hover_rotor_speed_rad_s * (1.0 + spread)


def scaled_inertia(scale: float) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(scale * moment for moment in row) for row in HUMMINGBIRD.inertia_kg_m2)


def fly(vehicle: Multirotor, held, hold_ns: int = 10 * MS) -> list[MultirotorState]:
    states = []
    for command in held:
        vehicle.step(command, hold_ns)
        states.append(one(vehicle.state))
    return states


def errors(flown, exact) -> tuple[float, float]:
    """Largest error of position [m] and of attitude [rad]."""
    pairs = list(zip(flown, exact, strict=True))
    return (
        max(float(np.linalg.norm(f.position - e.position)) for f, e in pairs),
        max(angle(f.orientation, e.orientation) for f, e in pairs),
    )


# Redone intervals

FEATHER = {"mass_kg": 3e-6, "wind_m_s": (100.0, 0.0, 0.0), "translational_lift_kg_m": 0.0}
"""3 mg in a storm."""


@pytest.mark.parametrize(
    ("override", "scale", "tolerance_m"),
    [
        ({"inertia_kg_m2": scaled_inertia(1e-4)}, 1.0, 1e-9),
        ({"inertia_kg_m2": scaled_inertia(1e-6)}, 1.0, 1e-9),
        (FEATHER, 0.002, 5e-6),  # 0.4 m in 50 steps with 1e-6 of 100 m/s each
    ],
    ids=["inertia_1e-4", "inertia_1e-6", "3_mg_in_100_m_s"],
)
def test_stiff_vehicles_fly_right(override, scale, tolerance_m, device):
    """Fixed steps of 1 ms blow up on all of these: rates of 1e3 ... 1e6 1/s."""
    config = preset("hummingbird", **override)
    vehicle = Multirotor(config, device=device)
    start = one(vehicle.state)
    held = scale * commands(count=2)
    exact = solve(config, start, held, 2e-3, stiff=True)
    position_error, attitude_error = errors(fly(vehicle, held, 2 * MS), exact)
    assert position_error < tolerance_m
    assert attitude_error < 1e-6
    assert vehicle.effort.redone_count[0] >= 1
    assert vehicle.effort.evaluation_count[0] >= 7 * vehicle.effort.redone_count[0]


def test_fast_tops_are_redone(device):
    """Moments 1 : 10 : 10.9 at 3 x 2000 rad/s: nutation is too fast for 1 ms."""
    inertia = ((1e-5, 0, 0), (0, 1e-4, 0), (0, 0, 1.09e-4))
    config = preset("hummingbird", **{**ISOLATED, "inertia_kg_m2": inertia})
    vehicle = Multirotor(config, device=device)
    vehicle.reset(body_rate=(2000.0, 2000.0, 2000.0))
    start = one(vehicle.state)
    held = np.zeros((2, 4))
    _, attitude_error = errors(fly(vehicle, held), solve(config, start, held, 0.01))
    assert attitude_error < 1e-4  # 70 rad in steps with 1e-6 each
    assert vehicle.effort.redone_count.tolist() == [2]
    momentum = np.diag(inertia) * vehicle.state.body_rate[0]
    assert np.linalg.norm(momentum) == pytest.approx(2000.0 * np.linalg.norm(np.diag(inertia)), rel=1e-5)


def test_moments_1_10_100_at_200_rad_s(device):
    """No body has them, and the settings say so; the equations do not mind, and turn at 1e4 rad/s inside."""
    inertia = ((1e-5, 0, 0), (0, 1e-4, 0), (0, 0, 1e-3))
    with pytest.raises(ConfigError, match="no body has principal moments"):
        preset("hummingbird", **{**ISOLATED, "inertia_kg_m2": inertia})
    config = preset("hummingbird", **ISOLATED).model_copy(update={"inertia_kg_m2": inertia})
    vehicle = Multirotor(config, device=device)
    vehicle.reset(body_rate=200.0 / np.sqrt(3.0) * np.ones(3))
    start = one(vehicle.state)
    held = np.zeros((3, 4))
    _, attitude_error = errors(fly(vehicle, held), solve(config, start, held, 0.01))
    assert attitude_error < 1e-4
    assert vehicle.effort.redone_count.tolist() == [3]


@pytest.mark.parametrize("tau_s", [5e-3, 1e-6])
@pytest.mark.parametrize("integrator", ["rkmk4", "dormand_prince"])
def test_ordinary_flight_needs_no_second_try(integrator, tau_s, device):
    config = preset("hummingbird", motor_time_constant_s=tau_s)
    vehicle = Multirotor(config, device=device, integrator=integrator)
    start = one(vehicle.state)
    position_error, attitude_error = errors(fly(vehicle, commands()), solve(config, start, commands(), 0.01))
    assert position_error < 1e-8
    assert attitude_error < 1e-7
    assert vehicle.effort.redone_count.tolist() == [0]
    assert (vehicle.effort.evaluation_count[0] > 0) == (integrator == "dormand_prince")


def mixed_batch(device: str) -> tuple[MultirotorConfig, MultirotorState, Multirotor]:
    """Five vehicles; fixed steps do for all but number 2, which enters the air at 100 km/s."""
    config = HUMMINGBIRD
    rng = np.random.default_rng(4)
    q = rng.normal(size=(5, 4))
    states = MultirotorState(
        rng.normal(size=(5, 3)),
        5.0 * rng.normal(size=(5, 3)),
        q / np.linalg.norm(q, axis=1, keepdims=True),
        5.0 * rng.normal(size=(5, 3)),
        rng.uniform(0.0, 1500.0, (5, 4)),
    )
    states.velocity[2] = (1e5, 0.0, 0.0)
    batch = Multirotor(config, count=5, device=device)
    batch.reset(*states)
    return config, states, batch


def test_a_redone_vehicle_does_not_touch_the_others(device):
    config, states, batch = mixed_batch(device)
    batch.step(np.full(4, 500.0), 10 * MS)
    assert (batch.effort.redone_count > 0).tolist() == [False, False, True, False, False]
    assert batch.arrays.stamp_ns.numpy().tolist() == 5 * [10 * MS]
    for index in range(5):
        single = Multirotor(config, device=device)
        single.reset(*(rows[index] for rows in states))
        single.step(np.full(4, 500.0), 10 * MS)
        for together, alone in zip(batch.state, single.state, strict=True):
            assert np.array_equal(together[index], alone[0])
        assert batch.effort.evaluation_count[index] == single.effort.evaluation_count[0]


def test_redone_intervals_can_be_captured(device):
    """No decision on the host: a graph redoes what it must each time it is replayed."""
    if device == "cpu":
        pytest.skip("graphs are captured on CUDA devices")
    _, states, replayed = mixed_batch(device)
    _, _, launched = mixed_batch(device)
    for vehicle in (replayed, launched):
        vehicle.advance(MS)
        vehicle.reset(*states)
    with wp.ScopedCapture(device=device) as capture:
        replayed.advance(MS)
    for _ in range(3):
        wp.capture_launch(capture.graph)
        launched.advance(MS)
    for a, b in zip(replayed.state, launched.state, strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(replayed.effort.redone_count, launched.effort.redone_count)
    assert replayed.effort.redone_count[2] > 0


def test_a_redone_interval_is_that_of_adaptive_steps(device):
    """It is restored to its beginning: nothing of the fixed steps that came before the guard is left."""
    ends = []
    for integrator in ("rkmk4", "dormand_prince"):
        vehicle = Multirotor(preset("hummingbird", **FEATHER), device=device, integrator=integrator)
        vehicle.step(np.full(4, 1.0), 5 * MS)
        ends.append(vehicle.state)
        assert vehicle.effort.redone_count[0] == (integrator == "rkmk4")
    for redone, adaptive in zip(*ends, strict=True):
        assert redone == pytest.approx(adaptive, rel=1e-13, abs=1e-15)  # compiled apart


def test_a_run_counts_redone_intervals(caplog, device):
    settings = {
        "device": device,
        "scene": {"kind": "hall", "size_m": [8, 6, 3]},
        "vehicle": {"parameters": {"inertia_kg_m2": scaled_inertia(1e-4)}},
        "sensors": {"odometry": {"kind": "odometry", "rate_hz": 100}},
        "path": {"kind": "hover"},
    }
    for stiff in (False, True):
        config = load_config(settings if stiff else {**settings, "vehicle": {}})
        model = sim.make_model(config)
        state = sim.make_state(model)
        with caplog.at_level(logging.INFO, logger="neurosim_core"):
            for _ in range(3):
                sim.step(model, state, [500.0, 520.0, 480.0, 510.0])
        assert (state.counts["redone intervals"] > 0) == stiff
        assert state.counts["redone intervals"] == state.vehicle.effort.redone_count.sum()
    assert [record.getMessage() for record in caplog.records if "redone" in record.getMessage()] == [
        "vehicle: steps of 1 ms are too long at times; such intervals are redone with adaptive steps"
    ]


# Tolerance


def test_error_falls_with_the_tolerance(device):
    """Order 5: a hundredth of the tolerance costs 100^(1/5) = 2.5 times the evaluations."""
    rng = np.random.default_rng(3)
    held = rng.choice([300.0, 900.0], (2, 4))
    start = {"velocity": (4.0, 1.0, -2.0), "body_rate": (6.0, -4.0, 3.0)}
    found = []
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        vehicle = Multirotor(HUMMINGBIRD, device=device, rtol=rtol, atol=1e-2 * rtol, **ADAPTIVE)
        vehicle.reset(**start)
        exact = solve(HUMMINGBIRD, one(vehicle.state), held, 0.1)
        flown = fly(vehicle, held, 100 * MS)
        found.append((*errors(flown, exact), vehicle.effort.evaluation_count[0]))
    position_error, attitude_error, evaluation_count = np.array(found).T
    for error in (position_error, attitude_error):
        assert (error[1:] < 0.1 * error[:-1]).all()  # two decades less tolerance, at least one less error
    assert attitude_error[-1] < 1e-8
    assert evaluation_count[-1] / evaluation_count[-2] == pytest.approx(100.0 ** (1 / 5), rel=0.25)


def test_rotation_about_an_axis_takes_few_steps(device):
    """The chart is exact there, so steps grow to two radians each."""
    vehicle = Multirotor(preset("hummingbird", **ISOLATED), device=device, **ADAPTIVE)
    vehicle.reset(body_rate=(0.0, 100.0, 0.0))
    vehicle.step(np.zeros(4), 200 * MS)
    half = 0.5 * 100.0 * 0.2
    q = vehicle.state.orientation[0]
    assert np.abs(q @ [0.0, np.sin(half), 0.0, np.cos(half)]) == pytest.approx(1.0, abs=1e-14)
    assert vehicle.effort.evaluation_count[0] <= 6 * 14 + 1  # 20 rad in 2 rad each, and growing to it


def test_the_world_may_be_moved(device):
    """Displacements are controlled, not positions: far from the origin nothing is sloppier."""
    ends = []
    for shift in (0.0, 2.0**20):
        vehicle = Multirotor(HUMMINGBIRD, device=device, **ADAPTIVE)
        vehicle.reset(position=(shift, 0.0, 0.0), body_rate=(6.0, -4.0, 3.0))
        fly(vehicle, commands())
        ends.append(one(vehicle.state))
    assert np.array_equal(ends[0].velocity, ends[1].velocity)
    assert ends[1].position[0] - 2.0**20 == pytest.approx(ends[0].position[0], abs=1e-8)  # 2^20 has 1e-10


def test_motor_lag_is_exact_in_adaptive_steps(device):
    vehicle = Multirotor(HUMMINGBIRD, device=device, **ADAPTIVE)
    vehicle.reset(rotor_speed=(100.0, 200.0, 300.0, 400.0))
    vehicle.step((500.0, 100.0, 300.0, 0.0), 7 * MS)
    first, held = np.array([100.0, 200.0, 300.0, 400.0]), np.array([500.0, 100.0, 300.0, 0.0])
    expected = held + (first - held) * np.exp(-7.0 / 5.0)
    assert vehicle.state.rotor_speed[0] == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_command_is_held_by_adaptive_steps(bad, device):
    vehicle = Multirotor(HUMMINGBIRD, device=device, **ADAPTIVE)
    vehicle.arrays.rotor_speed_command.assign(np.array([[500.0, bad, 500.0, 500.0]]))
    vehicle.advance(MS)
    with pytest.raises(DynamicsError, match="rotor_speed_command"):
        vehicle.check()
    assert vehicle.effort.evaluation_count.tolist() == [0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"integrator": "euler"}, r"integrator must be of \('rkmk4', 'dormand_prince'\), got 'euler'"),
        ({"rtol": 0.0}, r"rtol must be in \[1e-14, 0.1\], got 0.0"),
        ({"rtol": np.nan}, "rtol must be in"),
        ({"rtol": 0.2}, "rtol must be in"),
        ({"atol": 0.0}, "atol must be > 0 and finite, got 0.0"),
        ({"atol": np.inf}, "atol must be > 0"),
        ({"evaluation_count_max": 6}, "evaluation_count_max must be in"),
        ({"evaluation_count_max": 2**31}, "evaluation_count_max must be in"),
    ],
)
def test_settings_of_adaptive_steps_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        Multirotor(HUMMINGBIRD, **arguments)
