"""Accuracy of the flight: against DOP853 at 1e-12, the Jacobi solution, and closed forms."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from multirotor_oracle import NO_AERO, angle, rotation_matrix, solve
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import ellipj

from neurosim_core.vehicle import Multirotor, MultirotorState, preset

HOLD_NS = 10_000_000


def one(state: MultirotorState) -> MultirotorState:
    """The only vehicle of a batch of one."""
    return MultirotorState(*(rows[0] for rows in state))


def fly(vehicle: Multirotor, commands, hold_ns: int = HOLD_NS) -> list[MultirotorState]:
    states = []
    for command in commands:
        vehicle.step(command, hold_ns)
        states.append(one(vehicle.state))
    return states


def figure_eight(t: float) -> dict[str, np.ndarray]:
    """A lemniscate that asks for 9.7 m/s, of which 9 are reached: flat output for RotorPy's controller."""
    ramp_s, rate = 2.0, 9.7 / (3.0 * np.sqrt(2.0))
    s = min(t / ramp_s, 1.0)
    phase = rate * (ramp_s * (s**3 - 0.5 * s**4) + max(t - ramp_s, 0.0))
    phase_1 = rate * (3 * s**2 - 2 * s**3)
    phase_2 = rate * (6 * s - 6 * s**2) / ramp_s
    path = 3.0 * np.array([np.sin(phase), 0.5 * np.sin(2 * phase), 0.0])
    d1 = 3.0 * np.array([np.cos(phase), np.cos(2 * phase), 0.0])
    d2 = 3.0 * np.array([-np.sin(phase), -2 * np.sin(2 * phase), 0.0])
    zero = np.zeros(3)
    return {
        "x": path,
        "x_dot": d1 * phase_1,
        "x_ddot": d2 * phase_1**2 + d1 * phase_2,
        "x_dddot": zero,
        "x_ddddot": zero,
        "yaw": 0.0,
        "yaw_dot": 0.0,
        "yaw_ddot": 0.0,
    }


def test_figure_eight_at_9_m_s(device):
    """Commands of RotorPy's SE(3) controller at 100 Hz, recorded in closed loop, then replayed by both."""
    theirs = pytest.importorskip("rotorpy.controllers.quadrotor_control")
    quad_params = importlib.import_module("rotorpy.vehicles.hummingbird_params").quad_params

    config = preset("hummingbird")
    vehicle = Multirotor(config, device=device)
    start = one(vehicle.state)
    controller = theirs.SE3Control(quad_params)
    commands, flown = [], []
    for k in range(500):
        s = one(vehicle.state)
        measured = {"x": s.position, "v": s.velocity, "q": s.orientation, "w": s.body_rate}
        commands.append(controller.update(0.01 * k, measured, figure_eight(0.01 * k))["cmd_motor_speeds"])
        flown += fly(vehicle, commands[-1:])
    exact = solve(config, start, commands, 0.01)
    assert max(np.linalg.norm(s.velocity) for s in flown) > 9.0  # the flight is the fast one that is meant
    assert max(np.linalg.norm(f.position - e.position) for f, e in zip(flown, exact, strict=True)) < 1e-6
    assert max(angle(f.orientation, e.orientation) for f, e in zip(flown, exact, strict=True)) < 1e-7


def test_flip_at_700_deg_s(device):
    """A crazyflie rolls over: up to speed, on, and down again, with motors that lag."""
    config = preset("crazyflie")
    vehicle = Multirotor(config, device=device)
    start = one(vehicle.state)
    hover = config.hover_rotor_speed_rad_s
    roll = np.array([1.0, -1.0, -1.0, 1.0])  # more lift on the left
    swing = np.concatenate([np.full(25, 0.08), np.zeros(20), np.full(30, -0.08)])
    commands = hover * (1.0 + swing[:, None] * roll)
    flown = fly(vehicle, commands)
    exact = solve(config, start, commands, 0.01)
    assert max(abs(s.body_rate[0]) for s in flown) > np.radians(700.0)
    assert max(np.linalg.norm(f.position - e.position) for f, e in zip(flown, exact, strict=True)) < 1e-10
    assert max(angle(f.orientation, e.orientation) for f, e in zip(flown, exact, strict=True)) < 1e-9
    assert vehicle.effort.redone_count.tolist() == [0]


def test_tumble_at_20_rad_s(device):
    """About all three axes for 2 s, rotors running at random."""
    config = preset("hummingbird")
    vehicle = Multirotor(config, device=device)
    vehicle.reset(body_rate=20.0 / np.sqrt(3.0) * np.array([1.0, -1.0, 1.0]))
    start = one(vehicle.state)
    spread = np.random.default_rng(11).uniform(-0.05, 0.05, (200, 4))
    commands = config.hover_rotor_speed_rad_s * (1.0 + spread)
    flown = fly(vehicle, commands)
    exact = solve(config, start, commands, 0.01)
    assert max(np.linalg.norm(f.position - e.position) for f, e in zip(flown, exact, strict=True)) < 1e-8
    assert max(angle(f.orientation, e.orientation) for f, e in zip(flown, exact, strict=True)) < 1e-8
    assert vehicle.effort.redone_count.tolist() == [0]


