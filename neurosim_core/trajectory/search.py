# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type"
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
    # In:
    node: int,
    key: float,
    slot: int,
    # In/out:
    heap: wp.array[wp.int32],
    keys: wp.array[wp.float32],
    place: wp.array[wp.int32],
) -> None:
    """Move a node from a slot towards the root until its parent is not larger."""
    here = slot + 0  # a variable of the loop, not the argument
    while here > 0:
        above = (here - 1) // 2
        if keys[above] <= key:
            break
        other = heap[above]
        heap[here] = other
        keys[here] = keys[above]
        place[other] = here
        here = above
    heap[here] = node
    keys[here] = key
    place[node] = here


@wp.kernel
def _search(
    # Model:
    slowness: wp.array[wp.float32],
    shape: wp.vec3i,
    voxel_m: float,
    # In:
    start: int,
    goal: int,
    cost_max_m: float,
    # Out:
    cost_out: wp.array[wp.float32],
    parent_out: wp.array[wp.int32],
    heap: wp.array[wp.int32],
    keys: wp.array[wp.float32],
    place: wp.array[wp.int32],
) -> None:
    ny = shape[1]
    nz = shape[2]
    goal_z = goal % nz
    goal_y = (goal // nz) % ny
    goal_x = goal // (nz * ny)
    cost_out[start] = 0.0
    heap[0] = start
    keys[0] = 0.0
    place[start] = 0
    count = wp.int32(1)
    while count > 0:
        node = heap[0]
        place[node] = _CLOSED
        if node == goal or keys[0] > cost_max_m:
            break
        count -= 1
        if count > 0:  # the last node sinks from the root
            last = heap[count]
            last_key = keys[count]
            here = wp.int32(0)
            while True:
                child = 2 * here + 1
                if child >= count:
                    break
                if child + 1 < count:  # noqa: SIM102 (Warp's `and` evaluates both sides: out of range)
                    if keys[child + 1] < keys[child]:
                        child += 1
                if keys[child] >= last_key:
                    break
                heap[here] = heap[child]
                keys[here] = keys[child]
                place[heap[here]] = here
                here = child
            heap[here] = last
            keys[here] = last_key
            place[last] = here
        here_cost = cost_out[node]
        here_slowness = slowness[node]
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                half_step = 0.5 * wp.sqrt(float(dx * dx + dy * dy + 1)) * voxel_m
                half_middle = 0.5 * wp.sqrt(float(dx * dx + dy * dy)) * voxel_m
                row = node + (dx * ny + dy) * nz
                for dz in range(-1, 2):
                    other = row + dz
                    half = wp.where(dz == 0, half_middle, half_step)
                    cost = here_cost + half * (here_slowness + slowness[other])
                    if cost < cost_out[other]:  # noqa: SIM102 (as above: the second is rarely needed)
                        if place[other] != _CLOSED:
                            key = cost
                            if goal >= 0:
                                gx = float(goal_x - other // (nz * ny))
                                gy = float(goal_y - (other // nz) % ny)
                                gz = float(goal_z - other % nz)
                                key += 0.9999 * voxel_m * wp.sqrt(gx * gx + gy * gy + gz * gz)
                            cost_out[other] = cost
                            parent_out[other] = node
                            slot = place[other]
                            if slot == _UNSEEN:
                                slot = count
                                count += 1
                            _settle(other, key, slot, heap, keys, place)


@dataclass(frozen=True, eq=False)
class Search:
    """The result of a search from one voxel."""

    cost: NDArray[np.float32]
    """Length of the best way, weighted by slowness [m], shape [nx, ny, nz]; inf where none was found."""
    parent: NDArray[np.int32]
    """Index of the voxel before in a flat grid that has one more voxel all around; -1: there is none."""

    def way(self, goal: tuple[int, int, int]) -> NDArray[np.int64]:
        """Return the voxels from the start to a goal whose cost is finite, shape [n, 3]."""
        shape = tuple(n + 2 for n in self.cost.shape)
        node = _flat(goal, shape)
        nodes = [node]
        while (node := int(self.parent[node])) >= 0:
            nodes.append(node)
        return np.stack(np.unravel_index(np.array(nodes[::-1]), shape), axis=1) - 1


def search(
    slowness: NDArray[np.float32],
    voxel_m: float,
    start: tuple[int, int, int],
    goal: tuple[int, int, int] | None = None,
    *,
    cost_max_m: float = math.inf,
) -> Search:
    """Find the cheapest ways from a voxel over 26 neighbours, to a goal (A*) or to all (Dijkstra).

    `slowness` is the cost of a metre in each voxel, >= 1, or 0 where it must not go, shape [nx, ny, nz]; ways
    that cost more than `cost_max_m` need not be found.
    """
    # Nothing is cheaper than what goes through a voxel of infinite slowness: such a border, and no bounds.
    walls = np.pad(np.where(slowness > 0.0, slowness, np.inf), 1, constant_values=np.inf)
    size = walls.size
    empty = {"dtype": wp.int32, "device": "cpu"}
    cost: Any = wp.full(size, value=np.inf, dtype=wp.float32, device="cpu")
    parent: Any = wp.full(size, value=-1, **empty)
    wp.launch(
        _search,
        dim=1,
        inputs=[
            wp.array(walls.reshape(-1), dtype=wp.float32, device="cpu", copy=False),
            wp.vec3i(*walls.shape),
            voxel_m,
            _flat(start, walls.shape),
            -1 if goal is None else _flat(goal, walls.shape),
            cost_max_m,
            cost,
            parent,
            wp.empty(size, **empty),
            wp.empty(size, dtype=wp.float32, device="cpu"),
            wp.full(size, value=-1, **empty),
        ],
        device="cpu",
    )
    return Search(cost.numpy().reshape(walls.shape)[1:-1, 1:-1, 1:-1], parent.numpy())


def _flat(voxel: tuple[int, int, int], shape: tuple[int, ...]) -> int:
    """Return the index of a voxel in a flat array that has one more voxel all around."""
    return int(np.ravel_multi_index([k + 1 for k in voxel], shape))
