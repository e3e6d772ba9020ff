# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,no-any-return,arg-type,assignment"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,valid-type,return-value"
"""Where a camera is when each of its rays is cast: a history of the flight, and poses between its entries.

The history has the state at every boundary of the integration, on the device, as far back as the longest
picture takes. Between two entries, h apart, position is the cubic of Hermite through both positions and
velocities, and orientation that through both orientations and body rates, as rotation vectors from the first:
the error is h^4 / 384 times the fourth derivative. At an entry the state is that entry, to the last bit.
"""

# No `from __future__ import annotations`: Warp needs the annotations of structures and kernels as objects.

from typing import Any

import warp as wp

from neurosim_core.frames import quaternion_exp

wp.set_module_options({"enable_backward": False})


@wp.struct
class History:
    """The states of vehicles at boundaries, in a ring of L entries; all of shape [world, L] but `count`."""

    count: wp.array[wp.int64]
    """Entries since the reset of a world, shape [world]."""
    stamp_ns: wp.array2d[wp.int64]
    """Time since the reset of the world [ns]."""
    position: wp.array2d[wp.vec3d]
    velocity: wp.array2d[wp.vec3d]
    orientation: wp.array2d[wp.quatd]
    body_rate: wp.array2d[wp.vec3d]


def make_history(world_count: int, length: int, device: str) -> History:
    """Allocate a ring of `length` entries for each world; 0: nothing is kept."""
    history = History()
    shape = (world_count, length)
    history.count = wp.zeros(world_count if length else 0, dtype=wp.int64, device=device)
    history.stamp_ns = wp.zeros(shape, dtype=wp.int64, device=device)
    for name in ("position", "velocity", "body_rate"):
        setattr(history, name, wp.zeros(shape, dtype=wp.vec3d, device=device))
    history.orientation = wp.zeros(shape, dtype=wp.quatd, device=device)
    return history


@wp.func
def append_history(
    history: History,
    world: int,
    stamp_ns: wp.int64,
    position: wp.vec3d,
    velocity: wp.vec3d,
    orientation: wp.quatd,
    body_rate: wp.vec3d,
) -> wp.int64:
    """Append an entry, or replace the last one if it is of the same time; return its number.

    The entry at stamp 0 is the first.
    """
    entry = history.count[world]
    length = wp.int64(history.stamp_ns.shape[1])
    if stamp_ns == wp.int64(0):
        entry = wp.int64(0)
    else:
        before = wp.max(entry - wp.int64(1), wp.int64(0))
        if history.stamp_ns[world, int(before % length)] == stamp_ns:
            entry = before
    place = int(entry % length)
    history.stamp_ns[world, place] = stamp_ns
    history.position[world, place] = position
    history.velocity[world, place] = velocity
    history.orientation[world, place] = orientation
    history.body_rate[world, place] = body_rate
    history.count[world] = entry + wp.int64(1)
    return entry


@wp.func
def _rotation_vector(q: wp.quatd) -> wp.vec3d:
    """Return the rotation vector of a unit quaternion, of at most half a turn [rad]."""
    v = wp.vec3d(q[0], q[1], q[2])
    w = q[3]
    if w < wp.float64(0.0):
        v = -v
        w = -w
    length = wp.length(v)
    if length < wp.float64(1.0e-12):
        return wp.float64(2.0) * v
    return (wp.float64(2.0) * wp.atan2(length, w) / length) * v


@wp.func
def _vector_rate(phi: wp.vec3d, rate: wp.vec3d) -> wp.vec3d:
    """Return the derivative of a rotation vector of small angle, for a body rate: by the inverse Jacobian."""
    first = wp.cross(phi, rate)
    second = wp.cross(phi, first)
    fourth = wp.cross(phi, wp.cross(phi, second))
    return (
        rate + wp.float64(0.5) * first + second / wp.float64(12.0) - fourth / wp.float64(720.0)
    )  # the next term is phi^6 / 30240


@wp.func
def _hermite(p0: wp.vec3d, d0: wp.vec3d, p1: wp.vec3d, d1: wp.vec3d, s: wp.float64) -> wp.vec3d:
    """Return the cubic with values p0, p1 and derivatives d0, d1 at s = 0 and 1."""
    rise = p1 - p0
    c2 = wp.float64(3.0) * rise - wp.float64(2.0) * d0 - d1
    c3 = d0 + d1 - wp.float64(2.0) * rise
    return p0 + s * (d0 + s * (c2 + s * c3))


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
    low = wp.max(last - length + wp.int64(1), wp.int64(0))
    high = last
    while low < high:  # the last entry that is not later
        middle = (low + high + wp.int64(1)) / wp.int64(2)
        if history.stamp_ns[world, int(middle % length)] <= stamp_ns:
            low = middle
        else:
            high = middle - wp.int64(1)
    a = int(low % length)
    p_WB = history.position[world, a]
    q_WB = history.orientation[world, a]
    since_ns = stamp_ns - history.stamp_ns[world, a]
    if since_ns > wp.int64(0) and low < last:
        b = int((low + wp.int64(1)) % length)
        span_ns = history.stamp_ns[world, b] - history.stamp_ns[world, a]
        s = wp.float64(since_ns) / wp.float64(span_ns)
        h = wp.float64(span_ns) * wp.float64(1.0e-9)
        p_WB = _hermite(
            p_WB,
            h * history.velocity[world, a],
            history.position[world, b],
            h * history.velocity[world, b],
            s,
        )
        phi = _rotation_vector(wp.quat_inverse(q_WB) * history.orientation[world, b])
        end = _vector_rate(phi, h * history.body_rate[world, b])
        q_WB = q_WB * quaternion_exp(_hermite(wp.vec3d(), h * history.body_rate[world, a], phi, end, s))
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
