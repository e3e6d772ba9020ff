# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,valid-type,call-overload,assignment"
# ruff: noqa: UP018, RUF046  (typed literals have a meaning in kernels)
"""Kernels of adaptive sampling: probes that look for what moves, and how far it moves in the picture."""

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
class Rule:
    """What kernels share. Rows are the ticks of a block; row 0 is the last render before it."""

    lens: Pinhole
    mesh: wp.uint64
    columns: int  # Of the grid of probes
    spacing: float  # [px]
    shifts: wp.array[wp.vec2]  # Of the grid, shape [row]
    # Poses T_WC of the camera, and one tick after each, shape [row]:
    p_WC: wp.array[wp.vec3d]
    q_WC: wp.array[wp.quatd]
    p_next_WC: wp.array[wp.vec3d]
    q_next_WC: wp.array[wp.quatd]
    # Of each probe, shape [row, probe]:
    points: wp.array2d[wp.vec4d]  # What it hits, in W or in the frame of a body
    seen: wp.array2d[wp.vec3d]  # Where in the picture that is
    owner: wp.array2d[int]  # Which body it is, -1: none
    # What moves by itself, B bodies; in their poses there is a row more:
    body_mesh: wp.array[wp.uint64]  # Trees in the frames of the bodies, shape [B]
    corners: wp.array2d[wp.vec3d]  # Of the bounding boxes, in the frames of the bodies [m], shape [B, 8]
    p_WO: wp.array2d[wp.vec3d]  # Shape [row, B]
    q_WO: wp.array2d[wp.quatd]
    moved: wp.array2d[float]
    """How far something moves from a render in a row to the tick after another [px], shape [row, row]."""


@wp.kernel(enable_backward=False)
def load_poses(
    # Model:
    p_BC: wp.vec3d,
    q_BC: wp.quatd,
    # In:
    states: wp.array3d[wp.float64],
    slots: wp.array[int],
    step_s: wp.array[wp.float64],
    # In/out:
    rule: Rule,
) -> None:
    """Write the poses of the camera at the ticks of a block and one tick later; threads are the ticks."""
    tick = wp.tid()
    slot = slots[tick]
    p_WB = wp.vec3d(states[slot, 0, 0], states[slot, 0, 1], states[slot, 0, 2])
    q_WB = wp.quatd(states[slot, 0, 3], states[slot, 0, 4], states[slot, 0, 5], states[slot, 0, 6])
    v_W = wp.vec3d(states[slot, 0, 7], states[slot, 0, 8], states[slot, 0, 9])
    w_B = wp.vec3d(states[slot, 0, 10], states[slot, 0, 11], states[slot, 0, 12])
    rule.p_WC[tick + 1] = p_WB + wp.quat_rotate(q_WB, p_BC)
    rule.q_WC[tick + 1] = q_WB * q_BC
    q_next_WB = q_WB * quaternion_exp(step_s[tick] * w_B)
    rule.p_next_WC[tick + 1] = p_WB + step_s[tick] * v_W + wp.quat_rotate(q_next_WB, p_BC)
    rule.q_next_WC[tick + 1] = q_next_WB * q_BC


