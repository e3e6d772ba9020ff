# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,arg-type,assignment,no-untyped-def"
# mypy: disable-error-code="valid-type,return-value"
"""The history of a flight, and the motion between its entries.

The history has the state at every boundary of the integration, on the device, as far back as somebody needs.
Between two entries, h apart, position is the cubic of Hermite through both positions and
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

    count: wp.array[wp.int64]  # Entries since the reset of a world, shape [world]
    stamp_ns: wp.array2d[wp.int64]  # Time since the reset of the world [ns]
    position: wp.array2d[wp.vec3d]
    velocity: wp.array2d[wp.vec3d]
    orientation: wp.array2d[wp.quatd]
    body_rate: wp.array2d[wp.vec3d]


def make_history(world_count: int, length: int, device: Any) -> History:
    """Allocate a ring of `length` entries for each world."""
    history = History()
    shape = (world_count, length)
    history.count = wp.zeros(world_count, dtype=wp.int64, device=device)
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


@wp.struct
class Moving:
    """The motion of a vehicle at a time."""

    position: wp.vec3d
    orientation: wp.quatd
    velocity: wp.vec3d
    body_rate: wp.vec3d


@wp.func
def _hermite_rate(p0: wp.vec3d, d0: wp.vec3d, p1: wp.vec3d, d1: wp.vec3d, s: wp.float64) -> wp.vec3d:
    """Return the derivative of `_hermite` by s."""
    rise = p1 - p0
    c2 = wp.float64(3.0) * rise - wp.float64(2.0) * d0 - d1
    c3 = d0 + d1 - wp.float64(2.0) * rise
    return d0 + s * (wp.float64(2.0) * c2 + wp.float64(3.0) * s * c3)


@wp.func
def motion_at(history: History, world: int, last: wp.int64, stamp_ns: wp.int64) -> Moving:
    """Return the motion at a time >= 0, between the entries up to the number `last`; after it that of it."""
    length = wp.int64(history.stamp_ns.shape[1])
    low = wp.max(last - length + wp.int64(1), wp.int64(0))
    high = last
    if history.stamp_ns[world, int(last % length)] <= stamp_ns:
        low = last
    while low < high:  # the last entry that is not later
        middle = (low + high + wp.int64(1)) / wp.int64(2)
        if history.stamp_ns[world, int(middle % length)] <= stamp_ns:
            low = middle
        else:
            high = middle - wp.int64(1)
    a = int(low % length)
    at = Moving()
    at.position = history.position[world, a]
    at.orientation = history.orientation[world, a]
    at.velocity = history.velocity[world, a]
    at.body_rate = history.body_rate[world, a]
    since_ns = stamp_ns - history.stamp_ns[world, a]
    if since_ns > wp.int64(0) and low < last:
        b = int((low + wp.int64(1)) % length)
        span_ns = history.stamp_ns[world, b] - history.stamp_ns[world, a]
        s = wp.float64(since_ns) / wp.float64(span_ns)
        h = wp.float64(span_ns) * wp.float64(1.0e-9)
        p0 = history.position[world, a]
        d0 = h * history.velocity[world, a]
        p1 = history.position[world, b]
        d1 = h * history.velocity[world, b]
        at.position = _hermite(p0, d0, p1, d1, s)
        at.velocity = _hermite_rate(p0, d0, p1, d1, s) / h
        phi = _rotation_vector(wp.quat_inverse(at.orientation) * history.orientation[world, b])
        begin = h * at.body_rate
        end = _vector_rate(phi, h * history.body_rate[world, b])
        turned = _hermite(wp.vec3d(), begin, phi, end, s)
        rate = _hermite_rate(wp.vec3d(), begin, phi, end, s) / h
        at.orientation = at.orientation * quaternion_exp(turned)
        # body rate of a rotation vector: the next term is phi^3 / 24
        cross = wp.cross(turned, rate)
        at.body_rate = rate - wp.float64(0.5) * cross + wp.cross(turned, cross) / wp.float64(6.0)
    return at
