# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,arg-type,assignment,no-untyped-def"
"""The vehicle of a motion that is prescribed: a rigid body that follows it exactly, without dynamics.

With phi the rotation vector of a piece and t its length, R_WB = R(knot) exp(phi), and with the right Jacobian
of SO(3)

    w = phi' - a phi x phi' + b phi x (phi x phi'),    a = (1 - cos t) / t^2,    b = (t - sin t) / t^3,

whose derivative is the angular acceleration.

Reference: Barfoot (2017), State Estimation for Robotics, section 7.2 (kinematics of rotation vectors).
"""

# No `from __future__ import annotations`: Warp needs the annotations of structures and kernels as objects.

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.frames import quaternion_exp
from neurosim_core.runtime.cuda import RecordedLaunch
from neurosim_core.trajectory.path import Path, PathArrays, PathPoint, evaluate_path, find_place, upload_paths
from neurosim_core.vehicle import MultirotorArrays, MultirotorConfig
from neurosim_core.vehicle.arrays import BLOCK_DIM, allocate_arrays

wp.set_module_options({"enable_backward": False})

_SMALL_RAD2 = wp.constant(wp.float64(1.0e-2))
"""Squares of angles below which a series is used: its error is 1e-11, that of the quotients 1e-12."""


@wp.struct
class AttitudeArrays:
    """The attitudes of paths behind each other, on a device."""

    knots: wp.array[wp.quatd]  # q_WB, shape [knot]
    rotation_vectors: wp.array2d[wp.vec3d]
    """Coefficients in rising powers of normalised time [rad], shape [piece, 4]."""


@wp.struct
class _Turn:
    """Orientation and its derivatives."""

    orientation: wp.quatd
    body_rate: wp.vec3d  # w_WB in B [rad/s]
    acceleration: wp.vec3d  # dw_WB/dt in B [rad/s^2]


@wp.func
def _turn(phi: wp.vec3d, d1: wp.vec3d, d2: wp.vec3d, knot: wp.quatd) -> _Turn:
    t2 = wp.dot(phi, phi)
    a = wp.float64(0.5) - t2 / wp.float64(24.0) + t2 * t2 / wp.float64(720.0)
    b = wp.float64(1.0) / wp.float64(6.0) - t2 / wp.float64(120.0) + t2 * t2 / wp.float64(5040.0)
    da = wp.float64(-1.0) / wp.float64(12.0) + t2 / wp.float64(180.0) - t2 * t2 / wp.float64(6720.0)
    db = wp.float64(-1.0) / wp.float64(60.0) + t2 / wp.float64(1260.0) - t2 * t2 / wp.float64(60480.0)
    if t2 > _SMALL_RAD2:
        t = wp.sqrt(t2)
        s = wp.sin(t)
        c = wp.cos(t)
        a = (wp.float64(1.0) - c) / t2
        b = (t - s) / (t2 * t)
        da = (t * s - wp.float64(2.0) * (wp.float64(1.0) - c)) / (t2 * t2)
        db = (wp.float64(3.0) * s - t * c - wp.float64(2.0) * t) / (t2 * t2 * t)
    turn = _Turn()
    turn.orientation = knot * quaternion_exp(phi)
    first = wp.cross(phi, d1)
    second = wp.cross(phi, d2)
    along = wp.dot(phi, d1)  # t t', so that da is (da / dt) / t
    turn.body_rate = d1 - a * first + b * wp.cross(phi, first)
    turn.acceleration = (
        d2
        - along * da * first
        - a * second
        + along * db * wp.cross(phi, first)
        + b * (wp.cross(d1, first) + wp.cross(phi, second))
    )
    return turn


