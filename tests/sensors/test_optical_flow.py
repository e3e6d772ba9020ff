"""Optical flow against closed forms, points tracked in small steps, and what hides what."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from lens_projection import project
from scipy.spatial.transform import Rotation
from small_room import room_scene

import neurosim_core as ns
from neurosim_core.scene.bodies import BodyConfig, body_poses
from neurosim_core.sensors.optical_flow import OpticalFlowConfig

W, H, F = 48, 36, 40.0
PINHOLE = {"width": W, "height": H, "fx": F, "fy": F, "cx": W / 2, "cy": H / 2}
LENSES = {
    "pinhole": PINHOLE,
    "rational": {
        "kind": "rational", **PINHOLE, "distortion": [0.2, 0.05, 1e-3, -5e-4, 0.003, 0.42, 0.12, 0.01],
    },
    "equidistant": {
        "kind": "equidistant", **PINHOLE, "fx": 15.0, "fy": 15.0, "distortion": [0.01, 0.002, 0, 0],
    },
}  # fmt: skip
COLUMNS, ROWS = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
R_BC = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # an optical frame that looks along x
AGILE = [
    {"time_s": 0.0, "position_m": [-0.5, 0.0, 1.2]},
    {"time_s": 0.1, "position_m": [-0.2, 0.1, 1.3], "rpy_rad": [0.1, 0.1, 0.2]},
    {"time_s": 0.2, "position_m": [0.2, 0.1, 1.2], "rpy_rad": [-0.1, 0.2, 0.5]},
    {"time_s": 0.3, "position_m": [0.4, -0.1, 1.1], "rpy_rad": [0.2, 0.0, 0.7]},
]
BALL = {
    "shape": {"kind": "sphere", "radius_m": 0.4},
    "motion": {
        "position_m": [2.0, 0.3, 1.3],
        "orbit": {"radius_m": 0.3, "rate_hz": 1.0},
        "spin_rad_s": [1, 2, 3],
    },
}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return room_scene(tmp_path_factory.mktemp("room"))


def flow(**more):
    return {
        "kind": "optical_flow", "lens": PINHOLE, "rate_hz": 20, "mount": {"position_m": [0, 0, 0]}, **more,
    }  # fmt: skip


def settings(scene, sensors, frames=AGILE, **more):
    path = {"kind": "poses", "keyframes": frames}
    return {"scene": scene, "duration_s": 0.21, "device": "cpu", "path": path, "sensors": sensors, **more}


def packets(config):
    found = {}
    for packet in ns.run(config):
        found.setdefault(packet.sensor, {})[packet.stamp_ns] = packet
    return found


def sliding(velocity, position=(-1.0, 0.0, 1.5)):
    def at(t):
        return {"time_s": t, "position_m": [p + v * t for p, v in zip(position, velocity, strict=True)]}

    return [at(0.1 * k) for k in range(5)]


def turning(rate_rad_s):
    return [
        {"time_s": 0.1 * k, "position_m": [0, 0, 1.5], "rpy_rad": [0.0, 0.0, 0.1 * k * rate_rad_s]}
        for k in range(5)
    ]


def test_a_slider_before_a_plane_has_the_flow_f_v_over_z(room):
    """Moving left along the wall x = 4: points move right in the picture by f v t / Z."""
    sensors = {
        "velocity": flow(window_s=0),
        "backward": flow(window_s=0.02),
        "forward": flow(window_s=0.02, direction="forward"),
        "depth": {**flow(), "kind": "depth"},
    }
    found = packets(settings(room, sensors, sliding((0.0, 1.5, 0.0))))
    stamp_ns = 100_000_000
    wall = np.abs(found["depth"][stamp_ns].data - 5.0) < 1e-4
    assert wall.sum() > 300
    for name, px in (("velocity", F * 1.5 / 5), ("backward", -F * 1.5 * 0.02 / 5), ("forward", F * 0.03 / 5)):
        found_px = found[name][stamp_ns].data[wall]
        np.testing.assert_allclose(found_px[:, 0], px, atol=1e-3)
        np.testing.assert_allclose(found_px[:, 1], 0.0, atol=1e-3)
    ends = {n: (p[stamp_ns].from_ns, p[stamp_ns].to_ns) for n, p in found.items() if n != "depth"}
    assert ends == {
        "velocity": (stamp_ns, stamp_ns),
        "backward": (stamp_ns, stamp_ns - 20_000_000),
        "forward": (stamp_ns - 20_000_000, stamp_ns),
    }


def test_pure_rotation_also_of_the_sky(tmp_path):
    """Of a yaw at the rate w: v' = -f w (1 + x^2), -f w x y in the picture, whatever is there or not."""
    trimesh.creation.box((1.0, 1.0, 1.0)).export(tmp_path / "box.ply")
    scene = {"kind": "mesh", "file": str(tmp_path / "box.ply")}
    w = 1.5
    sensors = {
        "velocity": flow(window_s=0),
        "window": flow(window_s=0.05),
        "range": {**flow(), "kind": "depth"},
    }
    frames = [{**frame, "position_m": [-3.0, 0.0, 0.3]} for frame in turning(w)]
    found = packets(settings(scene, sensors, frames))
    x, y = (COLUMNS - W / 2) / F, (ROWS - H / 2) / F
    at_rest = found["range"][0].data
    assert 0.2 < np.isinf(at_rest).mean() < 1.0
    for stamp_ns in (100_000_000, 200_000_000):
        velocity = found["velocity"][stamp_ns].data
        expected = np.stack([F * w * (1 + x * x), F * w * x * y], axis=-1)
        np.testing.assert_allclose(velocity, expected, atol=2e-3)  # the rate of a spline: 1e-5 of 100 px/s
        turn = Rotation.from_rotvec([0.0, -w * 0.05, 0.0])  # about y, which points down
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        before = turn.apply(rays).reshape(H, W, 3)
        before = before[..., :2] / before[..., 2:] * F + (W / 2, H / 2)
        window = found["window"][stamp_ns].data
        np.testing.assert_allclose(window, before - np.stack([COLUMNS, ROWS], axis=-1), atol=1e-3)


