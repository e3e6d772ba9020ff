# mypy: disable-error-code="index,attr-defined,no-any-return,operator,arg-type,no-untyped-def,call-overload"
# mypy: disable-error-code="return-value,assignment,valid-type,untyped-decorator,no-untyped-call"

"""Where points are in the picture of a lens, on the device: the models of `lenses.py`."""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

import math
from functools import cache
from typing import Any

import warp as wp

from neurosim_core.render.camera import Lens, PinholeConfig
from neurosim_core.render.lenses import DoubleSphereConfig, EquidistantConfig, RadtanConfig, RationalConfig

PROJECTED = ("pinhole", "radtan", "rational", "equidistant", "double_sphere")
"""Kinds of lenses that project points."""

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
    limit: wp.float64
    """Polynomials: largest sqrt(x^2 + y^2) / z; else the largest angle from the axis [rad]."""


def make_lens_data(lens: Lens) -> Any:
    """Return a lens for the function that `projector` makes of its kind.

    Raises:
        ValueError: The lens is a table of rays: it does not say where points are.
    """
    data = LensData()
    if not isinstance(
        lens, PinholeConfig | RadtanConfig | RationalConfig | EquidistantConfig | DoubleSphereConfig
    ):
        kind = getattr(lens, "kind", type(lens).__name__)
        raise ValueError(f"a lens of kind {kind} does not project points: take one of {', '.join(PROJECTED)}")
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
    return wp.vec3d(p[0] / p[2], p[1] / p[2], wp.float64(1.0))


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
