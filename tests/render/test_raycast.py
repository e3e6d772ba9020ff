"""What the ray caster sees, against geometry and photometry in closed form."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from render_scenes import (
    DARK,
    LOOK_DOWN,
    LUMA,
    UNSHADOWED,
    box,
    checkerboard,
    plane,
    point_light,
    render,
    scene_of,
    textured_plane,
)
from scipy.spatial.transform import Rotation

from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.outputs import OUTPUTS
from neurosim_core.render.raycast import raycast_kernel
from neurosim_core.render.scene_arrays import upload_scene
from neurosim_core.scene.scene import Ambient, Material, Texture
from neurosim_core.scene.texels import encode_texels

LENS = PinholeConfig(width=45, height=34, fx=40.0, fy=38.0, cx=21.0, cy=18.5)  # no multiples of a tile
BAKED = RenderConfig(lighting=LightingConfig(edge_max_m=0.5, ambient_ray_count=4), exposure=1.0)


def rays_W(lens, q_WC):
    return lens.ray_table().astype(np.float64) @ Rotation.from_quat(q_WC).as_matrix().T


def tilted(x, y, z):
    return tuple((Rotation.from_euler("xyz", (x, y, z)) * Rotation.from_quat(LOOK_DOWN)).as_quat())


def room():
    """Return a scene that has everything: textures, lights, emission, sky."""
    rng = np.random.default_rng(0)
    texture = Texture(name="noise", srgb=rng.integers(0, 256, (37, 64, 3), dtype=np.uint8))
    parts = (plane(6.0), box((1.0, 1.0, 1.0), (0.5, 0.3, 0.5)), box((0.3, 0.3, 0.3), (-1.0, 0.0, 1.5)))
    uv = np.concatenate([p.triangles.reshape(-1, 3)[:, :2] for p in parts])
    return scene_of(
        *parts,
        materials=(
            Material(name="floor", texture=texture),
            Material(name="red", base_color=(0.8, 0.1, 0.1)),
            Material(name="lamp", emission=(2.0, 1.5, 1.0)),
        ),
        part_material=(0, 1, 2),
        uv=uv,
        lights=(point_light((-1.0, 0.0, 1.5), 2.0),),
    )


POSES = [((0.1 * k, -0.2, 4.0 - 0.1 * k), tilted(0.05 * k, 0.1, 0.3 * k)) for k in range(5)]


def test_depth_of_a_plane(device):
    """Distance t = -(p_z) / ray_z along the ray, planar depth is its z in C; above the horizon is nothing."""
    q_WC, p_WC = tilted(1.2, 0.2, 0.4), (0.3, -0.2, 2.5)
    image = render(scene_of(plane(400.0)), LENS, [(p_WC, q_WC)], outputs=("depth",), device=device)
    depth = image["depth"][0]
    rays = rays_W(LENS, q_WC)
    hits = (rays[..., 2] < 0.0) & (np.abs(p_WC[2] * rays[..., :2] / rays[..., 2:]).max(axis=-1) < 190.0)
    expected = -p_WC[2] / rays[..., 2] * LENS.ray_table()[..., 2]
    assert hits.any()
    assert not hits.all()
    # float32 corners at 200 m and rays that graze at 2.5 / 190 rad: 6e-8 * 200 / 2.5, 6e-8 * 76
    np.testing.assert_allclose(depth[hits], expected[hits], rtol=1e-5)
    assert np.isinf(depth[rays[..., 2] > 0.0]).all()


def test_depth_of_a_box(device):
    """Slab method in float64."""
    low, high = np.array([-0.4, -0.6, -0.5]), np.array([0.4, 0.6, 0.5])
    q_WC, p_WC = tilted(-0.6, 0.1, 0.1), np.array([0.2, 1.6, 2.2])
    scene = scene_of(box(tuple(high - low), (0.0, 0.0, 0.0)))
    depth = render(scene, LENS, [(tuple(p_WC), q_WC)], outputs=("depth",), device=device)["depth"][0]
    rays = rays_W(LENS, q_WC)
    near, far = (low - p_WC) / rays, (high - p_WC) / rays
    enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
    expected = np.where(leave > enter, enter * LENS.ray_table()[..., 2], np.inf)
    sure = np.abs(leave - enter) > 1e-4
    assert np.isfinite(expected).sum() > 100
    np.testing.assert_allclose(depth[sure], expected[sure], rtol=2e-6)


def test_depth_of_a_sphere(device):
    """Triangles with corners on a unit sphere lie between it and the sphere that touches their middles."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    q_WC, p_WC = LOOK_DOWN, np.array([0.2, -0.1, 3.0])
    depth = render(scene_of(ball), LENS, [(tuple(p_WC), q_WC)], outputs=("depth",), device=device)["depth"][0]
    rays = rays_W(LENS, q_WC)
    along = rays @ p_WC
    cosine = LENS.ray_table()[..., 2]

    def hit(radius):
        return (-along - np.sqrt(along**2 - p_WC @ p_WC + radius**2)) * cosine

    inner = np.linalg.norm(ball.triangles.mean(axis=1), axis=1).min()
    well_inside = p_WC @ p_WC - along**2 < 0.9**2
    rays, along, cosine, depth = (
        rays[well_inside],
        along[well_inside],
        cosine[well_inside],
        depth[well_inside],
    )
    assert well_inside.sum() > 100
    assert (depth >= hit(1.0) - 1e-6).all()
    assert (depth <= hit(inner) + 1e-6).all()


