"""Instance segmentation against the silhouette of a board of known size and place."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_room import fly_in_room, write_room

LENS = {"width": 64, "height": 48, "horizontal_fov_rad": 1.2}


@pytest.mark.parametrize("traversal", ["embree", "warp"])
def test_the_board_is_where_its_projection_is(tmp_path, traversal):
    room = write_room(tmp_path / "room.glb")
    sensors = {
        "labels": {"kind": "instance", "lens": LENS, "mount": {"position_m": [0, 0, 0]}, "rate_hz": 20}
    }
    render = {"lighting": {"mode": "unshadowed"}, "cpu_traversal": traversal}
    packets = fly_in_room(room, sensors, render=render)
    assert [packet.stamp_ns for packet in packets] == [0, 50_000_000, 100_000_000]
    focal = 0.5 * LENS["width"] / math.tan(0.5 * LENS["horizontal_fov_rad"])
    half_px = focal * 0.5 / 2.5  # of the board's near face, 2.5 m away
    columns, rows = np.arange(64) + 0.5 - 32.0, np.arange(48) + 0.5 - 24.0
    board = (np.abs(rows)[:, None] < half_px) & (np.abs(columns)[None] < half_px)
    first = packets[0]
    assert (first.data.dtype, first.encoding) == (np.int32, "32SC1")
    labels = set(np.unique(first.data).tolist())
    assert len(labels) == 2
    seen = first.data == first.data[24, 32]
    np.testing.assert_array_equal(seen, board)
