"""The range finder: lengths of rays to the walls of a box and to a board before one of them."""

from __future__ import annotations

import numpy as np
import pytest
from small_room import fly_in_room, write_room

from neurosim_core.sensors.range_finder import Range, RangeFinderConfig
from neurosim_core.settings_file import ConfigError


def reading(tmp_path, **settings) -> Range:
    sensor = {"kind": "range_finder", "mount": {"position_m": [0, 0, 0], **settings.pop("mount", {})}}
    packets = fly_in_room(write_room(tmp_path / "room.glb"), {"range": {**sensor, **settings}})
    assert [packet.stamp_ns for packet in packets] == list(range(0, 100_000_001, 20_000_000))
    assert all(isinstance(packet, Range) for packet in packets)
    return packets[0]


@pytest.mark.parametrize(
    ("rpy_rad", "distance_m"),
    [
        ([0, 0, 0], 2.5),  # the near face of the board
        ([0, 0, np.pi / 2], 2.0),
        ([0, np.pi / 2, 0], 1.5),  # down
        ([0, 0, np.pi / 4], 2.0 * np.sqrt(2.0)),  # aslant onto the wall at y = 2
    ],
)
def test_the_distance_is_that_of_the_wall(tmp_path, rpy_rad, distance_m):
    found = reading(
        tmp_path, mount={"rpy_rad": rpy_rad}, lens={"width": 1, "height": 1, "horizontal_fov_rad": 0.01}
    )
    assert found.distance_m == pytest.approx(distance_m, rel=1e-6)  # float32
    assert found.field_of_view_rad == pytest.approx(0.01)


def test_the_nearest_surface_in_the_cone_counts(tmp_path):
    """Aslant at 45 degrees, the nearest ray of a wide cone leans towards the wall."""
    lens = {"width": 5, "height": 1, "horizontal_fov_rad": 0.4}
    found = reading(tmp_path, mount={"rpy_rad": [0, 0, np.pi / 4]}, lens=lens)
    lean_rad = np.arctan(0.8 * np.tan(0.2))  # centre of the outermost pixel
    assert found.distance_m == pytest.approx(2.0 / np.cos(np.pi / 4 - lean_rad), rel=1e-6)


def test_beyond_its_range_it_says_so(tmp_path):
    assert reading(tmp_path, range_max_m=2.4).distance_m == np.inf
    assert reading(tmp_path, range_min_m=2.6).distance_m == -np.inf


def test_a_range_without_length_is_refused():
    with pytest.raises(ConfigError, match="range_min_m must be below range_max_m = 1, got 2"):
        RangeFinderConfig(range_min_m=2.0, range_max_m=1.0)