@pytest.mark.parametrize("below", [False, True])
def test_radiance_of_a_plane_under_one_light(device, below):
    """Radiance is albedo * (ambient(n) + I cos / d^2) + emission, n towards the viewer on either side."""
    albedo, emission = np.array([0.8, 0.5, 0.2]), np.array([0.01, 0.02, 0.03])
    ambient = Ambient(up=(0.4, 0.5, 0.6), down=(0.1, 0.2, 0.3))
    side = -1.0 if below else 1.0
    light, intensity = np.array([0.4, -0.3, 1.2 * side]), 2.0
    scene = scene_of(
        plane(40.0),
        materials=(Material(name="m", base_color=tuple(albedo), emission=tuple(emission)),),
        ambient=ambient,
        lights=(point_light(tuple(light), intensity), point_light((0.0, 0.0, -side), 9.0)),  # one behind
    )
    q_WC = (0.0, 0.0, 0.0, 1.0) if below else LOOK_DOWN
    p_WC = np.array([0.2, 0.1, 1.5 * side])
    got = render(scene, LENS, [(tuple(p_WC), q_WC)], outputs=("log_radiance",), device=device)
    rays = rays_W(LENS, q_WC)
    point = p_WC - (p_WC[2] / rays[..., 2])[..., None] * rays
    to_light = light - point
    direct = intensity * np.abs(to_light[..., 2]) / np.linalg.norm(to_light, axis=-1) ** 3
    hemisphere = np.array(ambient.down if below else ambient.up)
    radiance = albedo * (hemisphere + direct[..., None]) + emission
    expected = np.log(radiance @ LUMA + UNSHADOWED.dark_floor)
    np.testing.assert_allclose(got["log_radiance"][0], expected, atol=2e-6)


def test_baked_light_is_what_pixels_show(device):
    """Without occluders baked light interpolates the closed form: error h^2 / 8 times its curvature."""
    scene = scene_of(plane(4.0), ambient=DARK, lights=(point_light((0.0, 0.0, 2.0), 1.0),))
    pose = [((0.0, 0.0, 3.0), LOOK_DOWN)]
    lens = PinholeConfig(width=40, height=40, horizontal_fov_rad=1.0)
    exact = render(scene, lens, pose, outputs=("log_radiance",), device=device)["log_radiance"]
    fine = RenderConfig(lighting=LightingConfig(edge_max_m=0.1), samples_per_pixel=1)
    baked = render(scene, lens, pose, outputs=("log_radiance",), device=device, config=fine)["log_radiance"]
    # The log of cos / d^2 curves by 3 / d^2 = 0.75 per m^2 at most; edges are 0.1 m, so 1e-3.
    np.testing.assert_allclose(baked, exact, atol=1e-3)


