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
    Fleet,
    Trace,
    make_surfaces,
)
from neurosim_core.vehicle import Multirotor, preset
from neurosim_core.vehicle.status import STATUS_COLLISION


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


def surfaces_of(field, device, world_count, *, holds=False):
    return make_surfaces(
        wp.array([field], dtype=DistanceField, device=device),
        wp.zeros(world_count, dtype=int, device=device),
        radius_m=0.2,
        ground_height_m=None,
        holds=holds,
    )


def fleet_of(position, device, **given):
    """Return vehicles at some places; what is not given is 0."""
    count = len(position)
    fleet = Fleet()
    values = {
        "position": (position, wp.vec3d),
        "velocity": (np.zeros((count, 3)), wp.vec3d),
        "orientation": (np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), wp.quatd),
        "body_rate": (np.zeros((count, 3)), wp.vec3d),
        "rotor_speed": (np.zeros((count, 4)), wp.float64),
        "rotor_speed_command": (np.zeros((count, 4)), wp.float64),
        "active": (np.ones(count), wp.int32),
        **{name: (np.zeros(count), wp.int64) for name in ("stamp_ns", "redone_count", "clock_ns")},
        "evaluation_count": (np.zeros(count), wp.int64),
        **{name: (np.zeros(count), wp.int32) for name in ("status", "collided")},
    }
    for name, (value, dtype) in values.items():
        setattr(fleet, name, wp.array(given.get(name, value), dtype=dtype, device=device))
    return fleet


def test_camera_pose_is_body_pose_times_mount(device):
    rng = np.random.default_rng(0)
    position = rng.normal(size=(1, 3))
    orientation = Rotation.random(1, random_state=1).as_quat()
    fleet = fleet_of(
        position,
        device,
        orientation=orientation,
        velocity=rng.normal(size=(1, 3)),
        body_rate=rng.normal(size=(1, 3)),
        rotor_speed=rng.normal(size=(1, 6)),
        status=[3],
        clock_ns=[2**53],
        redone_count=[3],
    )
    field, _floor = floor_field(device, np.full((4, 4, 4), 9.0, np.float32))
    trace = Trace(capacity=3, world_count=1, rotor_count=6, device=device)
    trace.bring_to_host()
    trace.record(surfaces_of(field, device, 1), fleet, 2, 1, first=True, last=True)
    trace.fetch(1, 2)
    wp.synchronize_device(device)
    rows = trace.numpy(1, 2)
    assert rows.status.tolist() == [[0], [3]]
    assert rows.redone.tolist() == [[0], [3]]
    assert trace.stamps.numpy().tolist() == [[0], [0], [2**53 + 1]]
    assert fleet.clock_ns.numpy().tolist() == [2**53 + 1]
    state = rows.states[1, 0]
    for part, array in (
        (POSITION, fleet.position),
        (ORIENTATION, fleet.orientation),
        (VELOCITY, fleet.velocity),
        (BODY_RATE, fleet.body_rate),
        (ROTOR_SPEED, fleet.rotor_speed),
    ):
        np.testing.assert_array_equal(state[part], array.numpy()[0])

    mount = Mount(position_m=(0.1, -0.2, 0.3), rpy_rad=(0.1, 0.2, 0.3))
    p_WC = wp.zeros(1, dtype=wp.vec3, device=device)
    q_WC = wp.zeros(1, dtype=wp.quat, device=device)
    trace.camera_poses(
        wp.array([2], dtype=int, device=device),
        count=1,
        p_BC=wp.array([mount.position_m], dtype=wp.vec3d, device=device),
        q_BC=wp.array([mount.optical_quaternion()], dtype=wp.quatd, device=device),
        p_WC=p_WC,
        q_WC=q_WC,
        stamps=wp.zeros((0, 1), dtype=wp.int64, device=device),
    )
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


@pytest.mark.parametrize("holds", [False, True])
def test_who_touches_the_floor_is_marked_and_held_if_asked(device, holds):
    """The room is the height less the radius; a world that is not active is left alone."""
    height_m = np.broadcast_to(0.5 * np.arange(4, dtype=np.float32), (4, 4, 4))
    field, _floor = floor_field(device, height_m)
    fleet = fleet_of([[0, 0, 0.15], [0, 0, 0.6], [0, 0, 0.1]], device, active=[1, 1, 0])
    trace = Trace(capacity=2, world_count=3, rotor_count=4, device=device)
    trace.bring_to_host()
    surfaces = surfaces_of(field, device, 3, holds=holds)
    trace.record(surfaces, fleet, 1, 0, first=True, last=False)
    trace.fetch(0, 2)
    wp.synchronize_device(device)
    # float32
    np.testing.assert_allclose(trace.numpy(1, 1).clearance, [[-0.05, 0.4, -0.1]], atol=1e-6)
    assert fleet.collided.numpy().tolist() == [1, 0, 0]
    assert fleet.status.numpy().tolist() == [int(STATUS_COLLISION) if holds else 0, 0, 0]
    fleet.position.fill_((0.0, 0.0, 0.6))
    trace.record(surfaces, fleet, 0, 0, first=False, last=False)
    assert fleet.collided.numpy().tolist() == [1, 0, 0], "a touch lasts as long as its batch"
    trace.record(surfaces, fleet, 0, 0, first=True, last=False)
    assert fleet.collided.numpy().tolist() == [int(holds), 0, 0]


def test_one_launch_flies_and_records_what_single_ones_do(device):
    """Bit for bit, also where a vehicle is held from the third of five spans on."""
    field, _floor = floor_field(device, np.broadcast_to(0.5 * np.arange(4, dtype=np.float32), (4, 4, 4)))
    surfaces, found = surfaces_of(field, device, 2, holds=True), []
    for joined in (False, True):
        vehicle = Multirotor(preset("hummingbird"), count=2, device=device)
        vehicle.reset(position=[[0.0, 0.0, 0.6], [0.0, 0.0, 0.2025]], velocity=[0.0, 0.0, -1.0])
        fleet = fleet_of(np.zeros((2, 3)), device, clock_ns=[7, 9])
        for name in set(Fleet.vars) & set(vars(vehicle.arrays)):
            setattr(fleet, name, getattr(vehicle.arrays, name))
        trace = Trace(capacity=6, world_count=2, rotor_count=4, device=device)
        if joined:
            trace.fly(vehicle, surfaces, fleet, 1, 0, 1_000_000, 5, first=True, last=True)
        for step in () if joined else range(5):
            vehicle.advance(1_000_000)
            elapsed_ns = 1_000_000 * (step + 1)
            trace.record(surfaces, fleet, 1 + step, elapsed_ns, first=step == 0, last=step == 4)
        arrays = (trace.states, trace.status, trace.stamps, trace.clearance, fleet.clock_ns, fleet.collided)
        found.append([array.numpy() for array in arrays])
    for single, one in zip(*found, strict=True):
        np.testing.assert_array_equal(single, one)
    states, status, stamps, _, clock_ns, _ = found[1]
    assert status[:, 1].tolist() == [0, 0, 0, 0, *2 * [int(STATUS_COLLISION)]], "noted before it is held"
    assert len(np.unique(states[1:, 0, 2])) == 5
    assert stamps[5].tolist() == clock_ns.tolist() == [5_000_007, 5_000_009]
