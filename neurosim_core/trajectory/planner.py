"""Collision-free paths: where to go, which way, and a smooth path whose clearance is proven.

For each leg A* finds the cheapest way on the voxel grid, metres near obstacles costing more. Dynamic
programming picks the few of its points between which straight lines are cheapest; every line is proven to
keep the clearance. A path of least snap goes through these points. Its pieces that cannot be proven clear are
split at points of the lines, and pieces that are short already get a stop at both ends, where they become
straight lines: so this ends, and what comes out is proven.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy  # which imports its parts when they are used
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.clock import NS_PER_S
from neurosim_core.frames import Vector3
from neurosim_core.scene.freespace import FreeSpace
from neurosim_core.settings import BaseConfig
from neurosim_core.trajectory.certify import prove_clearance
from neurosim_core.trajectory.feasibility import FlightLimits, flight_bounds, time_factor
from neurosim_core.trajectory.heading import follow_travel
from neurosim_core.trajectory.minsnap import allocate_durations, minimum_snap, solve_minimum_snap
from neurosim_core.trajectory.path import Path
from neurosim_core.trajectory.search import search

Array = NDArray[np.float64]
Voxel = tuple[int, int, int]

_NEAR_COST = 4.0
"""A metre that touches obstacles costs this much more than one with all the room that is wanted."""
_ROOM_WANTED_M = 0.4
"""Clearance beyond what is asked for that is worth a detour."""
_TURN_COST_M = 0.2
"""Each waypoint costs as much as this length of way: few waypoints make a smoother flight."""
_PIECE_MIN_M = 0.4
"""Pieces that collide and are shorter get stops at both ends."""
_SPLITS_MAX = 3
"""How often a piece may be split before it gets stops."""
_SPARE_M = 1e-6
"""More clearance than asked for while planning, so that the proof survives rounding to nanoseconds."""
_RING = (0.75, 1.25)
"""Goals are at a distance between these multiples of the leg's length."""
_CANDIDATES = 24
"""Random places of which the next goal is the one farthest from where the tour has been."""


class PlanningError(ValueError):
    """No path: the message names the leg and the reason."""


class CollisionFreeConfig(BaseConfig):
    """Settings that all planned paths have."""

    clearance_m: float = Field(default=0.3, gt=0.0)
    """Least distance between path and scene, everywhere [m]; must exceed the vehicle's collision radius."""
    limits: FlightLimits = FlightLimits()
    """Limits of the path; its time is scaled so that the tightest of them is met."""
    lookahead_s: float = Field(default=0.5, gt=0.0, le=1e6)
    """The heading points to where the vehicle is after this time [s]."""


class TourConfig(CollisionFreeConfig):
    """A flight through random places of the free space, for the whole run."""

    kind: Literal["tour"] = "tour"
    seed: int = Field(default=0, ge=0)
    """Seed of the random goals."""
    leg_length_m: float = Field(default=7.0, gt=0.0)
    """Approximate path length to the next goal [m]; less where the free space is smaller."""
    height_min_m: float = Field(default=0.9, ge=0.0)
    """Smallest height of goals above the surface below them [m]."""
    height_max_m: float = Field(default=1.7, gt=0.0)
    """Largest height of goals above the surface below them [m]."""

    @model_validator(mode="after")
    def _heights_are_a_range(self) -> TourConfig:
        if not self.height_min_m < self.height_max_m:
            raise ValueError(
                f"height_min_m must be below height_max_m = {self.height_max_m:g}, got {self.height_min_m:g}"
            )
        return self


