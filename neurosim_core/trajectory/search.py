# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,no-untyped-call"
"""Shortest ways through a voxel grid: A* with a binary heap, as one thread of compiled code.

It runs on the CPU whatever the simulation runs on: a search is a chain of decisions that no second thread can
help. The order of everything is fixed, so the same grid gives the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

wp.set_module_options({"enable_backward": False})

_UNSEEN = wp.constant(-1)
_CLOSED = wp.constant(-2)


@wp.func
def _settle(
    key: wp.array[wp.float32], heap: wp.array[wp.int32], place: wp.array[wp.int32], node: int, slot: int
) -> None:
    """Move a node from a slot towards the root until its parent is not larger."""
    here = slot + 0  # a variable of the loop, not the argument
    while here > 0:
        above = (here - 1) // 2
        other = heap[above]
        if key[other] <= key[node]:
            break
        heap[here] = other
        place[other] = here
        here = above
    heap[here] = node
    place[node] = here


@wp.kernel
def _search(
    # Model:
    slowness: wp.array3d[wp.float32],
    voxel_m: float,
    # In:
    start: int,
    goal: int,
    cost_max_m: float,
    # Out:
    cost_out: wp.array[wp.float32],
    parent_out: wp.array[wp.int32],
    key: wp.array[wp.float32],
    heap: wp.array[wp.int32],
    place: wp.array[wp.int32],
) -> None:
    nx = slowness.shape[0]
    ny = slowness.shape[1]
    nz = slowness.shape[2]
    goal_z = goal % nz
    goal_y = (goal // nz) % ny
    goal_x = goal // (nz * ny)
    cost_out[start] = 0.0
    key[start] = 0.0
    heap[0] = start
    place[start] = 0
    count = wp.int32(1)
    while count > 0:
        node = heap[0]
        place[node] = _CLOSED
        if node == goal or key[node] > cost_max_m:
            break
        count -= 1
        if count > 0:  # the last node sinks from the root
            last = heap[count]
            here = wp.int32(0)
            while True:
                child = 2 * here + 1
                if child >= count:
                    break
                if child + 1 < count:  # noqa: SIM102 (Warp's `and` evaluates both sides: out of range)
                    if key[heap[child + 1]] < key[heap[child]]:
                        child += 1
                if key[heap[child]] >= key[last]:
                    break
                heap[here] = heap[child]
                place[heap[here]] = here
                here = child
            heap[here] = last
            place[last] = here
        z = node % nz
        y = (node // nz) % ny
        x = node // (nz * ny)
        here_slowness = slowness[x, y, z]
        for side in range(27):
            dx = side // 9 - 1
            dy = (side // 3) % 3 - 1
            dz = side % 3 - 1
            ax = x + dx
            ay = y + dy
            az = z + dz
            if ax < 0 or ay < 0 or az < 0 or ax >= nx or ay >= ny or az >= nz:
                continue
            there_slowness = slowness[ax, ay, az]
            if there_slowness <= 0.0:
                continue
            other = (ax * ny + ay) * nz + az
            if place[other] == _CLOSED:
                continue
            step = wp.sqrt(float(dx * dx + dy * dy + dz * dz)) * voxel_m
            cost = cost_out[node] + 0.5 * step * (here_slowness + there_slowness)
            if cost < cost_out[other]:
                ahead = 0.0 * step
                if goal >= 0:
                    gx = float(goal_x - ax)
                    gy = float(goal_y - ay)
                    gz = float(goal_z - az)
                    ahead = 0.9999 * voxel_m * wp.sqrt(gx * gx + gy * gy + gz * gz)
                cost_out[other] = cost
                key[other] = cost + ahead
                parent_out[other] = node
                slot = place[other]
                if slot == _UNSEEN:
                    slot = count
                    count += 1
                _settle(key, heap, place, other, slot)


@dataclass(frozen=True, eq=False)
class Search:
    """What a search from one voxel has found."""

    cost: NDArray[np.float32]
    """Length of the best way, weighted by slowness [m], shape [nx, ny, nz]; inf where none was found."""
    parent: NDArray[np.int32]
    """Flat index of the voxel before, shape [nx ny nz]; -1 at the start."""

    def way(self, goal: tuple[int, int, int]) -> NDArray[np.int64]:
        """Return the voxels from the start to a goal whose cost is finite, shape [n, 3]."""
        node = int(np.ravel_multi_index(goal, self.cost.shape))
        nodes = [node]
        while (node := int(self.parent[node])) >= 0:
            nodes.append(node)
        return np.stack(np.unravel_index(np.array(nodes[::-1]), self.cost.shape), axis=1)


def search(
    slowness: NDArray[np.float32],
    voxel_m: float,
    start: tuple[int, int, int],
    goal: tuple[int, int, int] | None = None,
    *,
    cost_max_m: float = math.inf,
) -> Search:
    """Find the cheapest ways from a voxel over the 26 neighbours of each.

    Args:
        slowness: Cost of a metre in each voxel, >= 1, or 0 where it must not go, shape [nx, ny, nz].
        voxel_m: Spacing [m].
        start: Voxel.
        goal: Voxel at which to stop (A*); None: find the ways to all voxels (Dijkstra).
        cost_max_m: Ways that cost more need not be found [m].
    """
    size = slowness.size
    empty = {"dtype": wp.int32, "device": "cpu"}
    cost: Any = wp.full(size, value=np.inf, dtype=wp.float32, device="cpu")
    parent: Any = wp.full(size, value=-1, **empty)
    wp.launch(
        _search,
        dim=1,
        inputs=[
            wp.array(slowness, dtype=wp.float32, device="cpu", copy=False),
            voxel_m,
            int(np.ravel_multi_index(start, slowness.shape)),
            -1 if goal is None else int(np.ravel_multi_index(goal, slowness.shape)),
            cost_max_m,
            cost,
            parent,
            wp.empty(size, dtype=wp.float32, device="cpu"),
            wp.empty(size, **empty),
            wp.full(size, value=-1, **empty),
        ],
        device="cpu",
    )
    return Search(cost.numpy().reshape(slowness.shape), parent.numpy())
