"""The ground: rest, bounce, slip and ground effect against closed forms; energy; and what makes it stiff."""

from __future__ import annotations

import numpy as np
import pytest
from multirotor_oracle import NO_AERO, angle, rotation_matrix, solve
from scipy.optimize import brentq

from neurosim_core import load_config, sim
from neurosim_core.packets import Collision, Odometry
from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import TERMS, GroundConfig, Multirotor, MultirotorConfig, MultirotorState, preset

MS = 1_000_000
HUMMINGBIRD = preset("hummingbird")
MASS, GRAVITY = HUMMINGBIRD.mass_kg, 9.81
OFF = np.zeros(4)
BALL = {"foot_position_m": ((0.0, 0.0, 0.0),)}
"""One foot at the centre of mass: no torque."""


def on(ground: GroundConfig | dict, **override) -> MultirotorConfig:
    return preset("hummingbird", **{**NO_AERO, "ground": ground, **override})


def landed(config: MultirotorConfig, device: str, **start) -> Multirotor:
    terms = (
        TERMS if "ground_effect" in config.terms() else preset("hummingbird", ground=GroundConfig()).terms()
    )
    vehicle = Multirotor(config, device=device, terms=terms)  # two sets of kernels for all
    vehicle.reset(**{"rotor_speed": OFF, **start})
    return vehicle


def one(state: MultirotorState) -> MultirotorState:
    return MultirotorState(*(rows[0] for rows in state))


def energy(config: MultirotorConfig, state: MultirotorState) -> float:
    """Of motion, height, and the springs under the feet [J]."""
    R, ground = rotation_matrix(state.orientation), config.ground
    feet = ground.foot_position_m or [(x, y, -0.05) for x, y, _ in config.rotor_position_m]
    depths = [max(0.0, ground.height_m - (state.position + R @ np.array(foot))[2]) for foot in feet]
    spin = state.body_rate @ np.array(config.inertia_kg_m2) @ state.body_rate
    moving = config.mass_kg * (state.velocity @ state.velocity)
    springs = ground.stiffness_n_m * (np.array(depths) ** 2).sum()
    return 0.5 * (moving + spin + springs) + config.mass_kg * GRAVITY * (state.position[2] - ground.height_m)


@pytest.mark.parametrize("stiffness_n_m", [500.0, 2000.0, 1e5, 1e7])
def test_comes_to_rest_where_springs_carry_the_weight(stiffness_n_m, device):
    """Dropped level from 2 cm: m g / (4 k) deep in the end, also where 1 ms is too long for it."""
    config = on(GroundConfig(height_m=1.5, stiffness_n_m=stiffness_n_m, damping_s_m=50.0))
    vehicle = landed(config, device, position=(0.3, -0.2, 1.57))
    vehicle.step(OFF, 3_000 * MS)
    state = one(vehicle.state)
    depth = MASS * GRAVITY / (4.0 * stiffness_n_m)
    assert state.position == pytest.approx([0.3, -0.2, 1.55 - depth], abs=1e-6)
    assert np.abs(state.velocity).max() < 1e-4
    assert np.abs(vehicle.acceleration.linear).max() < 0.1
    assert angle(state.orientation, np.array([0.0, 0.0, 0.0, 1.0])) < 1e-9


def test_bounces_to_the_height_it_fell_from(device):
    """A spring alone loses nothing: highest after each bounce where it began; period by closed form."""
    stiffness, drop_m = 3000.0, 0.2
    config = on(GroundConfig(stiffness_n_m=stiffness, damping_s_m=0.0, friction=0.0, **BALL))
    vehicle = landed(config, device, position=(0.0, 0.0, drop_m))
    fall_s = np.sqrt(2.0 * drop_m / GRAVITY)
    rate, sink = np.sqrt(stiffness / MASS), MASS * GRAVITY / stiffness
    # in contact: z + sink = sink cos - v / rate sin; until z = 0 again
    contact_s = 2.0 * (np.pi - np.arctan2(GRAVITY * fall_s / rate, sink)) / rate
    for _ in range(3):
        period_ns = round((2.0 * fall_s + contact_s) * 1e9)
        vehicle.step(OFF, period_ns)
        state = one(vehicle.state)
        assert state.position[2] == pytest.approx(drop_m, abs=2e-5)  # rtol 1e-6 of 2 m/s, a few steps
        assert abs(state.velocity[2]) < 2e-3