class WaypointsConfig(CollisionFreeConfig):
    """A flight through given places, from rest to rest; the paths between them are planned."""

    kind: Literal["waypoints"] = "waypoints"
    points_m: tuple[Vector3, ...] = Field(min_length=2)
    """Positions to pass in W [m], at least two; consecutive ones differ."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Terrain:
    """Free space at one clearance."""

    space: FreeSpace
    clearance_m: float
    open: NDArray[np.bool_]
    slowness: NDArray[np.float32]


def plan_tour(space: FreeSpace, config: TourConfig, *, duration_s: float) -> Path:
    """Plan a flight through random places that lasts at least as long as asked.

    Goals are reachable, at flight height, with room around them, about a leg's length from each other along
    the way, and far from where the tour has been. It rests at its start and at its end and passes goals
    without stopping.

    Args:
        space: Where to fly.
        config: What to plan.
        duration_s: Least duration of the path [s].

    Raises:
        PlanningError: There is no room at this clearance.
    """
    terrain = _terrain(space, config)
    rng = np.random.default_rng(config.seed)
    places = _places(terrain, config)
    here = _voxel(places[rng.integers(len(places))])
    visited = [here]
    legs: list[Array] = []
    length = 0.0
    # nothing is faster than the limit, so a way of this length takes at least as long as asked
    length_min = duration_s * config.limits.speed_max_m_s
    while length < length_min:
        found = search(terrain.slowness, space.voxel_m, here, cost_max_m=_RING[1] * config.leg_length_m)
        goal = _next_goal(found.cost, places, visited, config.leg_length_m, rng)
        if goal is None:
            size_m, leg_m = float(np.ptp(space.bounds_m, axis=0).max()), config.leg_length_m
            if space.voxel_m > leg_m:
                raise PlanningError(
                    f"the scene is {size_m:,.0f} m across, too large for legs of {leg_m:g} m; if it is in "
                    "millimetres, declare scene.unit_m: 0.001, else raise path.leg_length_m"
                )
            raise PlanningError(
                f"leg {len(legs)} of the tour has nowhere to go: at clearance_m = {config.clearance_m:g} "
                f"only {len(places)} voxels of {space.voxel_m:g} m at flight height can be reached from "
                f"{_show(space.seed_m)}"
            )
        lines = _straighten(terrain, space.centers(found.way(goal)), leg=len(legs))
        legs.append(lines if not legs else lines[1:])
        length += float(np.linalg.norm(np.diff(lines, axis=0), axis=1).sum())
        visited.append(goal)
        here = goal
    return _smooth(terrain, np.concatenate(legs), config)


def plan_waypoints(space: FreeSpace, config: WaypointsConfig) -> Path:
    """Plan a flight through given places, from rest to rest.

    Args:
        space: Where the vehicle can fly.
        config: The places and the limits of the flight.

    Raises:
        PlanningError: A place is not in free space or cannot be reached at this clearance; the message says
            which one, and where the nearest place is that can.
    """
    terrain = _terrain(space, config)
    points = np.array(config.points_m, dtype=np.float64)
    legs: list[Array] = []
    for leg, (start, goal) in enumerate(itertools.pairwise(points)):
        if np.array_equal(start, goal):
            raise PlanningError(f"leg {leg}: points_m {leg} and {leg + 1} are the same, {_show(start)}")
        first = _entry(terrain, start, leg=leg, name="start")
        last = _entry(terrain, goal, leg=leg, name="goal")
        found = search(terrain.slowness, space.voxel_m, first, last)
        way = np.concatenate([start[None], space.centers(found.way(last)), goal[None]])
        lines = _straighten(terrain, way, leg=leg)
        legs.append(lines if not legs else lines[1:])
    return _smooth(terrain, np.concatenate(legs), config)


def _terrain(space: FreeSpace, config: CollisionFreeConfig) -> _Terrain:
    reachable = space.reachable(config.clearance_m)
    if not reachable.any():
        raise PlanningError(
            f"nothing can be reached at clearance_m = {config.clearance_m:g}: around the seed "
            f"{_show(space.seed_m)} no voxel of {space.voxel_m:g} m has as much room; the most in the scene "
            f"is {max(float(space.grid_clearance.max()), 0.0):.2f} m, which is "
            f"{float(np.ptp(space.bounds_m, axis=0).max()):.3g} m across"
        )
    lack = np.maximum(0.0, 1.0 - (space.grid_clearance - config.clearance_m) / _ROOM_WANTED_M)
    slowness = np.where(reachable, 1.0 + _NEAR_COST * lack**2, 0.0).astype(np.float32)
    return _Terrain(space=space, clearance_m=config.clearance_m, open=reachable, slowness=slowness)


def _places(terrain: _Terrain, config: TourConfig) -> NDArray[np.int64]:
    """Voxels that may be goals, [n, 3]: at flight height and with room; else the best there are."""
    height = terrain.space.height
    level = terrain.open & (height >= config.height_min_m) & (height <= config.height_max_m)
    level = level if level.any() else terrain.open
    room = terrain.space.grid_clearance
    wanted = min(config.clearance_m + 0.5 * _ROOM_WANTED_M, float(np.quantile(room[level], 0.5)))
    return np.argwhere(level & (room >= wanted))


def _next_goal(
    cost: NDArray[np.float32],
    places: NDArray[np.int64],
    visited: Sequence[Voxel],
    leg_length_m: float,
    rng: np.random.Generator,
) -> Voxel | None:
    """A random place about a leg's length away, the farthest of a few from where the tour has been."""
    way = cost[places[:, 0], places[:, 1], places[:, 2]]
    far = float(way.max(initial=0.0, where=np.isfinite(way)))
    if not far > 0.0:
        return None
    length = min(leg_length_m, far / _RING[1])
    ring = np.flatnonzero((way >= _RING[0] * length) & (way <= _RING[1] * length))
    if not len(ring):  # the voxels are wider than it
        return None
    few = places[rng.choice(ring, size=_CANDIDATES)]
    apart = np.linalg.norm(few[:, None].astype(np.float64) - np.array(visited), axis=2).min(axis=1)
    return _voxel(few[int(apart.argmax())])


