"""Rays with times of their own: rolling shutters and exposures against closed forms, and one time for all."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp
from render_scenes import LOOK_DOWN, box, plane, scene_of, textured_plane
from render_scenes import checkerboard as checker
from scipy.spatial.transform import Rotation

from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.outputs import OUTPUTS
from neurosim_core.render.ray_times import RayTimes, ShutterConfig
from neurosim_core.render.renderer import make_renderer, upload_scene
from neurosim_core.render.warp_renderer import ray_times_of
from neurosim_core.scene.bodies import (
    BodyConfig,
    MotionConfig,
    make_bodies,
    make_body_poses,
    pose_bodies,
    upload_motions,
)
from neurosim_core.scene.body_shapes import BoxShape, PlainSurface
from neurosim_core.scene.scene import Ambient, Material

LENS = PinholeConfig(width=48, height=24, fx=60.0, fy=60.0, cx=24.0, cy=12.0)
WHITE = Ambient(up=(1.0, 1.0, 1.0), down=(1.0, 1.0, 1.0))


def half_white() -> object:
    """A plane at z = 0 that is white where x > 0 and black elsewhere."""
    parts = [
        trimesh.Trimesh([[a, -9, 0], [b, -9, 0], [b, 9, 0], [a, 9, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
        for a, b in ((-9.0, 0.0), (0.0, 9.0))
    ]
    materials = (
        Material(name="black", base_color=(0.0, 0.0, 0.0)),
        Material(name="white", base_color=(1.0, 1.0, 1.0)),
    )
    return scene_of(*parts, materials=materials, part_material=(0, 1), ambient=WHITE)


def boxes_above_a_floor() -> object:
    rng = np.random.default_rng(3)
    boxes = [
        box(tuple(rng.uniform(0.05, 0.3, 3)), (*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.1, 0.5)))
        for _ in range(12)
    ]
    shades = rng.uniform(0.05, 1.0, 13)
    return scene_of(
        plane(8.0),
        *boxes,
        materials=tuple(Material(name=str(k), base_color=(x, x, x)) for k, x in enumerate(shades)),
        part_material=tuple(range(13)),
        ambient=WHITE,
    )


def render(
    scene,
    times,
    positions,
    orientations,
    *,
    traversal="auto",
    samples=1,
    device="cpu",
    outputs=OUTPUTS,
    bodies=(),
    body_poses=None,
    mode="unshadowed",
):
    """Render all outputs of one instant whose rays have these poses, shape [J, ...]."""
    config = RenderConfig(
        lighting=LightingConfig(mode=mode),
        exposure=1.0,
        samples_per_pixel=samples,
        cpu_traversal=traversal,
    )
    arrays = upload_scene(scene, config, device=device, bodies=bodies)
    renderer = make_renderer(arrays, LENS, outputs=outputs, instant_count=1, times=times)
    p = wp.array(np.asarray(positions, np.float32), dtype=wp.vec3, device=device)
    q = wp.array(np.asarray(orientations, np.float32), dtype=wp.quat, device=device)
    slots = wp.zeros(1, dtype=int, device=device)
    renderer.render(p, q, slots, instant_count=1, bodies=body_poses)
    return {name: getattr(renderer, name).numpy()[0].copy() for name in outputs}


@pytest.mark.parametrize("traversal", ["embree", "warp"])
@pytest.mark.parametrize("samples", [1, 4])
def test_one_time_for_all_rays_gives_the_same_bytes(traversal, samples):
    scene = textured_plane(checker(8, 4), size_m=4.0)
    pose = ([[0.1, 0.2, 1.5]], [Rotation.from_euler("xyz", [3.0, 0.2, 0.3]).as_quat()])
    layers = 1 + samples if samples > 1 else 1
    times = RayTimes(np.zeros(1, np.int64), np.zeros((layers, 48 * 24), np.int32), samples)
    own = render(scene, times, *pose, traversal=traversal, samples=samples)
    one = render(scene, None, *pose, traversal=traversal, samples=samples)
    for name in OUTPUTS:
        assert own[name].tobytes() == one[name].tobytes(), name


@pytest.mark.parametrize("mode", ["baked", "unshadowed"])
def test_one_time_for_all_rays_is_antialiased_to_the_same_bytes(device, mode):
    pose = ([[0.05, 0.03, 1.6]], [Rotation.from_euler("xyz", [3.0, 0.2, 0.3]).as_quat()])
    how = {"samples": "adaptive", "mode": mode, "device": device}
    times = RayTimes(np.zeros(1, np.int64), np.zeros((1, 48 * 24), np.int32), 1)
    own, one = (render(boxes_above_a_floor(), each, *pose, **how) for each in (times, None))
    for name in OUTPUTS:
        assert own[name].tobytes() == one[name].tobytes(), name


def test_exposures_take_rays_in_place_of_adaptive_antialiasing():
    arrays = upload_scene(
        half_white(), RenderConfig(lighting=LightingConfig(mode="unshadowed")), device="cpu"
    )
    assert ray_times_of(ShutterConfig(readout_s=0.01), LENS, arrays).sample_count == 1
    for count, rays in ((1, 1), (4, 16), (40, 40)):
        shutter = ShutterConfig(readout_s=0.01, exposure_s=0.002, exposure_samples=count)
        assert ray_times_of(shutter, LENS, arrays).sample_count == rays
    assert ray_times_of(ShutterConfig(), LENS, arrays) is None


@pytest.mark.parametrize(("traversal", "samples"), [("embree", 64), ("warp", 64), ("auto", "adaptive")])
def test_rolling_rows_shear_a_vertical_edge(device, traversal, samples):
    """Turning at w about the picture's y axis, row r sees the edge at cx + f tan(w t_r): within 0.05 px."""
    rate_rad_s = 3.0
    times = ShutterConfig(readout_s=0.03).times(LENS, 1 if samples == "adaptive" else samples)
    assert len(times.offsets_ns) == 24
    assert times.offsets_ns[-1] == 0
    t_s = times.offsets_ns * 1e-9
    turn = Rotation.from_rotvec(np.outer(rate_rad_s * t_s, [0.0, 1.0, 0.0])) * Rotation.from_quat(LOOK_DOWN)
    positions = np.tile([0.0, 0.0, 2.0], (24, 1))
    picture = render(
        half_white(),
        times,
        positions,
        turn.as_quat(),
        traversal=traversal if device == "cpu" else "auto",
        samples=samples,
        device=device,
    )
    white = np.exp(picture["log_radiance"]) - 1e-3
    edge = 48.0 - white.sum(axis=1)  # the share of a row that is white is to the right of the edge
    t_row_s = (np.arange(24) - 23.0) * 0.03 / 24.0
    expected = 24.0 + 60.0 * np.tan(rate_rad_s * t_row_s)
    # of the 64 samples each column of a pixel has one: 1/128 px
    assert np.abs(edge - expected).max() < 0.05
    assert np.ptp(edge) > 4.0


