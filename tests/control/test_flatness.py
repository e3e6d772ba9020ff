"""Attitude, body rate and angular acceleration from thrust and yaw."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from neurosim_core.control.flatness import AttitudeReference, Heading, attitude_reference

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _references(
    derivatives: wp.array2d[wp.vec3d],
    yaw: wp.array2d[wp.float64],
    orientation: wp.array[wp.quatd],
    reference_out: wp.array[AttitudeReference],
):
    sample = wp.tid()
    heading = Heading()
    heading.direction = wp.vec3d(wp.cos(yaw[sample, 0]), wp.sin(yaw[sample, 0]), wp.float64(0.0))
    heading.rate_rad_s = yaw[sample, 1]
    heading.acceleration_rad_s2 = yaw[sample, 2]
    reference_out[sample] = attitude_reference(
        derivatives[sample, 0], derivatives[sample, 1], derivatives[sample, 2], heading, orientation[sample]
    )


def references(thrust, yaw, device, orientation=(0.0, 0.0, 0.0, 1.0)):
    """Thrust and two derivatives [n, 3, 3], yaw and two derivatives [n, 3] -> structured rows [n]."""
    count = len(thrust)
    out = wp.empty(count, dtype=AttitudeReference, device=device)
    wp.launch(
        _references,
        dim=count,
        inputs=[
            wp.array(np.asarray(thrust, dtype=float), dtype=wp.vec3d, device=device),
            wp.array(np.asarray(yaw, dtype=float), dtype=wp.float64, device=device),
            wp.array(np.broadcast_to(orientation, (count, 4)).astype(float), dtype=wp.quatd, device=device),
        ],
        outputs=[out],
        device=device,
    )
    return out.numpy()


def wave(t, amplitude, rate, phase, offset):
    """A sum of sinusoids and its first two derivatives, [n, 3 derivatives, axes]."""
    argument = np.multiply.outer(t, rate) + phase
    return np.stack(
        [
            offset + amplitude * np.sin(argument),
            amplitude * rate * np.cos(argument),
            -amplitude * rate**2 * np.sin(argument),
        ],
        axis=1,
    )


def aerobatics(t):
    """Thrust of 3 to 22 m/s^2 tilted up to 70 degrees, yaw through all headings."""
    thrust = wave(
        t,
        np.array([7.0, 6.0, 5.0]),
        np.array([2.3, 3.1, 1.7]),
        np.array([0.3, 1.9, 0.7]),
        np.array([1.0, 0.0, 9.81]),
    )
    yaw = wave(t, np.array([2.5]), np.array([1.3]), np.array([0.2]), np.array([0.4]))[:, :, 0]
    return thrust, yaw


def loop(t):
    """Thrust that turns once about y and keeps its length: a flip in the plane of the heading."""
    angle, rate = 3.0 * t, 3.0
    zero = np.zeros_like(t)
    z = np.stack([np.sin(angle), zero, np.cos(angle)], axis=1)
    z_rate = rate * np.stack([np.cos(angle), zero, -np.sin(angle)], axis=1)
    return 12.0 * np.stack([z, z_rate, -(rate**2) * z], axis=1), np.zeros((len(t), 3))


def test_axes_satisfy_the_constraints(device):
    """Axis z is along the thrust, y orthogonal to the heading, x on the heading's side."""
    thrust, yaw = aerobatics(np.linspace(0.0, 6.0, 200))
    axes = Rotation.from_quat(references(thrust, yaw, device)["orientation"]).as_matrix()
    x, y, z = np.moveaxis(axes, 2, 0)
    b1 = np.stack([np.cos(yaw[:, 0]), np.sin(yaw[:, 0]), 0.0 * yaw[:, 0]], axis=1)
    np.testing.assert_allclose(
        z, thrust[:, 0] / np.linalg.norm(thrust[:, 0], axis=1, keepdims=True), atol=1e-14
    )
    np.testing.assert_allclose(np.sum(y * b1, axis=1), 0.0, atol=1e-14)
    assert (np.sum(x * b1, axis=1) > 0.0).all()


