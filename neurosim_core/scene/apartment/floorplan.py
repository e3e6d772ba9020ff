"""The plan of a flat: rooms as rectangles that share walls, and the doors and windows in these walls."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

Role = Literal["studio", "living", "kitchen", "bedroom", "study", "bathroom", "dining"]

WALL_M = 0.12
"""Thickness of the walls between rooms [m]."""
OUTER_WALL_M = 0.30
"""Thickness of the walls to the outside [m]."""

_ROLES: dict[int, tuple[Role, ...]] = {
    1: ("studio",),
    2: ("living", "bedroom"),
    3: ("living", "kitchen", "bedroom"),
    4: ("living", "kitchen", "bedroom", "study"),
    5: ("living", "kitchen", "bedroom", "study", "bathroom"),
    6: ("living", "kitchen", "bedroom", "study", "bathroom", "bedroom"),
    7: ("living", "kitchen", "bedroom", "study", "bathroom", "bedroom", "dining"),
    8: ("living", "kitchen", "bedroom", "study", "bathroom", "bedroom", "dining", "study"),
}
_AREA_M2: dict[Role, float] = {
    "studio": 38.0,
    "living": 27.0,
    "kitchen": 14.5,
    "bedroom": 16.0,
    "study": 12.5,
    "bathroom": 8.5,
    "dining": 15.0,
}
_SIDE_MIN_M: dict[Role, float] = {
    "studio": 5.0,
    "living": 4.2,
    "kitchen": 3.0,
    "bedroom": 3.3,
    "study": 2.8,
    "bathroom": 2.2,
    "dining": 3.2,
}
_CORNER_M = 0.30
"""Least distance of an opening from the corner of a room [m]."""


def stream(seed: int, *key: str | int) -> np.random.Generator:
    """Random numbers that belong to one subject: another subject's draws never change them."""
    words = [zlib.crc32(str(part).encode()) for part in key]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=words)))


@dataclass(frozen=True)
class Rect:
    """An axis-aligned rectangle [m]."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        """Extent along x [m]."""
        return self.x1 - self.x0

    @property
    def depth(self) -> float:
        """Extent along y [m]."""
        return self.y1 - self.y0

    @property
    def center(self) -> tuple[float, float]:
        """Its middle [m]."""
        return 0.5 * (self.x0 + self.x1), 0.5 * (self.y0 + self.y1)

    def grown(self, margin_m: float) -> Rect:
        """The rectangle with `margin_m` added on every side."""
        return Rect(self.x0 - margin_m, self.y0 - margin_m, self.x1 + margin_m, self.y1 + margin_m)

    def overlaps(self, other: Rect) -> bool:
        """Whether the two share an area."""
        return self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1

    def contains(self, other: Rect) -> bool:
        """Whether `other` lies inside."""
        return self.x0 <= other.x0 and self.y0 <= other.y0 and self.x1 >= other.x1 and self.y1 >= other.y1


@dataclass(frozen=True)
class Opening:
    """A hole in a wall of a room, in the frame of that wall (see `Wall`)."""

    kind: Literal["door", "window"]
    x0: float
    x1: float
    z0: float
    z1: float


@dataclass(frozen=True)
class Wall:
    """One side of a room, from inside.

    Its frame: x runs to the right for somebody in the room who looks at it, y into the wall, z up; the
    origin is the lower left corner. Furniture shares this frame: its back is at y = 0, its front towards -y.
    """

    origin: tuple[float, float]
    """Lower left corner, world [m]."""
    yaw_rad: float
    """Turns the wall's axes into the world's."""
    length_m: float
    outer: bool
    """Whether no other room lies behind any part of it."""
    openings: tuple[Opening, ...] = ()

    def rect(self, x0: float, x1: float, depth_m: float) -> Rect:
        """The floor in front of the wall between x0 and x1, in the world."""
        c, s = round(math.cos(self.yaw_rad)), round(math.sin(self.yaw_rad))
        ox, oy = self.origin
        xs = (ox + c * x0, ox + c * x1 + s * depth_m)
        ys = (oy + s * x0, oy + s * x1 - c * depth_m)
        return Rect(min(xs), min(ys), max(xs), max(ys))


@dataclass(frozen=True)
class Room:
    """One room: its floor rectangle between the walls' faces."""

    name: str
    role: Role
    rect: Rect
    walls: tuple[Wall, Wall, Wall, Wall]
    """North, east, south, west."""


@dataclass(frozen=True)
class Door:
    """An open doorway between two rooms."""

    rooms: tuple[int, int]
    """The room on its lower side and the one on its upper side (along `axis`)."""
    axis: Literal["x", "y"]
    """The direction of passage."""
    at_m: float
    """Position of the wall's middle along `axis` [m]."""
    low_m: float
    high_m: float
    """Extent across the passage [m]."""