def truth(lens_settings, stamp_ns, body, pixels, ranges, odometry, to_ns):
    """Return where what pixels see is at another time, by SciPy and the lens."""
    lens = OpticalFlowConfig(lens=lens_settings).lens
    rays = lens.ray_table().reshape(-1, 3)[pixels].astype(np.float64)
    here, there = odometry[stamp_ns], odometry[to_ns]
    points = here.position + (Rotation.from_quat(here.orientation) * R_BC).apply(ranges[:, None] * rays)
    if body is not None:
        p, q = body_poses({"ball": BodyConfig(**body)}, [stamp_ns, to_ns])
        points = p[1, 0] + Rotation.from_quat(q[1, 0]).apply(
            Rotation.from_quat(q[0, 0]).inv().apply(points - p[0, 0])
        )
    p_C = (Rotation.from_quat(there.orientation) * R_BC).inv().apply(points - there.position)
    if lens.kind == "ray_table":  # where the interpolated ray is the direction
        fisheye = OpticalFlowConfig(lens=LENSES["equidistant"]).lens
        at = goal = project(fisheye, p_C)
        for _ in range(8):  # the two differ by 1e-2 px
            at = at + goal - project(fisheye, lens.rays(*np.clip(np.nan_to_num(at), 0, (W, H)).T))
        inside = ((at > 1) & (at < (W - 1, H - 1))).all(axis=1)
        return np.where(inside[:, None], at, np.nan)
    if lens.kind == "pinhole":
        return p_C[:, :2] / p_C[:, 2:] * F + (W / 2, H / 2)
    return project(lens, p_C)


@pytest.fixture(params=["pinhole", "rational", "equidistant", "ray_table"])
def lens(request, tmp_path):
    """Some of the lenses that `test_lenses` projects through; the table lacks some rays of a fisheye."""
    if request.param != "ray_table":
        return LENSES[request.param]
    rays = OpticalFlowConfig(lens=LENSES["equidistant"]).lens.ray_table().astype(np.float64)
    rays[:3, :5] = np.nan
    np.save(tmp_path / "rays.npy", rays)
    return {"kind": "ray_table", "width": W, "height": H, "file": str(tmp_path / "rays.npy")}


def test_flow_is_that_of_the_points_through_any_lens_on_moving_bodies(room, lens):
    """Against the poses at both times in NumPy; an agile flight, a ball that turns and orbits."""
    common = {"lens": lens, "rate_hz": 20, "mount": {"position_m": [0, 0, 0]}}
    sensors = {
        "flow": flow(lens=lens, window_s=0.05),
        "range": {"kind": "range", **common},
        "instance": {"kind": "instance", **common},
        "velocity": flow(lens=lens, window_s=0),
        "odometry": {"kind": "odometry", "rate_hz": 1280},
    }
    found = packets(settings(room, sensors, bodies={"ball": BALL}))
    stamp_ns, step_ns = 200_000_000, 781_250
    measured = found["flow"][stamp_ns].data.reshape(-1, 2)
    velocity = found["velocity"][stamp_ns].data.reshape(-1, 2)
    ranges = found["range"][stamp_ns].data.reshape(-1).astype(np.float64)
    labels = found["instance"][stamp_ns].data.reshape(-1)
    is_ball = labels == labels.max()
    assert 20 < is_ball.sum() < 0.5 * W * H
    here = np.stack([COLUMNS, ROWS], axis=-1).reshape(-1, 2)
    for member, moving in ((is_ball, BALL), (~is_ball, None)):
        pixels = np.flatnonzero(member & np.isfinite(measured).all(axis=-1) & np.isfinite(ranges))
        args = (lens, stamp_ns, moving, pixels, ranges[pixels], found["odometry"])
        expected = truth(*args, stamp_ns - 50_000_000) - here[pixels]
        assert np.nanmax(np.abs(measured[pixels] - expected)) < 1e-3  # float32 poses and ranges
        slope = truth(*args, stamp_ns + step_ns) - truth(*args, stamp_ns - step_ns)
        slope /= 2e-9 * step_ns
        assert np.nanmax(np.abs(velocity[pixels] - slope)) < 1e-3 * np.nanmax(np.abs(slope))


