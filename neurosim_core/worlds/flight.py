# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-any-return,call-overload,valid-type"
"""Kernels of the flight of many worlds: who begins anew, who has touched something, where cameras are."""

from typing import Any

import warp as wp

from neurosim_core.scene.freespace import DistanceField, room_around
from neurosim_core.vehicle.status import STATUS_COLLISION, STATUS_OK

wp.set_module_options({"enable_backward": False})


@wp.struct
class Start:
    """Where vehicles begin, one row for each world."""

    position: wp.array2d[wp.float64]
    """p_WB [m], [N, 3]."""
    velocity: wp.array2d[wp.float64]
    """v_WB in W [m/s], [N, 3]."""
    orientation: wp.array2d[wp.float64]
    """q_WB, xyzw, [N, 4], of unit length."""
    body_rate: wp.array2d[wp.float64]
    """w_WB in B [rad/s], [N, 3]."""


@wp.struct
class Fleet:
    """The arrays of the vehicles that a beginning writes to (`MultirotorArrays`), and of their worlds."""

    position: wp.array[wp.vec3d]
    velocity: wp.array[wp.vec3d]
    orientation: wp.array[wp.quatd]
    body_rate: wp.array[wp.vec3d]
    rotor_speed: wp.array2d[wp.float64]
    rotor_speed_command: wp.array2d[wp.float64]
    stamp_ns: wp.array[wp.int64]
    status: wp.array[wp.int32]
    redone_count: wp.array[wp.int64]
    evaluation_count: wp.array[wp.int64]
    clock_ns: wp.array[wp.int64]
    collided: wp.array[wp.int32]


@wp.func
def _row3(rows: wp.array2d[wp.float64], row: int) -> wp.vec3d:
    return wp.vec3d(rows[row, 0], rows[row, 1], rows[row, 2])


@wp.kernel
def restart(
    # Model:
    hover_rad_s: wp.float64,
    # In:
    mask: wp.array[wp.int32],
    start: Start,
    # Out:
    fleet: Fleet,
) -> None:
    """Put the vehicles of some worlds where they begin, with rotors at hover, at time 0."""
    world = wp.tid()
    if mask[world] == 0:
        return
    fleet.position[world] = _row3(start.position, world)
    fleet.velocity[world] = _row3(start.velocity, world)
    fleet.orientation[world] = wp.quatd(
        start.orientation[world, 0],
        start.orientation[world, 1],
        start.orientation[world, 2],
        start.orientation[world, 3],
    )
    fleet.body_rate[world] = _row3(start.body_rate, world)
    for rotor in range(fleet.rotor_speed.shape[1]):
        fleet.rotor_speed[world, rotor] = hover_rad_s
        fleet.rotor_speed_command[world, rotor] = hover_rad_s
    fleet.stamp_ns[world] = wp.int64(0)
    fleet.status[world] = STATUS_OK
    fleet.redone_count[world] = wp.int64(0)
    fleet.evaluation_count[world] = wp.int64(0)
    fleet.clock_ns[world] = wp.int64(0)
    fleet.collided[world] = 0


@wp.kernel
def normalise(
    # In/out:
    orientation: wp.array2d[wp.float64],
) -> None:
    """Give quaternions unit length."""
    world = wp.tid()
    total = wp.float64(0.0)
    for part in range(4):
        total += orientation[world, part] * orientation[world, part]
    for part in range(4):
        orientation[world, part] = orientation[world, part] / wp.sqrt(total)


@wp.kernel
def begin_period(
    # In:
    status: wp.array[wp.int32],
    # Out:
    collided_out: wp.array[wp.int32],
) -> None:
    """Forget touches of the period before, except of vehicles that are held because of one."""
    world = wp.tid()
    collided_out[world] = wp.where(status[world] == STATUS_COLLISION, 1, 0)


@wp.kernel
def end_period(
    # Model:
    duration_ns: wp.int64,
    # In/out:
    clock_ns: wp.array[wp.int64],
) -> None:
    """Let time pass in all worlds."""
    world = wp.tid()
    clock_ns[world] += duration_ns


@wp.kernel
def touch(
    # Model:
    fields: wp.array[DistanceField],
    scene: wp.array[int],
    radius_m: float,
    ground_height_m: wp.float64,
    holds: int,
    # In:
    mask: wp.array[wp.int32],
    position: wp.array[wp.vec3d],
    # Out:
    collided_out: wp.array[wp.int32],
    status_out: wp.array[wp.int32],
) -> None:
    """Note which vehicles touch the scene that their world is in, and hold them if so asked."""
    world = wp.tid()
    if mask[world] == 0 or status_out[world] != STATUS_OK:
        return
    field = fields[scene[world]]
    if room_around(field, radius_m, radius_m + field.voxel, ground_height_m, position[world]) <= 0.0:
        collided_out[world] = 1
        if holds != 0:
            status_out[world] = STATUS_COLLISION


@wp.kernel
def place_cameras(
    # Model:
    p_BC: wp.vec3d,
    q_BC: wp.quatd,
    stride: int,
    # In:
    position: wp.array[wp.vec3d],
    orientation: wp.array[wp.quatd],
    clock_ns: wp.array[wp.int64],
    instant: int,
    offset_ns: wp.int64,
    # Out:
    p_WC_out: wp.array[wp.vec3],
    q_WC_out: wp.array[wp.quat],
    stamps_out: wp.array2d[wp.int64],
) -> None:
    """Write the poses T_WC = T_WB T_BC of a camera at an instant of all worlds, rounded once."""
    world = wp.tid()
    place = world * stride + instant
    q_WB = orientation[world]
    p_WC_out[place] = wp.vec3(position[world] + wp.quat_rotate(q_WB, p_BC))
    q_WC_out[place] = wp.quat(q_WB * q_BC)
    if stamps_out.shape[0] > 0:
        stamps_out[place, 0] = clock_ns[world] + offset_ns


@wp.kernel
def take_rows(
    # In:
    rows: wp.array2d[Any],
    # Out:
    rows_out: wp.array2d[wp.float64],
) -> None:
    """Copy numbers of any floating type."""
    row, column = wp.tid()
    rows_out[row, column] = wp.float64(rows[row, column])


wp.overload(take_rows, {"rows": wp.array2d[wp.float32]})
wp.overload(take_rows, {"rows": wp.array2d[wp.float64]})


@wp.kernel
def take_mask(
    # In:
    mask: wp.array[Any],
    # Out:
    mask_out: wp.array[wp.int32],
) -> None:
    """Copy a mask: not 0 is 1."""
    world = wp.tid()
    mask_out[world] = wp.where(wp.int32(mask[world]) != 0, 1, 0)


wp.overload(take_mask, {"mask": wp.array[wp.bool]})
wp.overload(take_mask, {"mask": wp.array[wp.uint8]})
wp.overload(take_mask, {"mask": wp.array[wp.int32]})