@wp.func
def _probe_pixel(rule: Rule, row: int, probe: int) -> wp.vec2d:
    """Return where in the picture a probe looks [px]: the corners come last, after the grid."""
    corner = probe - rule.points.shape[1] + 4
    if corner >= 0:
        return wp.vec2d(wp.float64(corner % 2) * rule.lens.width, wp.float64(corner // 2) * rule.lens.height)
    x = (float(probe % rule.columns - 1) + rule.shifts[row][0]) * rule.spacing
    y = (float(probe // rule.columns - 1) + rule.shifts[row][1]) * rule.spacing
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
def _point_of(rule: Rule, body: int, row: int, point: wp.vec4d) -> wp.vec4d:
    """Return a point in W, given in W (body -1) or in the frame of a body."""
    if body < 0:
        return point
    turned = wp.quat_rotate(rule.q_WO[row, body], wp.vec3d(point[0], point[1], point[2]))
    p_W = rule.p_WO[row, body] + turned
    return wp.vec4d(p_W[0], p_W[1], p_W[2], wp.float64(1.0))


@wp.func
def _see_corner(rule: Rule, body: int, corner: int, row: int, p_WC: wp.vec3d, q_WC: wp.quatd) -> wp.vec3d:
    """Return where the corner of the box of a body is in the picture; see `_see`."""
    p_O = rule.corners[body, corner]
    point = wp.vec4d(p_O[0], p_O[1], p_O[2], wp.float64(1.0))
    return _see(_point_of(rule, body, row, point), p_WC, q_WC, rule.lens)


@wp.func
def _near_picture(seen: wp.vec3d, lens: Pinhole) -> bool:
    """Whether a point is in the picture, or no further outside of it than the picture is large."""
    return (
        seen[2] > wp.float64(0.0)
        and wp.abs(seen[0] - wp.float64(0.5) * lens.width) <= wp.float64(1.5) * lens.width
        and wp.abs(seen[1] - wp.float64(0.5) * lens.height) <= wp.float64(1.5) * lens.height
    )


@wp.func
def _box_in_picture(rule: Rule, body: int, row: int, p_WC: wp.vec3d, q_WC: wp.quatd) -> bool:
    """Whether the box around the corners of a body overlaps the picture, or reaches behind the camera."""
    low = wp.vec2d(wp.float64(wp.inf))
    high = wp.vec2d(-wp.float64(wp.inf))
    front = int(0)
    for corner in range(8):
        seen = _see_corner(rule, body, corner, row, p_WC, q_WC)
        if seen[2] > wp.float64(0.0):
            front += 1
            low = wp.min(low, wp.vec2d(seen[0], seen[1]))
            high = wp.max(high, wp.vec2d(seen[0], seen[1]))
    overlaps = (
        low[0] <= rule.lens.width
        and high[0] >= wp.float64(0.0)
        and low[1] <= rule.lens.height
        and high[1] >= wp.float64(0.0)
    )
    return overlaps or (front > 0 and front < 8)


@wp.kernel(enable_backward=False)
def compare_bodies(
    first: int,
    # In:
    first_row: int,
    first_tick: int,
    tick_count: int,
    # In/out:
    rule: Rule,
) -> None:
    """Raise `moved` to how far the corners of bodies move from a row to the tick after another."""
    index = first + wp.tid()
    body = index % rule.body_mesh.shape[0]
    tick = first_tick + index // rule.body_mesh.shape[0] % tick_count
    row = first_row + index // rule.body_mesh.shape[0] // tick_count
    if tick < row:
        return
    p_WC = rule.p_WC[row]
    q_WC = rule.q_WC[row]
    p_next_WC = rule.p_next_WC[tick]
    q_next_WC = rule.q_next_WC[tick]
    if not (
        _box_in_picture(rule, body, row, p_WC, q_WC)
        or _box_in_picture(rule, body, tick + 1, p_next_WC, q_next_WC)
    ):
        return
    most = float(0.0)
    for corner in range(8):
        before = _see_corner(rule, body, corner, row, p_WC, q_WC)
        after = _see_corner(rule, body, corner, tick + 1, p_next_WC, q_next_WC)
        if _near_picture(before, rule.lens) or _near_picture(after, rule.lens):
            most = wp.max(most, _distance(before, after))
    wp.atomic_max(rule.moved, row, tick, most)


@wp.kernel(enable_backward=False)
def cast_probes(
    first: int,
    # In:
    first_row: int,
    # In/out:
    rule: Rule,
) -> None:
    """Find what probes hit from the poses of some rows; threads are [row, probe]."""
    index = first + wp.tid()
    row = first_row + index // rule.points.shape[1]
    probe = index % rule.points.shape[1]
    lens = rule.lens
    pixel = _probe_pixel(rule, row, probe)
    ray_C = wp.vec3d((pixel[0] - lens.cx) / lens.fx, (pixel[1] - lens.cy) / lens.fy, wp.float64(1.0))
    ray = wp.quat_rotate(rule.q_WC[row], wp.normalize(ray_C))
    origin = rule.p_WC[row]
    query = wp.mesh_query_ray(rule.mesh, wp.vec3(origin), wp.vec3(ray), _FAR_M)
    point = wp.vec4d(ray[0], ray[1], ray[2], wp.float64(0.0))
    nearest = float(_FAR_M)
    if query.result:
        nearest = query.t
        p_W = origin + wp.float64(nearest) * ray
        point = wp.vec4d(p_W[0], p_W[1], p_W[2], wp.float64(1.0))
    owner = int(-1)
    for body in range(rule.body_mesh.shape[0]):
        q_WO = rule.q_WO[row, body]
        origin_O = wp.quat_rotate_inv(q_WO, origin - rule.p_WO[row, body])
        ray_O = wp.quat_rotate_inv(q_WO, ray)
        hit = wp.mesh_query_ray(rule.body_mesh[body], wp.vec3(origin_O), wp.vec3(ray_O), nearest)
        if hit.result:
            nearest = hit.t
            p_O = origin_O + wp.float64(nearest) * ray_O
            point = wp.vec4d(p_O[0], p_O[1], p_O[2], wp.float64(1.0))
            owner = body
    rule.owner[row, probe] = owner
    rule.points[row, probe] = point
    rule.seen[row, probe] = _see(_point_of(rule, owner, row, point), origin, rule.q_WC[row], lens)


@wp.kernel(enable_backward=False)
def compare_probes(
    first: int,
    # In:
    first_row: int,
    first_tick: int,
    tick_count: int,
    chunk: int,
    # In/out:
    rule: Rule,
) -> None:
    """Raise `moved` to how far what probes hit moves from a row to the tick after another."""
    index = first + wp.tid()
    probes = rule.points.shape[1]
    chunks = (probes + chunk - 1) // chunk
    begin = (index % chunks) * chunk
    tick = first_tick + index // chunks % tick_count
    row = first_row + index // chunks // tick_count
    if tick < row:
        return
    most = float(0.0)
    for probe in range(begin, wp.min(begin + chunk, probes)):
        point = _point_of(rule, rule.owner[row, probe], tick + 1, rule.points[row, probe])
        before = rule.seen[row, probe]
        after = _see(point, rule.p_next_WC[tick], rule.q_next_WC[tick], rule.lens)
        if _in_picture(before, rule.lens) or _in_picture(after, rule.lens):
            most = wp.max(most, _distance(before, after))
    wp.atomic_max(rule.moved, row, tick, most)


@wp.kernel(enable_backward=False)
def carry_row(
    # In:
    row: int,
    # In/out:
    rule: Rule,
) -> None:
    """Copy what was seen in a row to row 0: the last render of the next block; threads are the probes."""
    probe = wp.tid()
    rule.points[0, probe] = rule.points[row, probe]
    rule.seen[0, probe] = rule.seen[row, probe]
    rule.owner[0, probe] = rule.owner[row, probe]
    if probe == 0:
        rule.p_WC[0] = rule.p_WC[row]
        rule.q_WC[0] = rule.q_WC[row]
