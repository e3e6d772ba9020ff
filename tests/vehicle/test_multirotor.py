"""The multirotor: equations, closed forms, batches, errors."""

from __future__ import annotations

import importlib
import pickle

import numpy as np
import pytest
import warp as wp
from multirotor_oracle import NO_AERO, derivative, rotation_matrix

from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import TERMS, DynamicsError, Multirotor, MultirotorConfig, MultirotorState, preset

MS = 1_000_000
ISOLATED = {"gravity_m_s2": 0.0, "thrust_coefficient_n_s2": 0.0, "torque_coefficient_n_m_s2": 0.0, **NO_AERO}
"""A body on which nothing acts."""


def random_states(config: MultirotorConfig, count: int, seed: int = 0) -> MultirotorState:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    low, high = config.rotor_speed_min_rad_s, config.rotor_speed_max_rad_s
    return MultirotorState(
        rng.normal(size=(count, 3)),
        10.0 * rng.normal(size=(count, 3)),
        q / np.linalg.norm(q, axis=1, keepdims=True),
        5.0 * rng.normal(size=(count, 3)),
        rng.uniform(low, high, (count, config.rotor_count)),
    )


def row(state: MultirotorState, index: int = 0) -> MultirotorState:
    return MultirotorState(*(rows[index] for rows in state))


def relative(value, reference) -> float:
    """Largest error against the largest component of each row."""
    return float(np.max(np.abs(value - reference).max(axis=1) / np.abs(reference).max(axis=1)))


# Equations


@pytest.mark.parametrize("aero", [True, False])
@pytest.mark.parametrize("name", ["crazyflie", "hummingbird"])
def test_derivatives_equal_rotorpys(name, aero, device):
    rotorpy = pytest.importorskip("rotorpy.vehicles.multirotor")
    table = dict(importlib.import_module(f"rotorpy.vehicles.{name}_params").quad_params, k_flap=1e-4)
    wind = (3.0, -2.0, 1.0)
    config = preset(
        name,
        mass_kg=table["mass"],
        inertia_kg_m2=tuple(map(tuple, np.diag([table["Ixx"], table["Iyy"], table["Izz"]]).tolist())),
        rotor_position_m=tuple(tuple(p.tolist()) for p in table["rotor_pos"].values()),
        torque_coefficient_n_m_s2=table["k_m"],
        motor_time_constant_s=table["tau_m"],
        **({"flapping_kg_m": 1e-4, "wind_m_s": wind, "rotor_drag_kg": table["k_d"]} if aero else NO_AERO),
    )
    oracle = rotorpy.Multirotor(table, aero=aero)
    states = random_states(config, 50)
    vehicle = Multirotor(config, count=50, device=device, terms=TERMS)
    vehicle.reset(*states)
    rates = np.array(
        [
            oracle._s_dot_fn(0.0, np.concatenate([p, v, q, w, wind, speed]), speed)
            for p, v, q, w, speed in zip(*states, strict=True)
        ]
    )
    acceleration = vehicle.acceleration
    assert relative(acceleration.linear, rates[:, 3:6]) < 1e-12
    assert relative(acceleration.angular, rates[:, 10:13]) < 1e-12


def test_derivatives_of_an_odd_airframe(device):
    """Six rotors out of the plane, off the centre, full inertia: against the rotor-by-rotor equations."""
    rng = np.random.default_rng(5)
    config = preset(
        "hummingbird",
        inertia_kg_m2=((4e-3, 3e-4, -2e-4), (3e-4, 5e-3, 1e-4), (-2e-4, 1e-4, 6e-3)),
        rotor_position_m=tuple(map(tuple, rng.normal(scale=0.2, size=(6, 3)))),
        rotor_direction=(1, -1, 1, -1, 1, 1),
        flapping_kg_m=1e-4,
        wind_m_s=(5.0, 1.0, -2.0),
    )
    states = random_states(config, 20)
    vehicle = Multirotor(config, count=20, device=device, terms=TERMS)
    vehicle.reset(*states)
    assert set(TERMS) - set(config.terms()) == {"turbulence", "ground", "ground_effect"}
    rates = np.array([derivative(config, np.concatenate([*s[:4]]), s[4]) for s in zip(*states, strict=True)])
    assert relative(vehicle.acceleration.linear, rates[:, 3:6]) < 1e-12
    assert relative(vehicle.acceleration.angular, rates[:, 10:13]) < 1e-12


