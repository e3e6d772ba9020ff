"""Planned paths: proven clear, checked by dense exact distances; errors that say which leg and why."""

from __future__ import annotations

import ast

import numpy as np
import pytest
import trimesh

from neurosim_core.scene.apartment import ApartmentConfig, make_apartment
from neurosim_core.scene.freespace import FreeSpace, FreeSpaceConfig, make_free_space
from neurosim_core.scene.scene import Scene
from neurosim_core.settings_file import ConfigError
from neurosim_core.trajectory import Path, TourConfig, check_thrust, make_path
from neurosim_core.trajectory.certify import prove_clearance, segment_clearance
from neurosim_core.trajectory.feasibility import FlightLimits, flight_bounds
from neurosim_core.trajectory.minsnap import minimum_snap
from neurosim_core.trajectory.planner import PlanningError, WaypointsConfig, plan_tour, plan_waypoints
from neurosim_core.trajectory.shapes import HoverConfig, LineConfig
from neurosim_core.vehicle import preset


def box(low: tuple[float, ...], high: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def as_space(*meshes: trimesh.Trimesh) -> FreeSpace:
    mesh = trimesh.util.concatenate(list(meshes))
    scene = Scene(
        name="test",
        vertices=mesh.vertices.astype(np.float32),
        faces=mesh.faces.astype(np.int32),
        normals=np.zeros((len(mesh.vertices), 3), dtype=np.float32),
        uv=np.zeros((len(mesh.vertices), 2), dtype=np.float32),
        face_material=np.zeros(len(mesh.faces), dtype=np.int32),
        face_instance=np.zeros(len(mesh.faces), dtype=np.int32),
        instance_names=("all",),
        materials=(),
        inside_m=(1.0, 1.0, 1.0),
    )
    return make_free_space(scene, FreeSpaceConfig())


WALL_X = 4.0
ROOMS = box((0.0, 0.0, 0.0), (8.0, 5.0, 2.5))


@pytest.fixture(scope="module")
def rooms() -> FreeSpace:
    """Two rooms, a door 0.9 m wide and 2 m high at one end of the wall between them, a closed cupboard."""
    return as_space(
        ROOMS,
        box((3.95, 0.0, 0.0), (4.05, 3.6, 2.5)),
        box((3.95, 4.5, 0.0), (4.05, 5.0, 2.5)),
        box((3.95, 3.6, 2.0), (4.05, 4.5, 2.5)),
        box((6.0, 0.5, 0.0), (7.5, 2.0, 2.4)),
    )


def least_clearance(path: Path, space: FreeSpace) -> float:
    """Exact distance to the triangles every 2 mm of the way."""
    stamps = np.linspace(path.start_ns, path.end_ns, int(path.length_m / 0.002)).astype(np.int64)
    speed = np.linalg.norm(path.evaluate(stamps).velocity, axis=1).max()
    assert speed * (stamps[1] - stamps[0]) * 1e-9 < 0.02  # samples are nowhere farther apart
    return float(space.clearance(path.evaluate(stamps).position).min())


def test_a_path_goes_through_the_door(rooms):
    config = WaypointsConfig(points_m=((1.0, 1.0, 1.2), (7.0, 3.0, 1.2)))
    path = plan_waypoints(rooms, config)
    samples = path.evaluate(np.linspace(0, path.end_ns, 4000).astype(np.int64))
    crossing = samples.position[np.abs(samples.position[:, 0] - WALL_X).argmin()]
    assert 3.9 <= crossing[1] <= 4.2  # 0.3 m from both door posts
    assert crossing[2] <= 1.7
    assert samples.position[[0, -1]] == pytest.approx(np.array(config.points_m), abs=1e-9)
    assert least_clearance(path, rooms) >= 0.3
    bounds = flight_bounds(path)
    assert bounds.within(config.limits)
    assert bounds.speed_m_s >= 0.99 * config.limits.speed_max_m_s or (
        bounds.tilt_rate_rad_s >= 0.9 * config.limits.tilt_rate_max_rad_s
        or bounds.thrust_to_weight_max >= 0.95 * config.limits.thrust_to_weight_max
    )  # as fast as some limit allows


def test_several_points_are_passed_without_stopping(rooms):
    points = ((1.0, 1.0, 1.2), (2.0, 4.0, 1.0), (6.5, 3.5, 1.5), (1.0, 2.5, 1.2))
    path = plan_waypoints(rooms, WaypointsConfig(points_m=points))
    samples = path.evaluate(np.linspace(0, path.end_ns, 20_000).astype(np.int64))
    for point in points[1:-1]:
        near = np.linalg.norm(samples.position - point, axis=1)
        assert near.min() < 1e-3  # a sample is within 0.5 mm of every place
        assert np.linalg.norm(samples.velocity[near.argmin()]) > 0.05
    assert np.abs(samples.velocity[[0, -1]]).max() < 1e-9
    assert np.abs(samples.yaw_rate).max() <= FlightLimits().yaw_rate_max_rad_s * (1.0 + 1e-9)
    assert least_clearance(path, rooms) >= 0.3


def test_it_looks_where_it_flies(rooms):
    path = plan_waypoints(rooms, WaypointsConfig(points_m=((1.0, 1.0, 1.2), (7.0, 3.0, 1.2))))
    samples = path.evaluate(np.linspace(0, path.end_ns, 2000).astype(np.int64))
    moving = np.linalg.norm(samples.velocity[:, :2], axis=1) > 0.5
    way = np.arctan2(samples.velocity[moving, 1], samples.velocity[moving, 0])
    off = np.abs(np.angle(np.exp(1j * (samples.yaw[moving] - way))))
    assert np.quantile(off, 0.9) < 0.8  # within a camera's field of view most of the time


def test_same_seed_same_path(rooms):
    paths = [plan_tour(rooms, TourConfig(seed=3), duration_s=3.0) for _ in range(2)]
    assert (paths[0].knots_ns == paths[1].knots_ns).all()
    assert (paths[0].coefficients == paths[1].coefficients).all()
    other = plan_tour(rooms, TourConfig(seed=4), duration_s=3.0)
    assert other.coefficients[0, 0, 0] != paths[0].coefficients[0, 0, 0]


@pytest.mark.parametrize("seed", range(8))
def test_tours_are_clear_long_enough_and_within_limits(rooms, seed):
    config = TourConfig(seed=seed, clearance_m=0.3)
    path = plan_tour(rooms, config, duration_s=4.0)
    assert path.end_ns >= 4 * 10**9
    assert least_clearance(path, rooms) >= 0.3
    assert prove_clearance(path.coefficients[:, :3], rooms, 0.3).all()
    assert flight_bounds(path).within(config.limits)
    stamps = np.linspace(0, path.end_ns, 500).astype(np.int64)
    p = path.evaluate(stamps).position
    assert not ((p > [6.0, 0.5, 0.0]) & (p < [7.5, 2.0, 2.4])).all(axis=1).any()  # the cupboard


@pytest.fixture(scope="module")
def apartment() -> FreeSpace:
    return make_free_space(make_apartment(ApartmentConfig()), FreeSpaceConfig())


@pytest.mark.parametrize("seed", range(4))
def test_tours_of_an_apartment_are_clear(apartment, seed):
    """A small version of the study over houses and apartments."""
    path = plan_tour(apartment, TourConfig(seed=seed), duration_s=4.0)
    assert least_clearance(path, apartment) >= 0.3
    assert path.end_ns >= 4 * 10**9


def test_the_default_flight_changes_rooms(apartment):
    """The first four seconds lead through a door at a human pace."""
    path = plan_tour(apartment, TourConfig(), duration_s=4.0)
    samples = path.evaluate(np.arange(0, 4 * 10**9, 10**7))
    travelled = np.linalg.norm(np.diff(samples.position, axis=0), axis=1).sum()
    assert 4.0 <= travelled <= 9.0
    ends = samples.position[[0, -1]]
    line = ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])
    assert apartment.clearance(line).min() < 0.05  # a wall stands between where it starts and where it is


