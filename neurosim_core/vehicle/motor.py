# mypy: disable-error-code="no-untyped-def,operator"
"""Rotor speed dynamics: a first-order lag towards the command, in closed form.

With a command c held over a step of h seconds, Omega(s) = c + (Omega_0 - c) exp(-z s), s = t / h in [0, 1]
and z = h / tau. The motor therefore leaves the differential equation. What the Runge-Kutta stages at s = 0,
1/2, 1 see is not the exponential itself but its best quadratic approximation on [0, 1] (L2 projection): the
impulse, and the first two moments of thrust and torque, are then exact for every tau including 0, and the
order stays 4 where the lag is resolved. Values of the exponential at the stages would be stable too, but of
order 1 for tau << h.
"""

import math
from typing import NamedTuple

import warp as wp

_SERIES_BELOW = 0.3
"""Below, the closed forms of the moments cancel; 14 terms of the series are exact to rounding there."""
_RATE_MAX_1_S = 1e300  # so that rate t is 0 at t = 0 also for tau = 0


class LagConstants(NamedTuple):
    """Coefficients of the lag for a step of given length."""

    speed_nodes: tuple[float, float, float]
    """exp(-z s) projected on quadratics, at s = 0, 1/2, 1: weights of Omega_0 - c in Omega."""
    square_nodes: tuple[float, float, float]
    """exp(-2 z s) projected likewise: weights of (Omega_0 - c)^2 in Omega^2."""
    decay: float
    """exp(-z): what is left of Omega_0 - c after the step."""
    rate_1_s: float
    """1 / tau [1/s], finite: Omega_0 - c decays with exp(-rate t)."""


def lag_constants(step_s: float, time_constant_s: float) -> LagConstants:
    """Return the constants of one step; a time constant of 0 means that the speed follows at once.

    Raises:
        ValueError: The step is not positive, the time constant negative, or one of them not finite.
    """
    if not 0.0 < step_s < math.inf:
        raise ValueError(f"step_s must be > 0 and finite, got {step_s}")
    if not 0.0 <= time_constant_s < math.inf:
        raise ValueError(f"time_constant_s must be >= 0 and finite, got {time_constant_s}")
    z = step_s / time_constant_s if time_constant_s > 0.0 else math.inf
    rate_1_s = min(z / step_s, _RATE_MAX_1_S)
    return LagConstants(_projected_exponential(z), _projected_exponential(2.0 * z), math.exp(-z), rate_1_s)


def _projected_exponential(z: float) -> tuple[float, float, float]:
    """Values at s = 0, 1/2, 1 of the L2 projection of exp(-z s) on quadratics over [0, 1]."""
    m0, m1, m2 = _moments(z)
    # coefficients of the shifted Legendre polynomials 1, 2s - 1, 6s^2 - 6s + 1
    a0, a1, a2 = m0, 3.0 * (2.0 * m1 - m0), 5.0 * (6.0 * m2 - 6.0 * m1 + m0)
    return (a0 - a1 + a2, a0 - 0.5 * a2, a0 + a1 + a2)


def _moments(z: float) -> tuple[float, float, float]:
    """Integrals of s^n exp(-z s) over [0, 1], n = 0, 1, 2."""
    if z < _SERIES_BELOW:
        terms = [(-z) ** k / math.factorial(k) for k in range(14)]
        m0, m1, m2 = (sum(term / (k + n + 1) for k, term in enumerate(terms)) for n in range(3))
        return m0, m1, m2
    if math.isinf(z):
        return 0.0, 0.0, 0.0
    rest = math.exp(-z)
    m0 = -math.expm1(-z) / z
    m1 = (m0 - rest) / z
    return m0, m1, (2.0 * m1 - rest) / z


@wp.func
def projected_exponential(z: wp.float64) -> wp.vec3d:
    """Return what `lag_constants` has as nodes for z = h / tau or 2 h / tau, on the device."""
    one = wp.float64(1.0)
    m0 = wp.float64(0.0)
    m1 = wp.float64(0.0)
    m2 = wp.float64(0.0)
    if z < one:  # the closed forms cancel
        term = one
        for k in range(20):
            m0 += term / wp.float64(k + 1)
            m1 += term / wp.float64(k + 2)
            m2 += term / wp.float64(k + 3)
            term *= -z / wp.float64(k + 1)
    else:
        rest = wp.exp(-z)
        m0 = (one - rest) / z
        m1 = (m0 - rest) / z
        m2 = (wp.float64(2.0) * m1 - rest) / z
    a1 = wp.float64(3.0) * (wp.float64(2.0) * m1 - m0)
    a2 = wp.float64(5.0) * (wp.float64(6.0) * (m2 - m1) + m0)
    return wp.vec3d(m0 - a1 + a2, m0 - wp.float64(0.5) * a2, m0 + a1 + a2)
