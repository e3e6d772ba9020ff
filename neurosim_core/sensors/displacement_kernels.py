# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,valid-type,call-overload,assignment"
# ruff: noqa: UP018, RUF046  (typed literals have a meaning in kernels)
"""Kernels of adaptive sampling: probes that look for what moves, and how far it moves in the picture."""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from neurosim_core.frames import quaternion_exp

_FAR_M = wp.constant(1.0e9)
_Z_MIN = wp.constant(wp.float64(1.0e-6))
"""Least cosine to the optical axis of what counts as in front of the camera."""
_BORDER_PX = wp.constant(wp.float64(1.0e-6))
"""Rounding of a projection to the border of the picture."""


@wp.struct
class Pinhole:
    """A lens in pixels."""

    fx: wp.float64
    fy: wp.float64
    cx: wp.float64
    cy: wp.float64
    width: wp.float64
    height: wp.float64


@wp.struct
class Poses:
    """Poses T_WC of the camera at the ticks of a batch and one tick after each; row 0: at the last render."""

    p_WC: wp.array[wp.vec3d]
    q_WC: wp.array[wp.quatd]
    p_next_WC: wp.array[wp.vec3d]
    q_next_WC: wp.array[wp.quatd]


@wp.struct
class Bodies:
    """What moves by itself; empty if nothing does. Row 0: at the last render; a row more than in `Poses`."""

    mesh: wp.array[wp.uint64]  # Trees in the frames of the bodies, shape [B]
    corners: wp.array2d[wp.vec3d]  # Of the bounding boxes, in the frames of the bodies [m], shape [B, 8]
    p_WO: wp.array2d[wp.vec3d]  # Shape [row, B]
    q_WO: wp.array2d[wp.quatd]


@wp.kernel(enable_backward=False)
def load_poses(
    # Model:
    p_BC: wp.vec3d,
    q_BC: wp.quatd,
    # In:
    states: wp.array3d[wp.float64],
    slots: wp.array[int],
    step_s: wp.array[wp.float64],
    # Out:
    poses_out: Poses,
) -> None:
    """Write the poses of the camera at the ticks of a block and one tick later; threads are the ticks."""
    tick = wp.tid()
    slot = slots[tick]
    p_WB = wp.vec3d(states[slot, 0, 0], states[slot, 0, 1], states[slot, 0, 2])
    q_WB = wp.quatd(states[slot, 0, 3], states[slot, 0, 4], states[slot, 0, 5], states[slot, 0, 6])
    v_W = wp.vec3d(states[slot, 0, 7], states[slot, 0, 8], states[slot, 0, 9])
    w_B = wp.vec3d(states[slot, 0, 10], states[slot, 0, 11], states[slot, 0, 12])
    poses_out.p_WC[tick + 1] = p_WB + wp.quat_rotate(q_WB, p_BC)
    poses_out.q_WC[tick + 1] = q_WB * q_BC
    q_next_WB = q_WB * quaternion_exp(step_s[tick] * w_B)
    poses_out.p_next_WC[tick + 1] = p_WB + step_s[tick] * v_W + wp.quat_rotate(q_next_WB, p_BC)
    poses_out.q_next_WC[tick + 1] = q_next_WB * q_BC


