"""The geometric controller in closed loop with the vehicle."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neurosim_core.clock import Rate
from neurosim_core.control import Controller, Se3Config
from neurosim_core.trajectory.path import Path
from neurosim_core.trajectory.shapes import FigureEightConfig, figure_eight
from neurosim_core.vehicle import Multirotor, preset

IDEAL = {
    "motor_time_constant_s": 0.0,
    "rotor_drag_kg": 0.0,
    "rotor_inflow_kg": 0.0,
    "translational_lift_kg_m": 0.0,
    "parasitic_drag_kg_m": (0.0, 0.0, 0.0),
}
"""Motors that follow at once, and no air."""


def eight(speed_max_m_s, length_m, *, yaw=0.0):
    config = FigureEightConfig(
        length_m=length_m, width_m=0.5 * length_m, speed_max_m_s=speed_max_m_s, laps=1.5, ramp_s=1.5, yaw=yaw
    )
    return figure_eight(config, center=np.zeros(3))


def fly(vehicle, controller, *, rate_hz, duration_ns):
    """Close the loop; return stamps [k] and behind each period position, velocity, q, w, rotor speed."""
    clock = Rate(rate_hz)
    stamps, states = [], []
    for tick in range(clock.first_tick(duration_ns)):
        controller.update(vehicle.arrays)
        end_ns = clock.stamp_ns(tick + 1)
        vehicle.advance(end_ns - clock.stamp_ns(tick))
        stamps.append(end_ns)
        states.append(vehicle.state)
    vehicle.check()
    return np.array(stamps), [np.stack(rows) for rows in zip(*states, strict=True)]


def path_error(config, path, *, rate_hz, gains=None, device="cpu", duration_ns=None):
    """Fly a path from its start; return the distance to it behind each period [m]."""
    vehicle = Multirotor(config, device=device)
    controller = Controller("path", config, gains, paths=path, device=device)
    start = path.evaluate(path.start_ns)
    vehicle.reset(position=start.position, velocity=start.velocity)
    stamps, states = fly(vehicle, controller, rate_hz=rate_hz, duration_ns=duration_ns or path.end_ns)
    return np.linalg.norm(states[0][:, 0] - path.evaluate(stamps).position, axis=1)


def test_tracking_is_exact_in_the_limit(device):
    """Ideal motors, no air, no initial error: what is left is that of held commands, of first order."""
    config = preset("hummingbird", **IDEAL)
    path = eight(4.0, 4.0, yaw="travel")
    rates_hz = (250.0, 500.0, 1000.0)
    errors = [path_error(config, path, rate_hz=rate_hz, device=device).max() for rate_hz in rates_hz]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 1.0, atol=0.15)
    assert errors[-1] < 1e-3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_attitude_step_response(device, axis):
    """A small attitude error obeys e'' + rate_gain e' + attitude_gain e = 0."""
    gains = Se3Config(attitude_gain_per_s2=300.0, rate_gain_per_s=20.0, yaw_gain_per_s2=90.0)
    k, d = (90.0, 10.0) if axis == 2 else (300.0, 20.0)
    config = preset("racer", **IDEAL)
    vehicle = Multirotor(config, device=device)
    controller = Controller("attitude", config, gains, device=device)
    angle = 1e-3
    turn = np.eye(3)[axis] * angle
    controller.set([config.mass_kg * 9.81, 0.0, 0.0, 0.0, 1.0])
    vehicle.reset(orientation=Rotation.from_rotvec(turn).as_quat())
    stamps, states = fly(vehicle, controller, rate_hz=10_000.0, duration_ns=400_000_000)
    t = stamps * 1e-9
    decay, beat = 0.5 * d, np.sqrt(k - 0.25 * d * d)
    expected = np.exp(-decay * t) * (np.cos(beat * t) + decay / beat * np.sin(beat * t))
    got = Rotation.from_quat(states[2][:, 0]).as_rotvec()[:, axis] / angle
    # a command held for h acts h/2 late: about h/2 * d relative, 1e-3
    np.testing.assert_allclose(got, expected, atol=2e-3)


