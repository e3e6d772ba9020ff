"""Connected components against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from neurosim_core.scene.topology import connected_components


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("edge_count", [0, 1, 300, 1000, 5000])
def test_random_graphs_have_the_components_of_scipy(seed, edge_count):
    """1,000 nodes fall apart, or have one large component among small ones, or are one."""
    one, other = np.random.default_rng(seed).integers(0, 1000, (2, edge_count))
    assert_as_scipy(1000, one, other)


def test_components_of_long_chains_and_wide_stars_are_found():
    number = np.random.default_rng(0).permutation(1000)
    chain, centre = number[:-1], np.full(999, 999)
    assert_as_scipy(1000, chain, number[1:])
    assert_as_scipy(1000, centre, np.arange(999))
    assert_as_scipy(2000, 2 * chain, 2 * number[1:])  # every other node is alone


def assert_as_scipy(count: int, one: NDArray[np.int64], other: NDArray[np.int64]) -> None:
    graph = sparse.coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(count, count))
    wanted_count, wanted = sparse.csgraph.connected_components(graph, directed=False)
    found_count, found = connected_components(count, one, other)
    assert found_count == wanted_count
    np.testing.assert_array_equal(found, wanted)