@wp.func
def _probe_pixel(
    probe: int, columns: int, count: int, spacing: float, shift: wp.vec2, lens: Pinhole
) -> wp.vec2d:
    """Return where in the picture a probe looks [px]: the corners come last, after the grid."""
    corner = probe - count + 4
    if corner >= 0:
        return wp.vec2d(wp.float64(corner % 2) * lens.width, wp.float64(corner // 2) * lens.height)
    x = (float(probe % columns - 1) + shift[0]) * spacing
    y = (float(probe // columns - 1) + shift[1]) * spacing
    return wp.vec2d(wp.float64(x), wp.float64(y))


@wp.func
def _see(point: wp.vec4d, p_WC: wp.vec3d, q_WC: wp.quatd, lens: Pinhole) -> wp.vec3d:
    """Return column and row [px] of a point (x, y, z, 1) or a direction (x, y, z, 0), and 1 if in front."""
    ray = wp.quat_rotate_inv(q_WC, wp.vec3d(point[0], point[1], point[2]) - point[3] * p_WC)
    if ray[2] <= _Z_MIN * wp.length(ray):
        return wp.vec3d(wp.float64(0.0))
    return wp.vec3d(lens.fx * ray[0] / ray[2] + lens.cx, lens.fy * ray[1] / ray[2] + lens.cy, wp.float64(1.0))


@wp.func
def _in_picture(seen: wp.vec3d, lens: Pinhole) -> bool:
    return (
        seen[2] > wp.float64(0.0)
        and seen[0] >= -_BORDER_PX
        and seen[0] <= lens.width + _BORDER_PX
        and seen[1] >= -_BORDER_PX
        and seen[1] <= lens.height + _BORDER_PX
    )


@wp.func
def _distance(before: wp.vec3d, after: wp.vec3d) -> float:
    """Return how far a point moved in the picture [px]: inf to or from behind the camera."""
    if before[2] == wp.float64(0.0) or after[2] == wp.float64(0.0):
        return float(wp.inf)
    return float(wp.length(wp.vec2d(after[0] - before[0], after[1] - before[1])))


@wp.func
def _point_of(body: int, row: int, point: wp.vec4d, bodies: Bodies) -> wp.vec4d:
    """Return a point in W, given in W (body -1) or in the frame of a body."""
    if body < 0:
        return point
    p_W = bodies.p_WO[row, body] + wp.quat_rotate(
        bodies.q_WO[row, body], wp.vec3d(point[0], point[1], point[2])
    )
    return wp.vec4d(p_W[0], p_W[1], p_W[2], wp.float64(1.0))


@wp.func
def _near_picture(seen: wp.vec3d, lens: Pinhole) -> bool:
    """Whether a point is in the picture, or no further outside of it than the picture is large."""
    return (
        seen[2] > wp.float64(0.0)
        and wp.abs(seen[0] - wp.float64(0.5) * lens.width) <= wp.float64(1.5) * lens.width
        and wp.abs(seen[1] - wp.float64(0.5) * lens.height) <= wp.float64(1.5) * lens.height
    )


@wp.func
def _box_in_picture(
    body: int, row: int, p_WC: wp.vec3d, q_WC: wp.quatd, bodies: Bodies, lens: Pinhole
) -> bool:
    """Whether the box around the corners of a body overlaps the picture, or reaches behind the camera."""
    low = wp.vec2d(wp.float64(wp.inf))
    high = wp.vec2d(-wp.float64(wp.inf))
    front = int(0)
    for corner in range(8):
        p_O = bodies.corners[body, corner]
        point = wp.vec4d(p_O[0], p_O[1], p_O[2], wp.float64(1.0))
        seen = _see(_point_of(body, row, point, bodies), p_WC, q_WC, lens)
        if seen[2] > wp.float64(0.0):
            front += 1
            low = wp.min(low, wp.vec2d(seen[0], seen[1]))
            high = wp.max(high, wp.vec2d(seen[0], seen[1]))
    overlaps = (
        low[0] <= lens.width
        and high[0] >= wp.float64(0.0)
        and low[1] <= lens.height
        and high[1] >= wp.float64(0.0)
    )
    return overlaps or (front > 0 and front < 8)


@wp.kernel(enable_backward=False)
def compare_bodies(
    first: int,
    # Model:
    lens: Pinhole,
    # In:
    first_row: int,
    first_tick: int,
    tick_count: int,
    poses: Poses,
    bodies: Bodies,
    # In/out:
    moved: wp.array2d[float],
) -> None:
    """Raise `moved` to how far the corners of bodies move from a row to the tick after another."""
    index = first + wp.tid()
    body = index % bodies.mesh.shape[0]
    tick = first_tick + index // bodies.mesh.shape[0] % tick_count
    row = first_row + index // bodies.mesh.shape[0] // tick_count
    if tick < row:
        return
    p_WC = poses.p_WC[row]
    q_WC = poses.q_WC[row]
    p_next_WC = poses.p_next_WC[tick]
    q_next_WC = poses.q_next_WC[tick]
    if not (
        _box_in_picture(body, row, p_WC, q_WC, bodies, lens)
        or _box_in_picture(body, tick + 1, p_next_WC, q_next_WC, bodies, lens)
    ):
        return
    most = float(0.0)
    for corner in range(8):
        p_O = bodies.corners[body, corner]
        point = wp.vec4d(p_O[0], p_O[1], p_O[2], wp.float64(1.0))
        before = _see(_point_of(body, row, point, bodies), p_WC, q_WC, lens)
        after = _see(_point_of(body, tick + 1, point, bodies), p_next_WC, q_next_WC, lens)
        if _near_picture(before, lens) or _near_picture(after, lens):
            most = wp.max(most, _distance(before, after))
    wp.atomic_max(moved, row, tick, most)


class _Kernels(NamedTuple):
    """The kernels for a scene with or without bodies."""

    cast: Any
    compare: Any


@cache
def rule_kernels(moving: bool) -> _Kernels:
    """Return the kernels that cast probes and compare them, with or without moving bodies."""

    @wp.kernel(module="unique", enable_backward=False)
    def cast_probes(
        first: int,
        # Model:
        mesh: wp.uint64,
        lens: Pinhole,
        columns: int,
        spacing: float,
        # In:
        first_row: int,
        poses: Poses,
        bodies: Bodies,
        shifts: wp.array[wp.vec2],
        # Out:
        points_out: wp.array2d[wp.vec4d],
        seen_out: wp.array2d[wp.vec3d],
        owner_out: wp.array2d[int],
    ) -> None:
        index = first + wp.tid()
        count = points_out.shape[1]
        row = first_row + index // count
        probe = index % count
        pixel = _probe_pixel(probe, columns, count, spacing, shifts[row], lens)
        ray_C = wp.vec3d((pixel[0] - lens.cx) / lens.fx, (pixel[1] - lens.cy) / lens.fy, wp.float64(1.0))
        ray = wp.quat_rotate(poses.q_WC[row], wp.normalize(ray_C))
        origin = poses.p_WC[row]
        query = wp.mesh_query_ray(mesh, wp.vec3(origin), wp.vec3(ray), _FAR_M)
        point = wp.vec4d(ray[0], ray[1], ray[2], wp.float64(0.0))
        nearest = float(_FAR_M)
        if query.result:
            nearest = query.t
            p_W = origin + wp.float64(nearest) * ray
            point = wp.vec4d(p_W[0], p_W[1], p_W[2], wp.float64(1.0))
        if wp.static(moving):
            owner = int(-1)
            for body in range(bodies.mesh.shape[0]):
                q_WO = bodies.q_WO[row, body]
                origin_O = wp.quat_rotate_inv(q_WO, origin - bodies.p_WO[row, body])
                ray_O = wp.quat_rotate_inv(q_WO, ray)
                hit = wp.mesh_query_ray(bodies.mesh[body], wp.vec3(origin_O), wp.vec3(ray_O), nearest)
                if hit.result:
                    nearest = hit.t
                    p_O = origin_O + wp.float64(nearest) * ray_O
                    point = wp.vec4d(p_O[0], p_O[1], p_O[2], wp.float64(1.0))
                    owner = body
            owner_out[row, probe] = owner
            points_out[row, probe] = point
            point = _point_of(owner, row, point, bodies)
        else:
            points_out[row, probe] = point
        seen_out[row, probe] = _see(point, origin, poses.q_WC[row], lens)

    @wp.kernel(module="unique", enable_backward=False)
    def compare(
        first: int,
        # Model:
        lens: Pinhole,
        # In:
        first_row: int,
        first_tick: int,
        tick_count: int,
        chunk: int,
        poses: Poses,
        bodies: Bodies,
        points: wp.array2d[wp.vec4d],
        seen: wp.array2d[wp.vec3d],
        owner: wp.array2d[int],
        # In/out:
        moved: wp.array2d[float],
    ) -> None:
        index = first + wp.tid()
        probes = points.shape[1]
        chunks = (probes + chunk - 1) // chunk
        begin = (index % chunks) * chunk
        tick = first_tick + index // chunks % tick_count
        row = first_row + index // chunks // tick_count
        if tick < row:
            return
        most = float(0.0)
        for probe in range(begin, wp.min(begin + chunk, probes)):
            point = points[row, probe]
            if wp.static(moving):
                point = _point_of(owner[row, probe], tick + 1, point, bodies)
            before = seen[row, probe]
            after = _see(point, poses.p_next_WC[tick], poses.q_next_WC[tick], lens)
            if _in_picture(before, lens) or _in_picture(after, lens):
                most = wp.max(most, _distance(before, after))
        wp.atomic_max(moved, row, tick, most)

    return _Kernels(cast_probes, compare)


@wp.kernel(enable_backward=False)
def carry_row(
    # In:
    row: int,
    # In/out:
    poses: Poses,
    points: wp.array2d[wp.vec4d],
    seen: wp.array2d[wp.vec3d],
    owner: wp.array2d[int],
) -> None:
    """Copy what was seen in a row to row 0: the last render of the next block; threads are the probes."""
    probe = wp.tid()
    points[0, probe] = points[row, probe]
    seen[0, probe] = seen[row, probe]
    if owner.shape[0] > 0:
        owner[0, probe] = owner[row, probe]
    if probe == 0:
        poses.p_WC[0] = poses.p_WC[row]
        poses.q_WC[0] = poses.q_WC[row]