def test_the_two_oracles_agree():
    """Ours, which the integrator is tested with, has RotorPy's quaternion rate too."""
    rotorpy = pytest.importorskip("rotorpy.vehicles.multirotor")
    table = importlib.import_module("rotorpy.vehicles.hummingbird_params").quad_params
    config = preset("hummingbird")
    for s in zip(*random_states(config, 5), strict=True):
        theirs = rotorpy.Multirotor(table)._s_dot_fn(0.0, np.concatenate([*s[:4], np.zeros(3), s[4]]), s[4])
        assert derivative(config, np.concatenate(s[:4]), s[4]) == pytest.approx(
            theirs[:13], rel=1e-12, abs=1e-12
        )


# Closed forms


def test_hover_is_a_fixed_point(device):
    vehicle = Multirotor(preset("hummingbird"), device=device)
    vehicle.step(np.full(4, vehicle.config.hover_rotor_speed_rad_s), 10_000 * MS)
    state = row(vehicle.state)
    # the hover speed is rounded: 1e-16 g for 10 s is 5e-14 m; the rest is rounding of 10,000 steps
    assert np.abs(state.position).max() < 1e-11
    assert np.abs(state.velocity).max() < 1e-11
    # fused multiply-adds on CUDA leave a torque of rounding size, and 1.1e-14 after 10,000 steps
    assert state.orientation == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=2e-14)


def test_free_fall_is_exact(device):
    vehicle = Multirotor(preset("hummingbird", **{**ISOLATED, "gravity_m_s2": 9.81}), device=device)
    vehicle.reset(position=(1.0, 2.0, 3.0), velocity=(4.0, 5.0, 6.0))
    vehicle.step(np.zeros(4), 2_000 * MS)
    state = row(vehicle.state)
    assert state.position == pytest.approx([9.0, 12.0, 3.0 + 12.0 - 0.5 * 9.81 * 4.0], rel=1e-13)
    assert state.velocity == pytest.approx([4.0, 5.0, 6.0 - 2.0 * 9.81], rel=1e-13)


def test_fall_with_quadratic_drag(device):
    """Closed form: v = -v_t tanh(g t / v_t), z = -v_t^2 / g ln cosh(g t / v_t)."""
    config = preset(
        "hummingbird", **{**ISOLATED, "gravity_m_s2": 9.81, "parasitic_drag_kg_m": (0.01, 0.01, 0.05)}
    )
    vehicle = Multirotor(config, device=device)
    vehicle.step(np.zeros(4), 3_000 * MS)
    terminal = np.sqrt(config.mass_kg * 9.81 / 0.05)
    state = row(vehicle.state)
    assert state.velocity[2] == pytest.approx(-terminal * np.tanh(9.81 * 3.0 / terminal), rel=1e-12)
    assert state.position[2] == pytest.approx(
        -(terminal**2) / 9.81 * np.log(np.cosh(9.81 * 3.0 / terminal)), rel=1e-11
    )


def test_rotor_drag_decays_exponentially(device):
    """At constant rotor speed rotor drag is linear: v = v_0 exp(-k sum(Omega) t / m), per axis."""
    config = preset("hummingbird", **{**ISOLATED, "rotor_drag_kg": 1.2e-4, "rotor_inflow_kg": 2.3e-4})
    vehicle = Multirotor(config, device=device)
    vehicle.reset(velocity=(3.0, -4.0, 5.0), rotor_speed=np.full(4, 600.0))
    vehicle.step(np.full(4, 600.0), 1_000 * MS)
    rate = 4.0 * 600.0 / config.mass_kg * np.array([1.2e-4, 1.2e-4, 2.3e-4])
    # RK4 at 1 ms: (rate h)^5 / 120 for 1000 steps
    assert row(vehicle.state).velocity == pytest.approx(np.array([3.0, -4.0, 5.0]) * np.exp(-rate), rel=1e-11)


