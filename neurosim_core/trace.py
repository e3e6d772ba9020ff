# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,arg-type"
"""The states of the vehicles at the boundaries of one batch, on the device until the batch is read back."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

wp.set_module_options({"enable_backward": False})

POSITION = slice(0, 3)
ORIENTATION = slice(3, 7)
VELOCITY = slice(7, 10)
BODY_RATE = slice(10, 13)
ROTOR_SPEED = slice(13, None)
"""Where each part of a state stands in a row of a `Trace`."""


@wp.kernel
def _record_state(
    # In:
    position: wp.array[wp.vec3d],
    orientation: wp.array[wp.quatd],
    velocity: wp.array[wp.vec3d],
    body_rate: wp.array[wp.vec3d],
    rotor_speed: wp.array2d[wp.float64],
    slot: int,
    # Out:
    states_out: wp.array3d[wp.float64],
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


class Trace:
    """A device buffer of vehicle states, one slot for each boundary of a batch."""

    def __init__(self, *, capacity: int, vehicle_count: int, rotor_count: int, device: str) -> None:
        self.states = wp.zeros((capacity, vehicle_count, 13 + rotor_count), dtype=wp.float64, device=device)

    def record(self, arrays: Any, slot: int) -> None:
        """Copy the present state of all vehicles into a slot.

        Args:
            arrays: Device arrays of the vehicles (`Multirotor.arrays`).
            slot: Where to write, in [0, capacity).
        """
        wp.launch(
            _record_state,
            dim=self.states.shape[1],
            inputs=[
                arrays.position,
                arrays.orientation,
                arrays.velocity,
                arrays.body_rate,
                arrays.rotor_speed,
                slot,
            ],
            outputs=[self.states],
            device=self.states.device,
        )

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
        wp.launch(
            _camera_poses,
            dim=count,
            inputs=[p_BC, q_BC, self.states, vehicle, slots],
            outputs=[p_WC, q_WC],
            device=self.states.device,
        )

    def numpy(self, count: int) -> NDArray[np.float64]:
        """Return the first `count` states on the host, shape [count, vehicle, 13 + R]."""
        return np.array(self.states[:count].numpy())