def test_rate_response(device):
    """A rate error obeys e' + rate_gain e = 0, about all axes at once, spinning body or not."""
    config = preset("hummingbird", **IDEAL)
    vehicle = Multirotor(config, device=device)
    controller = Controller("rates", config, device=device)
    target = np.array([1.0, -2.0, 0.5])
    controller.set([config.mass_kg * 9.81, *target])
    start = np.array([2.0, 1.0, 1.5])
    vehicle.reset(body_rate=start)
    stamps, states = fly(vehicle, controller, rate_hz=5_000.0, duration_ns=200_000_000)
    decay = np.exp(-np.outer(stamps * 1e-9, [35.0, 35.0, 10.0]))
    np.testing.assert_allclose(states[3][:, 0], target + (start - target) * decay, atol=1e-2)


def test_equivariance(device):
    """A path that is moved and turned about the vertical is flown the same, moved and turned."""
    config = preset("hummingbird")
    path = eight(4.0, 3.0)
    turn, shift = Rotation.from_euler("z", 2.0), np.array([10.0, -20.0, 3.0])
    coefficients = path.coefficients.copy()
    coefficients[:, :3] = np.einsum("ij,sjk->sik", turn.as_matrix(), coefficients[:, :3])
    coefficients[:, :3, 0] += shift
    coefficients[:, 3, 0] += 2.0
    moved = Path(path.knots_ns, coefficients)

    def flight(way, position, orientation):
        vehicle = Multirotor(config, device=device)
        vehicle.reset(position=position, orientation=orientation)
        controller = Controller("path", config, paths=way, device=device)
        return fly(vehicle, controller, rate_hz=200.0, duration_ns=2_000_000_000)[1]

    start = np.array([0.3, 0.2, -0.1])
    one = flight(path, start, [0.0, 0.0, 0.0, 1.0])
    two = flight(moved, turn.apply(start) + shift, turn.as_quat())
    # rounding at 20 m is 4e-15 m; an unstable direction would let it grow, this loop does not
    np.testing.assert_allclose(two[0][:, 0], turn.apply(one[0][:, 0]) + shift, atol=1e-10)
    np.testing.assert_allclose(two[4], one[4], rtol=1e-9)


@pytest.mark.parametrize("name", ["crazyflie", "hummingbird", "racer"])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.6, -0.8, 0.0), (0.7, 0.1, 0.7)])
@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
def test_recovery_from_upside_down(name, axis, rate_hz):
    """Thrown at 170 degrees and turning, it comes back to where it shall be, level and at rest."""
    config = preset(name)
    vehicle = Multirotor(config)
    turn = np.radians(170.0) * np.array(axis) / np.linalg.norm(axis)
    vehicle.reset(orientation=Rotation.from_rotvec(turn).as_quat(), body_rate=[1.0, -1.0, 1.0])
    controller = Controller("position", config)
    controller.set([0.0, 0.0, 0.0, 0.5])
    _, states = fly(vehicle, controller, rate_hz=rate_hz, duration_ns=8_000_000_000)
    upright = Rotation.from_quat(states[2][:, 0]).as_matrix()[:, 2, 2]
    assert upright[0] < 0.0
    assert upright[int(rate_hz) :].min() > 0.5  # within a second, and for good
    assert np.linalg.norm(states[0][-1, 0]) < 0.01
    assert np.linalg.norm(states[1][-1, 0]) < 0.01
    assert np.degrees(Rotation.from_quat(states[2][-1, 0]).as_euler("ZXY")[0]) == pytest.approx(
        np.degrees(0.5), abs=0.5
    )
    assert states[0][:, 0, 2].min() > -4.0  # m lost on the way


@pytest.mark.parametrize("name", ["crazyflie", "hummingbird", "racer"])
def test_far_setpoint(name):
    """A setpoint 30 m away is reached without overshoot, at the speed allowed, never past 60 degrees."""
    config = preset(name)
    vehicle = Multirotor(config)
    controller = Controller("position", config)
    controller.set([30.0, 0.0, 2.0, 0.0])
    vehicle.reset()
    _, states = fly(vehicle, controller, rate_hz=100.0, duration_ns=15_000_000_000)
    assert states[0][-1, 0] == pytest.approx([30.0, 0.0, 2.0], abs=0.01)
    assert states[0][:, 0, 0].max() < 30.2
    assert np.linalg.norm(states[1][:, 0], axis=1).max() < 4.2
    assert Rotation.from_quat(states[2][:, 0]).as_matrix()[:, 2, 2].min() > 0.5


