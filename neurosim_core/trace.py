# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,arg-type"
"""The states of the vehicles at the boundaries of batches, on the device until a batch is read back."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.scene.freespace import DistanceField, collision_check
from neurosim_core.streams import HostCopy

wp.set_module_options({"enable_backward": False})

POSITION = slice(0, 3)
ORIENTATION = slice(3, 7)
VELOCITY = slice(7, 10)
BODY_RATE = slice(10, 13)
ROTOR_SPEED = slice(13, None)
"""Where each part of a state stands in a row of a `Trace`."""
_SLOT_PARAMETER = 8
_LAUNCHES_MAX = 256


@wp.kernel
def _record_state(
    # In:
    position: wp.array[wp.vec3d],
    orientation: wp.array[wp.quatd],
    velocity: wp.array[wp.vec3d],
    body_rate: wp.array[wp.vec3d],
    rotor_speed: wp.array2d[wp.float64],
    status: wp.array[wp.int32],
    stamp_ns: wp.array[wp.int64],
    redone_count: wp.array[wp.int64],
    slot: int,
    # Out:
    states_out: wp.array3d[wp.float64],
    status_out: wp.array2d[wp.int32],
    stamps_out: wp.array2d[wp.int64],
    redone_out: wp.array2d[wp.int64],
) -> None:
    vehicle = wp.tid()
    for axis in range(3):
        states_out[slot, vehicle, axis] = position[vehicle][axis]
        states_out[slot, vehicle, 7 + axis] = velocity[vehicle][axis]
        states_out[slot, vehicle, 10 + axis] = body_rate[vehicle][axis]
    for part in range(4):
        states_out[slot, vehicle, 3 + part] = orientation[vehicle][part]
    for rotor in range(rotor_speed.shape[1]):
        states_out[slot, vehicle, 13 + rotor] = rotor_speed[vehicle, rotor]
    status_out[slot, vehicle] = status[vehicle]
    stamps_out[slot, vehicle] = stamp_ns[vehicle]
    redone_out[slot, vehicle] = redone_count[vehicle]


@wp.kernel
def _camera_poses(
    # Model:
    p_BC: wp.vec3d,
    q_BC: wp.quatd,
    # In:
    states: wp.array3d[wp.float64],
    vehicle: int,
    slots: wp.array[int],
    # Out:
    p_WC_out: wp.array[wp.vec3],
    q_WC_out: wp.array[wp.quat],
) -> None:
    instant = wp.tid()
    slot = slots[instant]
    p_WB = wp.vec3d(states[slot, vehicle, 0], states[slot, vehicle, 1], states[slot, vehicle, 2])
    q_WB = wp.quatd(
        states[slot, vehicle, 3], states[slot, vehicle, 4], states[slot, vehicle, 5], states[slot, vehicle, 6]
    )
    p_WC = p_WB + wp.quat_rotate(q_WB, p_BC)
    q_WC = q_WB * q_BC
    p_WC_out[instant] = wp.vec3(p_WC)
    q_WC_out[instant] = wp.quat(q_WC)


@wp.kernel
def _copy_rows(
    # In:
    first: int,
    states: wp.array3d[wp.float64],
    status: wp.array2d[wp.int32],
    clearance: wp.array[wp.float32],
    redone: wp.array2d[wp.int64],
    # Out:
    states_out: wp.array3d[wp.float64],
    status_out: wp.array2d[wp.int32],
    clearance_out: wp.array[wp.float32],
    redone_out: wp.array2d[wp.int64],
) -> None:
    place, vehicle, part = wp.tid()
    slot = first + place
    states_out[slot, vehicle, part] = states[slot, vehicle, part]
    if part == 0:
        status_out[slot, vehicle] = status[slot, vehicle]
        redone_out[slot, vehicle] = redone[slot, vehicle]
        if vehicle == 0:
            clearance_out[slot] = clearance[slot]


class TraceRows(NamedTuple):
    """Slots of a `Trace` on the host."""

    states: NDArray[np.float64]
    """Shape [slot, vehicle, 13 + R]."""
    status: NDArray[np.int32]
    """Shape [slot, vehicle]."""
    clearance: NDArray[np.float32]
    """[m], shape [slot]."""
    redone: NDArray[np.int64]
    """Shape [slot, vehicle]."""


class Trace:
    """Device buffers with one slot for each boundary of the batches under way, and their copies on the host.

    Attributes:
        states: States, float64, shape [slot, vehicle, 13 + R].
        status: Why a vehicle is held (`MultirotorArrays.status`), shape [slot, vehicle].
        stamps: Time of each state [ns], int64, shape [slot, vehicle]; only on the device.
        redone: Intervals redone so far (`MultirotorArrays.redone_count`), shape [slot, vehicle].
        clearance: Room around vehicle 0 as of the last `check_room` [m], float32, shape [slot].
    """

    def __init__(self, *, capacity: int, vehicle_count: int, rotor_count: int, device: str) -> None:
        self.states = wp.zeros((capacity, vehicle_count, 13 + rotor_count), dtype=wp.float64, device=device)
        self.status = wp.zeros((capacity, vehicle_count), dtype=wp.int32, device=device)
        self.stamps: Any = wp.zeros((capacity, vehicle_count), dtype=wp.int64, device=device)
        self.redone = wp.zeros((capacity, vehicle_count), dtype=wp.int64, device=device)
        self.clearance = wp.zeros(capacity, dtype=wp.float32, device=device)
        self._is_cuda = wp.get_device(device).is_cuda
        self._rows = (self.states, self.status, self.clearance, self.redone)
        self._copies = [HostCopy(array) for array in self._rows]
        self._mapped = [copy.mapped() for copy in self._copies]
        self._recording: tuple[Any, Any] = (None, None)
        self._room_checks: dict[tuple[int, int, float, float], tuple[DistanceField, wp.Launch]] = {}
        self._pose_launches: dict[tuple[int, int, int, int], tuple[Any, wp.Launch]] = {}

    def record(self, arrays: Any, slot: int) -> None:
        """Copy the present state, status and time of all vehicles into a slot.

        Args:
            arrays: Device arrays of the vehicles (`Multirotor.arrays`).
            slot: Where to write, in [0, capacity).
        """
        if self._recording[0] is not arrays:
            launch = wp.launch(
                _record_state,
                dim=self.states.shape[1],
                inputs=[
                    arrays.position,
                    arrays.orientation,
                    arrays.velocity,
                    arrays.body_rate,
                    arrays.rotor_speed,
                    arrays.status,
                    arrays.stamp_ns,
                    arrays.redone_count,
                    slot,
                ],
                outputs=[self.states, self.status, self.stamps, self.redone],
                device=self.states.device,
                record_cmd=True,
            )
            self._recording = (arrays, launch)
        launch = self._recording[1]
        launch.set_param_at_index(_SLOT_PARAMETER, slot)
        launch.launch()

    def check_room(
        self,
        field: DistanceField,
        first: int,
        count: int,
        *,
        radius_m: float,
        ground_height_m: float = -math.inf,
    ) -> None:
        """Write how much room vehicle 0 has in some slots to `clearance`; see `freespace.check_collision`.

        Args:
            field: Of the scene.
            first: First slot.
            count: Number of slots, at least one.
            radius_m: Of the vehicle [m].
            ground_height_m: z of the plane that it may land on [m]; -inf: none.
        """
        key = (first, count, radius_m, ground_height_m)
        if key not in self._room_checks or self._room_checks[key][0] is not field:
            stride = self.states.strides[0]
            positions: Any = wp.array(
                ptr=self.states.ptr + first * stride,
                dtype=wp.vec3d,
                shape=(count,),
                strides=(stride,),
                device=self.states.device,
            )
            room = self.clearance[first : first + count]
            launch = collision_check(
                field, positions, room, radius_m=radius_m, ground_height_m=ground_height_m
            )
            if len(self._room_checks) >= _LAUNCHES_MAX:
                self._room_checks.clear()
            self._room_checks[key] = (field, launch)
        self._room_checks[key][1].launch()

    def camera_poses(
        self,
        slots: wp.array[int],
        *,
        count: int,
        p_BC: wp.vec3d,
        q_BC: wp.quatd,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        vehicle: int = 0,
    ) -> None:
        """Write the poses T_WC = T_WB T_BC of a camera at the first `count` of the given slots, in float32.

        Args:
            slots: Slots of the instants, shape [K].
            count: How many of them to use.
            p_BC: Position of the camera on the body [m].
            q_BC: Orientation of the camera against the body, xyzw.
            p_WC: Positions, shape [K]; overwritten.
            q_WC: Orientations, shape [K]; overwritten.
            vehicle: Which vehicle carries the camera.
        """
        key = (slots.ptr, count, p_WC.ptr, vehicle)
        # another list of slots may have the memory of one that is gone
        if key not in self._pose_launches or self._pose_launches[key][0] is not slots:
            launch = wp.launch(
                _camera_poses,
                dim=count,
                inputs=[p_BC, q_BC, self.states, vehicle, slots],
                outputs=[p_WC, q_WC],
                device=self.states.device,
                record_cmd=True,
            )
            if len(self._pose_launches) >= _LAUNCHES_MAX:
                self._pose_launches.clear()
            self._pose_launches[key] = (slots, launch)
        self._pose_launches[key][1].launch()

    def fetch(self, first: int, count: int) -> None:
        """Launch the copy of some slots to the host: by one kernel, three times as fast as four copies."""
        if self._is_cuda:
            copy_rows(self._rows, self._mapped, first, count)

    def numpy(self, first: int, count: int) -> TraceRows:
        """Return some slots that were fetched, and that the device has finished with."""
        return TraceRows(*(copy.rows(first, count) for copy in self._copies))


def copy_rows(rows: Sequence[Any], rows_out: Sequence[Any], first: int, count: int) -> None:
    """Launch the copy of some slots to other arrays.

    Args:
        rows: States, status, clearance and redone intervals, as in `Trace`.
        rows_out: Where to, likewise; for a CUDA device, memory of the host may be among it that is pinned.
        first: First slot.
        count: Number of slots.
    """
    states = rows[0]
    wp.launch(
        _copy_rows,
        dim=(count, *states.shape[1:]),
        inputs=[first, *rows],
        outputs=list(rows_out),
        device=states.device,
    )