def test_unreachable_places_are_explained(rooms):
    def plan(*points: tuple[float, float, float], clearance_m: float = 0.3) -> str:
        with pytest.raises(PlanningError) as error:
            plan_waypoints(rooms, WaypointsConfig(points_m=points, clearance_m=clearance_m))
        return str(error.value)

    start = (1.0, 1.0, 1.2)
    message = plan(start, (3.0, 3.0, 1.0), (6.75, 1.25, 1.2))  # inside the closed cupboard
    assert "leg 1: its goal (6.75, 1.25, 1.20) m has 0.750 m of room but cannot be reached" in message
    near = np.array(ast.literal_eval(message.split("can be reached is ")[1].split(" m,")[0]))
    assert rooms.clearance(near)[0] >= 0.3
    assert "has only 0.100 m of room" in plan((0.1, 1.0, 1.2), start)
    assert "is outside the scene" in plan(start, (20.0, 1.0, 1.0))
    assert "cannot be reached" in plan(start, (7.0, 3.5, 1.2), clearance_m=0.46)  # the door is 0.9 m wide
    assert "are the same" in plan(start, start)


def test_no_room_at_all_is_explained(rooms):
    with pytest.raises(
        PlanningError, match=r"nothing can be reached at clearance_m = 3: .*most in the scene"
    ):
        plan_tour(rooms, TourConfig(clearance_m=3.0), duration_s=4.0)


