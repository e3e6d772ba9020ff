# mypy: disable-error-code="valid-type"
"""The state of a batch of vehicles as it lies on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

_VECTORS = ("position", "velocity", "body_rate", "acceleration", "angular_acceleration", "air_velocity")
_ROTORS = ("rotor_speed", "rotor_speed_command")
_OTHERS = {"orientation": wp.quatd, "status": wp.int32}

BLOCK_DIM = 32
"""Threads of a block on CUDA where a thread is a vehicle: a few thousand vehicles then reach every
multiprocessor, and the block of a single one fits beside those of a renderer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MultirotorArrays:
    """What lives on the device of a batch. Write `rotor_speed_command`; the rest is read-only."""

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
    """0, or why a vehicle is held: index into `status.STATUS_TERMS`, [N]."""
    redone_count: wp.array[wp.int64]
    """Intervals redone with adaptive steps since the reset, [N]."""
    evaluation_count: wp.array[wp.int64]
    """Evaluations of the right-hand side in adaptive steps since the reset, [N]."""


def allocate_arrays(count: int, rotor_count: int, device: Any) -> MultirotorArrays:
    """Return the state of vehicles, all zero."""
    dtypes = dict.fromkeys(_VECTORS, wp.vec3d) | _OTHERS
    arrays: dict[str, Any] = {
        name: wp.zeros(
            (count, rotor_count) if name in _ROTORS else count,
            dtype=wp.float64 if name in _ROTORS else dtypes.get(name, wp.int64),
            device=device,
        )
        for name in MultirotorArrays.__annotations__
    }
    return MultirotorArrays(**arrays)