@pytest.mark.parametrize("motion", [aerobatics, loop])
def test_rate_and_acceleration_are_derivatives(device, motion):
    """Both w = vee(R^T R') and w' against fourth-order central differences of R and of w."""
    h = 1e-3
    centre = np.linspace(0.1, 5.9, 80)
    t = centre[:, None] + h * np.arange(-2, 3)
    shape = t.shape
    thrust, yaw = motion(t.ravel())
    q_WB = (0.0, 0.0, 0.0, 1.0)
    if motion is loop:  # the flip is continuous because the body is where it should be
        q_WB = Rotation.from_rotvec(np.outer(3.0 * t.ravel(), [0.0, 1.0, 0.0])).as_quat()
    rows = references(thrust, yaw, device, q_WB)
    R = Rotation.from_quat(rows["orientation"]).as_matrix().reshape(*shape, 3, 3)
    stencil = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12.0 * h)
    R_rate = np.einsum("k,nkij->nij", stencil, R)
    skew = np.einsum("nji,njk->nik", R[:, 2], R_rate)
    w = rows["body_rate"].reshape(*shape, 3)
    a = rows["angular_acceleration"].reshape(*shape, 3)
    # truncation h^4 / 30 times the fifth derivative (10 rad/s)^5 is 3e-9; rounding eps / h is 2e-13
    np.testing.assert_allclose(
        np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1), w[:, 2], atol=1e-7
    )
    np.testing.assert_allclose(np.einsum("k,nki->ni", stencil, w), a[:, 2], atol=1e-6)


def test_flip_keeps_turning_the_same_way(device):
    """In the flip the attitude is the rotation about y, inverted or not, and the rate is constant."""
    t = np.linspace(0.0, 2.0, 57)
    q_WB = Rotation.from_rotvec(np.outer(3.0 * t, [0.0, 1.0, 0.0])).as_quat()
    rows = references(*loop(t), device, q_WB)
    turned = Rotation.from_quat(rows["orientation"]) * Rotation.from_quat(q_WB).inv()
    assert turned.magnitude().max() < 1e-7  # arccos at 1: sqrt of rounding
    np.testing.assert_allclose(rows["body_rate"], np.tile([0.0, 3.0, 0.0], (len(t), 1)), atol=1e-12)


def test_free_fall_holds_the_attitude(device):
    """Without thrust there is no direction: z stays, heading is still served, nothing turns or is nan."""
    body = Rotation.from_euler("ZXY", [0.7, 0.4, -0.3])
    thrust = np.zeros((1, 3, 3))
    thrust[0, 1:] = 5.0
    row = references(thrust, [[0.7, 0.0, 0.0]], device, body.as_quat())[0]
    assert (Rotation.from_quat(row["orientation"]) * body.inv()).magnitude() < 1e-7
    assert row["body_rate"].tolist() == [0.0, 0.0, 0.0]
    assert row["angular_acceleration"].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("body", [(0.0, 90.0, 0.0), (0.0, 80.0, 10.0), (40.0, 0.0, -30.0), (0.0, 0.0, 90.0)])
def test_heading_along_the_thrust_holds_the_heading(device, body):
    """Where b1 is parallel to z, y is the horizontal axis nearest to the body's, and nothing is infinite."""
    q_WB = Rotation.from_euler("ZYX", body, degrees=True)
    thrust = np.zeros((1, 3, 3))
    thrust[0] = [[9.0, 0.0, 0.0], [0.0, 1.0, 2.0], [1.0, 1.0, 1.0]]
    row = references(thrust, [[0.0, 1.0, 1.0]], device, q_WB.as_quat())[0]
    axes = Rotation.from_quat(row["orientation"]).as_matrix()
    np.testing.assert_allclose(axes[:, 2], [1.0, 0.0, 0.0], atol=1e-14)
    y_B = q_WB.as_matrix()[:, 1]
    np.testing.assert_allclose(
        axes[1:, 1], y_B[1:] / np.linalg.norm(y_B[1:]), atol=1e-14
    )  # the part of y_B orthogonal to x_W
    assert np.isfinite(row["angular_acceleration"]).all()
    assert np.abs(row["body_rate"]).max() < 1.0
    assert row["body_rate"][2] == 0.0


def test_not_a_number_is_not_hidden(device):
    """Warp makes a quaternion of a nan matrix; the rates still carry the nan to the rotors."""
    thrust = np.zeros((3, 3, 3))
    thrust[:, 0, 2] = 9.81
    thrust[0, 0, 0] = thrust[1, 1, 0] = np.nan
    rows = references(thrust, [[0.0] * 3, [0.0] * 3, [np.nan, 0.0, 0.0]], device)
    assert np.isnan(rows["body_rate"]).any(axis=1).all()