@pytest.mark.parametrize("rate_rad_s", [1e-3, 30.0, 400.0])
def test_rotation_about_a_principal_axis_is_exact(rate_rad_s, device):
    """Also where the angle in a step is large, 400 rad/s at 2 ms: the chart is the exponential."""
    vehicle = Multirotor(preset("hummingbird", **ISOLATED), device=device, max_step_ns=2 * MS)
    vehicle.reset(body_rate=(0.0, rate_rad_s, 0.0))
    vehicle.step(np.zeros(4), 100 * MS)
    half = 0.05 * rate_rad_s
    # each of 50 products rounds to 2e-16
    assert row(vehicle.state).orientation == pytest.approx([0.0, np.sin(half), 0.0, np.cos(half)], abs=1e-14)


def test_motor_lag_is_exact(device):
    vehicle = Multirotor(preset("hummingbird"), device=device)
    vehicle.reset(rotor_speed=(100.0, 200.0, 300.0, 400.0))
    vehicle.step((500.0, 100.0, 300.0, 0.0), 7 * MS)
    start, command = np.array([100.0, 200.0, 300.0, 400.0]), np.array([500.0, 100.0, 300.0, 0.0])
    expected = command + (start - command) * np.exp(-7.0 / 5.0)
    assert row(vehicle.state).rotor_speed == pytest.approx(expected, rel=1e-14)


# Properties


def test_flight_does_not_depend_on_heading_and_place(device):
    """Turned about the vertical, moved, and with it the wind: the same flight, turned and moved."""
    turn, shift = np.array([0.0, 0.0, np.sin(0.35), np.cos(0.35)]), np.array([100.0, -50.0, 20.0])
    R = rotation_matrix(turn)
    wind = np.array([4.0, 1.0, -1.0])
    ends = []
    for moved in (False, True):
        config = preset("hummingbird", wind_m_s=tuple(R @ wind if moved else wind))
        s = random_states(config, 8)
        if moved:
            q = s.orientation
            x, y, z, w = turn
            left = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
            s = s._replace(
                position=s.position @ R.T + shift, velocity=s.velocity @ R.T, orientation=q @ left.T
            )
        vehicle = Multirotor(config, count=8, device=device)
        vehicle.reset(*s)
        vehicle.step(np.linspace(400.0, 600.0, 4), 100 * MS)
        ends.append(vehicle.state)
    assert ends[1].position == pytest.approx(ends[0].position @ R.T + shift, abs=1e-11)
    assert ends[1].body_rate == pytest.approx(ends[0].body_rate, abs=1e-10)


def test_batch_equals_single_vehicles_bitwise(device):
    config = preset("hummingbird")
    states = random_states(config, 7)
    command = np.random.default_rng(1).uniform(0.0, 1500.0, (7, 4))
    batch = Multirotor(config, count=7, device=device)
    batch.reset(*states)
    batch.step(command, 25 * MS)
    for index in range(7):
        single = Multirotor(config, device=device)
        single.reset(*row(states, index))
        single.step(command[index], 25 * MS)
        for together, alone in zip(row(batch.state, index), row(single.state), strict=True):
            assert np.array_equal(together, alone)


def test_reset_repeats_the_flight_bitwise(device):
    vehicle = Multirotor(preset("crazyflie"), device=device)
    ends = []
    for _ in range(2):
        vehicle.reset(body_rate=(1.0, 2.0, 3.0))
        vehicle.step(np.array([1700.0, 1800.0, 1750.0, 1790.0]), 33 * MS)
        ends.append(np.concatenate(row(vehicle.state)))
        assert vehicle.stamp_ns == 33 * MS
    assert np.array_equal(*ends)


