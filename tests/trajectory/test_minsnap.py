"""Minimum snap against its closed form, a dense solve of the same problem, and its own optimality."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.trajectory.minsnap import (
    allocate_durations,
    hermite_matrix,
    minimum_snap,
    solve_minimum_snap,
)


def falling(order: int, count: int = 8) -> np.ndarray:
    return np.array([math.perm(p, order) for p in range(count)], dtype=np.float64)


def problem(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(size=(count + 1, 3)), axis=0), rng.uniform(0.5, 2.0, size=count)


def dense_solution(points: np.ndarray, durations: np.ndarray) -> tuple[np.ndarray, float]:
    """The same problem as least squares in monomials under equality constraints, by its KKT system."""
    count = len(durations)
    hessian = np.zeros((8 * count, 8 * count))
    for n, t in enumerate(durations):
        for a in range(4, 8):
            for b in range(4, 8):
                scale = math.perm(a, 4) * math.perm(b, 4) / (a + b - 7)
                hessian[8 * n + a, 8 * n + b] = 2.0 * scale * t**-7
    rows, right = [], []

    def row(n: int, end: float, order: int) -> np.ndarray:
        full = np.zeros(8 * count)
        full[8 * n : 8 * n + 8] = falling(order) * [end ** max(p - order, 0) for p in range(8)]
        full[8 * n : 8 * n + 8] /= durations[n] ** order
        return full

    for n in range(count):
        rows += [row(n, 0.0, 0), row(n, 1.0, 0)]
        right += [points[n], points[n + 1]]
    for order in (1, 2, 3):
        rows += [row(0, 0.0, order), row(count - 1, 1.0, order)]
        right += [np.zeros(3)] * 2
        for n in range(count - 1):
            rows.append(row(n, 1.0, order) - row(n + 1, 0.0, order))
            right.append(np.zeros(3))
    equality = np.array(rows)
    kkt = np.block([[hessian, equality.T], [equality, np.zeros((len(rows), len(rows)))]])
    solved = np.linalg.lstsq(kkt, np.concatenate([np.zeros((8 * count, 3)), right]), rcond=None)[0][
        : 8 * count
    ]
    cost = 0.5 * float(np.einsum("ix,ij,jx->", solved, hessian, solved))
    return solved.reshape(count, 8, 3).transpose(0, 2, 1), cost


def test_one_segment_is_the_known_polynomial():
    """From rest to rest in unit time: 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7."""
    path = minimum_snap([[0.0, 0.0, 0.0], [1.0, -2.0, 0.5]], [0, 10**9])
    shape = np.array([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])
    assert path.coefficients[0, :3] == pytest.approx(np.outer([1.0, -2.0, 0.5], shape), abs=1e-12)
    assert not path.coefficients[0, 3].any()


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_hermite_matrix_is_exact(order):
    """In rational arithmetic: the polynomials it gives have exactly the end values asked for."""
    matrix = [[Fraction(x) for x in row] for row in hermite_matrix(order).tolist()]
    for column in range(2 * order):
        coefficients = [row[column] for row in matrix]
        for k in range(order):
            start = coefficients[k] * math.factorial(k)
            end = sum(c * math.perm(p, k) for p, c in enumerate(coefficients))
            # multiples of 1/6 and 1/24 are rounded in binary: exact to the last bit of the largest term
            assert abs(float(start - (column == k))) < 1e-13
            assert abs(float(end - (column == order + k))) < 1e-10


@pytest.mark.parametrize("count", [2, 3, 7])
def test_agrees_with_a_dense_solve(count):
    points, durations = problem(count, count)
    spline = solve_minimum_snap(points, durations, np.zeros(count + 1, dtype=bool))
    coefficients, cost = dense_solution(points, durations)
    assert spline.coefficients == pytest.approx(
        coefficients, abs=1e-7
    )  # the KKT system's condition is about 1e9
    assert spline.cost == pytest.approx(cost, rel=1e-8)


@pytest.mark.parametrize("count", [2, 30, 300])
def test_six_derivatives_are_continuous(count):
    """Continuity of derivatives 4 to 6 is not asked for: it is what optimality gives."""
    points, durations = problem(4, count)
    c = solve_minimum_snap(points, durations, np.zeros(count + 1, dtype=bool)).coefficients
    for order in range(7):
        end = (c * falling(order)).sum(axis=2) / durations[:, None] ** order
        start = c[:, :, order] * math.factorial(order) / durations[:, None] ** order
        size = np.abs(c * falling(order)).max() / durations.min() ** order
        assert np.abs(end[:-1] - start[1:]).max() < 1e-10 * size, order


def test_rests_where_asked():
    """A stop on the way splits the problem: each half is the known polynomial on its line."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    path = minimum_snap(points, [0, 10**9, 3 * 10**9], rest=[False, True, False])
    shape = np.array([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])
    assert path.coefficients[0, 0] == pytest.approx(shape, abs=1e-12)
    assert path.coefficients[1, 1] == pytest.approx(2.0 * shape, abs=1e-12)
    assert not path.coefficients[0, 1].any()


