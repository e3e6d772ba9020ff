"""The two renderers against each other: OpenGL's rasterizer is the independent oracle of the ray caster."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from render_scenes import box, plane, point_light, scene_of
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from neurosim_core.frames import Q_FORWARD_OPTICAL
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.pyrender_renderer import PyrenderError
from neurosim_core.render.renderer import make_renderer, upload_scene
from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene

LIGHT = LightingConfig(edge_max_m=1.0, ambient_ray_count=4, shadow_ray_count=1)
OFF_CENTRE = PinholeConfig(width=173, height=130, fx=95.0, fy=97.0, cx=80.0, cy=68.0)


def both(scene, lens, poses):
    """Return rgb and depth of (x, y, z, yaw, pitch) poses by each backend, or skip without OpenGL."""
    position = wp.array(np.array(poses, np.float32)[:, :3], dtype=wp.vec3, device="cpu")
    turn = [Rotation.from_euler("ZY", p[3:]) * Rotation.from_quat(Q_FORWARD_OPTICAL) for p in poses]
    orientation = wp.array(np.array([q.as_quat() for q in turn], np.float32), dtype=wp.quat, device="cpu")
    slot = wp.array(np.arange(len(poses), dtype=np.int32), dtype=int, device="cpu")
    pictures = []
    for backend in ("warp", "pyrender"):
        try:
            uploaded = upload_scene(scene, RenderConfig(lighting=LIGHT), device="cpu", renderer=backend)
            renderer = make_renderer(
                uploaded, lens, outputs={"rgb", "depth"}, instant_count=len(poses), image_count=len(poses)
            )
        except PyrenderError as error:
            pytest.skip(str(error))
        renderer.render(position, orientation, slot, instant_count=len(poses))
        pictures.append((renderer.rgb.numpy().astype(float), renderer.depth.numpy().copy()))
    return pictures


def inside(depth):
    """Return where depth changes by less than 10 % to all neighbours: away from silhouettes and the sky."""
    finite = np.where(np.isfinite(depth), depth, 1e6)
    size = (1, 3, 3)
    return maximum_filter(finite, size) < 1.1 * minimum_filter(finite, size)


def test_house(house):
    scene = load_mesh_scene(MeshSceneConfig(file=str(house)))
    poses = [(-4.0, -1.0, 1.4, 0.0, 0.1), (3.0, 1.0, 1.5, 3.0, 0.15), (7.0, -3.0, 1.6, 2.4, 0.2)]
    (rgb, depth), (rgb_gl, depth_gl) = both(scene, OFF_CENTRE, poses)
    away = inside(depth) & inside(depth_gl) & np.isfinite(depth)
    assert away.mean() > 0.5
    error = np.abs(depth[away] - depth_gl[away])
    # OpenGL snaps corners to 1/256 of a pixel; at 5 m and grazing angles that is tenths of a millimetre.
    assert np.median(error) < 1e-3
    assert np.percentile(error, 95) < 0.02
    # Mip levels are chosen differently, and pyrender's display curve is a power of 1 / 2.2.
    assert np.median(np.abs(rgb - rgb_gl)[away]) < 4.0
    assert np.abs(rgb - rgb_gl).mean() < 8.0


def test_slanted_surfaces_to_a_fraction_of_a_pixel():
    """An offset of half a pixel, or a principal point mirrored, would show as a centimetre here."""
    scene = scene_of(
        plane(30.0), box((1.0, 2.0, 1.0), (3.0, 0.5, 0.5)), lights=(point_light((0.0, 0.0, 3.0), 2.0),)
    )
    (_, depth), (_, depth_gl) = both(scene, OFF_CENTRE, [(0.0, 0.0, 1.5, 0.1, 0.3)])
    away = inside(depth) & inside(depth_gl) & (depth < 6.0)
    assert away.sum() > 5000
    np.testing.assert_allclose(depth_gl[away], depth[away], rtol=1e-3)


def test_what_pyrender_does_not_have_is_refused():
    try:
        uploaded = upload_scene(scene_of(plane(1.0)), RenderConfig(), device="cpu", renderer="pyrender")
    except PyrenderError as error:
        pytest.skip(str(error))
    lens = PinholeConfig(width=8, height=8, horizontal_fov_rad=1.0)
    with pytest.raises(ValueError, match="use renderer: warp for event cameras"):
        make_renderer(uploaded, lens, outputs={"log_radiance", "rgb"}, instant_count=1)


def test_without_opengl_the_error_says_what_to_install(monkeypatch):
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    with pytest.raises(PyrenderError, match="apt-get install libegl1 libgl1-mesa-dri"):
        upload_scene(scene_of(plane(1.0)), RenderConfig(), device="cpu", renderer="pyrender")