@wp.func
def _evaluate_turn(path: PathArrays, attitude: AttitudeArrays, index: int, stamp_ns: wp.int64) -> _Turn:
    """Return the orientation of a path at a stamp."""
    place = find_place(path, index, stamp_ns)
    u = place.u
    rate = place.rate
    piece = place.knot - index
    c1 = attitude.rotation_vectors[piece, 1]
    c2 = attitude.rotation_vectors[piece, 2]
    c3 = attitude.rotation_vectors[piece, 3]
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    phi = attitude.rotation_vectors[piece, 0] + u * (c1 + u * (c2 + u * c3))
    d1 = rate * (c1 + u * (two * c2 + three * u * c3))
    d2 = rate * rate * (two * c2 + two * three * u * c3)
    return _turn(phi, d1, d2, attitude.knots[place.knot])


@wp.kernel
def _move(
    # Model:
    path: PathArrays,
    attitude: AttitudeArrays,
    path_of_world: wp.array[int],
    # In:
    mask: wp.array[wp.int32],
    duration_ns: wp.int64,
    # In/out:
    body: MultirotorArrays,
) -> None:
    world = wp.tid()
    if mask.shape[0] > 0:
        if mask[world] == 0:
            return
        for rotor in range(body.rotor_speed.shape[1]):
            body.rotor_speed[world, rotor] = wp.float64(0.0)
            body.rotor_speed_command[world, rotor] = wp.float64(0.0)
    stamp_ns = body.stamp_ns[world] + duration_ns
    body.stamp_ns[world] = stamp_ns
    index = path_of_world[world]
    point = PathPoint()
    point = evaluate_path(path, index, stamp_ns)
    turn = _evaluate_turn(path, attitude, index, stamp_ns)
    body.position[world] = point.position
    body.velocity[world] = point.velocity
    body.acceleration[world] = point.acceleration
    body.orientation[world] = turn.orientation
    body.body_rate[world] = turn.body_rate
    body.angular_acceleration[world] = turn.acceleration


class KinematicVehicle:
    """Bodies in place of vehicles, each at the pose that its path prescribes at its stamp.

    They are what the engine asks of a vehicle (`vehicle.base.Vehicle`). Rotors stand still; of the
    `config` IMUs need gravity.
    """

    terms: tuple[str, ...] = ()

    def __init__(
        self,
        config: MultirotorConfig,
        paths: Sequence[Path],
        *,
        path_of_world: Sequence[int],
        device: str,
        max_step_ns: int,
    ) -> None:
        """Bring paths, all with an attitude, to the device; each body follows one, `path_of_world`."""
        self.config, self.count = config, len(path_of_world)
        self.device, self.max_step_ns = wp.get_device(device), max_step_ns
        self.arrays = allocate_arrays(self.count, config.rotor_count, self.device)
        attitudes = [path.attitude for path in paths if path.attitude is not None]
        knots = np.concatenate([attitude.knots for attitude in attitudes])
        vectors_of_pieces = np.concatenate([attitude.rotation_vectors for attitude in attitudes])
        attitude = AttitudeArrays()
        attitude.knots = wp.array(knots, dtype=wp.quatd, device=self.device)
        attitude.rotation_vectors = wp.array(vectors_of_pieces, dtype=wp.vec3d, device=self.device)
        worlds: Any = wp.array(list(path_of_world), dtype=int, device=self.device)
        self._motion = [upload_paths(paths, self.device), attitude, worlds]
        self._nobody = wp.zeros(0, dtype=wp.int32, device=self.device)
        self._move = RecordedLaunch(_move, self.device, block_dim=BLOCK_DIM)

    def advance(self, duration_ns: int) -> None:
        """Move all bodies on; launches only."""
        self._move.launch(self.count, [*self._motion, self._nobody, duration_ns, self.arrays])

    def flight_kernel(self, record: Any) -> None:
        """It is moved span by span."""

    def begin(self, mask: Any) -> None:
        """Put some bodies where their stamp says, device array of int32, shape [N]; launches only."""
        self._move.launch(self.count, [*self._motion, mask, 0, self.arrays], key="begin")

    def accelerate(self) -> None:
        """Accelerations are always those of the stamp."""
