"""Lenses against the pinhole equation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim_core.render.camera import PinholeConfig


@given(
    fx=st.floats(50.0, 500.0),
    fy=st.floats(50.0, 500.0),
    cx=st.floats(-20.0, 60.0),
    cy=st.floats(-20.0, 60.0),
)
def test_rays_project_back_onto_pixel_centres(fx, fy, cx, cy):
    """Column = fx x / z + cx at the centre of pixel k is k + 0.5."""
    lens = PinholeConfig(width=31, height=17, fx=fx, fy=fy, cx=cx, cy=cy)
    rays = lens.ray_table().astype(np.float64)
    col = fx * rays[..., 0] / rays[..., 2] + cx
    row = fy * rays[..., 1] / rays[..., 2] + cy
    # float32 directions: 6e-8 relative, times the focal length and at most 2 of tan
    np.testing.assert_allclose(col, np.broadcast_to(np.arange(31) + 0.5, (17, 31)), atol=2e-4)
    np.testing.assert_allclose(row, np.broadcast_to(np.arange(17)[:, None] + 0.5, (17, 31)), atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=2e-7)


def test_field_of_view_reaches_from_border_to_border():
    lens = PinholeConfig(width=640, height=480, horizontal_fov_rad=1.4)
    left = lens.ray_table((0.0, 0.5))[240, 0]
    assert 2.0 * math.atan2(-left[0], left[2]) == pytest.approx(1.4, rel=1e-6)
    fx, fy, cx, cy = lens.intrinsics()
    assert fx == fy
    assert (cx, cy) == (320.0, 240.0)
    np.testing.assert_array_equal(
        lens.ray_table(), PinholeConfig(width=640, height=480, fx=fx, fy=fy, cx=cx, cy=cy).ray_table()
    )
    assert lens.intrinsics().matrix()[0].tolist() == [fx, 0.0, 320.0]


def test_ray_spread_is_the_root_of_a_pixels_solid_angle():
    """Solid angle of a pixel from the cross product of its sides on the unit sphere."""
    lens = PinholeConfig(width=40, height=30, fx=25.0, fy=20.0, cx=18.0, cy=16.0)
    across = lens.ray_table((1.0, 0.5)).astype(float) - lens.ray_table((0.0, 0.5))
    down = lens.ray_table((0.5, 1.0)).astype(float) - lens.ray_table((0.5, 0.0))
    solid = np.linalg.norm(np.cross(across, down), axis=-1)
    # finite differences: second order in the size of a pixel, 1/20 rad
    np.testing.assert_allclose(lens.ray_spread() ** 2, solid, rtol=3e-3)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "give horizontal_fov_rad"),
        ({"fx": 100.0, "fy": 100.0}, r"missing \['cx', 'cy'\]"),
        ({"horizontal_fov_rad": 1.0, "fx": 100.0}, "not both"),
        ({"horizontal_fov_rad": 3.2}, "less than 3.14"),
        ({"horizontal_fov_rad": 1.0, "width": 0}, "greater than 0"),
    ],
)
def test_what_is_no_camera_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        PinholeConfig(**{"width": 64, "height": 48, **fields})
