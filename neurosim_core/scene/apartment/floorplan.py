"""The plan of a flat: rooms as rectangles that share walls, and the doors and windows in these walls."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from neurosim_core.scene.apartment.draws import stream
from neurosim_core.settings_file import read_table

if TYPE_CHECKING:
    from neurosim_core.scene.apartment.apartment import ApartmentConfig

Role = Literal["studio", "living", "kitchen", "bedroom", "study", "bathroom", "dining"]

WALL_M = 0.12
"""Thickness of the walls between rooms [m]."""
OUTER_WALL_M = 0.30
"""Thickness of the walls to the outside [m]."""
_CORNER_M = 0.30
"""Least distance of an opening from the corner of a room [m]."""
_MANY: tuple[Role, ...] = ("living", "kitchen", "bedroom", "study", "bathroom", "bedroom", "dining", "study")
_OPEN_PLAN = ({"living", "kitchen"}, {"living", "dining"}, {"kitchen", "dining"})
"""Rooms with a wider doorway between them."""


class Rect(NamedTuple):
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
        """Return the rectangle with `margin_m` added on every side."""
        return Rect(self.x0 - margin_m, self.y0 - margin_m, self.x1 + margin_m, self.y1 + margin_m)


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
    openings: tuple[Opening, ...] = ()

    def point(self, x: Any, out: float) -> tuple[Any, Any]:
        """Return where x along the wall and `out` in front of it is on the floor of the world [m]."""
        c, s = round(math.cos(self.yaw_rad)), round(math.sin(self.yaw_rad))
        return self.origin[0] + c * x + s * out, self.origin[1] + s * x - c * out


@dataclass(frozen=True)
class Room:
    """One room: its floor rectangle between the walls' faces."""

    name: str
    role: Role
    rect: Rect
    walls: tuple[Wall, ...]
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


def make_floor_plan(config: ApartmentConfig) -> FloorPlan:
    """Lay out a flat whose rooms are all connected by doors.

    Of many random subdivisions of a rectangle the one with the best proportions is taken.
    """
    seed, rooms, sizes = config.seed, config.rooms, read_table(__file__, "plan")
    roles = _MANY[:rooms] if rooms > 2 else (("studio",), ("living", "bedroom"))[rooms - 1]
    best: tuple[float, list[Rect], list[Door], Rect] | None = None
    for attempt in range(400):
        rng = stream(seed, "plan", rooms, attempt)
        areas = [sizes[role]["area_m2"] * rng.uniform(0.9, 1.15) for role in roles]
        aspect = rng.uniform(1.15, 1.6) if rooms > 1 else rng.uniform(1.2, 1.5)
        width = round(math.sqrt(sum(areas) * aspect), 2)
        depth = round(sum(areas) / width, 2)
        outline = Rect(-width / 2.0, -depth / 2.0, width / 2.0, depth / 2.0)
        placed = dict(_subdivide(outline, [int(k) for k in rng.permutation(rooms)], areas, rng))
        cells = [placed[index] for index in range(rooms)]
        doors = _doors(cells, roles, config.door_width_m, rng)
        if doors is None:
            continue
        badness = _badness(cells, roles, outline) + 0.05 * rng.uniform()
        if best is None or badness < best[0]:
            best = badness, cells, doors, outline
        if best[0] < 0.1 and attempt >= 40:
            break
    assert best is not None, "no subdivision of the plan connects all rooms"
    _, cells, doors, outline = best
    built = []
    for index, (role, cell) in enumerate(zip(roles, cells, strict=True)):
        name = f"{role}_{1 + roles[:index].count(role)}"
        walls = _walls(index, role, cell, doors, outline, stream(seed, "windows", name), config)
        built.append(Room(name, role, cell.grown(-0.5 * WALL_M), tuple(walls)))
    return FloorPlan(outline, tuple(built), tuple(doors))


def _subdivide(
    rect: Rect, order: Sequence[int], areas: Sequence[float], rng: np.random.Generator
) -> list[tuple[int, Rect]]:
    """Cut a rectangle into one for each room of `order`."""
    if len(order) == 1:
        return [(order[0], rect)]
    total = sum(areas[k] for k in order)
    shares = [area / total for area in itertools.accumulate(areas[k] for k in order[:-1])]
    weight = np.array([math.exp(-6.0 * abs(share - 0.5)) for share in shares])
    cut = 1 + int(rng.choice(len(shares), p=weight / weight.sum()))
    share = shares[cut - 1]
    axis = "x" if (rect.width > rect.depth) == (rng.uniform() < 0.9) else "y"
    low, size = (rect.x0, rect.width) if axis == "x" else (rect.y0, rect.depth)
    at = round(low + share * size, 2)
    first, second = rect._replace(**{f"{axis}1": at}), rect._replace(**{f"{axis}0": at})
    return _subdivide(first, order[:cut], areas, rng) + _subdivide(second, order[cut:], areas, rng)