def test_split_of_a_duration_changes_rounding_only(device):
    ends = []
    for parts in (1, 10):
        vehicle = Multirotor(preset("hummingbird"), device=device)
        vehicle.reset(body_rate=(1.0, 2.0, 3.0))
        for _ in range(parts):
            vehicle.step((500.0, 520.0, 480.0, 510.0), 10 * MS // parts)
        ends.append(np.concatenate(row(vehicle.state)))
        assert vehicle.stamp_ns == 10 * MS
        assert vehicle.arrays.stamp_ns.numpy().tolist() == [10 * MS]
    assert ends[1] == pytest.approx(ends[0], rel=1e-13, abs=1e-13)


def test_steps_are_equal_and_no_longer_than_allowed(device):
    """2.4 ms in steps of at most 1 ms are three steps of 0.8 ms."""
    ends = []
    for max_step_ns in (MS, 800_000):
        vehicle = Multirotor(preset("hummingbird"), device=device, max_step_ns=max_step_ns)
        vehicle.reset(body_rate=(1.0, 2.0, 3.0))
        vehicle.step(np.full(4, 500.0), 2_400_000)
        ends.append(np.concatenate(row(vehicle.state)))
    assert np.array_equal(*ends)


def test_terms_that_are_not_needed_are_left_out(device):
    assert Multirotor(preset("hummingbird"), device=device).terms == (
        "motor_lag", "rotor_drag", "translational_lift", "parasitic_drag",
    )  # fmt: skip
    assert preset("crazyflie").terms() == preset("hummingbird").terms()  # one set of kernels
    assert Multirotor(preset("racer", motor_time_constant_s=0.0), device=device).terms == ()


@pytest.mark.parametrize(
    "config", [preset("hummingbird"), preset("racer"), preset("racer", motor_time_constant_s=0.0)]
)
def test_reduced_kernel_equals_the_full_one(config, device):
    ends = []
    for terms in (None, TERMS):
        vehicle = Multirotor(config, count=5, device=device, terms=terms)
        vehicle.reset(*random_states(config, 5))
        vehicle.step(np.linspace(500.0, 800.0, 4), 50 * MS)
        ends.append(np.concatenate(vehicle.state, axis=1))
    assert ends[1] == pytest.approx(ends[0], rel=1e-13, abs=1e-13)


def test_commands_saturate_at_the_range_of_the_rotors(device):
    ends = []
    for command in ((1e5, -1e5, 500.0, 0.0), (1500.0, 0.0, 500.0, 0.0)):
        vehicle = Multirotor(preset("hummingbird"), device=device)
        vehicle.step(command, 20 * MS)
        ends.append(np.concatenate(row(vehicle.state)))
    assert np.array_equal(*ends)


def test_many_durations_stay_right(device):
    """More durations than launches are kept."""
    vehicle = Multirotor(preset("hummingbird"), device=device)
    total = 0
    for _ in range(2):
        for extra in range(70):
            vehicle.step(np.full(4, 500.0), MS + extra)
            total += MS + extra
    assert vehicle.stamp_ns == vehicle.arrays.stamp_ns.numpy()[0] == total


# What goes wrong


def stiff() -> MultirotorConfig:
    """3 mg in a storm: quadratic drag that no explicit step of 1 ms can resolve."""
    return preset("hummingbird", mass_kg=3e-6, wind_m_s=(100.0, 0.0, 0.0))


def test_what_adaptive_steps_cannot_resolve_is_held_at_the_last_good_state(device):
    vehicle = Multirotor(stiff(), device=device, evaluation_count_max=50)
    vehicle.reset(position=(1.0, 2.0, 3.0), velocity=(100.0, 0.0, 0.0))
    vehicle.step(np.zeros(4), 20_000)  # with the wind: not stiff yet, the drag falls with the air speed
    good = row(vehicle.state)
    with pytest.raises(DynamicsError, match="velocity") as caught:
        vehicle.step(np.full(4, 500.0), 50 * MS)
    error = caught.value
    assert (error.vehicle, error.term, error.stamp_ns) == (0, "velocity", 20_000)
    assert all(np.array_equal(held, before) for held, before in zip(error.state, good, strict=True))
    assert vehicle.effort.redone_count.tolist() == [1]
    assert 50 <= vehicle.effort.evaluation_count[0] < 57  # a step has six
    copy = pickle.loads(pickle.dumps(error))
    assert (copy.stamp_ns, copy.term) == (error.stamp_ns, error.term)
    with pytest.raises(DynamicsError):
        vehicle.step(np.zeros(4), MS)
    assert np.array_equal(row(vehicle.state).position, error.state.position)
    vehicle.reset()
    vehicle.check()
    assert vehicle.effort == ([0], [0])


def test_overflow_of_the_body_rate_is_held(device):
    config = preset("hummingbird", **ISOLATED)
    vehicle = Multirotor(config, device=device)
    vehicle.reset(body_rate=(1e160, 1e160, 20.0))
    with pytest.raises(DynamicsError) as caught:
        vehicle.step(np.zeros(4), 50 * MS)
    assert (caught.value.term, caught.value.stamp_ns) == ("body_rate", 0)
    assert np.array_equal(row(vehicle.state).body_rate, [1e160, 1e160, 20.0])


@pytest.mark.parametrize("tau_s", [0.005, 0.0])
def test_one_bad_vehicle_does_not_touch_the_others(tau_s, device):
    config = preset("hummingbird", motor_time_constant_s=tau_s)
    states = random_states(config, 5)
    states.velocity[2] = (1e200, 0.0, 0.0)  # finite, but its drag is not
    batch = Multirotor(config, count=5, device=device)
    batch.reset(*states)
    with pytest.raises(DynamicsError) as caught:
        batch.step(np.full(4, 500.0), 10 * MS)
    assert (caught.value.vehicle, caught.value.stamp_ns) == (2, 0)
    assert np.array_equal(batch.state.rotor_speed[2], states.rotor_speed[2])
    assert batch.arrays.stamp_ns.numpy().tolist() == [10 * MS, 10 * MS, 0, 10 * MS, 10 * MS]
    for index in (0, 1, 3, 4):
        single = Multirotor(config, device=device)
        single.reset(*row(states, index))
        single.step(np.full(4, 500.0), 10 * MS)
        assert np.array_equal(np.concatenate(row(batch.state, index)), np.concatenate(row(single.state)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_command_on_the_device_holds_the_vehicle(bad, device):
    vehicle = Multirotor(preset("hummingbird"), count=2, device=device)
    before = vehicle.state
    vehicle.arrays.rotor_speed_command.assign(np.array([[500.0] * 4, [500.0, bad, 500.0, 500.0]]))
    vehicle.advance(5 * MS)
    with pytest.raises(DynamicsError, match="rotor_speed_command") as caught:
        vehicle.check()
    assert (caught.value.vehicle, caught.value.stamp_ns) == (1, 0)
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(vehicle.state, before, strict=True))
    assert vehicle.state.position[0, 2] != 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.full(4, np.nan), MS), "rotor_speed_command must be finite"),
        ((np.full(3, 500.0), MS), r"rotor_speed_command must have shape \[1, 4\]"),
        ((np.full((2, 4), 500.0), MS), "rotor_speed_command must have shape"),
        ((np.full(4, 500.0), 0), "duration_ns must be > 0, got 0"),
        ((np.full(4, 500.0), -5), "duration_ns must be > 0, got -5"),
    ],
)
def test_step_refuses(arguments, message, device):
    vehicle = Multirotor(preset("hummingbird"), device=device)
    before = vehicle.state
    with pytest.raises(ValueError, match=message):
        vehicle.step(*arguments)
    assert all(np.array_equal(a, b) for a, b in zip(vehicle.state, before, strict=True))


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"position": (np.nan, 0.0, 0.0)}, "position must be finite"),
        ({"velocity": (1.0, 2.0)}, "velocity must have shape"),
        ({"orientation": (0.0, 0.0, 0.0, 0.0)}, "orientation must not be 0"),
        ({"rotor_speed": np.full(4, 1788.53)}, r"rotor_speed must be in \[0, 1500\] rad/s"),
        ({"rotor_speed": np.full(4, -1.0)}, "rotor_speed must be in"),
    ],
)
def test_reset_refuses(state, message, device):
    with pytest.raises(ValueError, match=message):
        Multirotor(preset("hummingbird"), device=device).reset(**state)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ({"mass_kg": 0.0}, "mass_kg"),
        ({"mass_kg": np.nan}, "mass_kg"),
        ({"motor_time_constant_s": -1e-3}, "motor_time_constant_s"),
        ({"rotor_drag_kg": -1e-9}, "rotor_drag_kg"),
        ({"inertia_kg_m2": ((1, 0, 0), (0, 1, 0), (0, 0, 3))}, "no body has principal moments"),
        ({"inertia_kg_m2": ((1, 0, 0), (0, 1, 0), (0, 0, -1))}, "positive definite"),
        ({"inertia_kg_m2": ((1, 0.1, 0), (0, 1, 0), (0, 0, 1))}, "symmetric"),
        ({"rotor_direction": (1, -1, 1)}, "one entry for each rotor, got 4 and 3"),
        ({"rotor_direction": (1, -1, 1, 0)}, "rotor_direction"),
        ({"rotor_position_m": (), "rotor_direction": ()}, "one entry for each rotor"),
        ({"rotor_speed_min_rad_s": 2000.0}, "rotor_speed_min_rad_s must be below"),
        ({"mass": 1.0}, "mass"),
    ],
)
def test_parameters_are_checked(override, message):
    with pytest.raises(ConfigError, match=message):
        preset("hummingbird", **override)


