"""The lag that the stages see: a quadratic with the exponential's moments, for any step and time constant."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.integrate import quad

from neurosim_core.vehicle.motor import lag_constants, projected_exponential


@pytest.mark.parametrize("z", [1e-9, 1e-3, 0.1, 0.1499, 0.1501, 0.299, 0.301, 1.0, 7.0, 50.0, 1e3, 1e6])
def test_projection_has_the_moments_of_the_exponential(z):
    constants = lag_constants(z, 1.0)
    for nodes, rate in ((constants.speed_nodes, z), (constants.square_nodes, 2.0 * z)):
        quadratic = np.poly1d(np.polyfit([0.0, 0.5, 1.0], nodes, 2))
        for n in range(3):
            end = min(1.0, 60.0 / rate)  # what follows is below 1e-26
            exact = quad(lambda s, n=n, rate=rate: s**n * np.exp(-rate * s), 0.0, end, epsabs=1e-15)[0]
            moment = (quadratic * np.poly1d([1.0] + n * [0.0])).integ()(1.0)
            assert moment == pytest.approx(exact, abs=2e-14)  # 5 (6 m2 - 6 m1 + m0) loses two digits
    assert constants.decay == pytest.approx(np.exp(-z), rel=1e-15)


def test_no_time_constant_means_at_once():
    assert lag_constants(1e-3, 0.0)[:3] == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)


def test_tiny_time_constants_stay_finite():
    assert np.isfinite(np.concatenate(lag_constants(1e-3, 5e-324)[:2])).all()


@wp.kernel
def _project(z: wp.array[wp.float64], nodes_out: wp.array[wp.vec3d]) -> None:
    row = wp.tid()
    nodes_out[row] = projected_exponential(z[row])


def test_the_device_projects_alike(device):
    z = np.array([1e-9, 1e-3, 0.1, 0.299, 0.3, 0.301, 1.0, 7.0, 50.0, 1e3, 1e297])
    nodes = wp.zeros(len(z), dtype=wp.vec3d, device=device)
    wp.launch(
        _project, dim=len(z), inputs=[wp.array(z, dtype=wp.float64, device=device), nodes], device=device
    )
    expected = [lag_constants(value, 1.0).speed_nodes for value in z]
    assert nodes.numpy() == pytest.approx(np.array(expected), abs=1e-13)  # the host loses digits at 0.3