@pytest.mark.parametrize(
    ("direction", "moving", "light", "readout_s"),
    [("down", False, "baked", 0.03), ("right", True, "unshadowed", 0.03), ("left", False, "baked", 0.3)],
)
def test_rolling_pixels_are_means_over_their_area(device, direction, moving, light, readout_s):
    """In a fast turn past boxes and a body: as close to 64 rays at the same times as a still camera is.

    In 0.3 s the camera moves by 0.13 m within a block of pixels: past the planes of faces that it sees.
    """
    scene = boxes_above_a_floor()
    bodies = {
        "crate": BodyConfig(
            shape=BoxShape(size_m=(0.3, 0.3, 0.3)),
            surface=PlainSurface(color=(1.0, 0.1, 0.1)),
            motion=MotionConfig(position_m=(-0.5, 0.0, 0.6), velocity_m_s=(6.0, 0.0, 0.0)),
        )
    }
    shutter = ShutterConfig(readout_s=readout_s, direction=direction)

    def radiance(samples, timing):
        times = None if timing is None else timing.times(LENS, 1 if samples == "adaptive" else samples)
        t_ns = np.zeros(1, np.int64) if times is None else times.offsets_ns
        t_s = t_ns * 1e-9
        turn = Rotation.from_rotvec(np.outer(2.0 * t_s, [0.3, 1.0, 0.5])) * Rotation.from_quat(LOOK_DOWN)
        where = None
        if moving:
            where = make_body_poses(len(t_s), 1, device)
            stamps = wp.array(100_000_000 + t_ns[:, None], dtype=wp.int64, device=device)
            order = wp.array(np.arange(len(t_s)), dtype=int, device=device)
            pose_bodies(upload_motions(bodies, device), stamps, order, count=len(t_s), poses=where)
        return render(
            scene,
            times,
            np.add([0.05, 0.03, 1.6], np.outer(t_s, [5.0, -3.0, 2.0])),
            turn.as_quat(),
            samples=samples,
            device=device,
            outputs=("radiance",),
            bodies=make_bodies(bodies) if moving else (),
            body_poses=where,
            mode=light,
        )["radiance"].astype(float)

    def error(samples, timing):
        return np.sqrt(np.mean((radiance(samples, timing) - radiance(64, timing)) ** 2))

    assert error("adaptive", shutter) < 0.15 * error(1, shutter)
    assert error("adaptive", shutter) < (1.5 if readout_s < 0.1 else 2.0) * error("adaptive", None)


