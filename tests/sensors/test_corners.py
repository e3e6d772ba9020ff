"""Corners of a room with a crate, a board and a moving box, whose projections are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from small_room import fly_in_room, room_scene, write_room

import neurosim_core as ns
from neurosim_core.live.messages import to_message, to_packet
from neurosim_core.scene.bodies import BodyConfig, body_poses
from neurosim_core.scene.topology import find_corners
from neurosim_core.sensors.corners import Corners, CornersConfig

W, H, F = 64, 48, 40.0
LENS = {"width": W, "height": H, "fx": F, "fy": F, "cx": W / 2, "cy": H / 2}
CAMERA = {"kind": "corners", "lens": LENS, "rate_hz": 20, "mount": {"position_m": [0, 0, 0]}}
R_BC = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # an optical frame that looks along x
BOX = {
    "shape": {"kind": "box", "size_m": [0.4, 0.6, 0.5]},
    "motion": {"position_m": [1.5, 0.2, 1.3], "velocity_m_s": [0, -1, 0], "spin_rad_s": [0.5, 1.0, 2.0]},
}
PATH = [
    {"time_s": 0.0, "position_m": [-1.0, 0.0, 1.2]},
    {"time_s": 0.1, "position_m": [-0.8, 0.1, 1.3], "rpy_rad": [0.1, 0.1, 0.2]},
    {"time_s": 0.2, "position_m": [-0.6, 0.1, 1.2], "rpy_rad": [-0.1, 0.1, 0.4]},
]


@pytest.fixture(scope="module")
def agile(tmp_path_factory):
    """An agile flight in a room with a crate and a moving box."""
    scene = room_scene(tmp_path_factory.mktemp("room"))
    path = {"kind": "poses", "keyframes": PATH}
    sensors = {"corners": CAMERA, "odometry": {"kind": "odometry", "rate_hz": 20}}
    return {
        "scene": scene, "path": path, "duration_s": 0.16, "device": "cpu", "sensors": sensors,
        "bodies": {"box": BOX}, "control": {"rate_hz": 100.0},
    }  # fmt: skip


def corners_of(mesh, **angles):
    given = {"crease_rad": 0.5, "turn_rad": 0.5, **angles}
    return find_corners(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), **given)


def test_a_mesh_has_the_corners_of_its_shape_however_it_is_cut():
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    for mesh in (box, box.subdivide().subdivide()):
        found = corners_of(mesh)
        np.testing.assert_allclose(np.abs(found), np.tile([0.5, 1.0, 1.5], (8, 1)), atol=1e-6)
        assert len(np.unique(found, axis=0)) == 8
    split = trimesh.Trimesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(12, 3), process=False)
    assert len(corners_of(split)) == 8  # vertices of their own for each face
    either_way = np.where(np.arange(12)[:, None] % 2, box.faces, box.faces[:, ::-1])
    assert len(corners_of(trimesh.Trimesh(box.vertices, either_way, process=False))) == 8
    assert len(corners_of(trimesh.creation.icosphere(3))) == 0
    assert len(corners_of(trimesh.creation.cylinder(0.5, 1.0, sections=64))) == 0
    assert len(corners_of(trimesh.creation.cylinder(0.5, 1.0, sections=6))) == 12


def test_planes_whose_triangles_do_not_share_edges_have_none_inside():
    """One edge of the left half meets two of the right: a corner of a triangle in the middle of an edge."""
    points = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [1, 1]], np.float32)
    vertices = np.concatenate([points, np.zeros((8, 1), np.float32)], axis=1)
    faces = np.array([[0, 1, 5], [0, 5, 6], [1, 2, 7], [2, 3, 7], [3, 4, 7], [4, 5, 7]], np.int32)
    found = find_corners(vertices, faces, crease_rad=0.5, turn_rad=0.5)
    assert sorted(map(tuple, found[:, :2].tolist())) == [(0, 0), (0, 2), (2, 0), (2, 2)]
    halves = np.array([0, 0, 1, 1, 1, 1], np.int32)  # two objects: their border ends at the rim
    found = find_corners(vertices, faces, halves, crease_rad=0.5, turn_rad=0.5)
    assert sorted(map(tuple, found[:, :2].tolist())) == [(0, 0), (0, 2), (1, 0), (1, 2), (2, 0), (2, 2)]


def test_corners_of_a_board_and_of_a_wall_are_where_geometry_says(tmp_path):
    """The board hides its own back and nothing else; the far corners of the room are creases."""
    packets = fly_in_room(write_room(tmp_path / "room.glb"), {"corners": CAMERA})
    found = next(p for p in packets if isinstance(p, Corners))
    signs = np.array([[a, b] for a in (-1, 1) for b in (-1, 1)])
    expected = {1: (W / 2, H / 2) + signs * F * 0.5 / 2.5, 3: (W / 2, H / 2) + signs * F * (2 / 3, 1.5 / 3)}
    for edge, places in expected.items():
        mine = found.pixels[found.edge == edge]
        order = np.lexsort(mine.T[::-1])
        np.testing.assert_allclose(mine[order], places, atol=1e-4)  # float32
    assert len(found.id) == 8
    again = to_packet(to_message(found), "corners")
    assert type(again) is Corners
    np.testing.assert_array_equal(again.points, found.points)


def test_corners_keep_their_numbers_on_an_agile_flight_and_on_moving_bodies(agile):
    """Each number is one point of room, crate or box in all pictures; hidden ones are left out."""
    packets = list(ns.run(agile))
    odometry = {p.stamp_ns: p for p in packets if p.sensor == "odometry"}
    box = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.3, 0.3) for z in (-0.25, 0.25)])
    seen: dict[int, int] = {}
    fixed: dict[int, np.ndarray] = {}
    pictures = [p for p in packets if isinstance(p, Corners)]
    assert len(pictures) == 4
    for packet in pictures:
        here = odometry[packet.stamp_ns]
        R_WC = Rotation.from_quat(here.orientation) * R_BC
        projected = packet.points[:, :2] / packet.points[:, 2:] * F + (W / 2, H / 2)
        np.testing.assert_allclose(packet.pixels, projected, atol=1e-4)
        assert ((packet.pixels >= 0) & (packet.pixels < (W, H))).all()
        p_WO, q_WO = (pose[0, 0] for pose in body_poses({"box": BodyConfig(**BOX)}, [packet.stamp_ns]))
        world = here.position + R_WC.apply(packet.points)
        for number, point in zip(packet.id, world, strict=True):
            if number >= 16:  # after the 8 of the room and the 8 of the crate
                point = Rotation.from_quat(q_WO).inv().apply(point - p_WO)
                assert np.abs(box - point).max(axis=1).min() < 1e-5
            seen[number] = seen.get(number, 0) + 1
            np.testing.assert_allclose(point, fixed.setdefault(number, point), atol=1e-5)
        eye = Rotation.from_quat(q_WO).inv().apply(here.position - p_WO)
        faces_eye = (box * eye > np.abs(box) * np.abs(box)).any(axis=1)  # one of the sides that it is on
        p_C = R_WC.inv().apply(p_WO + Rotation.from_quat(q_WO).apply(box) - here.position)
        place = p_C[:, :2] / p_C[:, 2:] * F + (W / 2, H / 2)
        expected = faces_eye & (p_C[:, 2] > 0) & ((place >= 0) & (place < (W, H))).all(axis=1)
        assert (packet.id >= 16).sum() == expected.sum()
    assert max(seen.values()) == 4
    assert len(seen) > 10


def test_worlds_have_the_corners_of_single_runs(agile):
    alone = next(p for p in ns.run(agile) if isinstance(p, Corners) and p.stamp_ns == 100_000_000)
    worlds = ns.Simulation(agile, worlds=2)
    worlds.reset()
    for _ in range(10):
        seen = worlds.step()
    for picture in seen.images["corners"].numpy():
        found = CornersConfig().packet(picture)
        for name in ("id", "pixels", "points", "edge"):
            np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))
