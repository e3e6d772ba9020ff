"""Puts furniture into rooms: along walls, in groups, never into each other, a doorway or a window."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.apartment.assembly import Assembly, Piece
from neurosim_core.scene.apartment.floorplan import Rect, Room, Wall

WALL_GAP_M = 0.024
"""Between the wall and the back of what stands at it: room for the baseboard [m]."""
_LIFT_M = 0.002
"""Furniture hovers by this, so that its underside does not lie in the floor [m]."""
_APART_M = 0.03
"""Least gap between two pieces [m]."""
_DOOR_FREE_M = 1.05
"""Floor that stays free in front of a doorway [m]."""


@dataclass(frozen=True)
class Volume:
    """A block of space: a floor rectangle from one height to another [m]."""

    rect: Rect
    low: float
    high: float

    def overlaps(self, other: Volume) -> bool:
        """Whether the two share space."""
        return self.low < other.high and other.low < self.high and self.rect.overlaps(other.rect)


class RoomSpace:
    """What is still free in one room; pieces that fit are handed to the assembly."""

    def __init__(self, room: Room, assembly: Assembly, ceiling_m: float) -> None:
        self.room = room
        self.ceiling_m = ceiling_m
        self._assembly = assembly
        self._bodies: list[Volume] = []
        self._doors: list[Volume] = []
        self._windows: list[Volume] = []
        self._clearances: list[Volume] = []
        for wall in room.walls:
            for opening in wall.openings:
                if opening.kind == "door":
                    rect = wall.rect(opening.x0 - 0.14, opening.x1 + 0.14, _DOOR_FREE_M)
                    self._doors.append(Volume(rect, 0.02, ceiling_m))
                else:
                    rect = wall.rect(opening.x0 - 0.05, opening.x1 + 0.05, 0.4)
                    self._windows.append(Volume(rect, opening.z0 - 0.05, ceiling_m))

    def keep_free(self, rect: Rect, low: float = 0.02, high: float = 1.9) -> None:
        """Let nothing be put there but what belongs to a group [m]."""
        self._clearances.append(Volume(rect, low, high))

    def fits(self, volume: Volume, *, group: bool = False, window: bool = False) -> bool:
        """Whether a body can be there.

        Args:
            volume: The body.
            group: It belongs to what asked for clearance, and may stand in it.
            window: It may hide a window.
        """
        grown = Volume(volume.rect.grown(_APART_M), volume.low, volume.high)
        obstacles = [*self._doors, *([] if window else self._windows), *([] if group else self._clearances)]
        return (
            self.room.rect.contains(volume.rect)
            and not any(grown.overlaps(body) for body in self._bodies)
            and not any(volume.overlaps(obstacle) for obstacle in obstacles)
        )

    def put(
        self,
        piece: Piece,
        offset: tuple[float, float, float],
        yaw_rad: float = 0.0,
        *,
        group: bool = False,
        window: bool = False,
    ) -> bool:
        """Place a piece at a position in the world if it fits there; see `fits`."""
        moved = piece.moved((offset[0], offset[1], offset[2] + _LIFT_M), yaw_rad)
        volume = _volume(moved)
        if not self.fits(volume, group=group, window=window):
            return False
        self._assembly.place(moved)
        self._bodies.append(volume)
        return True

    def put_at_wall(
        self,
        piece: Piece,
        wall: Wall,
        x: float,
        *,
        out: float = WALL_GAP_M,
        yaw_rad: float = 0.0,
        lift: float = 0.0,
        group: bool = False,
        window: bool = False,
    ) -> bool:
        """Place a piece in the frame of a wall, at x along it and `out` in front of it, if it fits there."""
        wx, wy = wall_point(wall, x, out)
        return self.put(piece, (wx, wy, lift), wall.yaw_rad + yaw_rad, group=group, window=window)

    def spots(
        self,
        piece: Piece,
        rng: np.random.Generator,
        *,
        front_m: float = 0.5,
        sides_m: float = 0.0,
        liking: Callable[[Wall, float], float] | None = None,
        window: bool = False,
    ) -> list[tuple[Wall, float]]:
        """Places along the walls where a piece fits, the best first.

        Args:
            piece: What shall be placed.
            rng: Breaks ties.
            front_m: Floor in front of it that must be free of other bodies [m].
            sides_m: The same on both sides [m].
            liking: Higher for better places; of a wall and a position along it.
            window: It may hide a window.
        """
        (x0, y0, z0), (x1, _, z1) = piece.bounds
        ranked: list[tuple[float, Wall, float]] = []
        for wall in self.room.walls:
            margin = 0.04
            low, high = margin - x0 + sides_m, wall.length_m - margin - x1 - sides_m
            if high < low:
                continue
            for x in np.unique(np.concatenate([np.arange(low, high, 0.1), [high, 0.5 * (low + high)]])):
                rect = wall.rect(x + x0 - sides_m, x + x1 + sides_m, WALL_GAP_M - y0)
                if not self.fits(Volume(rect, z0 + _LIFT_M, z1 + _LIFT_M), window=window):
                    continue
                front = wall.rect(x + x0, x + x1, WALL_GAP_M - y0 + front_m)
                if not self.room.rect.contains(front) or any(
                    Volume(front, 0.05, 1.5).overlaps(body) for body in self._bodies
                ):
                    continue
                score = float(rng.uniform()) * 0.6 + (liking(wall, float(x)) if liking else 0.0)
                ranked.append((score, wall, float(x)))
        ranked.sort(key=lambda item: -item[0])
        return [(wall, x) for _, wall, x in ranked]

    def along_wall(
        self,
        piece: Piece,
        rng: np.random.Generator,
        *,
        front_m: float = 0.5,
        sides_m: float = 0.0,
        liking: Callable[[Wall, float], float] | None = None,
        window: bool = False,
    ) -> tuple[Wall, float] | None:
        """Place a piece at the best spot along the walls; where that is, or None when it fits nowhere."""
        for wall, x in self.spots(piece, rng, front_m=front_m, sides_m=sides_m, liking=liking, window=window):
            if self.put_at_wall(piece, wall, x, window=window):
                (x0, y0, _), (x1, _, _) = piece.bounds
                self.keep_free(wall.rect(x + x0, x + x1, WALL_GAP_M - y0 + front_m))
                return wall, x
        return None

    def hang(self, piece: Piece, wall: Wall, x: float, *, window: bool = False) -> bool:
        """Hang a piece on a wall, 3 mm off it, if it fits there."""
        return self.put_at_wall(piece, wall, x, out=0.003, group=True, window=window)

    def open_spot(
        self, bounds: NDArray[np.float64], rng: np.random.Generator, *, around_m: float, group: bool = False
    ) -> tuple[float, float] | None:
        """The most central place found for something with `around_m` of free floor around it.

        Args:
            bounds: Lowest and highest corner of it [m], shape [2, 3].
            rng: Proposes places.
            around_m: Free floor on all sides [m].
            group: It may stand in what other pieces want free.

        Returns:
            Where its origin has to be [m], or None.
        """
        (x0, y0, z0), (x1, y1, z1) = (
            bounds[0] - (around_m, around_m, 0.0),
            bounds[1] + (around_m, around_m, 0.0),
        )
        room = self.room.rect
        if room.width < x1 - x0 or room.depth < y1 - y0:
            return None
        best: tuple[float, float, float] | None = None
        for _ in range(80):
            x = float(rng.uniform(room.x0 - x0, room.x1 - x1))
            y = float(rng.uniform(room.y0 - y0, room.y1 - y1))
            volume = Volume(Rect(x + x0, y + y0, x + x1, y + y1), z0 + _LIFT_M, z1 + _LIFT_M)
            if not self.fits(volume, group=group):
                continue
            away = abs(x - room.center[0]) / room.width + abs(y - room.center[1]) / room.depth
            if best is None or away < best[0]:
                best = away, x, y
        return None if best is None else best[1:]

    def roomiest(self, height_m: float) -> tuple[float, tuple[float, float, float]]:
        """The point at a height that is furthest from walls and furniture's bounds, and that distance [m]."""
        room = self.room.rect
        xs, ys = np.arange(room.x0 + 0.2, room.x1 - 0.2, 0.1), np.arange(room.y0 + 0.2, room.y1 - 0.2, 0.1)
        x, y = (grid.reshape(-1) for grid in np.meshgrid(xs, ys))
        clear = np.minimum(np.minimum(x - room.x0, room.x1 - x), np.minimum(y - room.y0, room.y1 - y))
        for body in self._bodies:
            dx = np.maximum(np.maximum(body.rect.x0 - x, x - body.rect.x1), 0.0)
            dy = np.maximum(np.maximum(body.rect.y0 - y, y - body.rect.y1), 0.0)
            dz = max(body.low - height_m, height_m - body.high, 0.0)
            clear = np.minimum(clear, np.sqrt(dx * dx + dy * dy + dz * dz))
        best = int(np.argmax(clear))
        return float(clear[best]), (float(x[best]), float(y[best]), height_m)


def wall_point(wall: Wall, x: float, out: float) -> tuple[float, float]:
    """A point of the floor at x along a wall and `out` in front of it, in the world [m]."""
    c, s = round(math.cos(wall.yaw_rad)), round(math.sin(wall.yaw_rad))
    return wall.origin[0] + c * x + s * out, wall.origin[1] + s * x - c * out


def _volume(piece: Piece) -> Volume:
    (x0, y0, z0), (x1, y1, z1) = piece.bounds
    return Volume(Rect(float(x0), float(y0), float(x1), float(y1)), float(z0), float(z1))


def corner_liking(wall: Wall, x: float) -> float:
    """Prefers the ends of walls."""
    return 1.5 * abs(x / wall.length_m - 0.5)


def middle_liking(wall: Wall, x: float) -> float:
    """Prefers the middle of long walls without windows."""
    windows = sum(opening.x1 - opening.x0 for opening in wall.openings)
    return 0.25 * (wall.length_m - windows) - 2.5 * abs(x / wall.length_m - 0.5)


def opposite(room: Room, wall: Wall) -> Wall:
    """The wall across the room."""
    return room.walls[(room.walls.index(wall) + 2) % 4]
