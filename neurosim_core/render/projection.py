# mypy: disable-error-code="index,attr-defined,operator,arg-type,no-untyped-def,call-overload,return-value"
# mypy: disable-error-code="assignment,valid-type"
"""Projection of points into the picture of a lens, on the device: the models of `lenses.py`."""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

import math
from functools import cache
from typing import Any

import numpy as np
import scipy  # which imports its parts when they are used
import warp as wp

from neurosim_core.render.camera import Lens, PinholeConfig
from neurosim_core.render.lenses import (
    DoubleSphereConfig,
    EquidistantConfig,
    RadtanConfig,
    RationalConfig,
    RayTableConfig,
)

_GUESSES = wp.constant(64)
"""Directions along each axis for which the pixel is known where the search in a table of rays begins."""
_SEARCH_STEPS = wp.constant(20)

_STEP = wp.constant(wp.float64(1.0e-4))
_coefficients = wp.types.vector(length=8, dtype=wp.float64)


@wp.struct
class LensData:
    """A lens on a device."""

    fx: wp.float64
    fy: wp.float64
    cx: wp.float64
    cy: wp.float64
    k: _coefficients
    """Polynomials: k1, k2, p1, p2, k3, k4, k5, k6; equidistant: k1 to k4; double sphere: xi, alpha, w2."""
    limit: wp.float64  # Polynomials: largest sqrt(x^2 + y^2) / z; else the largest angle from the axis [rad]
    table: wp.array2d[wp.vec3d]  # Of a ray table: the unit rays of the pixels; nan: none
    guess: wp.array2d[wp.vec2]
    """Of a ray table: column and row of the pixel that looks about where a direction does [px]."""


def make_lens_data(lens: Lens, device: Any = "cpu") -> Any:
    """Return a lens, one of `lenses.AnyLens`, for the function that `projector` makes of its kind.

    Raises:
        ValueError: The lens does not say where points are.
    """
    data = LensData()
    if isinstance(lens, RayTableConfig):
        return _make_table(data, lens, device)
    if not isinstance(
        lens, PinholeConfig | RadtanConfig | RationalConfig | EquidistantConfig | DoubleSphereConfig
    ):
        raise ValueError(f"a lens of type {type(lens).__name__} does not project points")
    data.fx, data.fy, data.cx, data.cy = lens.intrinsics()
    given = list(lens.distortion_coefficients)
    data.limit = math.inf
    if isinstance(lens, RadtanConfig | RationalConfig):
        data.limit = float(lens._rising[0][-1])
    elif isinstance(lens, EquidistantConfig):
        data.limit = float(lens._rising[-1])
    elif isinstance(lens, DoubleSphereConfig):
        w1 = lens.alpha / (1.0 - lens.alpha) if lens.alpha <= 0.5 else (1.0 - lens.alpha) / lens.alpha
        given.append((w1 + lens.xi) / math.sqrt(2.0 * w1 * lens.xi + lens.xi**2 + 1.0))
        data.limit = lens.angle_max_rad
    data.k = _coefficients(*given, *(0.0 for _ in range(8 - len(given))))
    return data


def _make_table(data: Any, lens: RayTableConfig, device: Any) -> Any:
    """Set the rays of a table, and for directions evenly around the axis the pixel that is next to each."""
    if min(lens.width, lens.height) < 2:
        raise ValueError(f"a ray_table of {lens.width} x {lens.height} rays does not project points")
    rays = lens.directions()
    row, col = np.nonzero(np.isfinite(rays).all(axis=-1))
    known = rays[row, col]
    angle = np.arctan2(np.hypot(known[:, 0], known[:, 1]), known[:, 2])
    data.fx = data.fy = 1.0
    data.limit = min(math.pi, 1.05 * float(angle.max()) + 1e-3)
    a = np.linspace(-data.limit, data.limit, int(_GUESSES))
    x, y = np.meshgrid(a, a)
    size = np.hypot(x, y)
    scale = np.sin(size) / np.where(size > 0.0, size, 1.0)
    _, nearest = scipy.spatial.KDTree(known).query(np.stack([x * scale, y * scale, np.cos(size)], axis=-1))
    places = np.stack([col[nearest], row[nearest]], axis=-1) + 0.5
    data.table = wp.array(rays, dtype=wp.vec3d, device=device)
    data.guess = wp.array(places.astype(np.float32), dtype=wp.vec2, device=device)
    return data


@cache
def projector(kind: str) -> wp.Function:
    """Return the function that projects a point in C: (column, row) [px] and 1; zeros: it is not seen.

    Its parameters: `LensData`, and the position of the point, or its direction.
    """
    distort = {
        "pinhole": _pinhole,
        "radtan": _polynomial,
        "rational": _polynomial,
        "equidistant": _equidistant,
        "double_sphere": _double_sphere,
        "ray_table": _look_up,
    }[kind]

    @wp.func
    def project(lens: LensData, p: wp.vec3d) -> wp.vec3d:
        d = distort(lens, p)
        if d[2] == wp.float64(0.0):
            return wp.vec3d()
        return wp.vec3d(lens.fx * d[0] + lens.cx, lens.fy * d[1] + lens.cy, wp.float64(1.0))

    return project


