"""Minimum-snap paths through waypoints: closed form, linear in the number of pieces.

Unknown are velocity, acceleration and jerk at the inner waypoints; positions are given and the path rests at
both ends (and wherever it is asked to). The snap integral is a quadratic form in them whose matrix is block
tridiagonal with 3 x 3 blocks: one banded Cholesky factorisation solves all axes at once.

Reference: Mellinger, Kumar (2011), Minimum snap trajectory generation and control for quadrotors; Bry,
Richter, Bachrach, Roy (2015), Aggressive flight of fixed-wing and quadrotor aircraft in dense indoor
environments, sec. 3.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy  # which imports its parts when they are used
from numpy.typing import ArrayLike, NDArray

from neurosim_core.clock import NS_PER_S
from neurosim_core.trajectory.path import Path

Array = NDArray[np.float64]

_BAND = 5
"""Subdiagonals of a block tridiagonal matrix with 3 x 3 blocks."""


@functools.lru_cache
def hermite_matrix(order: int) -> Array:
    """Matrix from end values to coefficients, for polynomials of degree 2 order - 1 on [0, 1].

    Exact: its elements are multiples of 1 / (order - 1)!. Shape [2 order, 2 order]: column k < order belongs
    to derivative k at 0, column order + k to derivative k at 1, row j to power j.
    """
    powers = np.arange(2 * order)
    values = np.zeros((2 * order, 2 * order))
    for k in range(order):
        falling = np.array([math.perm(p, k) for p in powers], dtype=np.float64)
        values[k, k] = falling[k]
        values[order + k] = falling
    unit = math.factorial(order - 1)
    return np.asarray(np.rint(np.linalg.inv(values) * unit) / unit)


@functools.lru_cache
def _snap_form() -> Array:
    """Quadratic form of the snap integral over [0, 1] in the 8 end values of a degree-7 piece."""
    falling = np.array([math.perm(p, 4) for p in range(8)], dtype=np.float64)
    power = np.arange(8)
    gram = np.zeros((8, 8))
    gram[4:, 4:] = np.outer(falling, falling)[4:, 4:] / (power[4:, None] + power[None, 4:] - 7)
    matrix = hermite_matrix(4)
    return np.asarray(matrix.T @ gram @ matrix)


@dataclass(frozen=True, kw_only=True, eq=False)
class Spline:
    """Solution of the minimum-snap problem for given durations."""

    derivatives: Array
    """Position, velocity, acceleration, jerk at the waypoints, shape [n + 1, 4, axis]."""
    coefficients: Array
    """Rising powers of normalised time, shape [n, axis, 8]."""
    cost: float
    """Integral of squared snap over the path, summed over the axes [m^2/s^7]."""
    gradient: Array
    """Derivative of the cost with respect to each duration, shape [n]."""


def solve_minimum_snap(points: Array, durations_s: Array, rest: NDArray[np.bool_]) -> Spline:
    """Minimise the integral of squared snap through waypoints [n + 1, axis] that are durations [n] apart [s].

    The gradient follows from the envelope theorem: at the optimum, only the explicit dependence of the cost
    on a duration counts. Velocity, acceleration and jerk are zero where it rests, [n + 1], and at both ends.
    """
    count, axes = len(durations_s), points.shape[1]
    scale_s = float(
        durations_s.mean()
    )  # time unit in which the equations are solved: keeps them well conditioned
    t = durations_s / scale_s
    step = np.diff(points, axis=0)
    form = _snap_form()
    powers = t[:, None] ** np.arange(4)
    scaling = np.concatenate([powers, powers], axis=1)  # end values of a piece in its own time
    weight = t**-7
    blocks = weight[:, None, None] * form * scaling[:, :, None] * scaling[:, None, :]

    inner = count - 1
    free = np.repeat(~rest[1:-1], 3)
    unknown = np.zeros((inner, 3, axes))
    if free.any():
        diagonal = blocks[:-1, 5:8, 5:8] + blocks[1:, 1:4, 1:4]
        lower = blocks[1:-1, 5:8, 1:4]  # row: right end of a piece, column: its left end
        # positions enter by their difference alone: constants have no snap
        right = -(
            blocks[:-1, 5:8, 4, None] * step[:-1, None, :] + blocks[1:, 1:4, 4, None] * step[1:, None, :]
        )
        band = np.zeros((_BAND + 1, 3 * inner))
        for row in range(3):
            for column in range(3):
                if row >= column:
                    band[row - column, column::3] = diagonal[:, row, column]
                band[3 + row - column, column : 3 * (inner - 1) : 3] = lower[:, row, column]
        fixed = np.flatnonzero(~free)
        band[:, fixed] = 0.0
        for offset in range(1, _BAND + 1):
            band[offset, fixed[fixed >= offset] - offset] = 0.0
        band[0, fixed] = 1.0
        right = right.reshape(3 * inner, axes)
        right[fixed] = 0.0
        unknown = scipy.linalg.solveh_banded(band, right, lower=True, check_finite=False)
        unknown = unknown.reshape(inner, 3, axes)

    derivatives = np.zeros((count + 1, 4, axes))  # in units of scale_s
    derivatives[:, 0] = points
    derivatives[1:-1, 1:] = unknown
    ends = np.concatenate([derivatives[:-1], derivatives[1:]], axis=1)
    ends[:, 0] = 0.0
    ends[:, 4] = step
    own = scaling[:, :, None] * ends
    image = np.einsum("ij,njx->nix", form, own)
    costs = weight * np.einsum("nix,nix->n", own, image)
    order = np.tile(np.arange(4.0), 2)
    slope = (-7.0 * costs + 2.0 * weight * np.einsum("nix,nix,i->n", own, image, order)) / t
    coefficients = np.einsum("ij,njx->nxi", hermite_matrix(4), own)
    coefficients[:, :, 0] = points[:-1]
    return Spline(
        derivatives=derivatives / (scale_s ** np.arange(4))[:, None],
        coefficients=coefficients,
        cost=float(costs.sum()) / scale_s**7,
        gradient=slope / scale_s**8,
    )


def allocate_durations(
    points: Array, *, rest: NDArray[np.bool_] | None = None, iterations: int = 60
) -> Array:
    """Return durations of mean 1, shape [n], that divide time between the pieces so that snap is least.

    Minimises log(cost) + 7 log(sum of durations) over the logarithms of the durations, by L-BFGS with the
    exact gradient. Cost is homogeneous of degree -7 in the durations, so this has the same minimiser, up to a
    common factor, as cost + k * total duration for every k > 0: k only chooses that factor, and that is
    chosen afterwards, by what the vehicle can do. Parameters as of `solve_minimum_snap`; no two neighbours
    are equal.
    """
    rest = np.zeros(len(points), dtype=bool) if rest is None else rest
    distance = np.linalg.norm(np.diff(points, axis=0), axis=1)
    guess = np.sqrt(distance)
    stops = rest.copy()
    stops[[0, -1]] = True
    guess *= 1.0 + 0.5 * (stops[:-1].astype(np.float64) + stops[1:])  # from and to rest takes longer

    def objective(log_t: Array) -> tuple[float, Array]:
        t = np.exp(log_t)
        spline = solve_minimum_snap(points, t, rest)
        total = float(t.sum())
        return math.log(spline.cost) + 7.0 * math.log(total), t * (
            spline.gradient / spline.cost + 7.0 / total
        )

    start = np.log(guess / guess.mean())
    if len(start) == 1:
        return np.ones(1)
    bounds = [(low - 3.0, low + 3.0) for low in start]  # a factor of 20 either way: keeps the solver sane
    result = scipy.optimize.minimize(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": iterations, "ftol": 1e-6},
    )
    durations = np.exp(np.asarray(result.x, dtype=np.float64))
    return np.asarray(durations / durations.mean(), dtype=np.float64)


def minimum_snap(waypoints: ArrayLike, knots_ns: ArrayLike, *, rest: ArrayLike | None = None) -> Path:
    """Return the path of least snap that passes each waypoint at its stamp and rests at both ends.

    Args:
        waypoints: Positions, neighbours differ, and optionally yaw, shape [n + 1, 3] or [n + 1, 4]; without
            yaw it stays 0.
        knots_ns: When each is passed [ns], increasing integers, shape [n + 1].
        rest: At which waypoints to stop, shape [n + 1]; the ends in any case.

    Raises:
        ValueError: Stamps that are no increasing integers.
    """
    points, knots = np.asarray(waypoints, dtype=np.float64), np.asarray(knots_ns)
    if not np.issubdtype(knots.dtype, np.integer) or (np.diff(knots) <= 0).any():
        raise ValueError(f"knots_ns must be {len(points)} increasing integers, got {knots.tolist()}")
    stops = np.zeros(len(points), dtype=bool) if rest is None else np.asarray(rest, dtype=bool)
    if points.shape[1] == 3:
        points = np.pad(points, ((0, 0), (0, 1)))
    spline = solve_minimum_snap(points, np.diff(knots) / NS_PER_S, stops)
    return Path(knots, spline.coefficients)