@pytest.mark.parametrize("config", [UNSHADOWED, BAKED], ids=["unshadowed", "baked"])
def test_far_checkerboard_is_its_linear_mean(device, config):
    """Black and white half and half reflect 0.5 in linear light: the log of it, not of mean sRGB (0.21)."""
    scene = textured_plane(checkerboard(64), size_m=4.0, repeats=8.0)
    lens = PinholeConfig(width=24, height=24, horizontal_fov_rad=0.1)
    image = render(
        scene, lens, [((0.0, 0.0, 25.0), LOOK_DOWN)], outputs=("log_radiance",), config=config, device=device
    )
    # 2.5 m / 24 px is 13 squares per pixel: the mean, to half a step of the 10-bit root
    np.testing.assert_allclose(image["log_radiance"], np.log(0.5 + config.dark_floor), atol=2e-3)


def test_mip_level_is_the_log_of_the_footprint_in_texels(device):
    """Each level has its own grey, so radiance tells the level: log2 of distance * spread / cos in texels."""
    texture = Texture(name="m", srgb=np.zeros((256, 256, 3), np.uint8))
    arrays = upload_scene(textured_plane(texture, size_m=4096.0), UNSHADOWED, device)  # a texel is 16 m
    levels = arrays.data.levels.numpy()
    texels = arrays.data.texels.numpy()
    grey = 0.1 + 0.05 * np.arange(len(levels))
    for (first, width, height), value in zip(levels, grey, strict=True):
        texels[first : first + width * height] = encode_texels(np.full(3, value, np.float32))
    arrays.data.texels.assign(texels)
    lens = PinholeConfig(width=1, height=1, fx=100.0, fy=100.0, cx=0.5, cy=0.5)
    for height_m, tilt_rad, level in (
        (1600.0, 0.0, 0.0),
        (3200.0, 0.0, 1.0),
        (4525.48, 0.0, 1.5),
        (1600.0, 1.0, None),
    ):
        slant = 1.0 / np.cos(tilt_rad)
        expected = np.log2(height_m * slant / 100.0 / 16.0 * slant) if level is None else level
        pose = ((0.0, -height_m * np.tan(tilt_rad), height_m), tilted(tilt_rad, 0.0, 0.0))
        log = render(arrays, lens, [pose], outputs=("log_radiance",), device=device)["log_radiance"]
        # codes of 11 bits: 1e-3 of 0.05 per level at most, twice
        assert np.exp(log.item()) - UNSHADOWED.dark_floor == pytest.approx(0.1 + 0.05 * expected, abs=4e-4)


def test_zooming_out_never_aliases(device):
    """Fine stripes change by little when the camera rises by a hundredth; sampled at points they flicker."""
    texture = Texture(
        name="stripes", srgb=np.repeat(np.tile([[[0], [255]]], (64, 32, 1)), 3, axis=2).astype(np.uint8)
    )
    scene = textured_plane(texture, size_m=4.0, repeats=16.0)
    lens = PinholeConfig(width=16, height=16, horizontal_fov_rad=0.05)
    poses = [((0.0, 0.0, 18.0 * 1.01**k), LOOK_DOWN) for k in range(20)]
    log = render(scene, lens, poses, outputs=("log_radiance",), device=device)["log_radiance"]
    assert np.abs(np.diff(log, axis=0)).max() < 5e-3


@pytest.mark.parametrize("filtering", ["bilinear", "nearest"])
def test_unfiltered_textures_alias(device, filtering):
    """Of squares smaller than pixels, point samples see one or the other, or what is between two texels."""
    config = UNSHADOWED.model_copy(update={"texture_filter": filtering})
    scene = textured_plane(checkerboard(64, texels_per_square=4), size_m=4.0, repeats=8.0)
    lens = PinholeConfig(width=40, height=40, horizontal_fov_rad=0.1)
    # 2.6 m / 40 px is 8.33 squares per pixel: neighbouring pixels see other places of a square
    pose = [((0.0, 0.0, 26.0), LOOK_DOWN)]
    log = render(scene, lens, pose, outputs=("log_radiance",), config=config, device=device)["log_radiance"]
    radiance = np.exp(log) - config.dark_floor
    plain = np.isclose(radiance, 0.0, atol=1e-6) | np.isclose(radiance, 1.0, atol=1e-5)
    # of a square of 4 x 4 texels the middle 3 x 3 are away from others: 9 / 16 of the area, if interpolated
    assert plain.all() if filtering == "nearest" else 0.4 < plain.mean() < 0.7
    assert radiance.std() > 0.35  # of black and white 0.5; of the mean 0


