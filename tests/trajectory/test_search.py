"""A* against SciPy's Dijkstra on the same graph."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from neurosim_core.trajectory.search import search


def graph(slowness: np.ndarray, voxel_m: float) -> sparse.csr_matrix:
    index = np.arange(slowness.size).reshape(slowness.shape)
    rows, columns, costs = [], [], []
    for offset in np.ndindex(3, 3, 3):
        step = np.array(offset) - 1
        if not step.any():
            continue
        here = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(step, slowness.shape, strict=True))
        there = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip(step, slowness.shape, strict=True))
        a, b = slowness[here], slowness[there]
        open_ = (a > 0) & (b > 0)
        rows.append(index[here][open_])
        columns.append(index[there][open_])
        costs.append(0.5 * (a + b)[open_] * voxel_m * np.linalg.norm(step))
    edges = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix((np.concatenate(costs), edges), shape=(slowness.size,) * 2)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 12), st.integers(1, 9), st.integers(1, 6)),
    walls=st.floats(0.0, 0.6),
)
def test_costs_are_those_of_dijkstra(seed, shape, walls):
    rng = np.random.default_rng(seed)
    slowness = rng.uniform(1.0, 3.0, size=shape).astype(np.float32)
    slowness[rng.uniform(size=shape) < walls] = 0.0
    slowness[0, 0, 0] = 1.0
    expected = dijkstra(graph(slowness.astype(np.float64), 0.1), indices=0).reshape(shape)
    found = search(slowness, 0.1, (0, 0, 0))
    assert found.cost == pytest.approx(expected, rel=1e-5)  # float32 sums of some 20 steps; inf equals inf
    reached = np.argwhere(np.isfinite(expected))
    goal = tuple(reached[rng.integers(len(reached))].tolist())
    direct = search(slowness, 0.1, (0, 0, 0), goal)
    assert direct.cost[goal] == pytest.approx(
        expected[goal], rel=1e-4
    )  # the heuristic is a lower bound to 1e-4
    way = direct.way(goal)
    assert way[0].tolist() == [0, 0, 0]
    assert tuple(way[-1].tolist()) == goal
    assert (np.abs(np.diff(way, axis=0)).max(axis=1) == 1).all() if len(way) > 1 else goal == (0, 0, 0)
    assert (slowness[tuple(way.T)] > 0.0).all()


def test_a_limit_finds_what_is_nearer():
    slowness = np.ones((40, 40, 1), dtype=np.float32)
    whole = search(slowness, 0.1, (0, 0, 0)).cost
    near = search(slowness, 0.1, (0, 0, 0), cost_max_m=1.5).cost
    assert (near[whole <= 1.5] == whole[whole <= 1.5]).all()
    assert np.isinf(near[whole > 1.7]).all()