def test_no_other_derivatives_are_cheaper():
    """Any change of velocity, acceleration or jerk at an inner waypoint costs more."""
    points, durations = problem(5, 4)
    spline = solve_minimum_snap(points, durations, np.zeros(5, dtype=bool))

    def cost(derivatives: np.ndarray) -> float:
        scale = durations[:, None] ** np.arange(4)
        ends = np.concatenate(
            [derivatives[:-1] * scale[:, :, None], derivatives[1:] * scale[:, :, None]], axis=1
        )
        c = np.einsum("ij,njx->nxi", hermite_matrix(4), ends)
        u, w = np.polynomial.legendre.leggauss(8)
        powers = np.array([(0.5 + 0.5 * u) ** max(p - 4, 0) for p in range(8)])
        snap = np.einsum("nxi,iu->nxu", c * falling(4), powers)
        return float(((snap**2).sum(axis=1) @ (0.5 * w) * durations**-7).sum())

    best = cost(spline.derivatives)
    assert best == pytest.approx(spline.cost, rel=1e-11)
    rng = np.random.default_rng(6)
    for _ in range(20):
        other = spline.derivatives.copy()
        other[1:-1, 1:] += 1e-3 * rng.normal(size=(3, 3, 3))
        assert cost(other) > best


def test_gradient_is_that_of_the_cost():
    points, durations = problem(7, 5)
    rest = np.array([False, False, True, False, False, False])
    gradient = solve_minimum_snap(points, durations, rest).gradient
    for n in range(5):
        step = np.zeros(5)
        step[n] = 1e-5
        rise = solve_minimum_snap(points, durations + step, rest).cost
        rise -= solve_minimum_snap(points, durations - step, rest).cost
        # central difference: error 1e-10 of the third derivative, about 1e3 costs
        assert gradient[n] == pytest.approx(rise / 2e-5, rel=1e-5)


def test_cost_scales_with_the_seventh_power_of_time():
    points, durations = problem(8, 6)
    rest = np.zeros(7, dtype=bool)
    slow = solve_minimum_snap(points, 3.0 * durations, rest).cost
    assert slow == pytest.approx(solve_minimum_snap(points, durations, rest).cost / 3.0**7, rel=1e-11)


def test_equal_segments_share_time_symmetrically():
    """Points on a line, mirror-symmetric: so are the durations; the ends, from and to rest, take longest."""
    points = np.outer(np.arange(6.0), [1.0, 0.5, 0.0])
    durations = allocate_durations(points)
    assert durations == pytest.approx(
        durations[::-1], rel=1e-3
    )  # L-BFGS stops at a relative 1e-6 of log cost
    assert durations.mean() == pytest.approx(1.0)
    assert durations[0] > 1.2 * durations[2]


def test_allocation_is_stationary():
    """At the optimum of log cost + 7 log total, T_i dJ/dT_i = -7 J T_i / total for every piece."""
    points, _ = problem(9, 12)
    durations = allocate_durations(points, iterations=500)
    spline = solve_minimum_snap(points, durations, np.zeros(13, dtype=bool))
    slope = durations * (spline.gradient / spline.cost + 7.0 / durations.sum())
    assert np.abs(slope).max() < 0.02  # of 7 / 12 for one that ignores the cost
    even = np.ones(12)
    assert spline.cost * 12.0**7 <= solve_minimum_snap(points, even, np.zeros(13, dtype=bool)).cost * 12.0**7


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 12),
    scale=st.floats(0.01, 100.0),
)
def test_passes_its_waypoints_and_rests_at_its_ends(seed, count, scale):
    rng = np.random.default_rng(seed)
    points = scale * rng.normal(size=(count + 1, 4))
    knots = np.cumsum([0, *rng.integers(10**8, 3 * 10**9, size=count)])
    samples = minimum_snap(points, knots).evaluate(knots)
    tolerance = 1e-9 * scale  # durations differ by up to 30: powers of them up to 2e4 in the solve
    assert samples.position == pytest.approx(points[:, :3], abs=tolerance)
    assert samples.yaw == pytest.approx(points[:, 3], abs=tolerance)
    assert np.abs(samples.velocity[[0, -1]]).max() < 1e-7 * scale
    assert np.abs(samples.acceleration[[0, -1]]).max() < 1e-5 * scale


def test_refuses_stamps_that_do_not_fit():
    with pytest.raises(ValueError, match="increasing integers"):
        minimum_snap([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [5, 5])
