"""The test pattern: which instant a picture shows, that frames differ and depend on nothing but the pose."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from render_scenes import plane, scene_of

from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import RenderConfig
from neurosim_core.render.renderer import make_renderer, upload_scene
from neurosim_core.render.synthetic_renderer import OUTPUTS, read_pose

LENS = PinholeConfig(width=64, height=48, horizontal_fov_rad=1.5)
SIDE = 1  # 48 // 30
NOWHERE = -1


def poses(count, seed=0):
    """Return places [m] and unit quaternions."""
    generator = np.random.default_rng(seed)
    q = generator.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return generator.uniform(-5, 5, (count, 3)).astype(np.float32), q.astype(np.float32)


def card(device, *, lens=LENS, outputs=OUTPUTS, capacity=4, images=4):
    scene = upload_scene(scene_of(plane(1.0)), RenderConfig(), device=device, renderer="synthetic")
    return make_renderer(scene, lens, outputs=outputs, instant_count=capacity, image_count=images)


def draw(renderer, device, p_WC, q_WC, slots):
    renderer.render(
        wp.array(p_WC, dtype=wp.vec3, device=device),
        wp.array(q_WC, dtype=wp.quat, device=device),
        wp.array(np.array(slots, dtype=np.int32), dtype=int, device=device),
        instant_count=len(p_WC),
    )
    return {name: getattr(renderer, name).numpy().copy() for name in OUTPUTS if getattr(renderer, name)}


def test_a_picture_begins_with_its_pose(device):
    p_WC, q_WC = poses(4)
    drawn = draw(card(device), device, p_WC, q_WC, [2, NOWHERE, 0, 1])
    for instant, slot in enumerate([2, NOWHERE, 0, 1]):
        if slot != NOWHERE:
            wanted = np.concatenate([p_WC[instant], q_WC[instant]])
            np.testing.assert_array_equal(read_pose(drawn["rgb"][slot]), wanted)
            np.testing.assert_array_equal(read_pose(drawn["depth"][slot]), wanted)
            np.testing.assert_array_equal(read_pose(drawn["depth"][slot][:, :, None]), wanted)


def test_a_picture_is_a_function_of_its_pose(device):
    """Whatever was in the slot before: only the square that was there has to be restored."""
    p_WC, q_WC = poses(40, seed=1)
    used = card(device)
    for first in range(0, 40, 4):
        again = draw(used, device, p_WC[first : first + 4], q_WC[first : first + 4], [0, 1, 2, 3])
    fresh = draw(card(device), device, p_WC[36:], q_WC[36:], [0, 1, 2, 3])
    for name in OUTPUTS:
        np.testing.assert_array_equal(again[name], fresh[name])


def test_the_square_moves_with_the_camera(device):
    """5 mm along x are one pixel: 16 places in a row, all different, in what event cameras see too."""
    q_WC = np.tile(np.float32([-0.5, 0.5, -0.5, 0.5]), (16, 1))
    p_WC = np.zeros((16, 3), np.float32)
    p_WC[:, 0] = 0.0025 + 0.005 * np.arange(16)
    drawn = draw(card(device, capacity=16, images=16), device, p_WC, q_WC, range(16))
    blank = np.median(drawn["log_radiance"], axis=0)
    where = [np.argwhere(frame != blank) for frame in drawn["log_radiance"]]
    assert {len(places) for places in where} == {SIDE * SIDE}
    columns = [int(places[0, 1]) for places in where]
    assert np.abs(np.diff(columns)).tolist() == [1] * 15
    for frame, depth, places in zip(drawn["rgb"], drawn["depth"], where, strict=True):
        row, col = places[0]
        assert frame[row, col].tolist() == [255, 255, 255]
        assert depth[row, col] == 1.0


def test_the_square_leaves_the_pose_alone(device):
    """This pose has the square in the corner where the pose is written."""
    lens = PinholeConfig(width=120, height=120, horizontal_fov_rad=1.5)
    pose = np.float32([0.0, 0.0, -120 / 200, 0.0, 0.0, 0.0, 1.0])
    drawn = draw(card(device, lens=lens), device, pose[None, :3], pose[None, 3:], [0])
    assert (drawn["depth"][0, 1:4, :4] == 1.0).all()
    np.testing.assert_array_equal(read_pose(drawn["rgb"][0]), pose)
    np.testing.assert_array_equal(read_pose(drawn["depth"][0]), pose)


def test_log_radiance_is_that_of_the_card(device):
    drawn = draw(card(device), device, *poses(1), [0])
    floor = RenderConfig().dark_floor
    grey = ((192 / 255 + 0.055) / 1.055) ** 2.4  # sRGB, IEC 61966-2-1
    assert drawn["log_radiance"][0, 0, 0] == pytest.approx(np.log(grey + floor), abs=1e-5)
    assert drawn["log_radiance"][0].max() == pytest.approx(np.log(1.0 + floor), abs=1e-6)
    assert drawn["depth"][0, -1, [0, -1]].tolist() == [2.0, 10.0]


@pytest.mark.parametrize(("width", "height"), [(5, 2), (2, 5), (10, 1), (1, 33)])
def test_the_smallest_card_still_holds_a_pose(device, width, height):
    lens = PinholeConfig(width=width, height=height, horizontal_fov_rad=1.0)
    p_WC, q_WC = poses(3)
    drawn = draw(card(device, lens=lens), device, p_WC, q_WC, [0, 1, 2])
    for slot in range(3):
        wanted = np.concatenate([p_WC[slot], q_WC[slot]])
        np.testing.assert_array_equal(read_pose(drawn["rgb"][slot]), wanted)
        np.testing.assert_array_equal(read_pose(drawn["depth"][slot]), wanted)


def test_only_what_is_asked_for_is_there(device):
    renderer = card(device, outputs={"rgb"})
    assert renderer.log_radiance is renderer.depth is renderer.normal is renderer.instance is None
    assert renderer.rgb.shape == (4, 48, 64, 3)
    draw(renderer, device, *poses(2), [0, 1])


def test_what_it_does_not_have_is_refused(device):
    with pytest.raises(ValueError, match=r"has \['depth', 'log_radiance', 'rgb'\], asked for \['normal'\]"):
        card(device, outputs={"normal"})
    with pytest.raises(ValueError, match=r"at least 10 pixels, got 3 x 3"):
        card(device, lens=PinholeConfig(width=3, height=3, horizontal_fov_rad=1.0))