@dataclass(frozen=True)
class FloorPlan:
    """Rooms, and the doors that connect them all."""

    outline: Rect
    """Everything inside the outer walls, plus half of an inner wall's thickness."""
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]


def make_floor_plan(
    *, seed: int, rooms: int, door_width_m: float, door_height_m: float, ceiling_m: float
) -> FloorPlan:
    """Lay out a flat whose rooms are all connected by doors.

    Of many random subdivisions of a rectangle the one with the best proportions is taken.

    Args:
        seed: Chooses the flat.
        rooms: Number of rooms, 1 to 8.
        door_width_m: Clear width of doorways [m].
        door_height_m: Clear height of doorways [m].
        ceiling_m: Height of the rooms [m].
    """
    roles = _ROLES[rooms]
    best: tuple[float, list[Rect], list[Door], Rect] | None = None
    for attempt in range(400):
        rng = stream(seed, "plan", rooms, attempt)
        areas = [_AREA_M2[role] * rng.uniform(0.9, 1.15) for role in roles]
        aspect = rng.uniform(1.15, 1.6) if rooms > 1 else rng.uniform(1.2, 1.5)
        width = round(math.sqrt(sum(areas) * aspect), 2)
        depth = round(sum(areas) / width, 2)
        outline = Rect(-width / 2.0, -depth / 2.0, width / 2.0, depth / 2.0)
        cells: list[Rect | None] = [None] * rooms
        _subdivide(outline, [int(k) for k in rng.permutation(rooms)], areas, cells, rng)
        placed = [cell for cell in cells if cell is not None]
        doors = _doors(placed, roles, door_width_m, rng)
        if doors is None:
            continue
        badness = _badness(placed, roles, outline) + 0.05 * rng.uniform()
        if best is None or badness < best[0]:
            best = badness, placed, doors, outline
        if best[0] < 0.1 and attempt >= 40:
            break
    assert best is not None, "no subdivision of the plan connects all rooms"
    _, placed, doors, outline = best
    names = [f"{role}_{1 + roles[:index].count(role)}" for index, role in enumerate(roles)]
    built = tuple(
        _room(index, names[index], roles[index], placed, doors, outline, seed, door_height_m, ceiling_m)
        for index in range(rooms)
    )
    return FloorPlan(outline=outline, rooms=built, doors=tuple(doors))


def _subdivide(
    rect: Rect, order: list[int], areas: list[float], cells: list[Rect | None], rng: np.random.Generator
) -> None:
    if len(order) == 1:
        cells[order[0]] = rect
        return
    total = sum(areas[k] for k in order)
    cuts = range(1, len(order))
    shares = [sum(areas[k] for k in order[:cut]) / total for cut in cuts]
    weight = np.array([math.exp(-6.0 * abs(share - 0.5)) for share in shares])
    cut = 1 + int(rng.choice(len(shares), p=weight / weight.sum()))
    share = shares[cut - 1]
    longer_x = rect.width > rect.depth
    if longer_x == (rng.uniform() < 0.9):
        at = round(rect.x0 + share * rect.width, 2)
        first, second = Rect(rect.x0, rect.y0, at, rect.y1), Rect(at, rect.y0, rect.x1, rect.y1)
    else:
        at = round(rect.y0 + share * rect.depth, 2)
        first, second = Rect(rect.x0, rect.y0, rect.x1, at), Rect(rect.x0, at, rect.x1, rect.y1)
    _subdivide(first, order[:cut], areas, cells, rng)
    _subdivide(second, order[cut:], areas, cells, rng)


def _badness(cells: list[Rect], roles: tuple[Role, ...], outline: Rect) -> float:
    """0 for rooms of good proportions that all reach an outer wall."""
    badness = 0.0
    for cell, role in zip(cells, roles, strict=True):
        short, long = sorted((cell.width - WALL_M, cell.depth - WALL_M))
        badness += 4.0 * max(0.0, _SIDE_MIN_M[role] - short) + max(0.0, long / short - 1.6)
        badness += 0.6 * (outline.grown(-0.01).contains(cell))
    return badness


def _shared(a: Rect, b: Rect) -> tuple[Literal["x", "y"], float, float, float, bool] | None:
    """Passage axis, wall position, extent, whether `a` is on the lower side; None if they do not touch."""
    low, high = max(a.y0, b.y0), min(a.y1, b.y1)
    if high > low and (a.x1 == b.x0 or a.x0 == b.x1):
        return "x", (a.x1 if a.x1 == b.x0 else a.x0), low, high, a.x1 == b.x0
    low, high = max(a.x0, b.x0), min(a.x1, b.x1)
    if high > low and (a.y1 == b.y0 or a.y0 == b.y1):
        return "y", (a.y1 if a.y1 == b.y0 else a.y0), low, high, a.y1 == b.y0
    return None