@cache
def velocity_projector(kind: str) -> wp.Function:
    """Return the function that gives the velocity in the picture [px/s] of a point in C, and 1; 0: not seen.

    By central differences over 1e-4 of the distance, in float64: to 1e-7 of the velocity. Its parameters:
    `LensData`; position of the point [m], or its direction; its velocity [m/s].
    """
    project = projector(kind)

    @wp.func
    def project_velocity(lens: LensData, p: wp.vec3d, v: wp.vec3d) -> wp.vec3d:
        speed = wp.length(v)
        if speed == wp.float64(0.0):
            return wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
        step_s = _STEP * wp.length(p) / speed
        a = project(lens, p - step_s * v)
        b = project(lens, p + step_s * v)
        if a[2] * b[2] == wp.float64(0.0):
            return wp.vec3d()
        rate = (b - a) / (wp.float64(2.0) * step_s)
        return wp.vec3d(rate[0], rate[1], wp.float64(1.0))

    return project_velocity


@wp.func
def _pinhole(lens: LensData, p: wp.vec3d) -> wp.vec3d:
    if p[2] <= wp.float64(0.0):
        return wp.vec3d()
    nearness = wp.float64(1.0) / p[2]
    return wp.vec3d(nearness * p[0], nearness * p[1], wp.float64(1.0))


@wp.func
def _polynomial(lens: LensData, p: wp.vec3d) -> wp.vec3d:
    one, two = wp.float64(1.0), wp.float64(2.0)
    if p[2] <= wp.float64(0.0):
        return wp.vec3d()
    x = p[0] / p[2]
    y = p[1] / p[2]
    r2 = x * x + y * y
    if r2 > lens.limit * lens.limit:
        return wp.vec3d()
    k = lens.k
    g = (one + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (one + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    return wp.vec3d(
        x * g + two * k[2] * x * y + k[3] * (r2 + two * x * x),
        y * g + k[2] * (r2 + two * y * y) + two * k[3] * x * y,
        one,
    )


@wp.func
def _equidistant(lens: LensData, p: wp.vec3d) -> wp.vec3d:
    size = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    a = wp.atan2(size, p[2])
    if a > lens.limit:
        return wp.vec3d()
    a2 = a * a
    k = lens.k
    r = a * (wp.float64(1.0) + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
    if size > wp.float64(0.0):
        r = r / size
    return wp.vec3d(p[0] * r, p[1] * r, wp.float64(1.0))


@wp.func
def _double_sphere(lens: LensData, p: wp.vec3d) -> wp.vec3d:
    xi = lens.k[0]
    alpha = lens.k[1]
    beside = p[0] * p[0] + p[1] * p[1]
    d1 = wp.length(p)
    if p[2] <= -lens.k[2] * d1 or wp.atan2(wp.sqrt(beside), p[2]) > lens.limit:
        return wp.vec3d()
    shifted = xi * d1 + p[2]
    scale = alpha * wp.sqrt(beside + shifted * shifted) + (wp.float64(1.0) - alpha) * shifted
    return wp.vec3d(p[0] / scale, p[1] / scale, wp.float64(1.0))


@wp.func
def _look_up(lens: LensData, p: wp.vec3d) -> wp.vec3d:
    """Find the point of the picture whose interpolated ray goes to a point, by Newton's method.

    Rays are interpolated between centres as `RayTableConfig.rays` does it. What is more than a pixel outside
    the picture is not found.
    """
    d = wp.normalize(p)
    angle = wp.atan2(wp.sqrt(d[0] * d[0] + d[1] * d[1]), d[2])
    if not (angle <= lens.limit):
        return wp.vec3d()
    scale = angle / wp.max(wp.sin(angle), wp.float64(1.0e-12))
    cells = wp.float64(_GUESSES - 1) / (wp.float64(2.0) * lens.limit)
    across = int(wp.rint((scale * d[0] + lens.limit) * cells))
    down = int(wp.rint((scale * d[1] + lens.limit) * cells))
    begin = lens.guess[wp.clamp(down, 0, _GUESSES - 1), wp.clamp(across, 0, _GUESSES - 1)]
    u = wp.float64(begin[0])
    v = wp.float64(begin[1])
    width = lens.table.shape[1]
    height = lens.table.shape[0]
    half = wp.float64(0.5)
    one = wp.float64(1.0)
    for _ in range(_SEARCH_STEPS):
        col = wp.clamp(int(wp.floor(u - half)), 0, width - 2)
        row = wp.clamp(int(wp.floor(v - half)), 0, height - 2)
        x = u - half - wp.float64(col)
        y = v - half - wp.float64(row)
        a = lens.table[row, col]
        right = lens.table[row, col + 1] - a
        below = lens.table[row + 1, col] - a
        bent = lens.table[row + 1, col + 1] - a - right - below
        ray = a + x * right + y * below + (x * y) * bent
        du = right + y * bent
        dv = below + x * bent
        # where ray + a du + b dv is along d
        step = wp.inverse(wp.matrix_from_cols(du, dv, d)) * ray
        u = wp.clamp(u - step[0], -one, wp.float64(width) + one)
        v = wp.clamp(v - step[1], -one, wp.float64(height) + one)
        if wp.abs(step[0]) + wp.abs(step[1]) < wp.float64(1.0e-9):
            if wp.dot(ray, d) > wp.float64(0.0):
                return wp.vec3d(u, v, one)
            return wp.vec3d()
    return wp.vec3d()