def test_a_proof_fails_where_a_path_comes_too_close(rooms):
    """A straight flight past the cupboard's corner at exactly 0.35 m."""
    corner = np.array([6.0, 2.0])
    direction = np.array([1.0, 1.0]) / np.sqrt(2.0)
    middle = corner + 0.35 * np.array([-1.0, 1.0]) / np.sqrt(2.0)
    a, b = middle - 0.8 * direction, middle + 0.8 * direction
    path = minimum_snap([[*a, 1.2], [*b, 1.2]], [0, 10**9])
    assert prove_clearance(path.coefficients[:, :3], rooms, 0.3499).all()
    assert not prove_clearance(path.coefficients[:, :3], rooms, 0.3501).any()


def test_a_proof_sees_the_curve_and_not_its_chords(rooms):
    """A parabola comes down to 0.5 m above the floor between the ends of a part, 0.6 mm higher."""
    tip = 12.5 / 35.0  # the middle of one of the 35 parts that a piece of this extent is cut into
    height = [0.5 + 3.0 * tip**2, -6.0 * tip, 3.0]
    coefficients = [[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], height, [0.0, 0.0, 0.0]]
    path = Path(np.array([0, 10**9]), np.array([coefficients]))
    assert prove_clearance(path.coefficients[:, :3], rooms, 0.4999).all()
    assert not prove_clearance(path.coefficients[:, :3], rooms, 0.5003).any()


def test_a_proof_sees_what_samples_miss():
    """A wire between two samples: both ends have room, the line between them does not."""
    space = as_space(ROOMS, box((4.0, 2.5, 0.0), (4.002, 2.502, 2.5)))
    path = minimum_snap([[3.6, 2.501, 1.2], [4.4, 2.501, 1.2]], [0, 10**9])
    assert not prove_clearance(path.coefficients[:, :3], space, 0.05).any()


def test_segments_keep_the_clearance_that_points_allow():
    """For random points as obstacles: the bound holds, and is reached by the nearest one."""
    rng = np.random.default_rng(0)
    obstacles = rng.normal(size=(40, 3))
    for _ in range(200):
        a, b = rng.normal(size=(2, 3))
        room_a, room_b = (np.linalg.norm(obstacles - p, axis=1).min() for p in (a, b))
        bound = segment_clearance(*(np.array([x]) for x in (room_a, room_b, np.linalg.norm(b - a))))[0]
        line = a + np.linspace(0.0, 1.0, 500)[:, None] * (b - a)
        true = np.linalg.norm(line[:, None] - obstacles, axis=2).min()
        assert bound <= true + 1e-12
    one = segment_clearance(np.array([0.5]), np.array([0.5]), np.array([0.6]))[0]
    assert one == pytest.approx(0.4)  # the triangle 0.3, 0.4, 0.5


def test_make_path_chooses_by_kind(rooms):
    assert make_path(HoverConfig(), rooms, duration_s=4.0).length_m == 0.0
    line = LineConfig(start_m=(1.0, 1.0, 1.0), end_m=(2.0, 1.0, 1.0))
    assert make_path(line, rooms, duration_s=4.0).length_m == pytest.approx(1.0)
    assert make_path(TourConfig(), rooms, duration_s=1.0).end_ns >= 10**9


def test_a_path_may_ask_for_no_more_thrust_than_the_vehicle_has():
    airframe = preset("hummingbird")
    check_thrust(TourConfig(), airframe)
    check_thrust(HoverConfig(), airframe)
    with pytest.raises(PlanningError, match="thrust_to_weight_max = 50 is more than the vehicle has"):
        check_thrust(TourConfig(limits=FlightLimits(thrust_to_weight_max=50.0)), airframe)


def test_configuration_refuses_nonsense():
    with pytest.raises(ConfigError, match="at least 2"):
        WaypointsConfig(points_m=((0.0, 0.0, 0.0),))
    with pytest.raises(ConfigError, match="clearance_m"):
        TourConfig(clearance_m=0.0)
