"""A pixel integrates light over its area: antialiasing against closed forms and many rays per pixel."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from render_scenes import DARK, LOOK_DOWN, UNSHADOWED, box, plane, render, scene_of
from scipy.spatial.transform import Rotation

from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.outputs import OUTPUTS, RADIANCE
from neurosim_core.render.ray_layers import first_rays, ray_layers
from neurosim_core.render.scene_arrays import upload_scene
from neurosim_core.scene.scene import Ambient, Material, Texture

LENS = PinholeConfig(width=33, height=18, fx=32.0, fy=32.0, cx=16.5, cy=9.0)
"""At 1 m a pixel is 1/32 m wide. The last blocks of 4 x 4 pixels are cut."""
PITCH_M = 1.0 / 32.0
ADAPTIVE = UNSHADOWED.model_copy(update={"samples_per_pixel": "adaptive"})
WHITE = Material(name="white", base_color=(0.0, 0.0, 0.0), emission=(1.0, 1.0, 1.0))
GREY = Material(name="grey", base_color=(0.0, 0.0, 0.0), emission=(0.25, 0.25, 0.25))


def strips(*spans_m, size_m=8.0):
    """Return white strips along y between x limits, just above a grey floor."""
    parts, end = [plane(size_m)], 0.5 * size_m
    for low, high in spans_m:
        corners = [[low, -end, 1e-4], [high, -end, 1e-4], [high, end, 1e-4], [low, end, 1e-4]]
        parts.append(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))
    return scene_of(*parts, materials=(GREY, WHITE), part_material=(0, *(1 for _ in spans_m)), ambient=DARK)


def radiance(scene, offsets_m, *, config=ADAPTIVE, device="cpu", lens=LENS, **options):
    """Return radiance of white and grey above the dark floor for cameras moved along x, shape [K, H, W]."""
    poses = [((x, 0.0, 1.0), LOOK_DOWN) for x in offsets_m]
    log = render(scene, lens, poses, outputs=("log_radiance",), config=config, device=device, **options)
    return np.exp(log["log_radiance"]) - config.dark_floor


@pytest.mark.parametrize("traversal", ["auto", "warp"])
def test_an_edge_that_moves_through_a_pixel(device, traversal):
    """Radiance is that of the box filter, to half the distance of the sample points: 1/64."""
    config = ADAPTIVE.model_copy(update={"cpu_traversal": traversal})
    offsets = np.linspace(0.0, PITCH_M, 41)
    seen = radiance(strips((0.0, 3.0)), offsets, config=config, device=device)
    column = np.arange(LENS.width)
    left = (column - 16.5)[None] + offsets[:, None] / PITCH_M  # of each pixel, from the edge [px]
    expected = 0.25 + 0.75 * np.clip(left + 1.0, 0.0, 1.0)
    assert np.abs(seen - expected[:, None]).max() <= 0.75 / 64.0 + 1e-4
    assert np.abs((seen - expected[:, None]).mean()) < 0.002  # no bias


def test_bars_thinner_than_a_pixel_are_seen(device):
    """Bars of 0.3 px are seen in all rows at any place: they cover 9 or 10 of 32 points.

    Where a bar lies in two pixels, the triangle that no first ray hits may be missed.
    """
    period, width = 7.0 * PITCH_M, 0.3 * PITCH_M
    bars = strips(*((k * period, k * period + width) for k in range(-4, 5)))
    seen = radiance(bars, np.linspace(0.0, PITCH_M, 65), device=device)
    share = (seen[:, 2:-2] - 0.25) / 0.75
    coverage = np.stack([share[..., col - 2 : col + 3].sum(axis=-1) for col in (9, 16, 23)], axis=-1)
    assert coverage.min() > 6.0 / 32.0 - 1e-3
    assert coverage.max() < 10.0 / 32.0 + 1e-3
    assert np.mean(np.abs(coverage - 0.3) < 0.03) > 0.8  # contrast within 10 %
    assert coverage.mean() == pytest.approx(0.3, abs=0.015)


def test_an_edge_crosses_levels_when_the_box_filter_does(device):
    """Log radiance passes levels 0.2 apart at the time of the closed form, to 1/64 of a pixel's transit."""
    offsets = np.linspace(0.5 * PITCH_M, 1.5 * PITCH_M, 321)
    log = np.log(radiance(strips((0.0, 3.0)), offsets, device=device)[:, 4, 15])
    levels = np.log(0.25) + 0.2 * np.arange(1, 7)
    crossed = np.array([np.argmax(log >= level) for level in levels]) / 320.0
    np.testing.assert_allclose(crossed, (np.exp(levels) - 0.25) / 0.75, atol=1 / 64 + 1 / 320)


