"""Moving bodies in pictures: closed forms, a static copy of the body, and OpenGL as oracles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
import warp as wp
from core_counts import cores
from render_scenes import LUMA, UNSHADOWED, box, plane, point_light, scene_of
from scipy.spatial.transform import Rotation

from neurosim_core.frames import Q_FORWARD_OPTICAL
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.embree import EmbreeError, packet_width
from neurosim_core.render.kernel_data import RenderTerms
from neurosim_core.render.outputs import OUTPUTS
from neurosim_core.render.pyrender_renderer import PyrenderError
from neurosim_core.render.raycast import raycast_kernel
from neurosim_core.render.renderer import make_renderer, upload_scene
from neurosim_core.render.warp_renderer import RenderWorlds, WarpRenderer
from neurosim_core.scene.bodies import (
    BodyConfig,
    MotionConfig,
    OrbitConfig,
    SwayConfig,
    body_poses,
    make_bodies,
    make_body_poses,
    pose_bodies,
    upload_motions,
)
from neurosim_core.scene.body_shapes import BoxShape, CheckerSurface, CylinderShape, PlainSurface, SphereShape
from neurosim_core.scene.scene import Ambient, Material

LENS = PinholeConfig(width=97, height=73, horizontal_fov_rad=1.2)
"""An odd number of pixels: one looks along the axis."""
MIDDLE = (slice(None), 36, 48)
"""Its pixel, of each instant."""
BAKED = RenderConfig(
    lighting=LightingConfig(edge_max_m=1.0, ambient_ray_count=4, shadow_ray_count=1),
    exposure=1.0,
    samples_per_pixel=1,
)
FORWARD = ((0.0, 0.0, 0.0), Q_FORWARD_OPTICAL)
"""A camera in the origin that looks along +x."""
FACET = 6e-4
"""How far, in radii, a sphere of 128 by 64 facets is inside the true one: two sagittas of 2.4 degrees."""


def wall(x_m=6.0):
    """A scene of one wall across the view."""
    return scene_of(box((0.1, 40.0, 40.0), (x_m + 0.05, 0.0, 0.0)))


def look(scene, bodies, poses, stamps_ns, *, config=UNSHADOWED, device="cpu", threads=None, lens=LENS):
    """Return all outputs of poses (p_WC, q_WC) at stamps, and the names of instances."""
    arrays = upload_scene(scene, config, device=device, bodies=make_bodies(bodies))
    count = len(stamps_ns)
    renderer = WarpRenderer(arrays, lens, outputs=OUTPUTS, instant_count=count, image_count=count)
    slot = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    where = make_body_poses(count, len(bodies), device) if bodies else None
    if where is not None:
        stamps = wp.array(np.array(stamps_ns)[:, None], dtype=wp.int64, device=device)
        pose_bodies(upload_motions(bodies, device), stamps, slot, count=count, poses=where)
    poses = poses * count if len(poses) == 1 else poses
    positions = wp.array(np.array([p for p, _ in poses], np.float32), dtype=wp.vec3, device=device)
    orientations = wp.array(np.array([q for _, q in poses], np.float32), dtype=wp.quat, device=device)
    with cores(threads):
        renderer.render(positions, orientations, slot, instant_count=count, bodies=where)
    return {name: getattr(renderer, name).numpy().copy() for name in OUTPUTS}, arrays.instance_names


@pytest.fixture(params=["warp", "embree"])
def traversal(request, device):
    """Who finds what rays hit in the scene."""
    if request.param == "embree":
        if device != "cpu":
            pytest.skip("Embree is for CPUs")
        try:
            packet_width()
        except EmbreeError as error:
            pytest.skip(str(error))
    return request.param


def test_depth_and_size_of_a_sphere_over_time(device, traversal):
    """Along the axis depth is distance less radius, and the outline a circle of f r / sqrt(d^2 - r^2)."""
    radius_m = 0.3
    sway = SwayConfig(amplitude_m=(1.0, 0.0, 0.0), frequency_hz=0.5, phase_rad=0.2)
    motion = MotionConfig(position_m=(2.5, 0.0, 0.0), sway=sway, spin_rad_s=(0.0, 2.0, 1.0))
    stamps_ns = [0, 333_333_333, 1_000_000_000, 1_777_777_777]
    config = UNSHADOWED.model_copy(update={"cpu_traversal": traversal})
    ball = {"ball": BodyConfig(shape=SphereShape(radius_m=radius_m), motion=motion)}
    seen, names = look(wall(), ball, [FORWARD], stamps_ns, config=config, device=device)
    assert names == ("part 0", "ball")
    distance = 2.5 + np.sin(np.pi * 1e-9 * np.array(stamps_ns) + 0.2)
    depth = seen["depth"][MIDDLE]
    assert (depth >= distance - radius_m - 1e-5).all()
    assert (depth <= distance - radius_m * (1.0 - FACET) + 1e-5).all()
    np.testing.assert_allclose(seen["normal"][MIDDLE], np.broadcast_to([-1.0, 0.0, 0.0], (4, 3)), atol=0.05)
    area = (seen["instance"] == 1).sum(axis=(1, 2))
    outline = LENS.intrinsics().fx * radius_m / np.sqrt(distance**2 - radius_m**2)
    # the points of a grid in a circle of 8 to 20 px: its area to some pixels, so its radius to 0.1 px
    np.testing.assert_allclose(np.sqrt(area / np.pi), outline, atol=0.12)
    rows, columns = np.nonzero(seen["instance"][0] == 1)
    assert (np.mean(rows), np.mean(columns)) == pytest.approx(MIDDLE[1:], abs=0.05)
    assert (seen["instance"] == 0).sum() == seen["instance"].size - area.sum()
    np.testing.assert_allclose(seen["depth"][seen["instance"] == 0], 6.0, rtol=1e-5)


def test_a_spinning_box_turns_as_far_as_it_should(device, traversal):
    """Normals of its sides are at the angle w t, whichever is in front; edges are where they should be."""
    motion = MotionConfig(position_m=(2.0, 0.0, 0.0), spin_rad_s=(0.0, 0.0, 1.5))
    stamps_ns = [0, 210_000_000, 950_000_000, 1_400_000_000]
    config = UNSHADOWED.model_copy(update={"cpu_traversal": traversal})
    seen, _ = look(
        wall(), {"box": BodyConfig(motion=motion)}, [FORWARD], stamps_ns, config=config, device=device
    )
    normal = seen["normal"][seen["instance"] == 1]
    instant = np.nonzero(seen["instance"] == 1)[0]
    angle = np.arctan2(normal[:, 1], normal[:, 0]) - 1.5e-9 * np.array(stamps_ns)[instant]
    quarter = np.angle(np.exp(4j * angle)) / 4.0
    np.testing.assert_allclose(quarter, 0.0, atol=1e-5)  # float32
    np.testing.assert_allclose(normal[:, 2], 0.0, atol=1e-6)
    fx, _, cx, _ = LENS.intrinsics()
    turn = np.exp(1j * (0.25 * math.pi + 1.5e-9 * np.array(stamps_ns)))
    for k in range(4):
        corner = math.sqrt(0.5) * 0.4 * turn[k] * np.array([1.0, 1.0j, -1.0, -1.0j])
        columns = np.nonzero(seen["instance"][k, 36] == 1)[0]
        outline = cx - fx * corner.imag / (2.0 + corner.real)
        assert columns[0] == pytest.approx(outline.min(), abs=0.51)  # of a pixel's centre at + 0.5
        assert columns[-1] + 1 == pytest.approx(outline.max(), abs=0.51)


def parts_at(stamp_ns, bodies):
    """The same solids as instances of a scene that does not move."""
    scene = [box((0.1, 40.0, 40.0), (6.05, 0.0, 0.0))]
    p, q = body_poses(bodies, [stamp_ns])
    for index, body in enumerate(make_bodies(bodies)):
        vertices = Rotation.from_quat(q[0, index]).apply(body.solid.vertices) + p[0, index]
        scene.append(trimesh.Trimesh(vertices, body.solid.faces, process=False))
    return scene


TWO = {
    "crate": BodyConfig(
        shape=BoxShape(size_m=(0.6, 0.3, 0.5)),
        surface=PlainSurface(color=(1.0, 1.0, 1.0)),
        motion=MotionConfig(
            position_m=(2.2, -0.2, 0.1), rpy_rad=(0.3, 0.5, 0.1), spin_rad_s=(0.3, 0.2, -2.0)
        ),
    ),
    "pole": BodyConfig(
        shape=CylinderShape(radius_m=0.1, length_m=2.0),
        surface=PlainSurface(color=(1.0, 1.0, 1.0)),
        motion=MotionConfig(
            position_m=(2.2, 0.0, 0.0), orbit=OrbitConfig(radius_m=0.7, rate_hz=0.4), rpy_rad=(0.7, 0.0, 0.0)
        ),
    ),
}
"""A crate and a pole that goes around it: it is in front of the crate, beside it, and hidden by it."""


@pytest.mark.parametrize("stamp_ns", [0, 600_000_000, 1_250_000_000, 2_000_000_000])
def test_a_body_looks_like_a_copy_of_it_that_does_not_move(device, traversal, stamp_ns):
    """Occlusion among bodies and scene, normals, light of lamps and surroundings: all as of one mesh."""
    lights = (point_light((0.5, 1.5, 2.0), 3.0), point_light((1.0, -2.0, 0.0), 2.0))
    surroundings = {"lights": lights, "ambient": Ambient(up=(0.5, 0.4, 0.3), down=(0.1, 0.1, 0.2))}
    config = UNSHADOWED.model_copy(update={"cpu_traversal": traversal, "samples_per_pixel": 2})
    camera = [
        ((0.1, 0.2, 0.3), (Rotation.from_euler("x", 0.2) * Rotation.from_quat(Q_FORWARD_OPTICAL)).as_quat())
    ]
    empty = scene_of(box((0.1, 40.0, 40.0), (6.05, 0.0, 0.0)), **surroundings)
    seen, _ = look(empty, TWO, camera, [stamp_ns], config=config, device=device)
    copy = scene_of(*parts_at(stamp_ns, TWO), **surroundings)
    expected, _ = look(copy, {}, camera, [stamp_ns], config=config, device=device)
    same = seen["instance"] == expected["instance"]
    assert same.mean() > 0.998  # a ray that meets an edge within rounding may pass on either side
    assert len(np.unique(seen["instance"])) == 3
    inside = same & (seen["instance"] > 0)
    np.testing.assert_allclose(seen["depth"][same], expected["depth"][same], rtol=1e-5)
    # Shading normals of the pole are smooth, those of the copy flat: compared on the crate.
    np.testing.assert_allclose(seen["normal"][inside], expected["normal"][inside], atol=2e-3)
    crate = same & (seen["instance"] == 1)
    crate &= np.abs(seen["log_radiance"] - expected["log_radiance"]) < 1e-4
    assert crate.sum() > 0.9 * (same & (seen["instance"] == 1)).sum()  # where no sample passes an edge


def test_bodies_are_antialiased(device, traversal):
    """Eight rays have less than half of the error of one ray per pixel, against 64."""
    scene = scene_of(box((0.1, 40.0, 40.0), (6.05, 0.0, 0.0)))
    seen = {}
    for samples in (1, "adaptive", 64):
        config = UNSHADOWED.model_copy(update={"cpu_traversal": traversal, "samples_per_pixel": samples})
        found, _ = look(scene, TWO, [FORWARD], [600_000_000], config=config, device=device)
        seen[samples] = found["log_radiance"]
    one, adaptive = (float(np.sqrt(np.mean((seen[k] - seen[64]) ** 2))) for k in (1, "adaptive"))
    assert one > 0.005
    assert adaptive < 0.45 * one  # 0.39


def test_patterns_are_mapped_as_on_a_mesh_of_the_scene(device):
    """A checker face on: squares of 0.1 m at 1.8 m, the red one in the lower left corner of the face."""
    surface = CheckerSurface(square_m=0.1, color=(1.0, 0.0, 0.0), other_color=(0.0, 0.0, 1.0))
    crate = {
        "crate": BodyConfig(surface=surface, motion=MotionConfig(position_m=(2.0, 0.0, 0.0))),
    }
    scene = scene_of(plane(30.0, -5.0), ambient=Ambient(up=(1.0,) * 3, down=(1.0,) * 3))
    lens = PinholeConfig(width=80, height=80, fx=180.0, fy=180.0, cx=40.0, cy=40.0)  # 100 px a metre at 1.8 m
    seen, _ = look(scene, crate, [FORWARD], [0], lens=lens, device=device)
    middles = seen["rgb"][0, 25:56:10, 25:56:10]
    red = middles[..., 0] > 200
    rows, columns = np.indices(red.shape)
    np.testing.assert_array_equal(red, (rows + columns) % 2 == 1)  # the last row begins with red
    assert (middles[..., 2][~red] > 200).all()


def test_scenes_without_bodies_are_compiled_without_them(device):
    arrays = upload_scene(wall(), UNSHADOWED, device=device)
    assert not arrays.terms.bodies
    assert arrays.bodies is None
    assert raycast_kernel(("depth",), RenderTerms(False, False, False, False, 0)) is not raycast_kernel(
        ("depth",), RenderTerms(False, False, False, False, 0, bodies=True)
    )


@pytest.mark.parametrize("config", [UNSHADOWED, BAKED])
def test_bodies_out_of_view_change_no_bit(device, traversal, config):
    """With them another kernel runs; behind the camera and behind the wall they are met by no ray."""
    if config is BAKED and (traversal, device) == ("warp", "cpu"):
        pytest.skip("baked light is read alike whoever finds what rays hit")
    config = config.model_copy(update={"cpu_traversal": traversal, "samples_per_pixel": 2})
    scene = scene_of(
        box((0.1, 40.0, 40.0), (6.05, 0.0, 0.0)), box((1.0, 1.0, 1.0), (3.0, 0.5, 0.0)),
        lights=(point_light((1.0, 0.0, 2.0), 3.0),),
    )  # fmt: skip
    hidden = {
        "behind": BodyConfig(motion=MotionConfig(position_m=(-0.5, 0.0, 0.0))),
        "beyond": BodyConfig(surface=CheckerSurface(), motion=MotionConfig(position_m=(8.0, 0.0, 0.0))),
    }
    seen, _ = look(scene, hidden, [FORWARD], [0, 10**9], config=config, device=device)
    expected, _ = look(scene, {}, [FORWARD], [0, 10**9], config=config, device=device)
    for name in OUTPUTS:
        np.testing.assert_array_equal(seen[name], expected[name])


def test_lamps_that_the_scene_hides_do_not_light_a_body(device):
    """Baked light: a screen leaves only the ambient light, in view of the lamp all of it falls."""
    screen = box((0.02, 4.0, 4.0), (1.0, 3.0, 0.0))
    scene = scene_of(
        screen, box((0.1, 40.0, 40.0), (9.0, 0.0, 0.0)), lights=(point_light((-1.0, 0.0, 0.0), 5.0),),
        ambient=Ambient(up=(0.2,) * 3, down=(0.2,) * 3),
    )  # fmt: skip
    sway = SwayConfig(amplitude_m=(0.0, 3.0, 0.0), frequency_hz=0.25)
    shape = BoxShape(size_m=(0.2, 0.2, 0.2))
    crate = {
        "crate": BodyConfig(
            shape=shape, surface=PlainSurface(color=(0.5,) * 3),
            motion=MotionConfig(position_m=(3.1, 0.0, 0.0), sway=sway),
        )
    }  # fmt: skip
    poses = [FORWARD, ((2.0, 3.0, 0.0), Q_FORWARD_OPTICAL)]
    seen, _ = look(scene, crate, poses, [0, 10**9], config=BAKED, device=device)
    radiance = np.exp(seen["log_radiance"][MIDDLE]) - BAKED.dark_floor
    in_view = 0.5 * (0.2 + 5.0 / 4.0**2)  # the face is 4 m from the lamp and faces it
    np.testing.assert_allclose(radiance, [in_view, 0.5 * 0.2], rtol=1e-5)
    assert seen["instance"][MIDDLE].tolist() == [2, 2]


def test_emission_and_colour_of_bodies(device):
    """Materials of bodies follow those of the scene: each keeps its own."""
    bodies = {
        "red": BodyConfig(
            surface=PlainSurface(color=(0.5, 0.0, 0.0)), motion=MotionConfig(position_m=(2.0, 0.5, 0.0))
        ),
        "green": BodyConfig(
            surface=PlainSurface(color=(0.0, 0.25, 0.0)), motion=MotionConfig(position_m=(2.0, -0.5, 0.0))
        ),
    }
    scene = scene_of(
        box((0.1, 40.0, 40.0), (6.05, 0.0, 0.0)),
        materials=(Material(name="glow", base_color=(0.0,) * 3, emission=(0.0, 0.0, 0.7)),),
        ambient=Ambient(up=(1.0,) * 3, down=(1.0,) * 3),
    )
    seen, _ = look(scene, bodies, [FORWARD], [0], device=device)
    for instance, linear in ((0, (0.0, 0.0, 0.7)), (1, (0.5, 0.0, 0.0)), (2, (0.0, 0.25, 0.0))):
        shown = np.exp(seen["log_radiance"][seen["instance"] == instance]) - UNSHADOWED.dark_floor
        assert len(shown) > 200
        np.testing.assert_allclose(shown, LUMA @ linear, rtol=1e-4)


def test_any_number_of_threads_and_instants_gives_the_same_bits(traversal):
    """Instants rendered together, one by one, or by one thread: CPU."""
    config = UNSHADOWED.model_copy(update={"cpu_traversal": traversal})
    stamps_ns = [0, 600_000_000, 1_250_000_000, 2_000_000_000]
    together, _ = look(wall(), TWO, [FORWARD], stamps_ns, config=config)
    by_one, _ = look(wall(), TWO, [FORWARD], stamps_ns, config=config, threads=1)
    by_three, _ = look(wall(), TWO, [FORWARD], stamps_ns, config=config, threads=3)
    for name in OUTPUTS:
        np.testing.assert_array_equal(by_one[name], together[name])
        np.testing.assert_array_equal(by_three[name], together[name])
        for k, stamp_ns in enumerate(stamps_ns):
            alone, _ = look(wall(), TWO, [FORWARD], [stamp_ns], config=config)
            np.testing.assert_array_equal(alone[name][0], together[name][k])
    assert len({together["depth"][k].tobytes() for k in range(4)}) == 4


def test_a_small_body_far_away_is_not_missed(device):
    """A sphere of 2 mm at 10 m, 1 km from the origin of the world, fills a hundredth of a narrow view."""
    ball = {
        "ball": BodyConfig(
            shape=SphereShape(radius_m=0.002), motion=MotionConfig(position_m=(1000.0, 10.0, 0.0))
        )
    }
    lens = PinholeConfig(width=65, height=65, fx=1e5, fy=1e5, cx=32.5, cy=32.5)  # 0.1 mm a pixel
    turn = (Rotation.from_euler("z", 0.5 * math.pi) * Rotation.from_quat(Q_FORWARD_OPTICAL)).as_quat()
    seen, _ = look(wall(), ball, [((1000.0, 0.0, 0.0), turn)], [0], device=device, lens=lens)
    area = (seen["instance"] == 1).sum()
    assert area == pytest.approx(math.pi * 20.0**2, rel=0.01)


def test_opengl_moves_the_same_bodies():
    """Depth and outlines at four instants against the rasterizer, in one launch."""
    stamps_ns = [0, 600_000_000, 1_250_000_000, 2_000_000_000]
    ball = BodyConfig(
        shape=SphereShape(radius_m=0.25),
        surface=CheckerSurface(),
        motion=MotionConfig(position_m=(1.8, 0.6, 0.3), spin_rad_s=(1.0, 2.0, 3.0)),
    )
    bodies = {**TWO, "ball": ball}
    scene = scene_of(box((0.1, 40.0, 40.0), (6.05, 0.0, 0.0)), lights=(point_light((0.0, 0.0, 3.0), 2.0),))
    seen, _ = look(scene, bodies, [FORWARD], stamps_ns, config=BAKED)
    try:
        uploaded = upload_scene(scene, BAKED, device="cpu", renderer="pyrender", bodies=make_bodies(bodies))
        renderer = make_renderer(uploaded, LENS, outputs={"rgb", "depth"}, instant_count=4, image_count=4)
    except PyrenderError as error:
        pytest.skip(str(error))
    slot = wp.array(np.arange(4, dtype=np.int32), dtype=int, device="cpu")
    where = make_body_poses(4, 3, "cpu")
    stamps = wp.array(np.array(stamps_ns)[:, None], dtype=wp.int64, device="cpu")
    pose_bodies(upload_motions(bodies, "cpu"), stamps, slot, count=4, poses=where)
    renderer.render(
        wp.array(np.zeros((4, 3), np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(np.tile(np.float32(Q_FORWARD_OPTICAL), (4, 1)), dtype=wp.quat, device="cpu"),
        slot,
        instant_count=4,
        bodies=where,
    )
    depth = renderer.depth.numpy()
    near, near_gl = seen["depth"] < 5.0, depth < 5.0
    assert near.sum() > 3000
    assert (near != near_gl).sum() < 0.01 * near.sum()  # OpenGL snaps corners to 1/256 px
    both = near & near_gl
    error = np.abs(depth - seen["depth"])[both] / seen["depth"][both]
    assert np.percentile(error, 97) < 2e-3  # the rest is at outlines of one body before another
    assert np.median(error) < 1e-4
    # Where a body was lit at stamp 0 it is lit alike; mip levels and pyrender's display curve differ.
    rgb = np.abs(renderer.rgb.numpy()[0].astype(float) - seen["rgb"][0])
    assert np.median(rgb[both[0]]) < 12.0


def test_what_is_wrong_is_said():
    bodies = make_bodies({"ball": BodyConfig()})
    renderer = WarpRenderer(
        upload_scene(wall(), UNSHADOWED, device="cpu", bodies=bodies),
        LENS,
        outputs={"depth"},
        instant_count=1,
    )
    p = wp.zeros(1, dtype=wp.vec3, device="cpu")
    q = wp.zeros(1, dtype=wp.quat, device="cpu")
    with pytest.raises(ValueError, match=r"bodies move in this scene \(ball\): render\(\) needs their poses"):
        renderer.render(p, q, wp.zeros(1, dtype=int, device="cpu"), instant_count=1)
    several = WarpRenderer(
        upload_scene(wall(), UNSHADOWED, device="cpu"),
        LENS,
        outputs={"depth"},
        instant_count=1,
        worlds=RenderWorlds(count=2),
    )
    with pytest.raises(ValueError, match=r"render\(\) of 2 worlds needs `active`"):
        several.render(p, q, wp.zeros(1, dtype=int, device="cpu"), instant_count=1)
    with pytest.raises(ValueError, match="the renderer 'synthetic' sees no bodies, and there are some: ball"):
        upload_scene(wall(), UNSHADOWED, device="cpu", renderer="synthetic", bodies=bodies)
