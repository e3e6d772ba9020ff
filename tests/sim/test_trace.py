"""States survive the buffer bit for bit; camera poses are T_WB T_BC."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from neurosim_core.frames import Mount
from neurosim_core.scene.freespace import DistanceField
from neurosim_core.sim.trace import (
    BODY_RATE,
    ORIENTATION,
    POSITION,
    ROTOR_SPEED,
    VELOCITY,
    Trace,
    WorldArrays,
    make_surfaces,
)
from neurosim_core.vehicle import Multirotor, preset
from neurosim_core.vehicle.arrays import STATUS_COLLISION, allocate_arrays


def floor_field(device, height_m):
    """Return the distance field of a wide floor at z = 0, and what has to be kept."""
    corners = np.array([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], dtype=np.float32)
    floor = wp.Mesh(
        points=wp.array(corners, dtype=wp.vec3, device=device),
        indices=wp.array([0, 1, 2], dtype=int, device=device),
    )
    field = DistanceField()
    field.mesh = floor.id
    field.distance = wp.array(np.ascontiguousarray(height_m), dtype=wp.float32, device=device)
    field.origin = wp.vec3(-0.75, -0.75, 0.0)
    field.voxel = 0.5
    return field, floor


def surfaces_of(field, device, world_count, *, stop_on_contact=False):
    return make_surfaces(
        wp.array([field], dtype=DistanceField, device=device),
        wp.zeros(world_count, dtype=int, device=device),
        radius_m=0.2,
        ground_height_m=None,
        stop_on_contact=stop_on_contact,
    )


def worlds_of(vehicles, device, **given):
    """Return worlds of vehicles; what is not given is 0, and all are active."""
    worlds = WorldArrays()
    worlds.vehicles = vehicles
    count = len(vehicles.position)
    for name, dtype in (("clock_ns", wp.int64), ("collided", wp.int32), ("active", wp.int32)):
        value = given.get(name, np.full(count, int(name == "active")))
        setattr(worlds, name, wp.array(value, dtype=dtype, device=device))
    return worlds


def vehicles_of(rotor_count, device, **given):
    """Return vehicles in some state; what is not given is 0."""
    vehicles = allocate_arrays(len(given["position"]), rotor_count, device)
    vehicles.orientation.fill_((0.0, 0.0, 0.0, 1.0))
    for name, value in given.items():
        getattr(vehicles, name).assign(np.asarray(value))
    return vehicles


def test_camera_pose_is_body_pose_times_mount(device):
    rng = np.random.default_rng(0)
    position = rng.normal(size=(1, 3))
    orientation = Rotation.random(1, random_state=1).as_quat()
    vehicles = vehicles_of(
        6,
        device,
        position=position,
        orientation=orientation,
        velocity=rng.normal(size=(1, 3)),
        body_rate=rng.normal(size=(1, 3)),
        rotor_speed=rng.normal(size=(1, 6)),
        status=[3],
        redone_count=[3],
    )
    worlds = worlds_of(vehicles, device, clock_ns=[2**53])
    field, _floor = floor_field(device, np.full((4, 4, 4), 9.0, np.float32))
    trace = Trace(surfaces_of(field, device, 1), worlds, capacity=3, history_length=4)
    trace.record(2, 1, first=True, last=True)
    trace.fetch(1, 2)
    wp.synchronize_device(device)
    rows = trace.numpy(1, 2)
    assert rows.status.tolist() == [[0], [3]]
    assert rows.redone.tolist() == [[0], [3]]
    assert worlds.clock_ns.numpy().tolist() == [2**53 + 1]
    state = rows.states[1, 0]
    for part, array in (
        (POSITION, vehicles.position),
        (ORIENTATION, vehicles.orientation),
        (VELOCITY, vehicles.velocity),
        (BODY_RATE, vehicles.body_rate),
        (ROTOR_SPEED, vehicles.rotor_speed),
    ):
        np.testing.assert_array_equal(state[part], array.numpy()[0])

    mount = Mount(position_m=(0.1, -0.2, 0.3), rpy_rad=(0.1, 0.2, 0.3))
    p_WC = wp.zeros(1, dtype=wp.vec3, device=device)
    q_WC = wp.zeros(1, dtype=wp.quat, device=device)
    stamps = wp.zeros((1, 1), dtype=wp.int64, device=device)
    trace.camera_poses(
        wp.array([2], dtype=int, device=device),
        wp.zeros(1, dtype=wp.int64, device=device),
        count=1,
        p_BC=wp.array([mount.position_m], dtype=wp.vec3d, device=device),
        q_BC=wp.array([mount.optical_quaternion()], dtype=wp.quatd, device=device),
        p_WC=p_WC,
        q_WC=q_WC,
        stamps=stamps,
    )
    assert stamps.numpy().tolist() == [[2**53 + 1]]
    R_WB = Rotation.from_quat(orientation[0])
    R_WC = (
        R_WB
        * Rotation.from_euler("ZYX", [0.3, 0.2, 0.1])
        * Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    )
    np.testing.assert_allclose(
        p_WC.numpy()[0], position[0] + R_WB.apply(mount.position_m), atol=1e-6
    )  # float32
    np.testing.assert_allclose(Rotation.from_quat(q_WC.numpy()[0]).as_matrix(), R_WC.as_matrix(), atol=1e-6)


def test_optical_frame_looks_forward():
    """Optical z is body x, optical x is body -y, optical y is body -z; positive pitch looks down."""
    R_BC = Rotation.from_quat(Mount().optical_quaternion()).as_matrix()
    np.testing.assert_allclose(R_BC, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-15)
    down = Rotation.from_quat(Mount(rpy_rad=(0.0, 0.5, 0.0)).optical_quaternion()).apply([0, 0, 1])
    np.testing.assert_allclose(down, [np.cos(0.5), 0.0, -np.sin(0.5)], atol=1e-15)


@pytest.mark.parametrize("stops", [False, True])
def test_who_touches_the_floor_is_marked_and_held_if_asked(device, stops):
    """The room is the height less the radius; a world that is not active is left alone."""
    height_m = np.broadcast_to(0.5 * np.arange(4, dtype=np.float32), (4, 4, 4))
    field, _floor = floor_field(device, height_m)
    vehicles = vehicles_of(4, device, position=[[0, 0, 0.15], [0, 0, 0.6], [0, 0, 0.1]])
    worlds = worlds_of(vehicles, device, active=[1, 1, 0])
    surfaces = surfaces_of(field, device, 3, stop_on_contact=stops)
    trace = Trace(surfaces, worlds, capacity=2, history_length=3)
    trace.record(1, 0, first=True, last=False)
    trace.fetch(0, 2)
    wp.synchronize_device(device)
    # float32
    np.testing.assert_allclose(trace.numpy(1, 1).clearance, [[-0.05, 0.4, -0.1]], atol=1e-6)
    assert worlds.collided.numpy().tolist() == [1, 0, 0]
    assert vehicles.status.numpy().tolist() == [int(STATUS_COLLISION) if stops else 0, 0, 0]
    vehicles.position.fill_((0.0, 0.0, 0.6))
    trace.record(0, 0, first=False, last=False)
    assert worlds.collided.numpy().tolist() == [1, 0, 0], "a touch lasts as long as its batch"
    trace.record(0, 0, first=True, last=False)
    assert worlds.collided.numpy().tolist() == [int(stops), 0, 0]


def test_one_launch_flies_and_records_what_single_ones_do(device):
    """Bit for bit, also where a vehicle is held from the third of five spans on."""
    field, _floor = floor_field(device, np.broadcast_to(0.5 * np.arange(4, dtype=np.float32), (4, 4, 4)))
    surfaces, found = surfaces_of(field, device, 2, stop_on_contact=True), []
    for joined in (False, True):
        vehicle = Multirotor(preset("hummingbird"), count=2, device=device)
        vehicle.reset(position=[[0.0, 0.0, 0.6], [0.0, 0.0, 0.2025]], velocity=[0.0, 0.0, -1.0])
        worlds = worlds_of(vehicle.arrays, device, clock_ns=[7, 9])
        trace = Trace(surfaces, worlds, capacity=6, history_length=6)
        if joined:
            assert trace.joins_spans(vehicle)
            trace.advance(vehicle, 1, 0, 1_000_000, 5, first=True, last=True)
        for step in () if joined else range(5):
            vehicle.advance(1_000_000)
            elapsed_ns = 1_000_000 * (step + 1)
            trace.record(1 + step, elapsed_ns, first=step == 0, last=step == 4)
        rows = trace.arrays
        stamps = rows.history.stamp_ns
        arrays = (rows.states, rows.status, stamps, rows.clearance, worlds.clock_ns, worlds.collided)
        found.append([array.numpy() for array in arrays])
    for single, one in zip(*found, strict=True):
        np.testing.assert_array_equal(single, one)
    states, status, stamps, _, clock_ns, _ = found[1]
    assert status[:, 1].tolist() == [0, 0, 0, 0, *2 * [int(STATUS_COLLISION)]], "noted before it is held"
    assert len(np.unique(states[1:, 0, 2])) == 5
    assert stamps[:, 4].tolist() == clock_ns.tolist() == [5_000_007, 5_000_009]
