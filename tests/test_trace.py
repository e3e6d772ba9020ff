"""States survive the buffer bit for bit; camera poses are T_WB T_BC."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from neurosim_core.frames import Mount
from neurosim_core.scene.freespace import DistanceField
from neurosim_core.trace import BODY_RATE, ORIENTATION, POSITION, ROTOR_SPEED, VELOCITY, Trace, copy_rows


def test_camera_pose_is_body_pose_times_mount(device):
    rng = np.random.default_rng(0)
    position = rng.normal(size=(1, 3))
    orientation = Rotation.random(1, random_state=1).as_quat()
    arrays = SimpleNamespace(
        position=wp.array(position, dtype=wp.vec3d, device=device),
        orientation=wp.array(orientation, dtype=wp.quatd, device=device),
        velocity=wp.array(rng.normal(size=(1, 3)), dtype=wp.vec3d, device=device),
        body_rate=wp.array(rng.normal(size=(1, 3)), dtype=wp.vec3d, device=device),
        rotor_speed=wp.array(rng.normal(size=(1, 6)), dtype=wp.float64, device=device),
        status=wp.array([7], dtype=wp.int32, device=device),
        stamp_ns=wp.array([2**53 + 1], dtype=wp.int64, device=device),
        redone_count=wp.array([3], dtype=wp.int64, device=device),
    )
    trace = Trace(capacity=3, vehicle_count=1, rotor_count=6, device=device)
    trace.record(arrays, 2)
    trace.fetch(1, 2)
    wp.synchronize_device(device)
    rows = trace.numpy(1, 2)
    assert rows.status.tolist() == [[0], [7]]
    assert rows.redone.tolist() == [[0], [3]]
    assert trace.stamps.numpy().tolist() == [[0], [0], [2**53 + 1]]
    state = rows.states[1, 0]
    for part, array in (
        (POSITION, arrays.position),
        (ORIENTATION, arrays.orientation),
        (VELOCITY, arrays.velocity),
        (BODY_RATE, arrays.body_rate),
        (ROTOR_SPEED, arrays.rotor_speed),
    ):
        np.testing.assert_array_equal(state[part], array.numpy()[0])

    mount = Mount(position_m=(0.1, -0.2, 0.3), rpy_rad=(0.1, 0.2, 0.3))
    p_WC = wp.zeros(1, dtype=wp.vec3, device=device)
    q_WC = wp.zeros(1, dtype=wp.quat, device=device)
    trace.camera_poses(
        wp.array([2], dtype=int, device=device),
        count=1,
        p_BC=wp.vec3d(*mount.position_m),
        q_BC=wp.quatd(*mount.optical_quaternion()),
        p_WC=p_WC,
        q_WC=q_WC,
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


def test_rows_are_copied_and_no_others(device):
    """The kernel that takes them to the host, which a CPU does without."""
    rng = np.random.default_rng(0)
    shapes = [((4, 2, 17), np.float64), ((4, 2), np.int32), ((4,), np.float32), ((4, 2), np.int64)]
    values = [rng.integers(1, 2**20, size=shape).astype(dtype) for shape, dtype in shapes]
    rows, others = (
        [wp.array(value, device=device) for value in group]
        for group in (values, [np.zeros_like(value) for value in values])
    )
    copy_rows(rows, others, 1, 2)
    wp.synchronize_device(device)
    for value, other in zip(values, others, strict=True):
        np.testing.assert_array_equal(other.numpy()[1:3], value[1:3])
        assert not other.numpy()[[0, 3]].any()


def test_optical_frame_looks_forward():
    """Optical z is body x, optical x is body -y, optical y is body -z; positive pitch looks down."""
    R_BC = Rotation.from_quat(Mount().optical_quaternion()).as_matrix()
    np.testing.assert_allclose(R_BC, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-15)
    down = Rotation.from_quat(Mount(rpy_rad=(0.0, 0.5, 0.0)).optical_quaternion()).apply([0, 0, 1])
    np.testing.assert_allclose(down, [np.cos(0.5), 0.0, -np.sin(0.5)], atol=1e-15)


def test_room_around_the_vehicle(device):
    """Over a wide floor at z = 0 the room is the height less the radius, for the slots that are asked for."""
    corners = np.array([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], dtype=np.float32)
    floor = wp.Mesh(
        points=wp.array(corners, dtype=wp.vec3, device=device),
        indices=wp.array([0, 1, 2], dtype=int, device=device),
    )
    field = DistanceField()
    field.mesh = floor.id
    height_m = np.broadcast_to(0.5 * np.arange(4, dtype=np.float32), (4, 4, 4))
    field.distance = wp.array(np.ascontiguousarray(height_m), dtype=wp.float32, device=device)
    field.origin = wp.vec3(-0.75, -0.75, 0.0)
    field.voxel = 0.5
    trace = Trace(capacity=4, vehicle_count=2, rotor_count=4, device=device)
    states = np.zeros((4, 2, 17))
    states[:, 0, 2] = [9.0, 0.15, 0.6, 9.0]
    trace.states.assign(states)
    trace.check_room(field, 1, 2, radius_m=0.2)
    trace.fetch(0, 4)
    wp.synchronize_device(device)
    # float32
    np.testing.assert_allclose(trace.numpy(0, 4).clearance, [0.0, -0.05, 0.4, 0.0], atol=1e-6)
