"""Setpoints are the rows of their modes, for one vehicle and for many."""

from __future__ import annotations

import numpy as np
import pytest

import neurosim_core as ns
from neurosim_core.control.modes import MODES


@pytest.mark.parametrize(
    ("setpoint", "row"),
    [
        (ns.MotorSpeeds(speed_rad_s=[1, 2, 3, 4]), [1, 2, 3, 4]),
        (ns.BodyRates(thrust_n=5.0, body_rate_rad_s=[1, 2, 3]), [5, 1, 2, 3]),
        (ns.AttitudeThrust(thrust_n=5.0, orientation=[0, 0, 0, 1]), [5, 0, 0, 0, 1]),
        (ns.Velocity(velocity_m_s=[1, 2, 3]), [1, 2, 3, 0]),
        (ns.Position(position_m=[1, 2, 3], yaw_rad=0.5), [1, 2, 3, 0.5]),
    ],
)
def test_a_setpoint_is_the_row_of_its_mode(setpoint, row):
    assert setpoint.mode in MODES
    np.testing.assert_array_equal(setpoint.row(), row)


def test_setpoints_of_many_worlds():
    """One number for all, or one for each."""
    velocity = np.arange(6.0).reshape(2, 3)
    rows = ns.Velocity(velocity_m_s=velocity, yaw_rate_rad_s=[7.0, 8.0]).row()
    np.testing.assert_array_equal(rows, [[0, 1, 2, 7], [3, 4, 5, 8]])
    np.testing.assert_array_equal(ns.Velocity(velocity_m_s=velocity, yaw_rate_rad_s=7.0).row()[:, 3], [7, 7])
    rows = ns.BodyRates(thrust_n=[1.0, 2.0], body_rate_rad_s=[0.0, 0.0, 3.0]).row()
    np.testing.assert_array_equal(rows, [[1, 0, 0, 3], [2, 0, 0, 3]])