def test_a_bias_is_for_levels():
    with pytest.raises(ValueError, match="mip_bias is for texture_filter trilinear, got -1 with nearest"):
        RenderConfig(mip_bias=-1.0, texture_filter="nearest")


def test_outputs_of_a_known_view(device):
    """Instances, normals towards the camera, sRGB codes, and what is written where nothing is hit."""
    materials = (
        Material(name="grey", base_color=(0.5, 0.2, 1.0)),
        Material(name="lamp", base_color=(0.0, 0.0, 0.0), emission=(3.0, 0.0, 0.001)),
    )
    scene = scene_of(
        plane(2.0, flipped=True),
        box((0.5, 0.5, 0.5), (0.0, 0.0, 0.25)),
        materials=materials,
        part_material=(0, 1),
        ambient=Ambient(up=(1.0, 1.0, 1.0), down=(0.0, 0.0, 0.0)),
        sky=(0.0, 0.5, 1.0),
    )
    lens = PinholeConfig(width=9, height=9, horizontal_fov_rad=1.2)
    got = render(
        scene,
        lens,
        [((0.0, 0.0, 3.0), LOOK_DOWN)],
        outputs=OUTPUTS,
        device=device,
    )
    instance = got["instance"][0]
    assert (instance[4, 4], instance[2, 4], instance[0, 0]) == (1, 0, -1)
    assert got["depth"][0, 4, 4] == pytest.approx(2.5)
    np.testing.assert_allclose(got["normal"][0, 4, 4], (0.0, 0.0, 1.0), atol=1e-6)
    np.testing.assert_allclose(got["normal"][0, 2, 4], (0.0, 0.0, 1.0), atol=1e-6)  # wound the other way
    assert (got["normal"][0, 0, 0] == 0.0).all()
    assert np.isinf(got["depth"][0, 0, 0])
    # 1.055 x^(1/2.4) - 0.055 of 0.5, 0.2, 1; 12.92 * 0.001
    assert got["rgb"][0, 2, 4].tolist() == [188, 124, 255]
    assert got["rgb"][0, 4, 4].tolist() == [255, 0, 3]
    assert got["rgb"][0, 0, 0].tolist() == [0, 188, 255]


@pytest.mark.parametrize("config", [UNSHADOWED, BAKED], ids=["unshadowed", "baked"])
def test_fewer_outputs_give_the_same_bits(device, config):
    arrays = upload_scene(room(), config, device)
    everything = render(arrays, LENS, POSES[:2], outputs=OUTPUTS, device=device)
    subsets = [
        ("log_radiance",),
        ("rgb", "depth"),
        ("depth",),
        ("normal", "instance"),
        ("log_radiance", "rgb"),
    ]
    for outputs in subsets:
        got = render(arrays, LENS, POSES[:2], outputs=outputs, device=device)
        for name in outputs:
            np.testing.assert_array_equal(got[name], everything[name], err_msg=f"{name} of {outputs}")


def test_instants_and_threads_do_not_change_a_bit(device):
    """K = 5 at once, one at a time, on one, two or three threads, and repeated: all the same."""
    arrays = upload_scene(room(), BAKED, device)
    at_once = render(arrays, LENS, POSES, outputs=OUTPUTS, device=device)
    alone = [render(arrays, LENS, [pose], outputs=OUTPUTS, device=device) for pose in POSES]
    for name in OUTPUTS:
        np.testing.assert_array_equal(at_once[name], np.concatenate([one[name] for one in alone]))
    for threads, launches in itertools.product((1, 2, 3), (1, 2)):
        again = render(
            arrays, LENS, POSES, outputs=OUTPUTS, device=device, thread_count=threads, launches=launches
        )
        for name in OUTPUTS:
            np.testing.assert_array_equal(again[name], at_once[name])


