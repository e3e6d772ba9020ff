"""Which ticks have to be rendered, against closed forms of how far things move in the picture."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import trimesh
import warp as wp
from core_counts import cores
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from neurosim_core.clock import Rate
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.scene_arrays import SceneArrays, upload_scene
from neurosim_core.render.warp_renderer import WarpRenderer
from neurosim_core.scene.bodies import BodyConfig, make_bodies
from neurosim_core.scene.scene import Material, Scene
from neurosim_core.sensors.displacement import DisplacementRule

RATE = Rate(1000.0)
LENS = PinholeConfig(width=96, height=72, fx=60.0, fy=60.0, cx=48.0, cy=36.0)
WALL_M = 2.0
LIMIT_PX = 0.5
CONFIG = RenderConfig(lighting=LightingConfig(mode="unshadowed"), exposure=1.0)


def scene_of(part: trimesh.Trimesh) -> Scene:
    count = len(part.faces)
    return Scene(
        name="test",
        vertices=part.vertices.astype(np.float32),
        faces=part.faces.astype(np.int32),
        normals=part.vertex_normals.astype(np.float32),
        uv=np.zeros((len(part.vertices), 2), np.float32),
        face_material=np.zeros(count, np.int32),
        face_instance=np.zeros(count, np.int32),
        instance_names=("part",),
        materials=(Material(name="white"),),
    )


def wall(size_m: float = 100.0) -> trimesh.Trimesh:
    """Return a wall across the z axis, which is the optical axis of a camera at the identity."""
    return trimesh.creation.box((size_m, size_m, 0.1), trimesh.transformations.translation_matrix(
        (0.0, 0.0, WALL_M + 0.05)))  # fmt: skip


@pytest.fixture(scope="module")
def arrays() -> SceneArrays:
    return upload_scene(scene_of(wall()), CONFIG, "cpu")


def make_rule(
    arrays: SceneArrays, limit_px: float = LIMIT_PX, lens: PinholeConfig = LENS
) -> DisplacementRule:
    """Return the rule of a camera whose axes are those of the body."""
    return DisplacementRule(
        arrays,
        lens,
        max_displacement_px=limit_px,
        rate=RATE,
        p_BC=wp.vec3d(0.0, 0.0, 0.0),
        q_BC=wp.quatd(0.0, 0.0, 0.0, 1.0),
    )


def flight(count: int, v_W=(0.0, 0.0, 0.0), w_B=(0.0, 0.0, 0.0), device: str = "cpu"):
    """Return states of a constant twist, one a millisecond from 0 on, as in `Trace.states`."""
    time_s = np.arange(count) * 1e-3
    states = np.zeros((count, 1, 17))
    states[:, 0, 0:3] = time_s[:, None] * np.array(v_W)
    states[:, 0, 3:7] = Rotation.from_rotvec(time_s[:, None] * np.array(w_B)).as_quat()
    states[:, 0, 7:10] = v_W
    states[:, 0, 10:13] = w_B
    return wp.array(states, dtype=wp.float64, device=device)


def choose(rule: DisplacementRule, states, cuts=(), forced=frozenset()) -> list[int]:
    """Return the ticks chosen of a flight that is cut into calls."""
    chosen = []
    for begin, end in itertools.pairwise([0, *cuts, states.shape[0]]):
        ticks = range(begin, end)
        stamps_ns = [RATE.stamp_ns(tick) for tick in ticks]
        places = rule.choose(states, list(ticks), stamps_ns, [tick in forced for tick in ticks])
        chosen += [begin + place for place in places]
    return chosen


def longest_gap(displacement_px, limit_px: float = LIMIT_PX) -> int:
    """Return after how many ticks a displacement that grows with time has to be looked at again."""
    return next(n for n in itertools.count(1) if displacement_px((n + 1) * 1e-3) > limit_px)


def test_a_translation_along_a_wall_moves_every_point_by_f_t_over_z(arrays):
    speed = 0.7
    gap = longest_gap(lambda t: LENS.fx * speed * t / WALL_M)
    assert gap == 23  # 21 px a second
    assert choose(make_rule(arrays), flight(200, v_W=(speed, 0.0, 0.0))) == list(range(0, 200, gap))


def test_an_approach_moves_the_corners_most(arrays):
    """A point at the radius r from the optical axis moves by r s / (z - s) when the camera comes s closer."""
    speed, corner_px = 1.01, math.hypot(48.0, 36.0)
    chosen = choose(make_rule(arrays), flight(400, v_W=(0.0, 0.0, speed)))
    expected = [0]
    for tick in range(1, 400):
        z = WALL_M - expected[-1] * 1e-3 * speed
        near = (tick + 1 - expected[-1]) * 1e-3 * speed
        if corner_px * near / (z - near) > LIMIT_PX:
            expected.append(tick)
    assert chosen == expected
    assert 15 < len(chosen) < 30


@pytest.mark.parametrize("empty", [False, True], ids=["wall", "sky"])
def test_a_rotation_moves_the_corners_most_and_the_sky_as_much(arrays, empty):
    """Turning about the y axis by a: column f tan(atan x + a), row f y cos(atan x) / cos(atan x + a)."""
    if empty:
        arrays = upload_scene(scene_of(wall().apply_translation((0.0, 0.0, -100.0))), CONFIG, "cpu")
    rate = 1.3
    x, y = 48.0 / 60.0, 36.0 / 60.0

    def moved(t: float) -> float:
        turned = math.atan(x) + rate * t
        column = LENS.fx * (math.tan(turned) - x)
        row = LENS.fy * y * (math.cos(math.atan(x)) / math.cos(turned) - 1.0)
        return math.hypot(column, row)

    gap = longest_gap(moved)
    assert gap == 3
    chosen = choose(make_rule(arrays), flight(100, w_B=(0.0, rate, 0.0)))
    assert chosen == list(range(0, 100, gap))


def test_a_turn_about_the_optical_axis_moves_the_corners_along_a_circle(arrays):
    rate, corner_px = 0.9, math.hypot(48.0, 36.0)
    gap = longest_gap(lambda t: 2.0 * corner_px * math.sin(0.5 * rate * t))
    assert gap == 9
    chosen = choose(make_rule(arrays), flight(100, w_B=(0.0, 0.0, rate)))
    assert chosen == list(range(0, 100, gap))


def test_under_the_open_sky_a_translation_moves_nothing():
    arrays = upload_scene(scene_of(wall().apply_translation((0.0, 0.0, -100.0))), CONFIG, "cpu")
    assert choose(make_rule(arrays), flight(300, v_W=(50.0, 0.0, 10.0))) == [0]


def test_a_hover_renders_only_what_is_asked_for(arrays):
    assert choose(make_rule(arrays), flight(300), forced={100, 101, 250}) == [0, 100, 101, 250]


def test_a_render_that_is_forced_begins_anew(arrays):
    chosen = choose(make_rule(arrays), flight(80, v_W=(0.7, 0.0, 0.0)), forced={30})
    assert chosen == [0, 23, 30, 53, 76]


def test_a_clock_that_is_too_slow_renders_all_and_says_so(arrays):
    rule = make_rule(arrays)
    assert choose(rule, flight(20, v_W=(40.0, 0.0, 0.0))) == list(range(20))
    assert rule.coarse_count == 20
    assert choose(make_rule(arrays), flight(20, v_W=(10.0, 0.0, 0.0))) == list(range(20))
    rule = make_rule(arrays)
    choose(rule, flight(20, v_W=(10.0, 0.0, 0.0)))
    assert rule.coarse_count == 0  # 0.3 px a tick: rendered, and within the bound


def test_what_passes_behind_the_camera_is_looked_at(arrays):
    """The camera flies through the wall: the points before it are behind it one tick later."""
    chosen = choose(make_rule(arrays, limit_px=50.0), flight(30, v_W=(0.0, 0.0, 100.0)))
    assert 19 in chosen  # at 1.9 m; 0.1 m further on it is in the wall


def test_a_near_box_moves_more_than_the_wall():
    """The box fills a few squares of the grid of probes, so that one of them hits it."""
    near = trimesh.creation.box((0.5, 0.5, 0.5), trimesh.transformations.translation_matrix((0.0, 0.0, 0.75)))
    arrays = upload_scene(scene_of(trimesh.util.concatenate([wall(), near])), CONFIG, "cpu")
    gap = longest_gap(lambda t: LENS.fx * 0.7 * t / 0.5)
    assert choose(make_rule(arrays), flight(40, v_W=(0.7, 0.0, 0.0))) == list(range(0, 40, gap))


def with_body(*, size_m, device: str = "cpu", **motion) -> SceneArrays:
    """Return the wall and a box that moves before it."""
    body = BodyConfig.model_validate({"shape": {"kind": "box", "size_m": size_m}, "motion": motion})
    return upload_scene(scene_of(wall()), CONFIG, device, bodies=make_bodies({"box": body}))


def test_a_body_between_the_probes_is_not_missed(device):
    """Its picture is 1.2 px wide; its front is 1 cm before its middle."""
    arrays = with_body(
        size_m=(0.02, 0.02, 0.02), position_m=(-0.1, 0.0, 1.0), velocity_m_s=(0.5, 0.0, 0.0), device=device
    )
    gap = longest_gap(lambda t: LENS.fx * 0.5 * t / 0.99)
    assert gap == 16
    chosen = choose(make_rule(arrays), flight(300, device=device))
    assert chosen == list(range(0, 300, gap))


def test_a_body_that_fills_the_picture_moves_as_its_surface():
    """Its corners are far outside, so that what the probes hit counts."""
    arrays = with_body(size_m=(20.0, 20.0, 0.2), position_m=(0.0, 0.0, 1.1), velocity_m_s=(0.0, 0.6, 0.0))
    gap = longest_gap(lambda t: LENS.fy * 0.6 * t / 1.0)
    assert choose(make_rule(arrays), flight(200)) == list(range(0, 200, gap))


def test_a_body_that_turns_moves_its_corners_along_a_circle():
    arrays = with_body(size_m=(0.3, 0.3, 0.02), position_m=(0.0, 0.0, 1.01), spin_rad_s=(0.0, 0.0, 3.0))
    corner_px = LENS.fx * 0.15 * math.sqrt(2.0) / 1.0
    gap = longest_gap(lambda t: 2.0 * corner_px * math.sin(1.5 * t))
    assert gap == 13
    assert choose(make_rule(arrays), flight(200)) == list(range(0, 200, gap))


@pytest.mark.parametrize("position_m", [(0.0, 0.0, -1.0), (9.0, 0.0, 1.0)], ids=["behind", "beside"])
def test_a_body_out_of_sight_does_not_count(position_m):
    arrays = with_body(size_m=(0.3, 0.3, 0.3), position_m=position_m, velocity_m_s=(0.0, 1.0, 0.0))
    assert choose(make_rule(arrays), flight(200)) == [0]


def test_a_body_that_comes_into_sight_is_looked_at():
    """It comes from the right, 1 m away: its left edge, at the back, is at the border after 0.0995 s."""
    start = 48.0 / 60.0 * 1.01 + 0.01 + 0.0995 * 2.0
    arrays = with_body(size_m=(0.02, 0.02, 0.02), position_m=(start, 0.0, 1.0), velocity_m_s=(-2.0, 0.0, 0.0))
    chosen = choose(make_rule(arrays), flight(150))
    assert chosen[:2] == [0, 99]
    assert np.diff(chosen[1:]).max() == longest_gap(lambda t: LENS.fx * 2.0 * t / 0.99)


def test_bodies_that_do_not_move_change_nothing(arrays):
    states = flight(200, v_W=(0.3, -0.2, 0.5), w_B=(0.2, 0.4, -0.9))
    still = with_body(size_m=(0.5, 0.5, 0.1), position_m=(0.0, 0.0, WALL_M + 5.0))
    assert choose(make_rule(still), states, cuts=[77, 90]) == choose(make_rule(arrays), states)


@given(cuts=st.sets(st.integers(min_value=1, max_value=199), max_size=20))
@settings(max_examples=25, deadline=None)
def test_the_choice_does_not_depend_on_how_a_flight_is_cut(arrays, cuts):
    states = flight(200, v_W=(0.3, -0.2, 0.5), w_B=(0.2, 0.4, -0.9))
    whole = choose(make_rule(arrays), states, forced={77})
    assert choose(make_rule(arrays), states, cuts=sorted(cuts), forced={77}) == whole
    assert 20 < len(whole) < 120


@pytest.mark.parametrize("moving", [False, True], ids=["still", "body"])
def test_the_choice_does_not_depend_on_the_number_of_cores(arrays, moving):
    """They share what a picture of this size needs."""
    if moving:
        arrays = with_body(size_m=(0.3, 0.2, 0.02), position_m=(0.1, 0.0, 1.0), spin_rad_s=(0.0, 0.0, 3.0))
    large = PinholeConfig(width=480, height=360, fx=300.0, fy=300.0, cx=240.0, cy=180.0)
    states = flight(150, v_W=(0.3, -0.2, 0.5), w_B=(0.2, 0.4, -0.1))
    found = []
    for count in (1, 3):
        with cores(count):
            rule = make_rule(arrays, limit_px=2.5, lens=large)
            found.append((choose(rule, states, forced={77, 78}), rule.coarse_count))
    assert found[0] == found[1]
    assert 10 < len(found[0][0]) < 100


def test_the_bound_holds_for_every_pixel_of_a_cluttered_scene():
    """Against depth as it is rendered at each chosen tick, moved to the next in NumPy."""
    rng = np.random.default_rng(3)
    boxes = [
        trimesh.creation.box(
            rng.uniform(0.1, 0.5, 3),
            trimesh.transformations.translation_matrix(rng.uniform(-1.0, 1.0, 3) + np.array([0.0, 0.0, 2.0])),
        )
        for _ in range(15)
    ]
    arrays = upload_scene(
        scene_of(trimesh.util.concatenate([wall().apply_translation((0, 0, 2.0)), *boxes])), CONFIG, "cpu"
    )
    states = flight(300, v_W=(0.8, 0.3, 0.2), w_B=(0.1, -0.3, 0.4))
    limit_px = 0.25
    chosen = choose(make_rule(arrays, limit_px=limit_px), states)
    assert 30 < len(chosen) < 200
    moved = np.array(
        [largest_move(arrays, states.numpy()[:, 0], a, b) for a, b in itertools.pairwise(chosen)]
    )
    assert moved.max() < 1.1 * limit_px  # 16 px apart, probes miss the nearest corner of a box by a little
    assert np.median(moved) > 0.8 * limit_px


def largest_move(arrays: SceneArrays, states: np.ndarray, first: int, second: int) -> float:
    """Return how far what any pixel shows moves from one tick to another [px]."""
    renderer = WarpRenderer(arrays, LENS, outputs=["depth"], instant_count=1)
    pose = states[first]
    renderer.render(
        wp.array([pose[:3]], dtype=wp.vec3, device="cpu"),
        wp.array([pose[3:7]], dtype=wp.quat, device="cpu"),
        wp.array([0], dtype=int, device="cpu"),
        instant_count=1,
    )
    rays = LENS.ray_table().astype(np.float64)
    points_C = rays / rays[..., 2:] * renderer.depth.numpy()[0][..., None].astype(np.float64)
    points_W = Rotation.from_quat(pose[3:7]).apply(points_C.reshape(-1, 3)) + pose[:3]
    later_C = Rotation.from_quat(states[second, 3:7]).inv().apply(points_W - states[second, :3])
    before, after = (p[:, :2] / p[:, 2:] * [LENS.fx, LENS.fy] for p in (points_C.reshape(-1, 3), later_C))
    return float(np.linalg.norm(after - before, axis=1).max())


def test_devices_agree(device):
    arrays = upload_scene(scene_of(wall()), CONFIG, device)
    chosen = choose(make_rule(arrays), flight(200, v_W=(0.7, 0.0, 0.0), device=device))
    assert chosen == list(range(0, 200, 23))
