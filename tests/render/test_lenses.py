"""Lenses against OpenCV, against closed forms, and in pictures of what can be computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from lens_projection import project
from pydantic import TypeAdapter
from render_scenes import LOOK_DOWN, plane, render, scene_of

from neurosim_core import load_config, run
from neurosim_core.render.lenses import (
    AnyLens,
    DoubleSphereConfig,
    EquidistantConfig,
    RadtanConfig,
    RationalConfig,
    RayTableConfig,
)
from neurosim_core.render.outputs import OUTPUTS

SIZE = {"width": 64, "height": 48, "fx": 45.0, "fy": 44.0, "cx": 31.3, "cy": 24.9}
RADTAN = (-0.28, 0.07, 1.9e-3, -7e-4, 0.004)
RATIONAL = (0.2, 0.05, 1e-3, -5e-4, 0.003, 0.42, 0.12, 0.01)
FISHEYE = (-0.013, 0.021, -0.012, 0.0025)
LENSES = [
    RadtanConfig(**SIZE, distortion=RADTAN),
    RadtanConfig(**SIZE, distortion=RADTAN[:4]),
    RationalConfig(**SIZE, distortion=RATIONAL),
    EquidistantConfig(**SIZE, distortion=FISHEYE),
    DoubleSphereConfig(**{**SIZE, "fx": 20.0, "fy": 20.0}, xi=-0.2, alpha=0.59),
    DoubleSphereConfig(**SIZE, xi=0.3, alpha=0.4),
]


def forward_points(count: int = 2000, angle_max_rad: float = 0.7) -> np.ndarray:
    """Points at random distances in a cone about the axis."""
    rng = np.random.default_rng(1)
    angle, around = rng.uniform(0.0, angle_max_rad, count), rng.uniform(0.0, 2.0 * math.pi, count)
    radius = np.sin(angle)
    points = np.stack([radius * np.cos(around), radius * np.sin(around), np.cos(angle)], axis=-1)
    return points * rng.uniform(0.3, 30.0, (count, 1))


def camera_matrix() -> np.ndarray:
    """OpenCV's: the centre of the first pixel is at 0."""
    return np.array([[SIZE["fx"], 0, SIZE["cx"] - 0.5], [0, SIZE["fy"], SIZE["cy"] - 0.5], [0, 0, 1]])


@pytest.mark.parametrize("lens", LENSES[:3], ids=["radtan", "radtan of 4", "rational"])
def test_polynomials_project_as_opencv(lens):
    cv2 = pytest.importorskip("cv2")
    points = forward_points()
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera_matrix(), np.array(lens.distortion)
    )
    assert np.abs(project(lens, points) - 0.5 - expected[:, 0]).max() < 1e-9


def test_fisheye_projects_as_opencv():
    cv2 = pytest.importorskip("cv2")
    points = forward_points(angle_max_rad=1.5)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera_matrix(), np.array(FISHEYE)
    )
    assert np.abs(project(LENSES[3], points) - 0.5 - expected[:, 0]).max() < 1e-9


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.kind)
def test_rays_project_back_onto_their_pixels(lens):
    """The bar is 1e-4 px for float32 rays; in float64 they are exact."""
    u, v = np.meshgrid(np.linspace(0.0, 64.0, 129), np.linspace(0.0, 48.0, 97))
    rays = lens.rays(u, v)
    assert np.isfinite(rays).all()
    assert np.abs(project(lens, rays) - np.stack([u, v], axis=-1)).max() < 1e-8
    table = project(lens, lens.ray_table())
    centres = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1)
    assert np.abs(table - centres).max() < 1e-4


def test_double_sphere_of_no_distance_is_a_unified_camera():
    """With xi = 0 and alpha = 1 the projection is orthographic: x_d = sin(angle)."""
    lens = DoubleSphereConfig(**SIZE, xi=0.0, alpha=1.0, angle_max_rad=1.5)
    rays = lens.rays(np.array(SIZE["cx"] + 0.6 * SIZE["fx"]), np.array(SIZE["cy"]))
    np.testing.assert_allclose(rays, [0.6, 0.0, 0.8], atol=1e-12)


def test_equidistant_sees_behind_itself_and_is_blind_outside_its_circle():
    lens = EquidistantConfig(width=100, height=100, fx=20.0, fy=20.0, cx=50.0, cy=50.0, angle_max_rad=2.2)
    side = lens.rays(np.array(50.0 + 20.0 * 2.0), np.array(50.0))  # 2 rad off the axis
    np.testing.assert_allclose(side, [math.sin(2.0), 0.0, math.cos(2.0)], atol=1e-12)
    rows, cols = np.indices((100, 100))
    outside = np.hypot(cols + 0.5 - 50.0, rows + 0.5 - 50.0) > 44.0
    np.testing.assert_array_equal(lens.blind_pixels(), outside)
    assert LENSES[0].blind_pixels() is None


def test_ray_spread_is_the_root_of_the_solid_angle():
    """All pixels together cover the cap that the picture's circle shows: 2 pi (1 - cos a)."""
    lens = EquidistantConfig(width=200, height=200, fx=60.0, fy=60.0, cx=100.0, cy=100.0, angle_max_rad=1.6)
    solid = (lens.ray_spread().astype(float) ** 2)[~lens.blind_pixels()].sum()
    # pixels at the rim are in or out as wholes: by chance within a few of 28,952
    assert solid == pytest.approx(2.0 * math.pi * (1.0 - math.cos(1.6)), rel=2e-3)


