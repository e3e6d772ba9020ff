# mypy: disable-error-code="valid-type,attr-defined,misc"
"""The state of a batch of vehicles: as it lies on the device, as it is read, and why a vehicle is held."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

STATUS_OK = wp.constant(wp.int32(0))
STATUS_COMMAND = wp.constant(wp.int32(1))
STATUS_VELOCITY = wp.constant(wp.int32(2))
STATUS_BODY_RATE = wp.constant(wp.int32(3))
STATUS_COLLISION = wp.constant(wp.int32(4))

STATUS_TERMS = ("ok", "rotor_speed_command", "velocity", "body_rate", "collision")
"""What each status code means: the quantity that was not finite or that cannot be integrated; "collision":
whoever flies the vehicles holds this one, because it has touched something."""

BLOCK_DIM = 32
"""Threads of a block on CUDA where a thread is a vehicle: a few thousand vehicles then reach every
multiprocessor, and the block of a single one fits beside those of a renderer."""


@wp.struct
class MultirotorArrays:
    """The device arrays of a batch. Write `rotor_speed_command`; the rest is read-only."""

    position: wp.array[wp.vec3d]
    """p_WB [m], [N]."""
    velocity: wp.array[wp.vec3d]
    """v_WB in W [m/s], [N]."""
    orientation: wp.array[wp.quatd]
    """q_WB, [N]."""
    body_rate: wp.array[wp.vec3d]
    """w_WB in B [rad/s], [N]."""
    rotor_speed: wp.array2d[wp.float64]
    """[rad/s], [N, R]."""
    rotor_speed_command: wp.array2d[wp.float64]
    """Held during `advance` [rad/s], [N, R]."""
    acceleration: wp.array[wp.vec3d]
    """dv/dt in W as of the last `accelerate` [m/s^2], [N]."""
    angular_acceleration: wp.array[wp.vec3d]
    """dw/dt in B as of the last `accelerate` [rad/s^2], [N]."""
    air_velocity: wp.array[wp.vec3d]
    """Velocity of the air at each vehicle, wind, gusts and turbulence together, in W [m/s], [N]."""
    stamp_ns: wp.array[wp.int64]
    """Time of each vehicle's state [ns], [N]; stops where a vehicle is held."""
    status: wp.array[wp.int32]
    """0, or why a vehicle is held: index into `STATUS_TERMS`, [N]."""
    redone_count: wp.array[wp.int64]
    """Intervals redone with adaptive steps since the reset, [N]."""
    evaluation_count: wp.array[wp.int64]
    """Evaluations of the right-hand side in adaptive steps since the reset, [N]."""


class MultirotorState(NamedTuple):
    """State of vehicles on the host, float64: of a batch with a leading [N], of one vehicle without it."""

    position: NDArray[np.float64]
    """p_WB [m], [N, 3]."""
    velocity: NDArray[np.float64]
    """v_WB in W [m/s], [N, 3]."""
    orientation: NDArray[np.float64]
    """q_WB, xyzw, [N, 4]."""
    body_rate: NDArray[np.float64]
    """w_WB in B [rad/s], [N, 3]."""
    rotor_speed: NDArray[np.float64]
    """Speed of each rotor [rad/s], [N, R]."""


class Acceleration(NamedTuple):
    """Accelerations of a batch on the host, float64."""

    linear: NDArray[np.float64]
    """dv/dt of the centre of mass, in W [m/s^2], [N, 3]."""
    angular: NDArray[np.float64]
    """dw/dt in B [rad/s^2], [N, 3]."""


class DynamicsError(ArithmeticError):
    """The motion of a vehicle cannot be integrated, or its command was not finite.

    The vehicle is held at its last good state, the beginning of the interval that failed (in turbulence: of
    its part from tick to tick), until it is reset; other vehicles of the batch are not affected.

    Attributes:
        stamp_ns: Time of the last good state [ns].
        vehicle: Index in the batch.
        term: What failed: "velocity", "body_rate" or "rotor_speed_command".
        state: The last good state, without the leading axis.
    """

    def __init__(self, stamp_ns: int, vehicle: int, term: str, state: MultirotorState) -> None:
        super().__init__(stamp_ns, vehicle, term, state)
        self.stamp_ns = stamp_ns
        self.vehicle = vehicle
        self.term = term
        self.state = state

    def __str__(self) -> str:
        return (
            f"vehicle {self.vehicle}: {self.term} cannot be integrated after {self.stamp_ns} ns; "
            "last good state: "
            + ", ".join(
                f"{name} {np.array2string(v, precision=6)}" for name, v in self.state._asdict().items()
            )
        )


def allocate_arrays(count: int, rotor_count: int, device: Any) -> MultirotorArrays:
    """Return the state of vehicles, all zero."""
    arrays = MultirotorArrays()
    for name, member in MultirotorArrays.vars.items():
        shape = (count, rotor_count)[: member.type.ndim]
        setattr(arrays, name, wp.zeros(shape, dtype=member.type.dtype, device=device))
    return arrays


def read_state(arrays: Any) -> MultirotorState:
    """Return a copy of the states of all vehicles on the host; waits for the device."""
    return MultirotorState(*(np.array(getattr(arrays, name).numpy()) for name in MultirotorState._fields))


def check_status(arrays: Any) -> None:
    """Wait for the device and raise if a vehicle is held.

    Raises:
        DynamicsError: For the first vehicle that is held.
    """
    status = arrays.status.numpy()
    for vehicle in np.flatnonzero(status)[:1].tolist():
        state = MultirotorState(*(rows[vehicle] for rows in read_state(arrays)))
        stamp_ns = int(arrays.stamp_ns.numpy()[vehicle])
        raise DynamicsError(stamp_ns, vehicle, STATUS_TERMS[status[vehicle]], state)
