"""Command modes: one answer whatever the level that is asked, and clear errors."""

from __future__ import annotations

import numpy as np
import pytest
from controller_commands import command_of
from scipy.spatial.transform import Rotation

from neurosim_core.control import MODES, Controller, Se3Config
from neurosim_core.settings_file import ConfigError
from neurosim_core.trajectory.shapes import FigureEightConfig, figure_eight
from neurosim_core.vehicle import DynamicsError, Multirotor, preset

HUMMINGBIRD = preset("hummingbird")
WEIGHT = HUMMINGBIRD.mass_kg * HUMMINGBIRD.gravity_m_s2
REST = {
    "position": [1.0, 2.0, 3.0],
    "velocity": [0.0, 0.0, 0.0],
    "orientation": [0.0, 0.0, 0.0, 1.0],
    "body_rate": [0.0, 0.0, 0.0],
    "rotor_speed": np.sqrt(WEIGHT / 4.0 / HUMMINGBIRD.thrust_coefficient_n_s2) * np.ones(4),
}
SETPOINTS = {
    "motor_speeds": [100.0, 200.0, 300.0, 400.0],
    "rates": [5.0, 0.1, -0.2, 0.3],
    "attitude": [5.0, 0.1, 0.05, 0.2, 0.97],
    "velocity": [1.0, -0.5, 0.2, 0.4],
    "position": [1.2, 1.8, 3.1, 0.3],
}


def random_states(count, config=HUMMINGBIRD, seed=0):
    random = np.random.default_rng(seed)
    return {
        "position": random.normal(size=(count, 3)),
        "velocity": random.normal(size=(count, 3)),
        "orientation": Rotation.random(count, rng=random).as_quat(),
        "body_rate": random.normal(size=(count, 3)),
        "rotor_speed": random.uniform(200.0, 1200.0, size=(count, config.rotor_count)),
    }


def a_path(yaw="travel"):
    return figure_eight(FigureEightConfig(yaw=yaw), center=np.zeros(3))


@pytest.mark.parametrize(
    ("mode", "setpoint"),
    [
        ("rates", [WEIGHT, 0.0, 0.0, 0.0]),
        ("attitude", [WEIGHT, 0.0, 0.0, 0.0, 1.0]),
        ("velocity", [0.0, 0.0, 0.0, 0.0]),
        ("position", [1.0, 2.0, 3.0, 0.0]),
    ],
)
def test_no_error_is_hover(device, mode, setpoint):
    """Every mode, asked for the state it is in, carries the weight and no more."""
    controller = Controller(mode, HUMMINGBIRD, device=device)
    speeds = command_of(controller, setpoint, **REST)
    np.testing.assert_allclose(speeds, [REST["rotor_speed"]], rtol=1e-14)


def test_attitude_at_its_attitude_is_rates():
    """Attitude without attitude error is the rate mode asked for no rate."""
    state = random_states(20)
    thrust = np.full((20, 1), 6.0)
    attitude = Controller("attitude", HUMMINGBIRD, count=20)
    rates = Controller("rates", HUMMINGBIRD, count=20)
    np.testing.assert_allclose(
        command_of(attitude, np.hstack([thrust, state["orientation"]]), **state),
        command_of(rates, np.hstack([thrust, np.zeros((20, 3))]), **state),
        rtol=1e-12,
    )


def test_position_is_velocity_asked_for_the_correction():
    """Below its limits, position asks the velocity level for gain / gain times the error."""
    state = random_states(20) | {"orientation": [0.0, 0.0, 0.0, 1.0], "body_rate": [0.0, 0.0, 0.0]}
    target = state["position"] + 0.1
    gains = Se3Config(position_gain_per_s2=12.0, velocity_gain_per_s=6.0)
    position = Controller("position", HUMMINGBIRD, gains, count=20)
    velocity = Controller("velocity", HUMMINGBIRD, gains, count=20)
    np.testing.assert_allclose(
        command_of(position, np.hstack([target, np.zeros((20, 1))]), **state),
        command_of(velocity, np.hstack([2.0 * (target - state["position"]), np.zeros((20, 1))]), **state),
        rtol=1e-12,
    )


def test_path_at_rest_is_position():
    """Behind its end a path rests: the same as the position mode there."""
    path, state = a_path(), random_states(8)
    end = path.evaluate(path.end_ns)
    setpoint = [*end.position[0], end.yaw[0]]
    np.testing.assert_allclose(
        command_of(
            Controller("path", HUMMINGBIRD, count=8, paths=path), **state, stamp_ns=path.end_ns + 10**9
        ),
        command_of(Controller("position", HUMMINGBIRD, count=8), setpoint, **state),
        rtol=1e-9,
    )


def test_quaternion_sign_does_not_matter():
    """Minus q is q: of the body and of the setpoint, within rounding."""
    state = random_states(30)
    setpoint = np.hstack([np.full((30, 1), 5.0), Rotation.random(30, rng=1).as_quat()])
    controller = Controller("attitude", HUMMINGBIRD, count=30)
    one = command_of(controller, setpoint, **state)
    np.testing.assert_allclose(
        command_of(controller, setpoint, **state | {"orientation": -state["orientation"]}), one
    )
    np.testing.assert_allclose(command_of(controller, setpoint * [1, -1, -1, -1, -1], **state), one)


