# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,no-any-return,arg-type,assignment"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,valid-type,return-value"
"""Where a camera is when each of its rays is cast, from the history of the flight."""

# No `from __future__ import annotations`: Warp needs the annotations of structures and kernels as objects.

from typing import Any

import warp as wp

from neurosim_core.vehicle.history import History, motion_at

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _ray_poses(
    # Model:
    p_BC: wp.vec3d,
    q_BC: wp.quatd,
    stride: int,
    offsets_ns: wp.array[wp.int64],
    # In:
    history: History,
    entries: wp.array2d[wp.int64],
    slots: wp.array[int],
    # Out:
    p_WC_out: wp.array[wp.vec3],
    q_WC_out: wp.array[wp.quat],
    stamps_out: wp.array2d[wp.int64],
) -> None:
    world, instant, part = wp.tid()
    last = entries[slots[instant], world]
    length = wp.int64(history.stamp_ns.shape[1])
    stamp_ns = history.stamp_ns[world, int(last % length)] + offsets_ns[part]
    stamp_ns = wp.max(stamp_ns, wp.int64(0))
    at = motion_at(history, world, last, stamp_ns)
    p_WB = at.position
    q_WB = at.orientation
    row = (world * stride + instant) * offsets_ns.shape[0] + part
    p_WC_out[row] = wp.vec3(p_WB + wp.quat_rotate(q_WB, p_BC))
    q_WC_out[row] = wp.quat(q_WB * q_BC)
    if stamps_out.shape[0] > 0:
        stamps_out[row, 0] = stamp_ns


def write_ray_poses(
    history: History,
    entries: Any,
    slots: Any,
    offsets_ns: Any,
    *,
    count: int,
    p_BC: wp.vec3d,
    q_BC: wp.quatd,
    p_WC: Any,
    q_WC: Any,
    stamps: Any,
) -> None:
    """Write the poses T_WC of a camera when its rays are cast, in float32; before stamp 0 it stands still.

    Args:
        history: It goes back as far as the offsets do.
        entries: Number of the entry of each slot, int64, shape [slot, world].
        slots: Slots of the instants, shape [K].
        offsets_ns: From an instant to its rays [ns], <= 0, int64, shape [J].
        count: How many instants to use.
        p_BC: Position of the camera on the body [m].
        q_BC: Orientation of the camera against the body, xyzw.
        p_WC: Positions, shape [world K J]; overwritten.
        q_WC: Orientations, likewise; overwritten.
        stamps: Times [ns], int64, shape [world K J, 1]; overwritten unless it is empty.
    """
    world_count, part_count = entries.shape[1], offsets_ns.shape[0]
    stride = p_WC.shape[0] // (world_count * part_count)
    wp.launch(
        _ray_poses,
        dim=(world_count, count, part_count),
        inputs=[p_BC, q_BC, stride, offsets_ns, history, entries, slots],
        outputs=[p_WC, q_WC, stamps],
        device=p_WC.device,
    )