def test_height_is_kept_before_distance():
    """A vehicle with little thrust to spare flies sideways only as hard as height allows."""
    config = preset("crazyflie", mass_kg=0.05)  # thrust over weight 1.17
    vehicle = Multirotor(config)
    vehicle.reset()
    controller = Controller("position", config)
    controller.set([20.0, 0.0, 0.0, 0.0])
    _, states = fly(vehicle, controller, rate_hz=100.0, duration_ns=4_000_000_000)
    assert states[0][:, 0, 2].min() > -0.15  # 0.118 m while it tilts: a fifth of a second of falling free
    assert states[0][-1, 0, 0] > 5.0


def test_yaw_rate_of_velocity_mode(device):
    """The heading turns at the rate asked for, while the velocity is kept."""
    config = preset("racer")
    vehicle = Multirotor(config, device=device)
    vehicle.reset()
    controller = Controller("velocity", config, device=device)
    controller.set([1.0, -0.5, 0.2, 0.8])
    _, states = fly(vehicle, controller, rate_hz=200.0, duration_ns=3_000_000_000)
    yaw = np.unwrap(Rotation.from_quat(states[2][:, 0]).as_euler("ZXY")[:, 0])
    assert (yaw[-1] - yaw[-201]) == pytest.approx(0.8, abs=1e-3)  # the last second
    np.testing.assert_allclose(states[1][-1, 0], [1.0, -0.5, 0.2], atol=1e-3)


def test_known_drag_is_cancelled():
    """Straight and level at 5 m/s: no error, where without the term it is that of drag over the gain."""
    config = preset("hummingbird")
    path = Path(np.array([0, 20_000_000_000]), np.array([[[0.0, 100.0], [0.0] * 2, [0.0] * 2, [0.0] * 2]]))
    with_air = path_error(config, path, rate_hz=200.0)[-1]
    gains = Se3Config(feed_forward_air=False)
    without = path_error(config, path, rate_hz=200.0, gains=gains)[-1]
    assert with_air < 1e-6
    assert without > 0.1


def test_flip_is_followed(device):
    """A vertical loop so fast that thrust points down at its top: the vehicle goes round with it."""
    config = preset("racer", motor_time_constant_s=0.0)
    t = np.arange(0.0, 4.0, 1e-3)  # radius 1.5 m at 4 rad/s: 24 m/s^2, inverted at the top
    radius, rate = 1.5, 4.0
    knots_ns = np.round(np.arange(0.0, 4.05, 0.05) * 1e9).astype(np.int64)
    u = np.cos(np.pi * (np.arange(8) + 0.5) / 8) / 2.0 + 0.5
    pieces = []
    for start_ns in knots_ns[:-1]:
        angle = rate * (start_ns * 1e-9 + 0.05 * u)
        axes = [radius * np.sin(angle), 0.0 * angle, -radius * np.cos(angle), 0.0 * angle]
        pieces.append([np.polynomial.polynomial.polyfit(u, x, 7) for x in axes])
    path = Path(knots_ns, np.array(pieces))
    vehicle = Multirotor(config, device=device)
    start = path.evaluate(0)
    vehicle.reset(position=start.position, velocity=start.velocity, body_rate=[0.0, -rate, 0.0])
    controller = Controller("path", config, paths=path, device=device)
    stamps, states = fly(vehicle, controller, rate_hz=500.0, duration_ns=int(t[-1] * 1e9))
    error = np.linalg.norm(states[0][:, 0] - path.evaluate(stamps).position, axis=1)
    upright = Rotation.from_quat(states[2][:, 0]).as_matrix()[:, 2, 2]
    assert upright.min() < -0.9  # it was inverted
    assert error.max() < 0.2


@pytest.mark.parametrize(
    ("name", "length_9_m_s", "error_2_m_s", "error_9_m_s"),
    [("crazyflie", 24.0, 0.010, 0.14), ("hummingbird", 10.0, 0.02, 0.06), ("racer", 10.0, 0.003, 0.04)],
)
@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
def test_presets_track(name, length_9_m_s, error_2_m_s, error_9_m_s, rate_hz):
    """All presets fly a figure eight with the same gains, at 100 Hz as at 500 Hz."""
    config = preset(name)
    # bounds are about 1.5 times what was measured
    assert path_error(config, eight(2.0, 3.0), rate_hz=rate_hz).max() < error_2_m_s
    assert path_error(config, eight(9.0, length_9_m_s), rate_hz=rate_hz).max() < error_9_m_s
