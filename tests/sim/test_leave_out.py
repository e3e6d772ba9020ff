"""What a scene does not need is left out: libraries, and arrays for pictures, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys

SCENE_LIBRARIES = {"trimesh", "PIL", "networkx", "embreex", "pyrender", "OpenGL"}
HEIGHT_PX, WIDTH_PX = 47, 61
"""Prime, and of no other array: what has them is a picture."""
FLY = """
import gc, itertools, json, sys
import warp as wp
import neurosim_core as ns
settings, size = ns.load_config(json.loads(sys.argv[1])), tuple(json.loads(sys.argv[2]))
flight = ns.run(settings)
next(flight)
shapes = [thing.shape for thing in gc.get_objects() if isinstance(thing, wp.array)]
pictures = sum(size in itertools.pairwise(shape) for shape in shapes)
print(json.dumps([pictures, sorted(sys.modules)]))
"""


def fly(sensor: dict[str, object]) -> tuple[int, set[str]]:
    """Return the number of arrays for pictures during a flight, and what it has imported."""
    settings = {
        "device": "cpu",
        "duration_s": 0.1,
        "path": {"kind": "circle", "radius_m": 0.3},
        "scene": {"kind": "apartment", "rooms": 1},
        "vehicle": {"on_collision": "report"},
        "sensors": {"sensor": sensor},
    }
    command = [sys.executable, "-c", FLY, json.dumps(settings), json.dumps([HEIGHT_PX, WIDTH_PX])]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    pictures, modules = json.loads(told.splitlines()[-1])
    return pictures, set(modules)


def test_an_imu_alone_needs_no_pictures_and_no_libraries_for_scenes():
    pictures, modules = fly({"kind": "imu"})
    assert pictures == 0
    assert not modules & SCENE_LIBRARIES


def test_pictures_of_a_camera_are_seen():
    lens = {"width": WIDTH_PX, "height": HEIGHT_PX, "horizontal_fov_rad": 1.5}
    assert fly({"kind": "event_camera", "lens": lens})[0] > 0