def test_velocities_in_64_steps_lead_where_flow_leads(room):
    """Points of the picture follow the velocities at 1,280 Hz, by the trapezium; away from edges, 0.01 px."""
    lens = {**PINHOLE, "fx": 2 * F, "fy": 2 * F}
    sensors = {
        "flow": flow(lens=lens, window_s=0.05),
        "velocity": flow(lens=lens, window_s=0, rate_hz=1280),
        "normal": {**flow(lens=lens, rate_hz=1280), "kind": "normal"},
    }
    frames = [{**frame, "position_m": [2.5, 0.0, 1.5]} for frame in AGILE]
    found = packets(settings(room, sensors, frames))
    stamps = sorted(s for s in found["velocity"] if 150_000_000 <= s <= 200_000_000)[::-1]
    assert len(stamps) == 65
    where = np.stack([COLUMNS, ROWS], axis=-1).reshape(-1, 2)
    start = where.copy()
    crossed = np.zeros(len(where), bool)
    # between pixels that see two planes a velocity is not that between theirs

    def read(stamp_ns, at):
        x, y = (at - 0.5).T
        col, row = np.clip(x.astype(int), 0, W - 2), np.clip(y.astype(int), 0, H - 2)
        normal = found["normal"][stamp_ns].data
        for r, c in ((0, 1), (1, 0), (1, 1)):
            crossed[np.abs(normal[row + r, col + c] - normal[row, col]).max(axis=1) > 1e-3] = True
        a, b = (x - col)[:, None], (y - row)[:, None]
        data = found["velocity"][stamp_ns].data.astype(np.float64)
        top = (1 - a) * data[row, col] + a * data[row, col + 1]
        return (1 - b) * top + b * ((1 - a) * data[row + 1, col] + a * data[row + 1, col + 1])

    for here_ns, there_ns in itertools.pairwise(stamps):
        step_s = 1e-9 * (there_ns - here_ns)
        v = read(here_ns, where)
        where = where + 0.5 * step_s * (v + read(there_ns, where + step_s * v))
    inside = ((where > 2) & (where < (W - 2, H - 2))).all(axis=-1) & ~crossed
    assert inside.mean() > 0.2
    measured = found["flow"][200_000_000].data.reshape(-1, 2)[inside]
    moved = (where - start)[inside]
    assert np.abs(moved).max() > 5.0
    error = np.abs(measured - moved).max(axis=-1)
    assert error.max() < 0.01


@pytest.mark.parametrize("direction", ["backward", "forward"])
def test_the_mask_says_what_a_ball_hides(room, direction):
    """A ball slides before a wall at rest: what it hides at the other time is a silhouette then."""
    body = {
        "shape": {"kind": "sphere", "radius_m": 0.5},
        "motion": {"position_m": [1.0, -0.4, 1.5], "velocity_m_s": [0.0, 4.0, 0.0]},
    }
    frames = sliding((0.0, 0.0, 0.0))
    sensors = {
        "flow": flow(window_s=0.05, direction=direction),
        "instance": {**flow(), "kind": "instance"},
    }
    found = packets(settings(room, sensors, frames, bodies={"ball": body}))
    ball = {s: p.data == p.data.max() for s, p in found["instance"].items()}
    stamps = (100_000_000, 50_000_000)
    here_ns, there_ns = stamps if direction == "backward" else stamps[::-1]
    here, there = ball[here_ns], ball[there_ns]
    mask = found["flow"][100_000_000].mask
    hidden = mask == 1
    near = edges_within(here, 1) | edges_within(there, 1)
    expected = there & ~here
    assert expected[~near].sum() > 10
    # besides, the ball turns no side away: all of it is seen at both times, but for its rim
    np.testing.assert_array_equal(hidden[~near & ~here], expected[~near & ~here])
    assert hidden[here & ~near].mean() < 0.05