def test_a_slow_drift_gives_no_event_of_its_own(device):
    """Bars 4 times as bright as the floor drift by 0.01 px/s: no step in log radiance reaches a threshold."""
    bars = strips(*((k * 5.3 * PITCH_M, (k * 5.3 + 1.7) * PITCH_M) for k in range(-6, 7)))
    log = np.log(radiance(bars, 0.02 * PITCH_M * np.arange(51), device=device))
    assert log.max() - log.min() > 1.3
    assert np.abs(np.diff(log, axis=0)).max() < 0.2  # 2 s each: true changes are below 0.06


def test_a_still_camera_sees_no_change(device):
    seen = radiance(strips((-0.3, 0.01), (0.2, 0.21)), [0.013] * 5, device=device)
    assert (seen == seen[0]).all()


def test_only_pixels_at_an_edge_are_means(device):
    """Pixels far from the edge show one surface, as one ray does."""
    seen = radiance(strips((0.3 * PITCH_M, 3.0)), [0.0], device=device)[0]
    np.testing.assert_allclose(seen[:, :12], 0.25, rtol=1e-5)
    np.testing.assert_allclose(seen[:, 21:], 1.0, rtol=1e-5)
    assert ((seen[:, 16] > 0.3) & (seen[:, 16] < 0.95)).all()


def test_the_sensitive_area_is_a_part_of_the_pixel(device):
    """With a fill factor of 1/4 the edge takes half a pixel from dark to bright."""
    config = ADAPTIVE.model_copy(update={"fill_factor": 0.25})
    offsets = np.linspace(-0.5, 0.5, 21) * PITCH_M
    seen = radiance(strips((0.0, 3.0)), offsets, config=config, device=device)[:, :, 16].mean(axis=1)
    expected = 0.25 + 0.75 * np.clip(offsets / PITCH_M / 0.5 + 0.5, 0.0, 1.0)
    assert np.abs(seen - expected).max() <= 0.75 / 32.0 + 1e-4


def test_close_to_many_rays(device):
    """Boxes before a wall: light is closer than with one ray per pixel, geometry is that of one ray."""
    rng = np.random.default_rng(3)
    boxes = [
        box(tuple(rng.uniform(0.02, 0.2, 3)), (*rng.uniform(-0.4, 0.4, 2), rng.uniform(0.1, 0.4)))
        for _ in range(30)
    ]
    materials = tuple(
        Material(name=str(k), base_color=(x, x, x)) for k, x in enumerate(rng.uniform(0.05, 1.0, 31))
    )
    scene = scene_of(
        plane(8.0),
        *boxes,
        materials=materials,
        part_material=tuple(range(31)),
        ambient=Ambient(up=(1.0, 1.0, 1.0), down=(0.3, 0.3, 0.3)),
    )
    poses = [((0.05 * k, 0.03 * k, 1.5), LOOK_DOWN) for k in range(4)]
    pictures = {}
    for samples in (1, "adaptive", 64):
        config = UNSHADOWED.model_copy(update={"samples_per_pixel": samples})
        pictures[samples] = render(scene, LENS, poses, outputs=OUTPUTS, config=config, device=device)
    rms = {
        (name, samples): float(
            np.sqrt(np.mean((pictures[samples][name].astype(float) - pictures[64][name]) ** 2))
        )
        for name in RADIANCE
        for samples in (1, "adaptive")
    }
    for name, share in (("log_radiance", 0.2), ("rgb", 0.25), ("radiance", 0.3)):  # 0.17, 0.23 and 0.27
        assert rms[name, "adaptive"] < share * rms[name, 1]
    for name in set(OUTPUTS).difference(RADIANCE):
        np.testing.assert_array_equal(pictures["adaptive"][name], pictures[1][name])
    alone = render(scene, LENS, poses, outputs=("radiance",), config=ADAPTIVE, device=device)
    np.testing.assert_allclose(alone["radiance"], pictures["adaptive"]["radiance"], rtol=1e-4, atol=1e-6)


def test_faces_that_are_cut_for_baked_light():
    """Two bars on a slant, cut into slivers of which first rays miss many, look as they do to many rays."""
    part = strips((-0.05, -0.03), (0.04, 0.07), size_m=1.5)
    lighting = LightingConfig(edge_max_m=0.02, ambient_ray_count=1, shadow_ray_count=1)
    poses = [((0.0013 * k, 0.0, 1.0), LOOK_DOWN) for k in range(8)]
    seen = []
    for samples, traversal in ((64, "auto"), ("adaptive", "auto"), ("adaptive", "warp")):
        config = ADAPTIVE.model_copy(
            update={"samples_per_pixel": samples, "lighting": lighting, "cpu_traversal": traversal}
        )
        log = render(part, LENS, poses, outputs=("log_radiance",), config=config)["log_radiance"]
        seen.append(np.exp(log))
    for adaptive in seen[1:]:
        assert np.abs(adaptive - seen[0]).max() < 0.75 * (1.0 / 16.0 + 1.0 / 64.0) + 1e-3