def _entry(terrain: _Terrain, point: Array, *, leg: int, name: str) -> Voxel:
    """The open voxel next to a given place from which a straight line to it is clear."""
    space = terrain.space
    place = (point - space.origin_m) / space.voxel_m
    around = np.floor(place).astype(np.int64) + np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
    around = around[((around >= 0) & (around < space.distance.shape)).all(axis=1)]
    around = around[terrain.open[around[:, 0], around[:, 1], around[:, 2]]]
    around = around[np.argsort(np.linalg.norm(around - place, axis=1), kind="stable")]
    if len(around):
        lines = _lines(point[None].repeat(len(around), 0), space.centers(around))
        clear = np.flatnonzero(prove_clearance(lines, space, terrain.clearance_m + _SPARE_M))
        if len(clear):
            return _voxel(around[clear[0]])
    room = float(space.clearance(point[None])[0])
    _, nearest = scipy.ndimage.distance_transform_edt(~terrain.open, return_indices=True)
    near = space.centers(np.array([n[space.voxel_of(point)] for n in nearest]))
    if room < 0.0:
        low, high = space.bounds_m
        reason = f"is outside the scene, whose bounds are {_show(low)} to {_show(high)}"
    elif room < terrain.clearance_m:
        reason = f"has only {room:.3f} m of room, clearance_m = {terrain.clearance_m:g} is asked for"
    else:
        reason = (
            f"has {room:.3f} m of room but cannot be reached from {_show(space.seed_m)} "
            f"at clearance_m = {terrain.clearance_m:g}"
        )
    raise PlanningError(
        f"leg {leg}: its {name} {_show(point)} {reason}; the nearest place that can be reached "
        f"is {_show(near)}, {float(np.linalg.norm(near - point)):.2f} m away"
    )


def _straighten(terrain: _Terrain, way: Array, *, leg: int) -> Array:
    """The corners [n, 3] of the cheapest chain of straight, proven lines between points of a way."""
    space = terrain.space
    points = _corners(way, spacing_m=0.5)
    i, j = np.triu_indices(len(points), 1)
    cost = _line_costs(terrain, points[i], points[j])
    blocked = np.zeros((len(points), len(points)), dtype=bool)
    for _ in range(len(i)):
        price = np.full((len(points), len(points)), np.inf)
        price[i, j] = cost
        price[blocked] = np.inf
        chain = _cheapest_chain(price)
        if chain is None:
            break
        lines = _lines(points[chain[:-1]], points[chain[1:]])
        holds = prove_clearance(lines, space, terrain.clearance_m + _SPARE_M)
        if holds.all():
            return np.asarray(points[chain])
        blocked[np.array(chain[:-1])[~holds], np.array(chain[1:])[~holds]] = True
    raise PlanningError(
        f"leg {leg}: the way from {_show(way[0])} to {_show(way[-1])} cannot be proven to keep "
        f"{terrain.clearance_m:g} m; a smaller voxel_m maps the free space more finely"
    )


