"""Following a path from outside: the same bits as inside, and setpoints that lead back to the path."""

from __future__ import annotations

import numpy as np
import pytest
from controller_commands import command_of
from scipy.spatial.transform import Rotation

from neurosim_core.control import Controller, PathFollower, Se3Config
from neurosim_core.trajectory.shapes import FigureEightConfig, figure_eight
from neurosim_core.vehicle import Multirotor, preset

VEHICLE = preset("hummingbird")
PATH = figure_eight(FigureEightConfig(), center=np.zeros(3))
STAMP_NS = 1_234_567_891


def a_state(seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    return {
        "position": random.normal(size=3),
        "velocity": random.normal(size=3),
        "orientation": Rotation.random(rng=random).as_quat(),
        "body_rate": random.normal(size=3),
        "rotor_speed": random.uniform(200.0, 1200.0, size=4),
    }


def test_motor_speeds_are_those_of_the_controller():
    """To the last bit, state after state: nothing of the state before is left."""
    gains = Se3Config(position_gain_per_s2=7.0)
    follower = PathFollower(PATH, VEHICLE, gains)
    controller = Controller("path", VEHICLE, gains, device="cpu", paths=PATH)
    for seed in range(20):
        state, stamp_ns = a_state(seed), STAMP_NS * seed
        command = follower.command(stamp_ns=stamp_ns, **state)
        assert command.tobytes() == command_of(controller, stamp_ns=stamp_ns, **state)[0].tobytes()


def test_a_command_is_the_callers_to_keep():
    follower = PathFollower(PATH, VEHICLE)
    first = follower.command(stamp_ns=0, **a_state(0))
    kept = first.copy()
    follower.command(stamp_ns=STAMP_NS, **a_state(1))
    assert (first == kept).all()


def test_on_the_path_setpoints_are_those_of_the_path():
    wanted = PATH.evaluate([STAMP_NS])
    half_yaw = 0.5 * wanted.yaw[0]
    state = a_state(0) | {
        "position": wanted.position[0],
        "orientation": np.array([0.0, 0.0, np.sin(half_yaw), np.cos(half_yaw)]),
    }
    position = PathFollower(PATH, VEHICLE, mode="position").command(stamp_ns=STAMP_NS, **state)
    assert (position == [*wanted.position[0], wanted.yaw[0]]).all()
    velocity = PathFollower(PATH, VEHICLE, mode="velocity").command(stamp_ns=STAMP_NS, **state)
    # the yaw comes back from the quaternion with a few roundings
    np.testing.assert_allclose(velocity, [*wanted.velocity[0], wanted.yaw_rate[0]], rtol=0.0, atol=1e-14)


def test_a_velocity_leads_back_to_the_path():
    """Off by 1 m to the east and 0.1 rad counter-clockwise, in any attitude with that heading."""
    wanted = PATH.evaluate([STAMP_NS])
    heading = Rotation.from_euler("ZXY", [wanted.yaw[0] + 0.1, 0.4, -0.3])
    state = a_state(0) | {
        "position": wanted.position[0] + [1.0, 0.0, 0.0],
        "orientation": heading.as_quat(),
    }
    gains = Se3Config(position_gain_per_s2=12.0, velocity_gain_per_s=4.0, correction_speed_max_m_s=2.5)
    command = PathFollower(PATH, VEHICLE, gains, mode="velocity").command(stamp_ns=STAMP_NS, **state)
    away = [-2.5, 0.0, 0.0, -0.2]  # 12 / 4 m/s per metre, limited to 2.5 m/s
    np.testing.assert_allclose(command - [*wanted.velocity[0], wanted.yaw_rate[0]], away, atol=1e-14)


@pytest.mark.parametrize("mode", ["motor_speeds", "velocity", "position"])
def test_every_mode_flies_the_path(mode):
    """Setpoints are flown by the controller of their mode, as the simulator does it."""
    follower = PathFollower(PATH, VEHICLE, mode=mode)
    inner = None if mode == "motor_speeds" else Controller(mode, VEHICLE, device="cpu")
    vehicle = Multirotor(VEHICLE, count=1, device="cpu", max_step_ns=1_000_000)
    start = PATH.evaluate([0])
    vehicle.reset(position=start.position, velocity=start.velocity)
    errors = []
    for tick in range(400):
        state = {name: value[0] for name, value in vehicle.state._asdict().items()}
        command = follower.command(stamp_ns=tick * 5_000_000, **state)
        if inner is not None:
            command = command_of(inner, command, **state)[0]
        vehicle.command(command)
        vehicle.advance(5_000_000)
        errors.append(follower.error_m((tick + 1) * 5_000_000, vehicle.state.position[0]))
    path = PATH.evaluate(np.arange(400) * 5_000_000)
    speed_m_s, acceleration_m_s2 = (
        np.linalg.norm(rows, axis=1).max() for rows in (path.velocity, path.acceleration)
    )
    gains = Se3Config()
    lag_m = {
        "motor_speeds": 0.01,  # the lag of the motors only
        "velocity": acceleration_m_s2 / gains.position_gain_per_s2,  # which it is not told of
        "position": speed_m_s * gains.velocity_gain_per_s / gains.position_gain_per_s2,
    }
    assert np.max(errors) < 1.2 * lag_m[mode]  # the rest is what overshoots


def test_an_error_is_a_distance():
    off = PATH.evaluate([STAMP_NS]).position[0] + [0.3, 0.0, -0.4]
    assert PathFollower(PATH, VEHICLE).error_m(STAMP_NS, off) == pytest.approx(0.5, abs=1e-15)


def test_what_is_wrong_is_refused():
    with pytest.raises(ValueError, match="unknown mode 'rates', known: motor_speeds, velocity, position"):
        PathFollower(PATH, VEHICLE, mode="rates")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="broadcast"):
        PathFollower(PATH, VEHICLE).command(stamp_ns=0, **(a_state(0) | {"rotor_speed": np.ones(6)}))