@pytest.mark.parametrize("velocity", [(0.0, 3.0, 0.0), (2.0, 1.0, 0.5), (-3.0, 0.0, -1.0), (0.0, 0.0, 0.0)])
def test_the_mask_says_what_rays_say_of_a_scene_at_rest(tmp_path, velocity):
    """A pillar and a table before a wall: rays to all triangles tell what they hide, but for edges."""
    boxes = [
        ((0.3, 0.4, 4.0), (2.0, 0.3, 1.5)),
        ((1.0, 2.0, 0.1), (3.0, -0.5, 1.0)),
        ((0.2, 20, 20), (6, 0, 0)),
    ]
    parts = [
        trimesh.creation.box(extents, trimesh.transformations.translation_matrix(at)) for extents, at in boxes
    ]
    mesh = trimesh.util.concatenate(parts)
    mesh.export(tmp_path / "pillar.ply")
    scene = {"kind": "mesh", "file": str(tmp_path / "pillar.ply")}
    sensors = {"flow": flow(window_s=0.1), "range": {**flow(), "kind": "range"}}
    found = packets(settings(scene, sensors, sliding(velocity, (0.0, 0.0, 1.5))))
    stamp_ns = 200_000_000
    ranges, mask = found["range"][stamp_ns].data.astype(np.float64), found["flow"][stamp_ns].mask
    rays = np.stack([(COLUMNS - W / 2) / F, (ROWS - H / 2) / F, np.ones((H, W))], axis=-1)
    rays = R_BC.apply((rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3))
    way = 0.1 * np.array(velocity) + ranges.reshape(-1, 1) * rays  # from the earlier camera to the points
    a, b, c = np.moveaxis(mesh.triangles - (np.array([0, 0, 1.5]) + 0.1 * np.array(velocity)), 1, 0)
    inside = np.stack([way @ np.cross(p, q).T for p, q in ((a, b), (b, c), (c, a))])
    volume = (a * np.cross(b, c)).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = volume / inside.sum(axis=0)  # of the way, up to the plane of a triangle
    met = ((inside > 0).all(axis=0) | (inside < 0).all(axis=0)) & (share > 0) & (share < 0.999)
    hidden = met.any(axis=1).reshape(H, W)
    near = edges_within(hidden, 1)
    nearness = 1.0 / ranges
    for step in ((0, 1), (1, 0), (1, 1), (1, -1)):
        bend = (
            np.roll(nearness, step, (0, 1)) + np.roll(nearness, (-step[0], -step[1]), (0, 1)) - 2.0 * nearness
        )
        near |= edges_within(np.abs(bend) > 0.05 * nearness, 1) | (np.abs(bend) > 0.05 * nearness)
    inside_picture = mask != 2
    np.testing.assert_array_equal((mask == 1)[inside_picture & ~near], hidden[inside_picture & ~near])
    assert np.any(velocity) == ((mask == 1).sum() > 20)


def edges_within(mask, px):
    """Return the pixels within so many of an edge of a mask."""
    found = np.zeros_like(mask)
    for dy in range(-px, px + 1):
        for dx in range(-px, px + 1):
            found |= np.roll(mask, (dy, dx), (0, 1)) != mask
    return found


def test_what_leaves_the_picture_is_outside(room):
    found = packets(settings(room, {"flow": flow(window_s=0.05)}, turning(2.0)))["flow"][200_000_000]
    x = COLUMNS + found.data[..., 0]
    y = ROWS + found.data[..., 1]
    outside = (x < 0) | (x >= W) | (y < 0) | (y >= H)
    assert 0.02 < outside.mean() < 0.5
    np.testing.assert_array_equal(found.mask == 2, outside)


def test_worlds_have_the_flow_of_single_runs(room):
    sensors = {"flow": flow(window_s=0.05), "velocity": flow(window_s=0)}
    config = settings(room, sensors, bodies={"ball": BALL}, control={"rate_hz": 100.0})
    alone = packets(config)
    worlds = ns.Simulation(config, worlds=2)
    worlds.reset()
    for _ in range(20):
        seen = worlds.step()
    for name in sensors:
        expected = alone[name][200_000_000].data
        for world in range(2):
            found = seen.images[name].numpy()[world]
            np.testing.assert_array_equal(found[..., :2], expected)


def test_what_cannot_be_done_is_refused(tmp_path, room):
    np.save(tmp_path / "rays.npy", np.ones((4, 1, 3)))
    lens = {"kind": "ray_table", "width": 1, "height": 4, "file": str(tmp_path / "rays.npy")}
    with pytest.raises(ValueError, match="a ray_table of 1 x 4 rays does not project points"):
        next(iter(ns.run(settings(room, {"flow": flow(lens=lens)}))))
    config = settings(room, {"flow": flow()}, renderer="synthetic")
    with pytest.raises(ValueError, match="use renderer: warp"):
        next(iter(ns.run(config)))
