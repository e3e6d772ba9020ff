"""Edges of a room with a board in it, whose projection is known."""

from __future__ import annotations

import json
import math

import numpy as np
from small_room import fly_in_room, write_room

LENS = {"width": 64, "height": 48, "horizontal_fov_rad": 1.8}
CAMERA = {"lens": LENS, "mount": {"position_m": [0, 0, 0]}, "rate_hz": 20}


def test_edges_are_where_geometry_says(tmp_path):
    """The board is an edge in depth, the corners of the room are creases, planes have no edge."""
    sensors = {"edges": {"kind": "edges", **CAMERA}, "labels": {"kind": "instance", **CAMERA}}
    found = {p.sensor: p for p in fly_in_room(write_room(tmp_path / "room.glb"), sensors) if p.stamp_ns == 0}
    edges, board = found["edges"].data, found["labels"].data == found["labels"].data[24, 32]
    assert json.loads(found["edges"].labels)["classes"] == ["none", "depth", "object", "crease"]
    differs = np.zeros_like(board)
    differs[:, :-1] |= board[:, :-1] != board[:, 1:]
    differs[:-1] |= board[:-1] != board[1:]
    np.testing.assert_array_equal(edges == 1, differs)
    assert not (edges == 2).any()
    # the wall x = 3 ends at y = +-2 and z = 1.5 +- 1.5
    focal = 32.0 / math.tan(0.9)
    x, y = np.arange(64) + 0.5 - 32.0, np.arange(48) + 0.5 - 24.0
    wall = (np.abs(y)[:, None] < focal * 1.5 / 3.0) & (np.abs(x)[None] < focal * 2.0 / 3.0)
    crease = edges == 3
    assert crease[24, int(32 + focal * 2.0 / 3.0 - 0.5)]
    rim = np.zeros_like(wall)
    rim[:, :-1] |= wall[:, :-1] != wall[:, 1:]
    rim[:-1] |= wall[:-1] != wall[1:]
    assert crease[rim & ~differs].all()
    assert not crease[wall & ~rim].any()