def _corners(way: Array, *, spacing_m: float) -> Array:
    """The points of a way where it turns, and some between, no farther apart than the spacing."""
    keep = [0]
    for k in range(1, len(way) - 1):
        turns = np.linalg.norm((way[k + 1] - way[k]) - (way[k] - way[k - 1])) > 1e-9
        if turns or np.linalg.norm(way[k] - way[keep[-1]]) >= spacing_m:
            keep.append(k)
    keep.append(len(way) - 1)
    points = way[keep]
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
    return np.asarray(points[np.concatenate([[True], moved])])


def _line_costs(terrain: _Terrain, a: Array, b: Array) -> Array:
    """Cost of straight lines by the grid [n]: length weighted by slowness, and a price for the corner."""
    space = terrain.space
    length = np.linalg.norm(b - a, axis=1)
    counts = np.ceil(length / space.voxel_m).astype(np.int64) + 1
    line = np.repeat(np.arange(len(a)), counts)
    s = (np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts)) / (counts[line] - 1)
    room = space.interpolated(a[line] + s[:, None] * (b - a)[line])
    slow = 1.0 + _NEAR_COST * np.maximum(0.0, 1.0 - (room - terrain.clearance_m) / _ROOM_WANTED_M) ** 2
    slow[room < terrain.clearance_m - space.voxel_m] = np.inf
    return np.asarray(length * np.add.reduceat(slow, np.cumsum(counts) - counts) / counts + _TURN_COST_M)


def _cheapest_chain(price: Array) -> list[int] | None:
    """Indices from the first to the last point along the cheapest forward chain; None if there is none."""
    count = len(price)
    best, before = np.full(count, np.inf), np.zeros(count, dtype=np.int64)
    best[0] = 0.0
    for k in range(1, count):
        total = best[:k] + price[:k, k]
        before[k] = int(total.argmin())
        best[k] = total[before[k]]
    if not math.isfinite(best[-1]):
        return None
    chain = [count - 1]
    while chain[-1] > 0:
        chain.append(int(before[chain[-1]]))
    return chain[::-1]


def _smooth(terrain: _Terrain, points: Array, config: CollisionFreeConfig) -> Path:
    """The fastest path of least snap through points within the limits, proven to keep the clearance."""
    rest = np.zeros(len(points), dtype=bool)
    splits = np.zeros(len(points) - 1, dtype=np.int64)
    while True:
        durations = allocate_durations(points, rest=rest)
        spline = solve_minimum_snap(points, durations, rest)
        holds = prove_clearance(spline.coefficients, terrain.space, config.clearance_m + _SPARE_M)
        if holds.all():
            factor = time_factor(spline.coefficients, durations, config.limits)
            path = follow_travel(
                _timed(points, rest, durations * factor),
                lookahead_s=config.lookahead_s,
                rate_max_rad_s=config.limits.yaw_rate_max_rad_s,
            )
            # durations were rounded to nanoseconds and pieces were cut: prove what is flown
            assert prove_clearance(path.coefficients[:, :3], terrain.space, config.clearance_m).all()
            assert flight_bounds(path).within(config.limits)
            return path
        points, rest, splits = _refine(points, rest, splits, ~holds)


def _timed(points: Array, rest: NDArray[np.bool_], durations_s: Array) -> Path:
    knots_ns = np.concatenate([[0], np.cumsum(np.ceil(durations_s * NS_PER_S).astype(np.int64))])
    return minimum_snap(points, knots_ns, rest=rest)


def _refine(
    points: Array, rest: NDArray[np.bool_], splits: NDArray[np.int64], collides: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Split pieces that collide in the middle of their line; if short already, stop at their ends."""
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    stop = collides & ((length < _PIECE_MIN_M) | (splits >= _SPLITS_MAX))
    rest = rest.copy()
    rest[:-1] |= stop
    rest[1:] |= stop
    split = np.flatnonzero(collides & ~stop)
    middles = 0.5 * (points[split] + points[split + 1])
    splits = splits.copy()
    splits[split] += 1
    return (
        np.insert(points, split + 1, middles, axis=0),
        np.insert(rest, split + 1, False),
        np.insert(splits, split, splits[split]),
    )


def _lines(a: Array, b: Array) -> Array:
    """Straight pieces as polynomials, [n, 3, 2]."""
    return np.stack([a, b - a], axis=2)


def _voxel(index: NDArray[np.int64]) -> Voxel:
    x, y, z = index.tolist()
    return x, y, z


def _show(point: Array) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in point) + ") m"
