"""Rooms of few triangles, whose geometry is known: scenes that are loaded in no time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import trimesh

import neurosim_core as ns
from neurosim_core.packets import Packet

LENGTH_M, WIDTH_M, HEIGHT_M = 8.0, 6.0, 3.0
"""Along x, y and z; the floor is at z = 0, the middle of it at the origin."""


def room_scene(folder: Path) -> dict[str, Any]:
    """Write a room with a crate in a corner to a file; return the settings of the scene."""
    middle = trimesh.transformations.translation_matrix([0.0, 0.0, 0.5 * HEIGHT_M])
    room = trimesh.creation.box((LENGTH_M, WIDTH_M, HEIGHT_M), middle)
    room.invert()
    crate = trimesh.creation.box((0.8, 0.8, 0.8), trimesh.transformations.translation_matrix([3, 2, 0.4]))
    file = folder / "room.ply"
    trimesh.util.concatenate([room, crate]).export(file)
    return {"kind": "mesh", "file": str(file)}


def write_room(path: Path) -> Path:
    """Write a box of 6 x 4 x 3 m seen from within, its middle at (0, 0, 1.5), with a board before the wall.

    The board is 1 m square and parallel to the wall at x = 3, half a metre before it.
    """
    scene = trimesh.Scene()
    walls = trimesh.creation.box(extents=(6.0, 4.0, 3.0))
    walls.invert()
    walls.apply_translation([0.0, 0.0, 1.5])
    scene.add_geometry(walls, node_name="walls")
    board = trimesh.creation.box(extents=[0.02, 1.0, 1.0])
    board.apply_translation([2.51, 0.0, 1.5])
    scene.add_geometry(board, node_name="board")
    scene.export(path)
    return path


def fly_in_room(path: Path, sensors: dict[str, Any], **changes: Any) -> list[Packet]:
    """Return the packets of a hover in the middle of the room, looking along x; 0.1 s."""
    settings = {
        "duration_s": 0.1,
        "device": "cpu",
        "scene": {
            "kind": "mesh", "file": str(path), "up_axis": "z", "unit_m": 1.0, "inside_m": [0.0, 0.0, 1.5],
        },
        "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
        "path": {"kind": "hover", "position_m": [0.0, 0.0, 1.5]},
        "sensors": sensors,
        **changes,
    }  # fmt: skip
    return list(ns.run(settings))
