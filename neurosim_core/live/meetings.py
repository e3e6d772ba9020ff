"""Vehicles that touch each other: spheres, looked at once every control period."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from neurosim_core.live.craft import Craft
from neurosim_core.packets import Collision
from neurosim_core.simulation import COLLISION


class Meetings:
    """Reports the beginning of every touch, to both."""

    def __init__(self) -> None:
        self._touching: set[tuple[str, str]] = set()

    def reset(self) -> None:
        """Forget who touches whom."""
        self._touching.clear()

    def check(self, crafts: Sequence[Craft]) -> None:
        """Report who has come to touch whom since the last time, as collisions like those with the scene."""
        for first, second in itertools.combinations(crafts, 2):
            pair = (first.name, second.name)
            gap_m = _gap_m(first, second)
            if gap_m > 0.0:
                self._touching.discard(pair)
            elif pair not in self._touching:
                self._touching.add(pair)
                _report(first, gap_m)
                _report(second, gap_m)


def _gap_m(first: Craft, second: Craft) -> float:
    distance_m = np.linalg.norm(first.observe().position - second.observe().position)
    radii_m = [craft.model.config.vehicle.collision_radius_m for craft in (first, second)]
    return float(distance_m) - sum(radii_m)


def _report(craft: Craft, gap_m: float) -> None:
    state, there = craft.state, craft.observe()
    craft.outlet.offer(
        [
            Collision(
                stamp_ns=there.stamp_ns,
                sequence=state.sequence[COLLISION],
                sensor=COLLISION,
                position=there.position,
                clearance_m=gap_m,
            )
        ]
    )
    state.sequence[COLLISION] += 1
    state.counts["collisions"] += 1
    if craft.model.config.vehicle.on_collision == "end":
        state.ended = True
