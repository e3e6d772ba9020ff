"""A hall with boxes: where they are, and that a seed chooses how they look."""

from __future__ import annotations

import numpy as np
import pytest

import neurosim_core as ns
from neurosim_core import sim
from neurosim_core.scene.freespace import FreeSpaceConfig, make_free_space
from neurosim_core.scene.hall import HallConfig, make_hall

BOX = {"position_m": (2.0, 1.0, 1.5), "size_m": (1.0, 0.4, 3.0), "yaw_rad": 0.5 * np.pi}


def test_boxes_and_walls_are_where_they_are_said_to_be():
    config = HallConfig(size_m=(12.0, 8.0, 3.0), boxes=[BOX])
    space = make_free_space(make_hall(config), FreeSpaceConfig())
    points = [(2.0, 0.0, 1.5), (3.0, 1.0, 1.5), (-5.0, 0.0, 1.5), (0.0, -3.5, 1.5), (-3.0, 0.0, 0.25)]
    # the box is turned by a quarter: half of it is 0.5 along y and 0.2 along x
    np.testing.assert_allclose(space.clearance(points), [0.5, 0.8, 1.0, 0.5, 0.25], atol=1e-5)
    assert sum(name.startswith("box_") for name in make_hall(config).instance_names) == 1


def test_a_seed_gives_the_same_hall_and_another_one_other_colours():
    first, again, other = (make_hall(HallConfig(seed=seed, boxes=[BOX] * 8)) for seed in (1, 1, 2))
    assert first.materials[0].texture.srgb.tobytes() == again.materials[0].texture.srgb.tobytes()
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.face_material, again.face_material)
    colours = [[material.base_color for material in hall.materials] for hall in (first, other)]
    assert colours[0] != colours[1]


def test_a_hall_is_lit():
    """Floor and walls reflect neither nearly nothing nor more than a picture has room for."""
    lens = {"width": 32, "height": 24, "horizontal_fov_rad": 1.6}
    config = ns.load_config(
        {
            "device": "cpu",
            "scene": {"kind": "hall", "size_m": (12.0, 12.0, 4.0), "inside_m": (0.0, 0.0, 1.5)},
            "path": {"kind": "hover"},
            "sensors": {"rgb": {"kind": "rgb", "lens": lens}},
        }
    )
    model = ns.make_model(config)
    (packet,) = (p for p in sim.start(model, ns.make_state(model)) if isinstance(p, ns.Image))
    assert 60.0 < packet.data.mean() < 200.0


def test_a_box_without_width_is_refused():
    with pytest.raises(ValueError, match="size_m"):
        HallConfig(boxes=[{**BOX, "size_m": (1.0, 0.0, 1.0)}])