@pytest.mark.parametrize("tau_s", [1e-1, 1e-2, 5e-3, 1e-3, 5e-4, 3e-4, 1e-4, 1e-5, 1e-6, 0.0])
def test_any_motor_time_constant(tau_s, device):
    """0.2 s of random commands: no blow-up, no stiffness, and order 4 is not lost to a boundary layer."""
    config = preset("hummingbird", motor_time_constant_s=tau_s)
    vehicle = Multirotor(config, device=device)
    rng = np.random.default_rng(7)
    commands = config.hover_rotor_speed_rad_s * (1.0 + 0.1 * rng.uniform(-1.0, 1.0, (20, 4)))
    start = one(vehicle.state)
    error = [
        np.linalg.norm(f.position - e.position)
        for f, e in zip(fly(vehicle, commands), solve(config, start, commands, 0.01), strict=True)
    ]
    assert max(error) < 1e-8


@pytest.mark.parametrize("tau_s", [5e-3, 1e-3, 1e-4])
def test_bang_bang_commands_do_not_trip_the_guard(tau_s, device):
    """The lag between two extremes is steep within a step, but it is integrated exactly."""
    config = preset("hummingbird", motor_time_constant_s=tau_s)
    vehicle = Multirotor(config, device=device)
    extremes = np.random.default_rng(3).choice([0.0, 1500.0], (40, 4))
    assert np.isfinite(np.concatenate(fly(vehicle, extremes)[-1])).all()


def test_order_of_convergence_is_four(device):
    config = preset("hummingbird", motor_time_constant_s=0.02, wind_m_s=(3.0, -2.0, 1.0))
    start = MultirotorState(
        np.zeros(3),
        np.array([4.0, 1.0, -2.0]),
        np.array([0.1, -0.2, 0.3, 0.9]) / np.sqrt(0.95),
        np.array([6.0, -4.0, 3.0]),
        np.array([400.0, 500.0, 450.0, 480.0]),
    )
    command = np.array([520.0, 430.0, 510.0, 440.0])
    exact = solve(config, start, [command], 0.16)[0]
    steps_ms = np.array([10, 8, 5, 4])
    errors = []
    for step_ms in steps_ms:
        vehicle = Multirotor(config, device=device, max_step_ns=int(step_ms) * 1_000_000)
        vehicle.reset(*start)
        end = fly(vehicle, [command], 160_000_000)[0]
        errors.append(
            [np.linalg.norm(end.position - exact.position), angle(end.orientation, exact.orientation)]
        )
    slope_position, slope_attitude = np.polyfit(np.log(steps_ms), np.log(errors), 1)[0]
    assert slope_position == pytest.approx(4.0, abs=0.2)
    assert slope_attitude == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize(("step_ns", "tolerance"), [(1_000_000, 5e-9), (250_000, 2e-11)])
def test_torque_free_top_follows_jacobi(step_ns, tolerance, device):
    """Asymmetric top: rates are elliptic functions, precession about the momentum is their quadrature.

    The tolerances are three times what is measured; their ratio is that of order 4.
    """
    i1, i2, i3 = 1.0e-3, 2.0e-3, 2.5e-3
    w1, w3 = 6.0, 12.0  # starts with w2 = 0
    config = preset(
        "hummingbird",
        inertia_kg_m2=((i1, 0, 0), (0, i2, 0), (0, 0, i3)),
        gravity_m_s2=0.0,
        thrust_coefficient_n_s2=0.0,
        torque_coefficient_n_m_s2=0.0,
        **NO_AERO,
    )
    energy2 = i1 * w1**2 + i3 * w3**2
    momentum2 = (i1 * w1) ** 2 + (i3 * w3) ** 2
    assert momentum2 > energy2 * i2  # rotation about axis 3: w3 = dn, no reversal
    rate = np.sqrt((i3 - i2) * (momentum2 - energy2 * i1) / (i1 * i2 * i3))
    m = (i2 - i1) * (energy2 * i3 - momentum2) / ((i3 - i2) * (momentum2 - energy2 * i1))
    w2 = np.sqrt((energy2 * i3 - momentum2) / (i2 * (i3 - i2)))

    def rates(t):
        sn, cn, dn, _ = ellipj(rate * t, m)
        # Euler: i2 dw2/dt = (i3 - i1) w3 w1 > 0 at t = 0
        return np.array([w1 * cn, w2 * sn, w3 * dn])

    def attitude(t):
        """R_WB with the momentum along z of W."""
        w = rates(t)
        direction = np.array([i1, i2, i3]) * w / np.sqrt(momentum2)

        def precession_rate(s):
            p, q, _ = rates(s)
            return np.sqrt(momentum2) * (i1 * p * p + i2 * q * q) / ((i1 * p) ** 2 + (i2 * q) ** 2)

        precession = quad(precession_rate, 0.0, t, epsabs=1e-13, epsrel=1e-13, limit=500)[0]
        spin, tilt = np.arctan2(direction[0], direction[1]), np.arccos(direction[2])
        return _about_z(precession) @ _about_x(tilt) @ _about_z(spin)

    vehicle = Multirotor(config, device=device, max_step_ns=step_ns)
    vehicle.reset(
        orientation=Rotation.from_matrix(attitude(0.0)).as_quat(),
        body_rate=rates(0.0),
        rotor_speed=np.zeros(4),
    )
    for second in (1, 2):
        vehicle.step(np.zeros(4), 1_000_000_000)
        state = one(vehicle.state)
        assert state.body_rate == pytest.approx(rates(second), abs=tolerance)
        error = rotation_matrix(state.orientation).T @ attitude(second) - np.eye(3)
        assert np.abs(error).max() < tolerance


def _about_z(a):
    return np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])


def _about_x(a):
    return np.array([[1.0, 0.0, 0.0], [0.0, np.cos(a), -np.sin(a)], [0.0, np.sin(a), np.cos(a)]])
