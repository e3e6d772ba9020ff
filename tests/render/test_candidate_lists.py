"""Rays with candidate lists give the outputs of rays that traverse the tree, to the last bit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
import warp as wp
from render_scenes import LOOK_DOWN, LUMA, UNSHADOWED, box, plane, render, scene_of
from scipy.spatial.transform import Rotation
from small_room import room_scene

from neurosim_core import run
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.candidate_lists import CandidateLists, choose_candidate_lists, tile_bounds
from neurosim_core.render.config import CandidateListConfig, RenderConfig
from neurosim_core.render.kernel_data import RenderTerms
from neurosim_core.render.outputs import OUTPUTS
from neurosim_core.render.ray_layers import ray_layers
from neurosim_core.render.raycast import raycast_kernel
from neurosim_core.render.scene_arrays import upload_scene
from neurosim_core.render.warp_renderer import WarpRenderer
from neurosim_core.scene.bodies import BodyConfig, body_poses, make_bodies, make_body_poses
from neurosim_core.scene.scene import Material

LENS = PinholeConfig(width=45, height=34, fx=40.0, fy=38.0, cx=21.0, cy=18.5)  # no multiples of a tile
ALONE = UNSHADOWED.model_copy(update={"cpu_traversal": "warp", "candidate_lists": None})


def with_lists(config=UNSHADOWED, **lists) -> RenderConfig:
    return config.model_copy(update={"candidate_lists": CandidateListConfig(**lists)})


def by_block(arrays):
    """The kernel of CUDA devices, which asks for one ray at a time on a CPU."""
    return dataclasses.replace(arrays, terms=arrays.terms._replace(by_tile=False))


def path(count, step_m=0.02, step_rad=0.01, start=(0.3, -0.2, 2.5)):
    """Poses on the way down, turning."""
    move = np.outer(np.arange(count), [step_m, -0.5 * step_m, -step_m]) + start
    turns = Rotation.from_euler("xyz", np.outer(np.arange(count), [step_rad, -0.5 * step_rad, step_rad]))
    return list(
        zip(map(tuple, move), map(tuple, (turns * Rotation.from_quat(LOOK_DOWN)).as_quat()), strict=True)
    )


def soup(count, seed, size_m=0.4):
    """Triangles all over the place: many layers, slivers, some seen from the side."""
    rng = np.random.default_rng(seed)
    middles = rng.uniform([-2.0, -2.0, -1.0], [2.0, 2.0, 1.5], (count, 1, 3))
    corners = middles + rng.normal(0.0, size_m, (count, 3, 3)) * rng.uniform(0.01, 1.0, (count, 3, 1))
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), process=False)


def assert_same(got, expected):
    for name, image in expected.items():
        np.testing.assert_array_equal(got[name], image, err_msg=name)


def compare(scene, poses, device, *, config=UNSHADOWED, **lists):
    """Render with and without candidate lists, in both forms; return the former."""
    alone = config.model_copy(update={"cpu_traversal": "warp", "candidate_lists": None})
    expected = render(scene, LENS, poses, outputs=OUTPUTS, config=alone, device=device)
    arrays = upload_scene(scene, with_lists(config, **lists), device)
    for form in (arrays, by_block(arrays)):
        assert_same(render(form, LENS, poses, outputs=OUTPUTS, device=device), expected)
    return expected


def lists_of(scene, poses, device, lens=LENS, **lists):
    """A renderer that has seen the poses: its lists."""
    arrays = upload_scene(scene, with_lists(**lists), device)
    renderer = WarpRenderer(arrays, lens, outputs=("log_radiance",), instant_count=len(poses))
    arguments = [
        wp.array(np.array([p for p, _ in poses], np.float32), dtype=wp.vec3, device=device),
        wp.array(np.array([q for _, q in poses], np.float32), dtype=wp.quat, device=device),
        wp.full(len(poses), -1, dtype=int, device=device),
    ]
    renderer.render(*arguments, instant_count=len(poses))
    return renderer, arguments


@pytest.mark.parametrize("instants", [1, 3, 16])
@pytest.mark.parametrize("limit", [1, 12, 256])
def test_same_bits_whatever_the_lists(device, instants, limit):
    """Eleven instants, of which the last list has the remainder; lists that are long enough, and too long."""
    compare(scene_of(plane(6.0), soup(120, 1)), path(11), device, instants=instants, face_count_max=limit)


@pytest.mark.parametrize("seed", range(4))
def test_same_bits_in_a_soup(device, seed):
    rng = np.random.default_rng(seed)
    scene = scene_of(soup(400, seed, size_m=float(rng.choice([0.05, 0.3, 1.0]))))
    compare(scene, path(6, 0.05, 0.03, start=tuple(rng.uniform(-1.0, 1.5, 3))), device)


def test_same_bits_with_several_samples(device):
    """The rays of the samples lie outside of those of the centres."""
    config = UNSHADOWED.model_copy(update={"samples_per_pixel": 4})
    compare(scene_of(plane(6.0), soup(120, 2)), path(4), device, config=config)


def test_same_bits_where_rounding_decides(device):
    """Rays along the edges of a grid, along planes, and two faces in one place: it is the first of them."""
    lens = PinholeConfig(width=32, height=32, fx=16.0, fy=16.0, cx=15.5, cy=15.5)  # a ray along the axis
    steps = np.linspace(-2.0, 2.0, 33)  # at a height of 2 m every ray goes through a corner of the grid
    x, y = np.meshgrid(steps, steps)
    grid = trimesh.Trimesh(
        np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3),
        [
            f
            for r in range(32)
            for c in range(32)
            for k in [33 * r + c]
            for f in ([k, k + 1, k + 34], [k, k + 34, k + 33])
        ],
        process=False,
    )
    wall = box((1e-3, 1.5, 1.0), (0.0, 0.0, 0.5))
    scene = scene_of(
        grid,
        plane(1.0),
        wall,
        materials=tuple(
            Material(name=n, base_color=(c, c, c)) for n, c in (("a", 0.2), ("b", 0.5), ("c", 0.9))
        ),
        part_material=(0, 1, 2),
    )
    poses = [((0.0, 0.0, 2.0), LOOK_DOWN), ((0.0, 0.0, 2.0), LOOK_DOWN), ((0.5, 0.0, 2.0), LOOK_DOWN)]
    for q_WC in (
        LOOK_DOWN,
        tuple((Rotation.from_euler("x", 1.5707963) * Rotation.from_quat(LOOK_DOWN)).as_quat()),
    ):
        poses += [((0.0, -1.5, 0.25), q_WC), ((5e-4, -1.5, 1.0), q_WC)]
    alone = upload_scene(scene, ALONE, device)
    arrays = upload_scene(scene, with_lists(instants=1), device)
    expected = render(alone, lens, poses, outputs=OUTPUTS, device=device)
    np.testing.assert_array_equal(np.unique(expected["instance"][0]), [0, 2])
    for form in (arrays, by_block(arrays)):
        assert_same(render(form, lens, poses, outputs=OUTPUTS, device=device), expected)


def along_borders(lens, count, seed):
    """Triangles in C with an edge along the outermost rays of a tile, and the rest of them outside of it.

    The edge lies within a few roundings of the plane through those rays, on either side.
    """
    rng = np.random.default_rng(seed)
    fx, fy, cx, cy = lens.intrinsics()
    corners = np.empty((count, 3, 3))
    for triangle in corners:
        axis = int(rng.integers(2))  # 0: the border is a column, 1: a row
        size, focal, centre = ((lens.width, fx, cx), (lens.height, fy, cy))[axis]
        other_size, other_focal, other_centre = ((lens.height, fy, cy), (lens.width, fx, cx))[axis]
        outwards = rng.choice([-1.0, 1.0])
        pixel = 8 * int(rng.integers(size // 8)) + (7 if outwards > 0.0 else 0)
        angle = np.arctan((pixel + 0.5 - centre) / focal) + rng.choice([0.0, 1e-7, 3e-7]) * rng.choice(
            [-1, 1]
        )
        angles = np.array([angle, angle, angle + outwards * rng.uniform(0.02, 0.1)])
        along = (rng.uniform(0.0, other_size, 3) - other_centre) / other_focal
        direction = np.empty((3, 3))
        direction[:, axis] = np.sin(angles)
        direction[:, 1 - axis] = along * np.cos(angles)
        direction[:, 2] = np.cos(angles)
        distance = rng.uniform(1.0, 4.0, (3, 1))
        triangle[:] = distance * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return corners


@pytest.mark.parametrize("behind", ["sky", "walls"])
@pytest.mark.parametrize("fov_deg", [90.0, 170.0, 178.5])
def test_same_bits_where_silhouettes_run_along_tiles(device, fov_deg, behind):
    lens = PinholeConfig(width=40, height=32, horizontal_fov_rad=np.radians(fov_deg))
    hits = 0
    for seed in (10, 40, 49, 70, 91, 195, 216):  # of which borders on the plane z = 1 lost some at 178.5 deg
        turn = Rotation.random(random_state=seed)
        place = np.random.default_rng(seed).uniform(-1.0, 1.0, 3)
        corners = turn.apply(along_borders(lens, 60, seed).reshape(-1, 3)) + place
        parts = [trimesh.Trimesh(corners, np.arange(180).reshape(-1, 3), process=False)]
        parts += [box((12.0, 12.0, 12.0), (0.0, 0.0, 0.0))] if behind == "walls" else []
        poses = [(tuple(place), tuple(turn.as_quat()))] * 2
        scene = scene_of(*parts)
        expected = render(scene, lens, poses, outputs=OUTPUTS, config=ALONE, device=device)
        arrays = upload_scene(scene, with_lists(), device)
        for form in (arrays, by_block(arrays)):
            assert_same(render(form, lens, poses, outputs=OUTPUTS, device=device), expected)
        hits += (expected["instance"] == 0).sum()
    assert hits > 1000


def test_same_bits_beside_the_sky(device):
    """Rays that hit nothing, in tiles with something and in tiles without."""
    expected = compare(scene_of(box((0.3, 0.3, 0.3), (0.5, 0.2, 0.0))), path(5), device, instants=5)
    assert 0.01 < np.isfinite(expected["depth"]).mean() < 0.5


def test_same_bits_through_a_slit_that_no_probe_finds(device):
    """A slope that begins within the reach is listed, a bar before it but beyond the reach is not."""
    lens = PinholeConfig(width=16, height=16, fx=16.0, fy=16.0, cx=8.0, cy=8.0)
    slope = trimesh.Trimesh(
        [[-20.0, -20.0, 16.0], [20.0, -20.0, -24.0], [20.0, 20.0, -24.0], [-20.0, 20.0, 16.0]],
        [[0, 1, 2], [0, 2, 3]],
        process=False,
    )
    plates = [
        box((10.0, 20.0, 0.01), (x, 0.0, 1.5)) for x in (-5.3, 4.74)
    ]  # rays of column 3 pass at x = -0.28
    bar = box((0.4, 2.6, 0.1), (-0.84, 0.0, 0.0))  # short: all of it is beyond the reach
    scene = scene_of(*plates, slope, bar)
    pose = [((0.0, 0.0, 2.5), LOOK_DOWN)]
    expected = render(scene, lens, pose, outputs=OUTPUTS, config=ALONE, device=device)
    assert (expected["instance"][0, :, 3] == 3).all()
    assert (np.delete(expected["instance"][0], 3, axis=1) < 2).all()
    renderer, _ = lists_of(scene, pose, device, lens=lens)
    assert renderer.candidates.data.reach.numpy().max() < 2.0
    arrays = upload_scene(scene, with_lists(), device)
    for form in (arrays, by_block(arrays)):
        assert_same(render(form, lens, pose, outputs=OUTPUTS, device=device), expected)


def test_same_bits_when_the_camera_whirls(device):
    """Turned by a radian from one instant to the next, no frustum holds the rays: such tiles have no list."""
    scene, poses = scene_of(soup(200, 5)), path(4, 0.0, 1.0, start=(0.0, 0.0, 0.0))
    compare(scene, poses, device)
    renderer, _ = lists_of(scene, poses, device)
    assert (renderer.candidates.data.count.numpy() == -1).all()


def test_same_bits_with_moving_bodies(device):
    motion = {"position_m": (0.3, -0.2, 1.0), "velocity_m_s": (5.0, 0.0, 0.0), "spin_rad_s": (0.0, 3.0, 9.0)}
    configs = {
        "ball": BodyConfig.model_validate({"shape": {"kind": "sphere", "radius_m": 0.3}, "motion": motion})
    }
    bodies, poses = make_bodies(configs), path(5)
    p_WO, q_WO = body_poses(configs, np.arange(5) * 10_000_000)
    where = make_body_poses(5, 1, device)
    where.p_WO.assign(p_WO)
    where.q_WO.assign(q_WO)
    seen = []
    for config in (ALONE, with_lists()):
        arrays = upload_scene(scene_of(plane(6.0), soup(60, 3)), config, device, bodies=bodies)
        renderer = WarpRenderer(arrays, LENS, outputs=OUTPUTS, instant_count=5, image_count=5)
        renderer.render(
            wp.array(np.array([p for p, _ in poses], np.float32), dtype=wp.vec3, device=device),
            wp.array(np.array([q for _, q in poses], np.float32), dtype=wp.quat, device=device),
            wp.array(np.arange(5, dtype=np.int32), dtype=int, device=device),
            instant_count=5,
            bodies=where,
        )
        seen.append({name: getattr(renderer, name).numpy().copy() for name in OUTPUTS})
    assert (seen[0]["instance"] == 2).sum() > 100
    assert_same(seen[1], seen[0])


def test_threads_do_not_change_a_bit():
    arrays = upload_scene(scene_of(plane(6.0), soup(120, 4)), with_lists(instants=4), "cpu")
    expected = render(arrays, LENS, path(6), outputs=OUTPUTS, thread_count=1)
    for threads in (2, 3):
        assert_same(render(arrays, LENS, path(6), outputs=OUTPUTS, thread_count=threads), expected)


def test_lists_hold_what_rays_hit(device):
    """Every triangle that a ray meets within the reach, hidden or not, by brute force in float64."""
    part = soup(60, 6)
    poses = path(6, 0.03, 0.02)
    renderer, _ = lists_of(scene_of(part), poses, device, instants=8, face_count_max=64)
    data = renderer.candidates.data
    count, reach = data.count.numpy()[0], data.reach.numpy()[0]
    lists = data.faces.numpy().reshape(len(count), 64)
    a, b, c = np.moveaxis(part.triangles.astype(np.float32).astype(np.float64), 1, 0)
    missed = listed = 0
    for p_WC, q_WC in poses:
        rays = LENS.ray_table().astype(np.float64).reshape(-1, 3) @ Rotation.from_quat(q_WC).as_matrix().T
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore"):
            t = ((a - p_WC) * normal).sum(axis=1) / (rays @ normal.T)
        edges = [np.cross(e - p_WC, f - p_WC) for e, f in ((b, c), (c, a), (a, b))]
        sides = np.stack([rays @ edge.T for edge in edges])
        inside = ((sides > 0.0).all(axis=0) | (sides < 0.0).all(axis=0)) & (t > 0.0)
        for pixel, face in zip(*np.nonzero(inside), strict=True):
            tile = pixel // 45 // 8 * 6 + pixel % 45 // 8
            if t[pixel, face] <= reach[tile]:
                listed += 1
                missed += face not in lists[tile, : count[tile]]
    assert (count >= 0).all()
    assert listed > 1000
    assert missed == 0


def test_lists_are_short_and_used(device):
    """Without its lists a renderer that trusts them sees nothing; with them few rays have to ask the tree."""
    lens = PinholeConfig(width=64, height=48, horizontal_fov_rad=1.2)
    scene = scene_of(plane(30.0), soup(40, 7, size_m=0.2))
    renderer, arguments = lists_of(scene, path(8, 0.005, 0.002), device, lens=lens)
    seen = renderer.log_radiance.numpy().copy()
    data = renderer.candidates.data
    count = data.count.numpy()
    assert (count >= 0).all()
    assert count.mean() < 15.0  # of 42 triangles
    true_reach = data.reach.numpy().copy()

    def look(reach):
        """Render with what the lists are replaced by, without a search."""
        data.count.zero_()
        data.reach.assign(np.broadcast_to(np.asarray(reach, np.float32), true_reach.shape))
        renderer.candidates.update = lambda *_, **__: data.unresolved_count.zero_()
        renderer.render(*arguments, instant_count=8)
        return renderer.log_radiance.numpy().copy()

    sky = np.log(np.array(scene.sky) @ LUMA + UNSHADOWED.dark_floor)
    np.testing.assert_array_equal(look(true_reach), seen)  # empty lists of a finite reach tell nothing
    assert (np.abs(look(1.0e9) - sky) < 1e-6).all()  # and of an infinite one, that there is only sky


def test_bounds_hold_the_rays_of_a_tile():
    rays = np.stack([LENS.ray_table(o).reshape(-1, 3) for o in ((0.5, 0.5), (0.1, 0.9))])
    bounds = tile_bounds(rays, 45, 34)
    assert bounds.shape == (6 * 5, 4)
    slopes = (rays[..., :2] / rays[..., 2:]).reshape(2, 34, 45, 2)
    part = slopes[:, 8:16, 40:45]
    low_x, high_x, low_y, high_y = bounds[6 + 5]
    for low, high, axis in ((low_x, high_x, 0), (low_y, high_y, 1)):
        assert low < part[..., axis].min() < low + 5e-5
        assert high - 5e-5 < part[..., axis].max() < high
    with pytest.raises(ValueError, match="need rays that look forward"):
        tile_bounds(-rays, 45, 34)


@pytest.mark.parametrize("fov_deg", [60.0, 170.0, 178.8])
def test_rays_are_inside_of_bounds_by_an_angle(fov_deg):
    lens = PinholeConfig(width=40, height=32, horizontal_fov_rad=np.radians(fov_deg))
    rays = lens.ray_table().astype(np.float64)
    bounds = tile_bounds(lens.ray_table().reshape(1, -1, 3), 40, 32).astype(np.float64)
    for tile, (low_x, high_x, low_y, high_y) in enumerate(bounds):
        row, col = 8 * (tile // 5), 8 * (tile % 5)
        part = rays[row : row + 8, col : col + 8].reshape(-1, 3)
        for axis, slope, sign in ((0, low_x, 1), (0, high_x, -1), (1, low_y, 1), (1, high_y, -1)):
            normal = np.array([0.0, 0.0, -slope])
            normal[axis] = 1.0
            inside = sign * (part @ normal) / np.linalg.norm(normal)  # sines
            assert 0.98e-5 < inside.min() < 1.02e-5


def test_a_lens_that_is_too_wide_is_refused():
    lens = PinholeConfig(width=40, height=32, horizontal_fov_rad=np.radians(179.5))
    with pytest.raises(
        ValueError, match=r"up to 100 \(89.4 deg .* has 223[.].*render.candidate_lists to null"
    ):
        tile_bounds(lens.ray_table().reshape(1, -1, 3), 40, 32)


def test_what_kernels_cannot_count_is_refused():
    rays = np.tile(np.array([0.0, 0.0, 1.0, 0.01], np.float32), (1, 128 * 128, 1))

    def lists(count, face_count_max):
        return CandidateLists(
            upload_scene(scene_of(plane(1.0)), ALONE, "cpu").data.tree,
            rays,
            width=128,
            height=128,
            extent_m=1.0,
            config=CandidateListConfig(instants=1, face_count_max=face_count_max),
            instant_count=count,
            has_fallback=False,
        )

    with pytest.raises(
        ValueError, match=r"4096 groups of instants of 256 tiles .*_max = 4096 .*: at most 2047 here"
    ):
        lists(4096, 4096)
    with pytest.raises(ValueError, match="no value is small enough here"):
        lists(200_000, 1)
    lens = PinholeConfig(width=16384, height=16384, horizontal_fov_rad=1.0)
    arrays = upload_scene(scene_of(plane(1.0)), ALONE, "cpu")
    with pytest.raises(ValueError, match=r"8 instants of 16384 x 16384 px .* at most 7 instants"):
        WarpRenderer(arrays, lens, outputs=("depth",), instant_count=8)


def test_events_of_a_flight_are_the_same(tmp_path):
    camera = {
        "kind": "event_camera",
        "lens": {"width": 40, "height": 30, "horizontal_fov_rad": 1.5},
        "sampling_rate_hz": 1000,
        "packet_rate_hz": 50,
    }
    turn = [
        {"time_s": time_s, "position_m": [time_s, 0.0, 1.2], "rpy_rad": [0.0, 0.0, 0.2 + 3.0 * time_s]}
        for time_s in (0.0, 0.1, 0.2)
    ]
    settings = {
        "duration_s": 0.2,
        "device": "cpu",
        "scene": room_scene(tmp_path),
        "path": {"kind": "poses", "keyframes": turn},
        "sensors": {"events": camera},
    }
    light = {"lighting": {"mode": "unshadowed"}, "exposure": 1.0, "samples_per_pixel": 1}
    streams = []
    for traversal in (
        {"cpu_traversal": "warp", "candidate_lists": None},
        {"candidate_lists": {}},
        {"candidate_lists": {"instants": 12}},
    ):
        packets = list(run({**settings, "render": {**light, **traversal}}))
        streams.append([np.concatenate(column) for column in zip(*(p.numpy() for p in packets), strict=True)])
    assert len(streams[0][0]) > 50
    for other in streams[1:]:
        for mine, theirs in zip(streams[0], other, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_what_does_not_go_together_is_refused():
    with pytest.raises(ValueError, match="need cpu_traversal auto or warp, got embree"):
        RenderConfig(cpu_traversal="embree", candidate_lists=CandidateListConfig())
    terms = RenderTerms(
        textured=False, emissive=False, baked=False, supersampled=False, candidate_group=1, worlds=True
    )
    for term in ("world_scenes", "world_lenses"):
        with pytest.raises(ValueError, match="candidate lists need worlds with one scene and one lens"):
            raycast_kernel(("log_radiance",), terms._replace(**{term: True}))


def test_there_are_no_lists_unless_requested(device):
    arrays = upload_scene(scene_of(plane(1.0)), ALONE, device)
    assert WarpRenderer(arrays, LENS, outputs=("depth",), instant_count=8).candidates is None


@pytest.mark.parametrize(
    ("pixel_rad", "least"), [(1.2e-3, 8), (1.7e-3, 16), (2.4e-3, 16), (5.8e-3, 32), (6.2e-3, None)]
)
@pytest.mark.parametrize("samples", [1, 4])
def test_the_default_is_for_many_instants_of_small_pixels(pixel_rad, least, samples):
    lens = PinholeConfig(width=16, height=16, fx=1.0 / pixel_rad, fy=1.0 / pixel_rad, cx=8.0, cy=8.0)
    rays = ray_layers(lens, samples)
    for count in (1, 7, 8, 15, 16, 31, 32, 1000):
        chosen = choose_candidate_lists("auto", rays, instant_count=count, face_count=1000, is_cuda=True)
        assert (chosen is not None) is (least is not None and count >= least)
    assert choose_candidate_lists("auto", -rays, instant_count=1000, face_count=1000, is_cuda=True) is None


def test_the_default_of_a_cpu_is_for_rays_without_embree():
    rays = ray_layers(LENS, 1)
    for given, embree, shared in ((rays, False, True), (rays, True, False), (-rays, False, False)):
        chosen = choose_candidate_lists(
            "auto", given, instant_count=1, face_count=10**7, is_cuda=False, embree=embree
        )
        assert (chosen is not None) is shared


@pytest.mark.parametrize(("pixel_rad", "most"), [(1.2e-3, 4_861_000), (2.24e-3, 1_395_000)])
def test_the_default_is_not_for_lists_that_are_long(pixel_rad, most):
    lens = PinholeConfig(width=16, height=16, fx=1.0 / pixel_rad, fy=1.0 / pixel_rad, cx=8.0, cy=8.0)
    rays = ray_layers(lens, 1)
    for face_count, shared in ((int(0.98 * most), True), (int(1.02 * most), False)):
        chosen = choose_candidate_lists("auto", rays, instant_count=64, face_count=face_count, is_cuda=True)
        assert (chosen is not None) is shared


def test_lists_are_the_default_where_they_pay(device):
    """On CUDA for many instants of small pixels; on a CPU in place of rays that Warp casts one by one."""
    arrays = upload_scene(scene_of(plane(1.0)), UNSHADOWED, device)
    alone = arrays.embree is None and device == "cpu"
    is_cuda = wp.get_device(device).is_cuda
    narrow = PinholeConfig(width=45, height=34, fx=800.0, fy=760.0, cx=21.0, cy=18.5)
    for lens, count, shared in ((narrow, 7, alone), (narrow, 8, alone or is_cuda), (LENS, 8, alone)):
        renderer = WarpRenderer(arrays, lens, outputs=("depth",), instant_count=count)
        assert (renderer.candidates is not None) is shared
    shared = upload_scene(scene_of(plane(1.0)), with_lists(instants=2, face_count_max=8), device)
    lists = WarpRenderer(shared, LENS, outputs=("depth",), instant_count=5).candidates
    assert isinstance(lists, CandidateLists)
    assert lists.data.faces.shape == (3 * 30 * 8,)