@pytest.mark.parametrize(
    ("name", "mode"),
    [*(("hummingbird", mode) for mode in SETPOINTS), ("crazyflie", "position"), ("racer", "position")],
)
def test_commands_stay_within_limits(name, mode, device):
    """Wild states and setpoints: every command is a number within the motors' range."""
    config = preset(name)
    state = random_states(200, config, seed=5)
    state["velocity"] = 50.0 * state["velocity"]
    state["body_rate"] = 50.0 * state["body_rate"]
    controller = Controller(mode, config, count=200, device=device)
    setpoint = 100.0 * np.random.default_rng(6).normal(size=(200, len(controller.layout)))
    speeds = command_of(controller, setpoint, **state)
    assert speeds.min() >= config.rotor_speed_min_rad_s
    assert speeds.max() <= config.rotor_speed_max_rad_s


@pytest.mark.parametrize("mode", [*SETPOINTS, "path"])
def test_batch_is_its_singles(mode, device):
    """A batch gives bit for bit what its vehicles give alone."""
    count = 7
    state, stamp_ns = random_states(count), 1_234_567_890
    paths = [a_path(yaw) for yaw in (0.1, 0.2, 0.3, 0.4, 0.5, "travel", 0.7)] if mode == "path" else None
    setpoint = None
    if paths is None:
        setpoint = np.array(SETPOINTS[mode]) + 0.1 * np.arange(count)[:, None]
    batch = Controller(mode, HUMMINGBIRD, count=count, device=device, paths=paths)
    together = command_of(batch, setpoint, **state, stamp_ns=stamp_ns)
    for vehicle in range(count):
        single = Controller(mode, HUMMINGBIRD, device=device, paths=paths and paths[vehicle])
        alone = command_of(
            single,
            None if setpoint is None else setpoint[vehicle],
            **{name: rows[vehicle] for name, rows in state.items()},
            stamp_ns=stamp_ns,
        )
        np.testing.assert_array_equal(alone[0], together[vehicle])


@pytest.mark.parametrize("mode", [*SETPOINTS, "path"])
def test_it_commands_a_vehicle_as_it_does_other_arrays(mode, device):
    """`update` on a vehicle's arrays writes what it does for its state in other arrays."""
    vehicle = Multirotor(HUMMINGBIRD, count=3, device=device)
    vehicle.reset(**random_states(3))
    vehicle.advance(50_000_000)
    path = a_path() if mode == "path" else None
    controller = Controller(mode, HUMMINGBIRD, count=3, device=device, paths=path)
    if mode != "path":
        controller.set(SETPOINTS[mode])
    controller.update(vehicle.arrays)
    expected = command_of(controller, **vehicle.state._asdict(), stamp_ns=50_000_000)
    np.testing.assert_array_equal(vehicle.arrays.rotor_speed_command.numpy(), expected)


@pytest.mark.parametrize(
    ("mode", "element"), [(mode, element) for mode in SETPOINTS for element in range(len(SETPOINTS[mode]))]
)
def test_not_a_number_reaches_the_vehicle(mode, element, device):
    """On the device nothing checks a setpoint, so nothing may hide it: the vehicle reports the command."""
    vehicle = Multirotor(HUMMINGBIRD, device=device)
    controller = Controller(mode, HUMMINGBIRD, device=device)
    row = np.array([SETPOINTS[mode]])
    row[0, element] = np.nan
    controller.setpoint.assign(row)
    controller.update(vehicle.arrays)
    vehicle.advance(1_000_000)
    with pytest.raises(DynamicsError, match="rotor_speed_command"):
        vehicle.check()


@pytest.mark.parametrize("bad", [[np.nan, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [[0.0] * 4] * 2])
def test_bad_setpoint_names_mode_and_layout(bad):
    controller = Controller("velocity", HUMMINGBIRD)
    with pytest.raises(ValueError, match=r"mode 'velocity' takes rows of \(v_W_x_m_s, .*yaw_rate_rad_s\)"):
        controller.set(bad)


def test_other_errors_are_clear():
    with pytest.raises(ValueError, match=r"unknown command mode 'fly', known: .*'attitude'"):
        Controller("fly", HUMMINGBIRD)
    with pytest.raises(ValueError, match="takes one path, or one for each of 3 vehicles, got 2"):
        Controller("path", HUMMINGBIRD, count=3, paths=[a_path(), a_path()])
    with pytest.raises(ValueError, match="not paths"):
        Controller("position", HUMMINGBIRD, paths=a_path())
    with pytest.raises(ValueError, match="unit quaternions"):
        Controller("attitude", HUMMINGBIRD).set([5.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ConfigError, match="velocity_gain_per_s"):
        Se3Config(velocity_gain_per_s=0.0)


def test_arrays_of_another_batch_are_refused(device):
    controller = Controller("rates", HUMMINGBIRD, count=2, device=device)
    with pytest.raises(ValueError, match="for 2 vehicles of 4 rotors"):
        controller.update(Multirotor(HUMMINGBIRD, count=3, device=device).arrays)


def test_layouts_have_units():
    assert {mode: len(Controller(mode, HUMMINGBIRD).layout) for mode in SETPOINTS} == {
        mode: len(row) for mode, row in SETPOINTS.items()
    }


def test_every_mode_is_tested():
    assert set(MODES) == {*SETPOINTS, "path"}