def _badness(cells: Sequence[Rect], roles: Sequence[Role], outline: Rect) -> float:
    """Return 0 for rooms of good proportions that all reach an outer wall."""
    badness = 0.0
    for cell, role in zip(cells, roles, strict=True):
        short, long = sorted((cell.width - WALL_M, cell.depth - WALL_M))
        side_min_m = read_table(__file__, "plan")[role]["side_min_m"]
        badness += 4.0 * max(0.0, side_min_m - short) + max(0.0, long / short - 1.6)
        badness += 0.6 * all(own != outer for own, outer in zip(cell, outline, strict=True))
    return badness


def _doors(
    cells: Sequence[Rect], roles: Sequence[Role], door_width_m: float, rng: np.random.Generator
) -> list[Door] | None:
    """Return a spanning tree of doors, and for larger flats one more, so that one can fly in a circle."""
    candidates: list[tuple[float, Door]] = []
    margin = 0.5 * WALL_M + _CORNER_M
    for first, second in itertools.combinations(range(len(cells)), 2):
        a, b = cells[first], cells[second]
        axis = next((axis for axis in (0, 1) if a[axis + 2] == b[axis] or a[axis] == b[axis + 2]), None)
        if axis is None:
            continue
        lower_first, across = a[axis + 2] == b[axis], 1 - axis
        at = b[axis] if lower_first else a[axis]
        low, high = max(a[across], b[across]), min(a[across + 2], b[across + 2])
        pair, clear = {roles[first], roles[second]}, high - low - 2.0 * margin
        wider = min(1.7 * door_width_m, max(door_width_m, clear - 0.4))
        width = wider if pair in _OPEN_PLAN else door_width_m
        if clear < width:
            continue
        start = low + margin + (clear - width) * float(rng.choice([0.0, 1.0, rng.uniform()]))
        cost = float(rng.uniform()) - 1.0 * ("living" in pair) + 1.5 * ("bathroom" in pair)
        cost -= 2.0 * (width > door_width_m)
        sides = (first, second) if lower_first else (second, first)
        candidates.append((cost, Door(sides, "y" if axis else "x", at, start, start + width)))
    group = list(range(len(cells)))
    doors: list[Door] = []
    spare: list[Door] = []
    for _, door in sorted(candidates, key=lambda item: item[0]):
        joined, other = (group[index] for index in door.rooms)
        (spare if joined == other else doors).append(door)
        group = [joined if g == other else g for g in group]
    if len(set(group)) > 1:
        return None
    loops = [door for door in spare if not any(roles[index] == "bathroom" for index in door.rooms)]
    return doors + loops[: 1 if len(cells) >= 4 else 0]


def _walls(
    index: int,
    role: Role,
    cell: Rect,
    doors: Sequence[Door],
    outline: Rect,
    rng: np.random.Generator,
    config: ApartmentConfig,
) -> list[Wall]:
    """Return the four walls of a room with doors, and windows in the longest outer ones."""
    rect = cell.grown(-0.5 * WALL_M)
    sides = (  # axis of passage, its position, which side the room is on, the wall, whether it is outer
        ("y", cell.y1, 0, Wall((rect.x0, rect.y1), 0.0, rect.width), cell.y1 == outline.y1),
        ("x", cell.x1, 0, Wall((rect.x1, rect.y1), -0.5 * math.pi, rect.depth), cell.x1 == outline.x1),
        ("y", cell.y0, 1, Wall((rect.x1, rect.y0), math.pi, rect.width), cell.y0 == outline.y0),
        ("x", cell.x0, 1, Wall((rect.x0, rect.y0), 0.5 * math.pi, rect.depth), cell.x0 == outline.x0),
    )
    lit = sorted((wall for *_, wall, outer in sides if outer), key=lambda wall: -wall.length_m)
    lit = lit[: 2 if role in ("living", "studio") else 1]
    walls = []
    for axis, at, side, wall, _ in sides:
        start = wall.origin[0] if axis == "y" else wall.origin[1]
        openings = []
        for door in doors:
            if (door.axis, door.at_m, door.rooms[side]) == (axis, at, index):
                x0, x1 = sorted(abs(value - start) for value in (door.low_m, door.high_m))
                openings.append(Opening("door", x0, x1, 0.0, config.door_height_m))
        if wall in lit:
            openings += _windows(role, wall.length_m, config.ceiling_m, rng)
        openings.sort(key=lambda opening: opening.x0)
        walls.append(Wall(wall.origin, wall.yaw_rad, wall.length_m, tuple(openings)))
    return walls


def _windows(role: Role, length_m: float, ceiling_m: float, rng: np.random.Generator) -> list[Opening]:
    """Return windows in an outer wall, evenly spread."""
    size = {"sill_m": 0.85, "window_m": 1.35} | read_table(__file__, "plan")[role]
    width = size["window_m"] + rng.uniform(-0.1, 0.15)
    count = 1 if length_m < 2.0 * width + 2.2 else 2
    if role == "bathroom" or length_m < width + 1.0:
        count = min(count, int(length_m > width + 0.8))
    middles = [length_m / count * (k + 0.5) for k in range(count)]
    top = min(2.3, ceiling_m - 0.25)
    return [Opening("window", x - 0.5 * width, x + 0.5 * width, size["sill_m"], top) for x in middles]