@pytest.mark.parametrize("speed_m_s", [0.1, 1.0, 5.0])
def test_restitution_of_hunt_and_crossley(speed_m_s, device):
    """Without gravity: c v - ln(1 + c v) is the same before and, with v < 0, after."""
    damping = 0.8
    config = on(GroundConfig(stiffness_n_m=2e4, damping_s_m=damping, **BALL), gravity_m_s2=0.0)
    vehicle = landed(config, device, position=(0.0, 0.0, 0.5e-3), velocity=(0.0, 0.0, -speed_m_s))
    vehicle.step(OFF, 60 * MS)

    def level(v):
        return damping * v - np.log1p(damping * v)

    rebound = -brentq(lambda v: level(v) - level(speed_m_s), -1.0 / damping + 1e-12, -1e-12)
    assert vehicle.state.velocity[0] == pytest.approx([0.0, 0.0, rebound], rel=1e-4)
    assert rebound < 0.95 * speed_m_s


def test_slides_to_a_stop(device):
    """Coulomb friction: dv/dt = -mu g v / sqrt(v^2 + u^2), so the way is the integral of sqrt(v^2 + u^2)."""
    mu, slip = 0.4, 0.02
    stiffness = 2000.0
    ground = GroundConfig(stiffness_n_m=stiffness, friction=mu, slip_speed_m_s=slip, **BALL)
    depth = MASS * GRAVITY / stiffness
    vehicle = landed(on(ground), device, position=(0.0, 0.0, -depth), velocity=(1.2, -0.9, 0.0))
    vehicle.step(OFF, 2_000 * MS)
    speed = 1.5
    root = np.hypot(speed, slip)
    way = 0.5 * (speed * root + slip**2 * np.arcsinh(speed / slip)) / (mu * GRAVITY)
    # stops exponentially, with u / (mu g) = 5 ms
    state = one(vehicle.state)
    assert state.position == pytest.approx([0.8 * way, -0.6 * way, -depth], abs=1e-6)
    assert np.abs(state.velocity).max() < 1e-8  # adaptive steps do not look closer


