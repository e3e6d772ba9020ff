# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""The exponential chart of SO(3): within a step the attitude is R = R_0 exp(u), and u' = dexp^-1_u(w).

Reference: Munthe-Kaas (1998), Runge-Kutta methods on Lie groups; Iserles, Munthe-Kaas, Norsett, Zanna (2000),
Lie-group methods, appendix B.
"""

import math

import warp as wp

_vec7d = wp.types.vector(length=7, dtype=wp.float64)
# Taylor coefficients in t^2, the highest first; what is left out is below 1e-16 for t < 1/2
_SINE_SERIES = wp.constant(_vec7d(*((-1.0) ** k / math.factorial(2 * k + 1) for k in range(6, -1, -1))))
_COSINE_SERIES = wp.constant(_vec7d(*((-1.0) ** k / math.factorial(2 * k + 2) for k in range(6, -1, -1))))
# (1 - t / 2 cot(t / 2)) / t^2 = sum of |B_2k| / (2k)! t^(2k - 2), B the Bernoulli numbers; next term 1e-17
_COTANGENT_SERIES = wp.constant(
    _vec7d(
        1.0 / 74724249600.0,
        691.0 / 1307674368000.0,
        1.0 / 47900160.0,
        1.0 / 1209600.0,
        1.0 / 30240.0,
        1.0 / 720.0,
        1.0 / 12.0,
    )
)


@wp.func
def rotation_series(u: wp.vec3d) -> wp.vec2d:
    """Return a = sin(t) / t and b = (1 - cos(t)) / t^2, t = |u|: exp(u) x = x + a u x x + b u x (u x x)."""
    t2 = wp.dot(u, u)
    a = wp.float64(0.0)
    b = wp.float64(0.0)
    for term in range(7):
        a = a * t2 + _SINE_SERIES[term]
        b = b * t2 + _COSINE_SERIES[term]
    if t2 > wp.float64(0.25):
        t = wp.sqrt(t2)
        a = wp.sin(t) / t
        b = (wp.float64(1.0) - wp.cos(t)) / t2
    return wp.vec2d(a, b)


@wp.func
def turned_back(u: wp.vec3d, series: wp.vec2d, x: wp.vec3d) -> wp.vec3d:
    """Return exp(-u) x; the series is that of u."""
    turn = wp.cross(u, x)
    return x - series[0] * turn + series[1] * wp.cross(u, turn)


@wp.func
def chart_rate_4(u: wp.vec3d, w: wp.vec3d) -> wp.vec3d:
    """Return dexp^-1_u(w) with as many terms as order 4 needs."""
    turn = wp.cross(u, w)
    return w + wp.float64(0.5) * turn + wp.cross(u, turn) / wp.float64(12.0)


@wp.func
def chart_rate(u: wp.vec3d, w: wp.vec3d) -> wp.vec3d:
    """Return dexp^-1_u(w) for |u| < 2 pi."""
    t2 = wp.dot(u, u)
    c = wp.float64(0.0)
    for term in range(7):
        c = c * t2 + _COTANGENT_SERIES[term]
    if t2 > wp.float64(0.25):
        half = wp.float64(0.5) * wp.sqrt(t2)
        c = (wp.float64(1.0) - half * wp.cos(half) / wp.sin(half)) / t2
    turn = wp.cross(u, w)
    return w + wp.float64(0.5) * turn + c * wp.cross(u, turn)
