"""Connected components of a graph, without the import of SciPy's sparse matrices, which takes 0.25 s."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def connected_components(
    count: int, one: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[int, NDArray[np.int64]]:
    """Return the number of components of a graph, and that of each node.

    Components are numbered in the order of their first nodes.

    Args:
        count: Number of nodes.
        one: A node that each edge joins, shape [E].
        other: The other node that it joins, shape [E].
    """
    root = np.arange(count)
    while True:
        one, other = root.take(one), root.take(other)
        apart = one != other
        one, other = one[apart], other[apart]
        if len(one) == 0:
            break
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while not np.array_equal(up := root.take(root), root):
            root = up
    first = root == np.arange(count)
    return int(first.sum()), (np.cumsum(first) - 1).take(root)
