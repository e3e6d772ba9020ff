"""Make a scene with trimesh, save it as GLB, and fly in it.

Any glTF, OBJ, PLY or STL file in metres works in the same way. The depth camera, 0.1 m in
front of the centre of the vehicle, looks along x at a wall that is 4 m away.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import trimesh

import neurosim_core as ns


def room(file: Path) -> None:
    """Write a room of 8 x 6 x 3 m, seen from inside, with a pillar behind the start."""
    walls = trimesh.creation.box(extents=[8.0, 6.0, 3.0])
    walls.apply_translation([0.0, 0.0, 1.5])
    walls.invert()  # normals point inwards
    pillar = trimesh.creation.box(extents=[0.4, 0.4, 3.0])
    pillar.apply_translation([-2.0, 1.0, 1.5])
    trimesh.Scene({"walls": walls, "pillar": pillar}).export(file)


def main() -> float:
    """Return the distance of the wall in the middle of the picture [m]."""
    lens = {"width": 64, "height": 48, "horizontal_fov_rad": 1.2}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "room.glb"
        room(file)
        config = ns.load_config(
            {
                "duration_s": 0.1,
                "device": "cpu",
                "scene": {"kind": "mesh", "file": str(file), "up_axis": "z"},
                "path": {"kind": "hover", "position_m": [0.0, 0.0, 1.5]},
                "sensors": {"depth": {"kind": "depth", "lens": lens, "rate_hz": 20.0}},
            }
        )
        pictures = [packet.data for packet in ns.run(config) if isinstance(packet, ns.Image)]
    distance_m = float(np.median(pictures[-1][20:28, 28:36]))
    print(f"{len(pictures)} pictures; the wall is at {distance_m:.2f} m")
    return distance_m


if __name__ == "__main__":
    main()
