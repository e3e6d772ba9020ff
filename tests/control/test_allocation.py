"""Thrust and torque to rotor speeds, within limits and in the documented order of priority."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from neurosim_core.control.allocation import Motors, allocate, allocation_matrix
from neurosim_core.vehicle import MultirotorConfig, preset
from neurosim_core.vehicle.aerodynamics import quadratic_weights

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _allocate(
    matrix: wp.array2d[wp.float64],
    motors: Motors,
    wrench: wp.array[wp.vec4d],
    speed: wp.array2d[wp.float64],
    command_out: wp.array2d[wp.float64],
):
    vehicle = wp.tid()
    w = wrench[vehicle]
    allocate(matrix, motors, w[0], wp.vec3d(w[1], w[2], w[3]), vehicle, speed, command_out)


def commands(vehicle, wrench, *, speed=None, lead=1.0, device="cpu"):
    """Wrenches [n, 4] -> rotor speed commands [n, R]."""
    wrench = np.atleast_2d(np.asarray(wrench, dtype=float))
    motors = Motors()
    motors.speed_min_rad_s = vehicle.rotor_speed_min_rad_s
    motors.speed_max_rad_s = vehicle.rotor_speed_max_rad_s
    motors.lead = lead
    shape = (len(wrench), vehicle.rotor_count)
    present = np.zeros(shape) if speed is None else np.broadcast_to(speed, shape)
    out = wp.zeros(shape, dtype=wp.float64, device=device)
    wp.launch(
        _allocate,
        dim=len(wrench),
        inputs=[
            wp.array(allocation_matrix(vehicle), dtype=wp.float64, device=device),
            motors,
            wp.array(wrench, dtype=wp.vec4d, device=device),
            wp.array(present, dtype=wp.float64, device=device),
        ],
        outputs=[out],
        device=device,
    )
    return out.numpy()


def weights(vehicle):
    """Wrench of one (rad/s)^2 of each rotor, [R, 4]: written out, not through the code under test."""
    x, y, _ = np.array(vehicle.rotor_position_m).T
    k, m = vehicle.thrust_coefficient_n_s2, vehicle.torque_coefficient_n_m_s2
    return np.stack([0.0 * x + k, k * y, -k * x, m * np.array(vehicle.rotor_direction)], axis=1)


def ring(count, **overrides):
    """A multirotor with `count` rotors on a circle."""
    angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    return preset(
        "hummingbird",
        rotor_position_m=tuple((0.2 * np.cos(a), 0.2 * np.sin(a), 0.0) for a in angle),
        rotor_direction=tuple(1 - 2 * (i % 2) for i in range(count)),
        **overrides,
    )


VEHICLES = {
    "crazyflie": preset("crazyflie"),
    "hummingbird": preset("hummingbird"),
    "racer": preset("racer"),  # slowest speed above 0
    "hexarotor": ring(6, rotor_speed_min_rad_s=100.0),
    "lopsided": preset(  # centre of mass off the middle: shares of thrust differ
        "hummingbird",
        rotor_position_m=((0.15, 0.1, 0.0), (0.1, -0.12, 0.01), (-0.1, -0.12, 0.0), (-0.13, 0.12, 0.0)),
    ),
}


@pytest.mark.parametrize("name", VEHICLES)
@given(share=st.lists(st.floats(0.02, 0.98), min_size=6, max_size=6))
@settings(max_examples=30, deadline=None)
def test_what_can_be_given_is_given(name, share):
    """Any wrench of speeds within limits comes out again; for four rotors the speeds do, too."""
    vehicle = VEHICLES[name]
    low, high = vehicle.rotor_speed_min_rad_s**2, vehicle.rotor_speed_max_rad_s**2
    if vehicle.rotor_count == 4:
        square = low + np.array(share[:4]) * (high - low)
    else:  # those the pseudo-inverse reaches without the null space
        matrix = np.linalg.pinv(weights(vehicle).T)
        scale = np.array([0.5, 0.1, 0.1, 0.1]) * (high - low) / np.abs(matrix).max(axis=0) / 2.0
        wrench = scale * np.array([1.0, *(2.0 * np.array(share[1:4]) - 1.0)])
        square = matrix @ wrench
        assert square.min() > low
    wanted = square @ weights(vehicle)
    got = commands(vehicle, wanted)[0]
    # rounding, amplified by the spread of the wrenches' sizes
    np.testing.assert_allclose(got**2, square, rtol=1e-9, atol=1e-10 * high)


def lexicographic(vehicle, wanted):
    """Linear programs for (share of tilt, thrust [N], share of yaw) of a wrench."""
    matrix = allocation_matrix(vehicle)
    high = vehicle.rotor_speed_max_rad_s**2
    low = vehicle.rotor_speed_min_rad_s**2 / high
    tilt = matrix[:, 1:3] @ wanted[1:3] / high
    lift = matrix[:, 0] / matrix[:, 0].max()  # thrust as a share of the largest
    top = high / matrix[:, 0].max()
    turn = matrix[:, 3] * wanted[3] / high

    def maximise(column, rest, bounds=(0.0, 1.0)):
        columns = np.column_stack([column])
        A = np.vstack([columns, -columns])
        b = np.concatenate([1.0 - rest, rest - low])
        count = columns.shape[1]
        result = linprog(
            [-1.0] + [0.0] * (count - 1), A_ub=A, b_ub=b, bounds=[bounds] + [(None, None)] * (count - 1)
        )
        return result.x[0] if result.status == 0 else None

    yaw = maximise(turn, lift * wanted[0] / top + tilt)
    if yaw is not None:
        return 1.0, wanted[0], yaw
    share = maximise(np.stack([tilt, lift], axis=1), 0.0 * tilt)
    share *= 1.0 - 1e-9  # room for the solver's tolerance
    most = maximise(lift, tilt * share, (None, None)) * top
    least = -maximise(-lift, tilt * share, (None, None)) * top
    thrust = np.clip(wanted[0], least, most)
    return share, thrust, maximise(turn, np.clip(lift * thrust / top + tilt * share, low, 1.0))


@pytest.mark.parametrize("name", VEHICLES)
def test_priorities_against_linear_programs(name, device):
    """Yaw goes first, then thrust, then roll and pitch together: equal to nested optimisations."""
    vehicle = VEHICLES[name]
    random = np.random.default_rng(3)
    W = weights(vehicle)
    high = vehicle.rotor_speed_max_rad_s**2
    scale = np.abs(W).sum(axis=0) * high
    wanted = random.normal(size=(40, 4)) * scale * np.array([0.7, 0.4, 0.4, 0.4])
    got = commands(vehicle, wanted, device=device)
    assert got.min() >= vehicle.rotor_speed_min_rad_s
    assert got.max() <= vehicle.rotor_speed_max_rad_s
    given_up = np.zeros(3)
    for row, command in zip(wanted, got, strict=True):
        tilt, thrust, yaw = lexicographic(vehicle, row)
        expected = [thrust, tilt * row[1], tilt * row[2], yaw * row[3]]
        # HiGHS meets constraints to 1e-7; where they are nearly parallel a share is worse by some
        np.testing.assert_allclose((command**2) @ W / scale, expected / scale, atol=2e-6)
        given_up += [tilt < 1.0, thrust != row[0], yaw < 1.0]
    assert (given_up > 3).all()  # the sample exercises every stage


def test_yaw_is_given_up_before_tilt_and_thrust(device):
    """Full thrust less what roll needs leaves nothing for yaw, and roll is exact."""
    vehicle = VEHICLES["hummingbird"]
    W = weights(vehicle)
    high = vehicle.rotor_speed_max_rad_s**2
    top = 4.0 * vehicle.thrust_coefficient_n_s2 * high
    got = (commands(vehicle, [top, 0.5, 0.0, 0.1], device=device)[0] ** 2) @ W
    np.testing.assert_allclose(got[1:], [0.5, 0.0, 0.0], atol=1e-12)
    # thrust falls by the share of roll: all rotors of one side at the limit, torque = arm * difference
    assert got[0] == pytest.approx(top - 0.5 / (0.17 * 0.70710678118), rel=1e-9)


def test_lead_overdrives_towards_the_wanted_speed(device):
    """Command = present + lead (wanted - present), within limits."""
    vehicle = VEHICLES["crazyflie"]
    hover = vehicle.mass_kg * 9.81
    wanted = np.sqrt(hover / 4.0 / vehicle.thrust_coefficient_n_s2)
    present = np.array([wanted - 100.0, wanted + 100.0, 0.0, 2500.0])
    got = commands(vehicle, [hover, 0.0, 0.0, 0.0], speed=present, lead=3.0, device=device)[0]
    np.testing.assert_allclose(got, [wanted + 200.0, wanted - 200.0, 2500.0, 3.0 * wanted - 5000.0])


def test_not_a_number_is_not_hidden(device):
    assert np.isnan(commands(VEHICLES["racer"], [np.nan, 0.0, 0.0, 0.0], device=device)).all()


def test_pseudo_inverse_is_the_least_effort():
    """For six rotors: an exact right inverse, orthogonal to the null space."""
    vehicle = VEHICLES["hexarotor"]
    matrix = allocation_matrix(vehicle)
    W = weights(vehicle).T
    np.testing.assert_allclose(W @ matrix, np.eye(4), atol=1e-12)
    null = np.linalg.svd(W)[2][4:]
    np.testing.assert_allclose(null @ matrix / np.abs(matrix).max(axis=0), 0.0, atol=1e-9)


def test_weights_agree_with_the_vehicle():
    vehicle = VEHICLES["lopsided"]
    theirs = quadratic_weights(
        np.array(vehicle.rotor_position_m),
        np.array(vehicle.rotor_direction, dtype=float),
        thrust=vehicle.thrust_coefficient_n_s2,
        torque=vehicle.torque_coefficient_n_m_s2,
    )
    np.testing.assert_allclose(theirs, weights(vehicle), rtol=1e-15)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"rotor_position_m": ((0.1, 0.0, 0.0), (-0.1, 0.0, 0.0)), "rotor_direction": (1, -1)}, "2 rotors"),
        ({"rotor_direction": (1, 1, 1, 1)}, "cannot produce"),
        ({"torque_coefficient_n_m_s2": 0.0}, "cannot produce"),
        (
            {"rotor_position_m": ((0.3, 0.1, 0.0), (0.3, -0.1, 0.0), (0.1, -0.1, 0.0), (0.1, 0.1, 0.0))},
            "not inside the ring",
        ),
    ],
)
def test_rotors_that_cannot_fly_are_refused(overrides, message):
    vehicle: MultirotorConfig = preset("hummingbird", **overrides)
    with pytest.raises(ValueError, match=message):
        allocation_matrix(vehicle)