@pytest.mark.parametrize("damping_s_m", [0.0, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_energy_never_grows(seed, damping_s_m, device):
    """Thrown on its feet at random, tumbling, with friction."""
    rng = np.random.default_rng(seed)
    config = on(GroundConfig(stiffness_n_m=5000.0, damping_s_m=damping_s_m, height_m=-0.5))
    q = rng.normal(size=4)
    vehicle = landed(
        config,
        device,
        position=(0.0, 0.0, 0.0),
        velocity=rng.normal(size=3),
        orientation=q,
        body_rate=6.0 * rng.normal(size=3),
    )
    before = first = energy(config, one(vehicle.state))
    for _ in range(1_500):
        vehicle.step(OFF, MS)
        now = energy(config, one(vehicle.state))
        assert now <= before + 1e-5 * first  # adaptive steps: 1e-6 of the speeds in each
        before = now
    assert before < 0.9 * first


def test_lands_and_lies_still(device):
    """Tilted and sliding, with drag and damping: in the end everything stands, and stays."""
    vehicle = Multirotor(preset("hummingbird", ground=GroundConfig()), device=device)
    vehicle.reset(
        position=(0.0, 0.0, 0.3),
        velocity=(0.5, 0.2, 0.0),
        orientation=(0.15, -0.1, 0.2, 0.95),
        body_rate=(0.5, 0.3, -1.0),
    )
    vehicle.step(OFF, 6_000 * MS)
    state = one(vehicle.state)
    up = rotation_matrix(state.orientation)[:, 2]
    assert up == pytest.approx([0.0, 0.0, 1.0], abs=1e-4)
    assert state.position[2] == pytest.approx(0.05 - MASS * GRAVITY / 8000.0, abs=1e-5)
    assert np.abs(state.velocity).max() < 1e-3
    assert np.abs(state.body_rate).max() < 1e-3


@pytest.mark.parametrize("integrator", ["rkmk4", "dormand_prince"])
def test_touch_down_against_the_second_multirotor(integrator, device):
    """Two feet first, drag, wind, rotors running, ground effect: against Radau at 1e-11."""
    config = preset(
        "hummingbird", ground=GroundConfig(rotor_radius_m=0.1), flapping_kg_m=1e-5, wind_m_s=(2.0, 1.0, 0.0)
    )
    vehicle = Multirotor(config, device=device, integrator=integrator, terms=TERMS)
    vehicle.reset(
        position=(0.0, 0.0, 0.08),
        velocity=(0.3, 0.1, -1.0),
        orientation=(0.1, -0.05, 0.3, 0.95),
        rotor_speed=np.full(4, 300.0),
    )
    start = one(vehicle.state)
    held = np.full((5, 4), 350.0)
    for expected in solve(config, start, held, 0.01, stiff=True):
        vehicle.step(held[0], 10 * MS)
        state = one(vehicle.state)
        assert state.position == pytest.approx(expected.position, abs=2e-6)
        assert angle(state.orientation, expected.orientation) < 2e-5
    assert vehicle.state.position[0, 2] < 0.06  # it did touch down


@pytest.mark.parametrize("heights", [0.01, 0.25, 0.5, 0.75, 1.0, 2.0, 4.0])
def test_ground_effect_of_cheeseman_and_bennett(heights, device):
    """T / T_free = 1 / (1 - (R / 4 z)^2) from z = R / 2 up, 4 / 3 below; torque stays."""
    radius = 0.12
    config = on(GroundConfig(height_m=-3.0, rotor_radius_m=radius, **BALL))
    vehicle = landed(
        config, device, position=(0.0, 0.0, heights * radius - 3.0), rotor_speed=(400.0, 500.0, 300.0, 350.0)
    )
    squared = np.square([400.0, 500.0, 300.0, 350.0])
    gain = 1.0 / (1.0 - (0.25 / max(heights, 0.5)) ** 2)
    thrust = gain * config.thrust_coefficient_n_s2 * squared
    x, y, _ = np.array(config.rotor_position_m).T
    found = vehicle.acceleration
    assert found.linear[0, 2] == pytest.approx(thrust.sum() / MASS - GRAVITY, rel=1e-13)
    yaw = config.torque_coefficient_n_m_s2 * (squared * config.rotor_direction).sum()
    torque = [(thrust * y).sum(), -(thrust * x).sum(), yaw]
    assert found.angular[0] == pytest.approx(torque / np.diag(config.inertia_kg_m2), rel=1e-12)


def test_one_that_stands_does_not_touch_one_that_flies(device):
    config = preset("hummingbird", ground=GroundConfig(stiffness_n_m=1e7))
    positions = np.array([[0.0, 0.0, 0.04], [0.0, 0.0, 5.0], [1.0, 0.0, 0.0499]])
    batch = Multirotor(config, count=3, device=device)
    batch.reset(position=positions)
    batch.step(np.full(4, 300.0), 30 * MS)
    assert (batch.effort.redone_count > 0).tolist() == [True, False, True]
    for index in range(3):
        single = Multirotor(config, device=device)
        single.reset(position=positions[index])
        single.step(np.full(4, 300.0), 30 * MS)
        for together, alone in zip(batch.state, single.state, strict=True):
            assert np.array_equal(together[index], alone[0])


# In a run, with all other settings at their defaults


def start_run(**start) -> tuple[sim.Model, sim.State]:
    settings = {
        "device": "cpu",
        "duration_s": 6.0,
        "scene": {"kind": "hall", "size_m": [8, 6, 3]},
        "vehicle": {"parameters": {"ground": {"height_m": 0.0}}},
        "path": {"kind": "hover"},
        "sensors": {"odometry": {"kind": "odometry", "rate_hz": 100}},
    }
    model = sim.make_model(load_config(settings))
    return model, sim.make_state(model, start=sim.StartState(**start))


def fly_run(model, state, speed_rad_s: float, until_s: float) -> list:
    packets = []
    while state.stamp_ns < until_s * 1e9 and not state.ended:
        packets += sim.step(model, state, np.full(4, speed_rad_s), mode="motor_speeds")
    return packets


def test_a_run_lands_rests_and_takes_off():
    """From hover to the floor, motors off: feet carry the weight, and it is no collision."""
    model, state = start_run()
    packets = fly_run(model, state, 0.0, 3.0)
    assert not any(isinstance(packet, Collision) for packet in packets)
    assert state.stamp_ns == 3_000 * MS
    rest = [packet for packet in packets if isinstance(packet, Odometry)][-1]
    sunk = MASS * GRAVITY / (4.0 * GroundConfig().stiffness_n_m)
    foot_m = HUMMINGBIRD.rotor_position_m[0][2] - 0.05
    assert rest.position[2] == pytest.approx(-foot_m - sunk, abs=1e-5)
    assert np.linalg.norm(rest.velocity) < 1e-3
    hover = HUMMINGBIRD.hover_rotor_speed_rad_s
    packets = fly_run(model, state, 1.1 * hover, 4.0)
    assert not any(isinstance(packet, Collision) for packet in packets)
    assert packets[-1].position[2] > 0.4


def test_a_run_below_the_ground_is_refused():
    ground = {"height_m": 50.0, "rotor_radius_m": 0.1}
    path = {"kind": "hover", "position_m": [0, 0, 1.2]}
    config = load_config({"vehicle": {"parameters": {"ground": ground}}, "path": path, "scene": {"rooms": 1}})
    with pytest.raises(ValueError, match=r"the path begins at z = 1.2 m, below the ground at 50 m"):
        sim.plan_paths(config)


def test_walls_still_end_a_run_with_a_ground():
    model, state = start_run(velocity=(5.0, 0.0, 0.0))
    packets = fly_run(model, state, HUMMINGBIRD.hover_rotor_speed_rad_s, 5.0)
    assert isinstance(packets[-1], Collision)
    assert packets[-1].position[2] > 0.3
    assert state.ended


def test_high_above_the_ground_nothing_changes(device):
    ends = []
    for ground in (None, GroundConfig(height_m=-100.0)):
        vehicle = Multirotor(preset("hummingbird", ground=ground), device=device)
        vehicle.reset(body_rate=(1.0, 2.0, 3.0))
        vehicle.step((500.0, 520.0, 480.0, 510.0), 100 * MS)
        ends.append(np.concatenate(one(vehicle.state)))
        assert vehicle.effort.redone_count.tolist() == [0]
    assert ends[1] == pytest.approx(ends[0], rel=1e-13, abs=1e-13)


def test_terms_of_the_ground():
    assert not {"ground", "ground_effect"} & set(HUMMINGBIRD.terms())
    assert {"ground", "ground_effect"} & set(on(GroundConfig()).terms()) == {"ground"}
    assert {"ground", "ground_effect"} <= set(on(GroundConfig(rotor_radius_m=0.1)).terms())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"height_m": np.nan}, "finite"),
        ({"stiffness_n_m": 0.0}, "greater than 0"),
        ({"stiffness_n_m": -1.0}, "greater than 0"),
        ({"stiffness_n_m": np.inf}, "finite"),
        ({"stiffness_n_m": 1e10}, "less than or equal to 1000000000"),
        ({"damping_s_m": -1.0}, "greater than or equal to 0"),
        ({"friction": -0.1}, "greater than or equal to 0"),
        ({"slip_speed_m_s": 0.0}, "greater than 0"),
        ({"rotor_radius_m": -0.1}, "greater than or equal to 0"),
        ({"foot_position_m": ()}, "at least 1 item"),
        ({"foot_position_m": ((0.0, np.inf, 0.0),)}, "finite"),
        ({"hardness": 1.0}, "hardness"),
    ],
)
def test_ground_is_checked(values, message):
    with pytest.raises(ConfigError, match=message):
        GroundConfig(**values)