def test_an_exposure_blurs_a_step_to_a_trapezium():
    """An edge that moves evenly by 7.3 px blurs a step into motion and pixel, to 1 %."""
    exposure_s, speed_px, depth_m = 0.01, 7.3, 2.0
    times = ShutterConfig(exposure_s=exposure_s, exposure_samples=128).times(LENS, 1)
    t_s = times.offsets_ns * 1e-9
    moved_m = speed_px * depth_m / 60.0 * t_s / exposure_s  # to the right: the edge goes to the left
    positions = np.stack([moved_m, np.zeros_like(t_s), np.full_like(t_s, depth_m)], axis=-1)
    orientations = np.tile(LOOK_DOWN, (len(t_s), 1))
    picture = render(half_white(), times, positions, orientations)
    white = np.exp(picture["log_radiance"].astype(float)) - 1e-3
    edge = 24.0 + speed_px * np.linspace(0.0, 1.0, 20001)  # where it is during the exposure
    columns = np.arange(48)
    expected = np.clip(columns[None] + 1.0 - edge[:, None], 0.0, 1.0).mean(axis=0)
    assert np.abs(white - expected).max() < 0.01
    np.testing.assert_allclose(picture["depth"], depth_m, rtol=1e-5)


def test_exposures_average_light_not_its_logarithm():
    """Half the time white, half black: half the light, which is brighter than half the logarithm."""
    times = RayTimes(np.array([-1, 0]), np.array([[0], [0], [1]]).repeat(48 * 24, axis=1).astype(np.int32), 2)
    positions = [[-4.0, 0.0, 2.0], [4.0, 0.0, 2.0]]
    picture = render(half_white(), times, positions, [LOOK_DOWN] * 2)
    np.testing.assert_allclose(picture["log_radiance"], np.log(0.5 + 1e-3), rtol=1e-5)


def test_lines_are_read_in_their_direction():
    def first(direction):
        times = ShutterConfig(readout_s=0.024, direction=direction).times(LENS, 1)
        t = times.offsets_ns[times.instant[0]].reshape(24, 48)
        return t[0, 0], t[0, -1], t[-1, 0]

    assert first("down") == (-23_000_000, -23_000_000, 0)
    assert first("up") == (0, 0, -23_000_000)
    assert first("right") == (-23_500_000, 0, -23_500_000)
    assert first("left") == (0, -23_500_000, 0)
    assert ShutterConfig().times(LENS, 4) is None
    times = ShutterConfig(exposure_s=0.01, exposure_samples=4).times(LENS, 1)
    assert sorted(times.offsets_ns) == [-8_750_000, -6_250_000, -5_000_000, -3_750_000, -1_250_000]
    assert times.offsets_ns[times.instant[0, 0]] == -5_000_000