def test_a_table_of_rays_is_the_lens_it_was_made_of(tmp_path):
    lens = LENSES[3]
    np.save(tmp_path / "rays.npy", lens.ray_table().astype(np.float64) * 3.0)  # of any length
    table = RayTableConfig(width=64, height=48, file=tmp_path / "rays.npy")
    np.testing.assert_allclose(table.ray_table(), lens.ray_table(), atol=2e-7)
    # between centres: bilinear, second order in a pixel of 1/45 rad
    np.testing.assert_allclose(table.ray_table((0.1, 0.8)), lens.ray_table((0.1, 0.8)), atol=1e-4)
    np.testing.assert_allclose(table.ray_spread(), lens.ray_spread(), rtol=1e-2)
    assert table.intrinsics().fx == pytest.approx(SIZE["fx"], rel=5e-3)
    rays = lens.ray_table()
    rays[:5] = np.nan
    np.save(tmp_path / "half.npy", rays)
    half = RayTableConfig(width=64, height=48, file=tmp_path / "half.npy")
    assert half.blind_pixels()[:5].all()
    assert half.blind_pixels().sum() == 5 * 64


def test_pictures_of_a_plane_through_each_lens():
    """Depth is planar whatever the lens: the distance 2 m to a plane before the camera, for all rays."""
    scene = scene_of(plane(1000.0))
    for lens in (LENSES[0], LENSES[3], LENSES[5]):
        seen = render(scene, lens, [((0.0, 0.0, 2.0), LOOK_DOWN)], outputs=OUTPUTS)
        np.testing.assert_allclose(seen["depth"], 2.0, rtol=2e-6)


def test_blind_pixels_are_black_and_infinitely_far():
    lens = EquidistantConfig(width=24, height=24, fx=12.0, fy=12.0, cx=12.0, cy=12.0, angle_max_rad=0.8)
    seen = render(scene_of(plane(100.0)), lens, [((0.0, 0.0, 2.0), LOOK_DOWN)], outputs=OUTPUTS)
    blind = lens.blind_pixels()
    assert 0 < blind.sum() < blind.size
    assert (seen["rgb"][0][blind] == 0).all()
    assert (seen["rgb"][0][~blind] > 0).all()
    np.testing.assert_allclose(seen["log_radiance"][0][blind], math.log(1.0e-3), rtol=1e-6)
    assert np.isposinf(seen["depth"][0][blind]).all()
    assert np.isfinite(seen["depth"][0][~blind]).all()
    assert (seen["instance"][0] == np.where(blind, -1, 0)).all()
    assert (seen["normal"][0][blind] == 0.0).all()


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ({"kind": "radtan", "distortion": [0.1, 0.0, 0.0]}, "at least 4 items"),
        ({"kind": "radtan", "distortion": [-2.0, 0.0, 0.0, 0.0]}, "folds over before the border"),
        ({"kind": "rational", "distortion": [0.1] * 7}, "at least 8 items"),
        ({"kind": "double_sphere", "xi": 0.1, "alpha": 1.5}, "less than or equal to 1"),
        ({"kind": "omni"}, "omni"),
    ],
)
def test_what_is_no_lens_is_refused(lens, message):
    with pytest.raises(ValueError, match=message):
        TypeAdapter(AnyLens).validate_python({**SIZE, **lens})


def test_ray_tables_that_do_not_fit_are_refused(tmp_path):
    file = tmp_path / "rays.npy"
    np.save(file, np.ones((4, 5, 3)))
    with pytest.raises(ValueError, match=r"shape \[5, 4, 3\], got float64 \[4, 5, 3\]"):
        RayTableConfig(width=4, height=5, file=file)
    with pytest.raises(ValueError, match="cannot read the rays"):
        RayTableConfig(width=4, height=5, file=tmp_path / "none.npy")


def test_files_of_rays_are_beside_the_settings(tmp_path):
    np.save(tmp_path / "rays.npy", np.tile([0.0, 0.0, 1.0], (3, 4, 1)))
    (tmp_path / "rig.yaml").write_text(
        "sensors: {eye: {kind: rgb, lens: {kind: ray_table, width: 4, height: 3, file: rays.npy}}}"
    )
    assert load_config(tmp_path / "rig.yaml").sensors["eye"].lens.file == tmp_path / "rays.npy"


def test_what_needs_a_pinhole_says_so():
    lens = {"kind": "equidistant", **SIZE}
    events = {"kind": "event_camera", "lens": lens, "max_displacement_px": 0.5}
    scene = {"kind": "hall", "size_m": [8, 6, 3]}
    config = load_config({"duration_s": 0.1, "device": "cpu", "scene": scene, "sensors": {"events": events}})
    with pytest.raises(ValueError, match="max_displacement_px of events needs a lens of kind pinhole"):
        next(iter(run(config)))


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.kind)
def test_lenses_are_equal_by_their_settings(lens):
    """Whatever has been computed of them: cameras with equal lenses share their rays."""
    lens.ray_table()
    other = type(lens).model_validate(lens.model_dump())
    other.ray_table()
    assert other == lens
    assert hash(other) == hash(lens)
    assert other.model_copy(update={"fx": 46.0}) != lens