def test_unknown_airframe_lists_the_known():
    with pytest.raises(ValueError, match=r"'drone', known: \['crazyflie', 'hummingbird', 'racer'\]"):
        preset("drone")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, r"count must be in \[1, 2147483647\], got 0"),
        ({"max_step_ns": 0}, r"max_step_ns must be in \[1, 1000000000000\], got 0"),
        ({"terms": ("motor_lag",)}, "terms must hold"),
        ({"terms": (*TERMS, "moon")}, "terms must hold"),
    ],
)
def test_constructor_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        Multirotor(preset("hummingbird"), **arguments)


# Device form


def test_state_is_a_copy(device):
    vehicle = Multirotor(preset("hummingbird"), device=device)
    before = vehicle.state
    vehicle.step(np.full(4, 600.0), 10 * MS)
    assert before.velocity[0, 2] == 0.0


def test_device_form_equals_host_form(device):
    vehicles = [Multirotor(preset("hummingbird"), count=3, device=device) for _ in range(2)]
    command = np.array([500.0, 520.0, 480.0, 510.0])
    vehicles[0].step(command, 10 * MS)
    vehicles[1].arrays.rotor_speed_command.assign(np.tile(command, (3, 1)))
    vehicles[1].advance(10 * MS)
    for a, b in zip(vehicles[0].state, vehicles[1].state, strict=True):
        assert np.array_equal(a, b)


def test_device_form_can_be_captured(device):
    if device == "cpu":
        pytest.skip("graphs are captured on CUDA devices")
    replayed, launched = (Multirotor(preset("hummingbird"), count=3, device=device) for _ in range(2))
    for vehicle in (replayed, launched):
        vehicle.advance(MS)  # compiles, and records the launches
        vehicle.accelerate()
        vehicle.reset(body_rate=(1.0, 2.0, 3.0))
    with wp.ScopedCapture(device=device) as capture:
        replayed.advance(MS)
        replayed.accelerate()
    for _ in range(20):
        wp.capture_launch(capture.graph)
        launched.advance(MS)
    for a, b in zip(replayed.state, launched.state, strict=True):
        assert np.array_equal(a, b)
    assert replayed.arrays.stamp_ns.numpy().tolist() == 3 * [20 * MS]


def test_a_duration_is_an_integer():
    vehicle = Multirotor(preset("hummingbird"))
    with pytest.raises(TypeError, match=r"duration_ns must be an integer, got 1\.5"):
        vehicle.step(np.full(4, 500.0), 1.5)
