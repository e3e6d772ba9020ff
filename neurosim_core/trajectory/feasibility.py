"""Paths that a vehicle can follow: proven bounds of speed, thrust and tilt rate, and a time scale that fits.

Bounds come from Bernstein control points: a polynomial stays in the convex hull of its control points, so the
largest control point bounds it everywhere, not at samples only. Pieces are cut into parts first, where the
hull is tight (its excess falls with the square of the part's length). They are upper bounds up to float64
rounding.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.settings import BaseConfig
from neurosim_core.trajectory.path import Path, restriction

Array = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
_PARTS = 16
"""Parts a piece is cut into for its bounds."""


class FlightLimits(BaseConfig):
    """Limits of what a path asks of the vehicle; they hold everywhere on the path."""

    speed_max_m_s: float = Field(default=3.0, gt=0.0, le=200.0)
    """Largest speed [m/s]."""
    thrust_to_weight_max: float = Field(default=1.6, gt=1.0)
    """Largest thrust as a multiple of the weight."""
    thrust_to_weight_min: float = Field(default=0.4, ge=0.0, lt=1.0)
    """Smallest vertical part of the thrust as a multiple of the weight; keeps the vehicle upright."""
    tilt_rate_max_rad_s: float = Field(default=4.0, gt=0.0)
    """Largest rate at which the thrust axis turns (roll and pitch together) [rad/s]."""
    yaw_rate_max_rad_s: float = Field(default=1.5, gt=0.0)
    """Largest rate of the heading [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class FlightBounds:
    """Proven bounds of what a path asks for."""

    speed_m_s: float
    """Upper bound of the speed [m/s]."""
    thrust_to_weight_max: float
    """Upper bound of thrust over weight."""
    thrust_to_weight_min: float
    """Lower bound of vertical thrust over weight."""
    tilt_rate_rad_s: float
    """Upper bound of the rate at which the thrust axis turns [rad/s]; inf where thrust may vanish."""

    def within(self, limits: FlightLimits) -> bool:
        """Whether these bounds respect the limits."""
        return (
            self.speed_m_s <= limits.speed_max_m_s
            and self.thrust_to_weight_max <= limits.thrust_to_weight_max
            and self.thrust_to_weight_min >= limits.thrust_to_weight_min
            and self.tilt_rate_rad_s <= limits.tilt_rate_max_rad_s
        )


def control_points(coefficients: Array, parts: int) -> Array:
    """Return Bernstein control points of each of `parts` equal parts of each piece.

    The pieces are in rising powers of normalised time, shape [S, axis, degree + 1].

    Returns:
        Shape [S * parts, degree + 1, axis]; the first and the last of a part lie on the curve.
    """
    degree = coefficients.shape[2] - 1
    points = np.einsum("pbj,saj->spba", _bernstein_matrices(degree, parts), coefficients)
    return np.ascontiguousarray(points.reshape(-1, degree + 1, coefficients.shape[1]))


def derivative(coefficients: Array, order: int) -> Array:
    """Coefficients of a derivative with respect to normalised time, shape [.., degree + 1 - order]."""
    powers = range(order, coefficients.shape[-1])
    if not powers:
        return np.zeros((*coefficients.shape[:-1], 1))
    return coefficients[..., order:] * np.array([math.perm(p, order) for p in powers], dtype=np.float64)


def flight_bounds(path: Path) -> FlightBounds:
    """Return proven bounds of speed, thrust and tilt rate over a whole path."""
    return _bounds(*_derivative_hulls(path.coefficients[:, :3], path.durations_s), factor=1.0)


def time_factor(coefficients: Array, durations_s: Array, limits: FlightLimits) -> float:
    """Return the factor on all durations [S] that makes a path as fast as the limits allow.

    By bisection, to 1e-4; the limits, but that of the yaw rate, are proven to hold at the factor returned,
    with 1e-6 to spare for rounding durations to nanoseconds. Positions are in rising powers of normalised
    time, shape [S, 3, degree + 1].
    """
    hulls = _derivative_hulls(coefficients, durations_s)
    spare = 1.0 - 1e-6
    tight = FlightLimits(
        speed_max_m_s=limits.speed_max_m_s * spare,
        thrust_to_weight_max=1.0 + (limits.thrust_to_weight_max - 1.0) * spare,
        thrust_to_weight_min=limits.thrust_to_weight_min * spare + (1.0 - spare),
        tilt_rate_max_rad_s=limits.tilt_rate_max_rad_s * spare,
    )
    slow = 1.0
    while not _bounds(*hulls, factor=slow).within(tight):
        slow *= 2.0
    fast = slow / 2.0
    while _bounds(*hulls, factor=fast).within(tight):
        slow, fast = fast, fast / 2.0
    while slow / fast > 1.0 + 1e-4:
        middle = math.sqrt(slow * fast)
        if _bounds(*hulls, factor=middle).within(tight):
            slow = middle
        else:
            fast = middle
    return slow


def _derivative_hulls(coefficients: Array, durations_s: Array) -> tuple[Array, Array, Array]:
    """Control points [part, point, 3] of velocity, acceleration and jerk."""
    hulls = []
    for order in (1, 2, 3):
        scaled = derivative(coefficients, order) / durations_s[:, None, None] ** order
        hulls.append(control_points(scaled, _PARTS))
    return hulls[0], hulls[1], hulls[2]


def _bounds(velocity: Array, acceleration: Array, jerk: Array, *, factor: float) -> FlightBounds:
    """Bounds of a path all of whose durations are multiplied by a factor."""
    thrust = acceleration / factor**2 + np.array([0.0, 0.0, GRAVITY_M_S2])  # per mass
    jerk = jerk / factor**3
    # The thrust axis b turns at |P j| / |thrust|, P the projection across b. With n a fixed direction for
    # the part and theta the largest angle between b and n, |P j| <= |P_n j| + sin(theta) |j|, and |thrust|
    # >= thrust . n.
    middle = thrust.mean(axis=1)
    axis = middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-300)
    along = np.einsum("pbi,pi->pb", thrust, axis)
    across = np.linalg.norm(thrust - along[..., None] * axis[:, None, :], axis=2).max(axis=1)
    smallest = along.min(axis=1)
    jerk_across = jerk - np.einsum("pbi,pi->pb", jerk, axis)[..., None] * axis[:, None, :]
    jerk_norm = np.linalg.norm(jerk, axis=2).max(axis=1)
    turning = np.minimum(
        np.linalg.norm(jerk_across, axis=2).max(axis=1)
        + jerk_norm * across / np.hypot(across, np.maximum(smallest, 1e-300)),
        jerk_norm,
    )
    rate = np.where(smallest > 0.0, turning / np.where(smallest > 0.0, smallest, 1.0), np.inf)
    return FlightBounds(
        speed_m_s=float(np.linalg.norm(velocity, axis=2).max()) / factor,
        thrust_to_weight_max=float(np.linalg.norm(thrust, axis=2).max()) / GRAVITY_M_S2,
        thrust_to_weight_min=float(thrust[..., 2].min()) / GRAVITY_M_S2,
        tilt_rate_rad_s=float(rate.max()),
    )


@functools.lru_cache
def bernstein_matrix(degree: int) -> Array:
    """Return the matrix [point, power] from coefficients to Bernstein control points on [0, 1]."""
    orders = range(degree + 1)
    return np.array([[math.comb(i, j) / math.comb(degree, j) for j in orders] for i in orders])


@functools.lru_cache
def _bernstein_matrices(degree: int, parts: int) -> Array:
    """Matrices [part, point, power] from coefficients to control points on equal parts of [0, 1]."""
    return bernstein_matrix(degree) @ restriction(
        np.arange(parts) / parts, np.full(parts, 1.0 / parts), degree
    )
