"""A room of few triangles: scenes that are loaded in no time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import trimesh

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