def test_faces_that_are_seen_edge_on(device):
    """A wall that is cut into parts, from within its plane: parts without extent are no reason for nan."""
    turn = Rotation.from_euler("zxy", [0.7, 0.13, 0.21])
    corners = turn.apply([[-3.0, 0.0, -1.0], [3.0, 0.0, -1.0], [3.0, 0.0, 1.5], [-3.0, 0.0, 1.5]])
    wall, floor = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), plane(8.0)
    uv = np.array([[0, 0], [6, 0], [6, 3], [0, 0], [6, 3], [0, 3], *[[0, 0]] * (3 * len(floor.faces))])
    rng = np.random.default_rng(0)
    noise = Texture(name="noise", srgb=rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    scene = scene_of(wall, floor, materials=(Material(name="noise", texture=noise),), uv=uv)
    poses = []
    for along, up, off in rng.uniform([-6.0, -1.0, -1e-6], [6.0, 1.5, 1e-6], (64, 3)):
        position = turn.apply([along, off, up])
        forward = turn.apply([0.0, 0.0, 0.2]) - position
        right = np.cross([0.0, 0.0, -1.0], forward)
        axes = np.stack([right, np.cross(forward, right), forward], axis=1)
        turned = Rotation.from_matrix(axes / np.linalg.norm(axes, axis=0))
        poses.append((tuple(position), tuple(turned.as_quat())))
    lighting = LightingConfig(edge_max_m=0.1, ambient_ray_count=1, shadow_ray_count=1)
    config = ADAPTIVE.model_copy(update={"lighting": lighting})
    log = render(scene, LENS, poses, outputs=("log_radiance",), config=config, device=device)["log_radiance"]
    assert np.isfinite(log).all()


def test_threads_and_launches_change_nothing():
    """A pixel does not depend on who renders it, nor on the other instants of a launch."""
    scene, offsets = strips((-0.3, 0.01), (0.2, 0.21)), np.linspace(0.0, 0.05, 7)
    one, two = (radiance(scene, offsets, thread_count=count) for count in (1, 3))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one[3:4], radiance(scene, offsets[3:4]))


def test_launches_change_nothing_where_faces_are_many(device):
    """Blocks that are rendered by rays: on CUDA 32 instants share candidate lists, and one has none."""
    lens = PinholeConfig(width=45, height=29, fx=400.0, fy=400.0, cx=22.5, cy=14.5)
    rng = np.random.default_rng(0)
    corners = rng.uniform([-0.2, -0.15, 0.0], [0.2, 0.15, 0.2], (4000, 1, 3)) + 0.01 * rng.normal(
        size=(4000, 3, 3)
    )
    crumbs = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(12_000).reshape(-1, 3), process=False)
    scene = scene_of(crumbs, plane(4.0), materials=(GREY, WHITE), part_material=(0, 1))
    poses = [((1e-3 * k, 5e-4 * k, 3.0), LOOK_DOWN) for k in range(32)]
    arrays = upload_scene(scene, ADAPTIVE, device)
    seen = render(arrays, lens, poses, outputs=("log_radiance",), device=device)["log_radiance"]
    assert len(np.unique(seen[0])) > 20
    for k in (0, 13, 31):
        alone = render(arrays, lens, poses[k : k + 1], outputs=("log_radiance",), device=device)[
            "log_radiance"
        ]
        np.testing.assert_array_equal(alone[0], seen[k])


def test_first_rays():
    """Four adjacent pixels look through four columns or rows of cells."""
    lens = PinholeConfig(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0)
    rays = first_rays(lens).reshape(8, 8, 4)
    position = rays[..., :2] / rays[..., 2:3] * 8.0 + 4.0
    cell = np.floor((position % 1.0) * 4.0).astype(int)
    for start in range(5):
        assert all(len(set(cell[start : start + 4, col, 0])) == 4 for col in range(8))
        assert all(len(set(cell[row, start : start + 4, 1])) == 4 for row in range(8))
    np.testing.assert_allclose(rays[..., 3], ray_layers(lens, 1)[0, :, 3].reshape(8, 8), rtol=1e-6)


def test_settings():
    assert RenderConfig().samples_per_pixel == "adaptive"
    for bad in ("all", 0, 65):
        with pytest.raises(ValueError, match="samples_per_pixel"):
            RenderConfig(samples_per_pixel=bad)
    with pytest.raises(ValueError, match="fill_factor"):
        RenderConfig(fill_factor=0.0)
