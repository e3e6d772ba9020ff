"""A room to learn in."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp
from runtime_directory import runtime

import neurosim_core as ns

__all__ = ["runtime"]


@pytest.fixture(scope="session")
def hall(tmp_path_factory):
    """A textured room, loaded once: what `make_model` returns."""
    scene = trimesh.Scene()
    walls = trimesh.creation.box(extents=[8.0, 8.0, 4.0])
    for _ in range(4):
        walls = walls.subdivide()
    walls.invert()
    walls.apply_translation([0.0, 0.0, 2.0])
    shades = np.random.default_rng(1).integers(30, 255, (len(walls.faces), 1)).repeat(3, axis=1)
    walls.visual.face_colors = np.hstack([shades, np.full((len(shades), 1), 255)])
    scene.add_geometry(walls, node_name="walls")
    path = tmp_path_factory.mktemp("hall") / "hall.glb"
    scene.export(path)
    mesh = {"kind": "mesh", "file": str(path), "up_axis": "z", "unit_m": 1.0, "inside_m": [0.0, 0.0, 2.0]}
    lens = {"width": 8, "height": 8, "horizontal_fov_rad": 1.5}
    return ns.make_model(
        ns.load_config(
            {
                "device": "cpu",
                "render": {"samples_per_pixel": 4},
                "scene": mesh,
                "path": {"kind": "hover"},
                "sensors": {"front": {"kind": "event_camera", "lens": lens}},
            }
        )
    )


@pytest.fixture(scope="module")
def env(request):
    """The task that the module names, in the first of its scenes to test in: without a camera, on a CPU."""
    from neurosim_core.learn.env import find_task

    options = dict(request.module.ENV)
    task = find_task(options.pop("task"))
    return ns.learn.make_env(task, device="cpu", scenes=task.scenes(unseen=True)[:1], **options)


@pytest.fixture
def host_tensors(monkeypatch):
    """Return the function that counts how many tensors of numbers of the host another function makes.

    On a CUDA device each is a copy that waits until all work there is done. Views of Warp's arrays are none.
    """
    from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

    to_torch = wp.to_torch

    class Count(TorchDispatchMode):
        made = 0

        def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
            self.made += "lift_fresh" in str(operation)
            return operation(*args, **(kwargs or {}))

    def view(array):
        with _disable_current_modes():
            return to_torch(array)

    def count(function) -> int:
        monkeypatch.setattr(wp, "to_torch", view)
        with Count() as counted:
            function()
        return counted.made

    return count
