"""Surface normals of a box: those of its walls, towards the camera, also where the vehicle is turned."""

from __future__ import annotations

import numpy as np
import pytest
from small_room import fly_in_room, write_room

LENS = {"width": 40, "height": 30, "horizontal_fov_rad": 1.5}


@pytest.mark.parametrize("traversal", ["embree", "warp"])
@pytest.mark.parametrize(("yaw_rad", "facing"), [(0.0, [-1, 0, 0]), (np.pi / 2, [0, -1, 0])])
def test_normals_are_those_of_the_walls(tmp_path, traversal, yaw_rad, facing):
    room = write_room(tmp_path / "room.glb")
    mount = {"position_m": [0, 0, 0], "rpy_rad": [0.0, 0.0, yaw_rad]}
    sensors = {"normals": {"kind": "normal", "lens": LENS, "mount": mount, "rate_hz": 20}}
    render = {"lighting": {"mode": "unshadowed"}, "cpu_traversal": traversal}
    first = fly_in_room(room, sensors, render=render)[0]
    assert (first.data.dtype, first.data.shape, first.encoding) == (np.float32, (30, 40, 3), "32FC3")
    np.testing.assert_allclose(first.data[15, 20], facing, atol=1e-6)  # float32
    np.testing.assert_allclose(np.linalg.norm(first.data, axis=2), 1.0, atol=1e-6)
    assert np.abs(first.data).max(axis=2).min() > 1.0 - 1e-6  # all along an axis
    upper = [0, 0, -1] if yaw_rad == 0.0 else facing  # the ceiling, which the nearer wall hides
    np.testing.assert_allclose(first.data[0, 20], upper, atol=1e-6)