@pytest.mark.parametrize("samples", [4, 16])
def test_light_of_several_samples_is_the_same_without_geometry(device, samples):
    """On CUDA four threads render four pixels together then, at one instant or at two."""
    arrays = upload_scene(room(), BAKED.model_copy(update={"samples_per_pixel": samples}), device)
    for count in (1, 2, 5):
        beside = render(arrays, LENS, POSES[:count], outputs=OUTPUTS, device=device)
        alone = render(arrays, LENS, POSES[:count], outputs=("log_radiance", "rgb"), device=device)
        np.testing.assert_allclose(alone["log_radiance"], beside["log_radiance"], atol=1e-5)  # order of sums
        np.testing.assert_allclose(alone["rgb"].astype(int), beside["rgb"].astype(int), atol=1)


def test_images_are_written_for_the_instants_that_have_a_slot(device):
    """Cameras that share a cast: log radiance of all instants, images only where requested."""
    arrays = upload_scene(room(), BAKED, device)
    alone = render(arrays, LENS, POSES, outputs=OUTPUTS, device=device)
    for outputs in (OUTPUTS, ("rgb", "depth")):
        shared = render(arrays, LENS, POSES, outputs=outputs, device=device, slots=[-1, 1, -1, 0, -1])
        for name in ("rgb", "depth"):
            np.testing.assert_array_equal(shared[name][0], alone[name][3])
            np.testing.assert_array_equal(shared[name][1], alone[name][1])
            assert (shared[name][2:] == 0).all()
        if "log_radiance" in outputs:
            np.testing.assert_array_equal(shared["log_radiance"], alone["log_radiance"])


def test_samples_average_linear_radiance(device):
    """A vertical edge between black and white at 0.27 of a pixel: 16 samples see it, one does not."""
    left = trimesh.Trimesh(
        [[-9, -9, 0], [0, -9, 0], [0, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    right = trimesh.Trimesh(
        [[0, -9, 0], [9, -9, 0], [9, 9, 0], [0, 9, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    scene = scene_of(
        left,
        right,
        materials=(
            Material(name="black", base_color=(0.0,) * 3),
            Material(name="white", base_color=(1.0,) * 3),
        ),
        part_material=(0, 1),
        ambient=Ambient(up=(1.0,) * 3, down=(1.0,) * 3),
    )
    lens = PinholeConfig(width=8, height=8, fx=20.0, fy=20.0, cx=4.27, cy=4.0)
    pose = [((0.0, 0.0, 2.0), LOOK_DOWN)]
    one = render(scene, lens, pose, outputs=OUTPUTS, device=device)
    many = render(
        scene,
        lens,
        pose,
        outputs=OUTPUTS,
        device=device,
        config=UNSHADOWED.model_copy(update={"samples_per_pixel": 16}),
    )
    white = np.exp(many["log_radiance"][0]) - UNSHADOWED.dark_floor
    # column 4 is white from 4.27 to 5; a lattice of 16 columns without bias errs by half a sixteenth at most
    np.testing.assert_allclose(white[:, 4], 0.73, atol=1.0 / 32.0)
    np.testing.assert_allclose(white[:, 5], 1.0, atol=1e-6)
    np.testing.assert_allclose(white[:, 3], 0.0, atol=1e-6)
    assert set(np.round(np.exp(one["log_radiance"][0]), 2).ravel()) == {0.0, 1.0}
    for name in ("depth", "instance"):  # geometry stays that of the centre
        np.testing.assert_array_equal(many[name], one[name])


def test_exposure_is_chosen_from_the_scene_alone(device):
    """White everywhere, evenly lit by 4: the mean surface becomes middle grey."""
    scene = scene_of(plane(4.0), ambient=Ambient(up=(4.0,) * 3, down=(4.0,) * 3))
    arrays = upload_scene(scene, RenderConfig(), device)
    assert arrays.exposure == pytest.approx(0.2 / 4.0, rel=1e-5)
    assert upload_scene(scene, RenderConfig(exposure=2.5), device).exposure == 2.5


@pytest.mark.parametrize("outputs", [(), ("log_radiance", "flow")])
def test_unknown_outputs_are_refused(outputs):
    terms = upload_scene(scene_of(plane(1.0)), UNSHADOWED, "cpu").terms
    with pytest.raises(ValueError, match="outputs must be some of"):
        raycast_kernel(outputs, terms)