def _doors(
    cells: list[Rect], roles: tuple[Role, ...], door_width_m: float, rng: np.random.Generator
) -> list[Door] | None:
    """A spanning tree of doors, and for larger flats one more, so that one can fly in a circle."""
    candidates: list[tuple[float, Door]] = []
    margin = 0.5 * WALL_M + _CORNER_M
    for first in range(len(cells)):
        for second in range(first + 1, len(cells)):
            shared = _shared(cells[first], cells[second])
            if shared is None:
                continue
            axis, at, low, high, first_is_lower = shared
            width = door_width_m
            pair = {roles[first], roles[second]}
            if pair in ({"living", "kitchen"}, {"living", "dining"}, {"kitchen", "dining"}):
                width = min(1.7 * door_width_m, max(door_width_m, high - low - 2.0 * margin - 0.4))
            slack = high - low - 2.0 * margin - width
            if slack < 0.0:
                continue
            start = low + margin + slack * float(rng.choice([0.0, 1.0, rng.uniform()]))
            cost = float(rng.uniform()) - 1.0 * ("living" in pair) + 1.5 * ("bathroom" in pair)
            cost -= 2.0 * (width > door_width_m)
            lower, upper = (first, second) if first_is_lower else (second, first)
            candidates.append((cost, Door((lower, upper), axis, at, start, start + width)))
    candidates.sort(key=lambda item: item[0])
    group = list(range(len(cells)))
    doors: list[Door] = []
    spare: list[Door] = []
    for _, door in candidates:
        a, b = (group[index] for index in door.rooms)
        if a == b:
            spare.append(door)
            continue
        doors.append(door)
        group = [a if g == b else g for g in group]
    if len(set(group)) > 1:
        return None
    loops = [door for door in spare if not any(roles[index] == "bathroom" for index in door.rooms)]
    return doors + loops[: 1 if len(cells) >= 4 else 0]


def _room(
    index: int,
    name: str,
    role: Role,
    cells: list[Rect],
    doors: list[Door],
    outline: Rect,
    seed: int,
    door_height_m: float,
    ceiling_m: float,
) -> Room:
    cell = cells[index]
    rect = cell.grown(-0.5 * WALL_M)
    sides = (  # name of the passage axis, position of the wall, whether this room is on its lower side
        ("y", cell.y1, True, (rect.x0, rect.y1), 0.0, rect.width, cell.y1 == outline.y1),
        ("x", cell.x1, True, (rect.x1, rect.y1), -0.5 * math.pi, rect.depth, cell.x1 == outline.x1),
        ("y", cell.y0, False, (rect.x1, rect.y0), math.pi, rect.width, cell.y0 == outline.y0),
        ("x", cell.x0, False, (rect.x0, rect.y0), 0.5 * math.pi, rect.depth, cell.x0 == outline.x0),
    )
    rng = stream(seed, "windows", name)
    lit = sorted((side for side in sides if side[6]), key=lambda side: -side[5])
    lit = lit[: 2 if role in ("living", "studio") else 1]
    walls = []
    for side in sides:
        axis, at, lower, origin, yaw, length, outer = side
        openings = []
        for door in doors:
            if door.axis == axis and door.at_m == at and door.rooms[0 if lower else 1] == index:
                start = origin[0] if axis == "y" else origin[1]
                ends = sorted(abs(value - start) for value in (door.low_m, door.high_m))
                openings.append(Opening("door", ends[0], ends[1], 0.0, door_height_m))
        if side in lit:
            openings += _windows(role, length, ceiling_m, rng)
        walls.append(Wall(origin, yaw, length, outer, tuple(sorted(openings, key=lambda o: o.x0))))
    north, east, south, west = walls
    return Room(name, role, rect, (north, east, south, west))


def _windows(role: Role, length_m: float, ceiling_m: float, rng: np.random.Generator) -> list[Opening]:
    """Windows in an outer wall, evenly spread."""
    sill = {"bathroom": 1.35, "kitchen": 1.15, "living": 0.45, "studio": 0.55}.get(role, 0.85)
    width = {"bathroom": 0.8, "living": 1.9, "studio": 1.9}.get(role, 1.35) + rng.uniform(-0.1, 0.15)
    top = min(2.3, ceiling_m - 0.25)
    count = 1 if length_m < 2.0 * width + 2.2 else 2
    if role == "bathroom" or length_m < width + 1.0:
        count = min(count, int(length_m > width + 0.8))
    pitch = length_m / count if count else 0.0
    return [
        Opening("window", pitch * (k + 0.5) - 0.5 * width, pitch * (k + 0.5) + 0.5 * width, sill, top)
        for k in range(count)
    ]
