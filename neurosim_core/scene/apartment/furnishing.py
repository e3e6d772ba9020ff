"""Puts furniture into rooms: along walls, in groups, never into each other, a doorway or a window."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim_core.scene.apartment.draws import Draws
from neurosim_core.scene.apartment.floorplan import Room, Wall
from neurosim_core.scene.apartment.pieces import Piece
from neurosim_core.scene.solids import Array

WALL_GAP_M = 0.024
"""Between the wall and the back of what stands at it: room for the baseboard [m]."""
_LIFT_M = 0.002
"""Furniture hovers by this, so that its underside does not lie in the floor [m]."""
_APART_M = 0.03
"""Least gap between two pieces [m]."""
_DOOR_FREE_M = 1.05
"""Floor that stays free in front of a doorway [m]."""

Place = Literal["anywhere", "corner", "middle"]


class RoomSpace:
    """The free floor of one room; pieces that fit are kept where they stand.

    Boxes are lowest and highest corners in the world [m], shape [N, 2, 3].
    """

    def __init__(self, room: Room, ceiling_m: float) -> None:
        """Start with an empty room, whose doors and windows stay free."""
        self.room = room
        self.ceiling_m = ceiling_m
        self.pieces: list[Piece] = []
        self._bodies: list[Array] = []
        self._doors: list[Array] = []
        self._windows: list[Array] = []
        self._clearances: list[Array] = []
        for wall, o in ((side, opening) for side in room.walls for opening in side.openings):
            if o.kind == "door":
                free = _front_of(wall, o.x0 - 0.14, o.x1 + 0.14, _DOOR_FREE_M, (0.02, ceiling_m))
                self._doors.append(free)
            else:
                above = (o.z0 - 0.05, ceiling_m)
                self._windows.append(_front_of(wall, o.x0 - 0.05, o.x1 + 0.05, 0.4, above))

    def _free(self, boxes: Array, *, group: bool = False, window: bool = False) -> NDArray[np.bool_]:
        """Return for each box whether a body can be there, shape [N].

        A `group` may stand in the clearance that a piece of it asked for; what may hide a `window` says so.
        """
        grown = boxes + np.array([[-_APART_M, -_APART_M, 0.0], [_APART_M, _APART_M, 0.0]])
        kept = [*self._doors, *([] if window else self._windows), *([] if group else self._clearances)]
        return self._inside(boxes) & ~_touches(grown, self._bodies) & ~_touches(boxes, kept)

    def _inside(self, boxes: Array) -> NDArray[np.bool_]:
        x0, y0, x1, y1 = self.room.rect
        return np.asarray(((boxes[:, 0, :2] >= (x0, y0)) & (boxes[:, 1, :2] <= (x1, y1))).all(axis=1))

    def put(self, piece: Piece, offset: ArrayLike, yaw_rad: float = 0.0, **allowed: bool) -> bool:
        """Place a piece at a position in the world if it fits there; `_free` says what can be allowed."""
        moved = piece.moved(np.add(offset, (0.0, 0.0, _LIFT_M)), yaw_rad)
        if not self._free(moved.bounds[None], **allowed)[0]:
            return False
        self.pieces.append(moved)
        self._bodies.append(moved.bounds[None])
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
        **allowed: bool,
    ) -> bool:
        """Place a piece in the frame of a wall, at x along it and `out` in front of it, if it fits there."""
        return self.put(piece, (*wall.point(x, out), lift), wall.yaw_rad + yaw_rad, **allowed)

    def hang(self, piece: Piece, wall: Wall, x: float, *, window: bool = False) -> bool:
        """Hang a piece on a wall, 3 mm off it, if it fits there."""
        return self.put_at_wall(piece, wall, x, out=0.003, group=True, window=window)

    def along_wall(
        self,
        piece: Piece,
        draws: Draws,
        *,
        front: float = 0.5,
        sides: float = 0.0,
        prefer: Place = "anywhere",
        window: bool = False,
    ) -> tuple[Wall, float] | None:
        """Place a piece at the best spot along the walls; return the wall and the position along it, or None.

        In front and on both sides of it so much floor must be free of other bodies [m], and that in front
        stays so but for its group. `prefer`: the ends of walls, or the middle of long walls without windows,
        one of which it may hide with `window`.
        """
        (x0, y0, z0), (x1, _, z1) = piece.bounds
        deep, heights = WALL_GAP_M - y0, (z0 + _LIFT_M, z1 + _LIFT_M)
        best: tuple[float, Wall, float] | None = None
        for index, wall in enumerate(self.room.walls):
            low, high = 0.04 - x0 + sides, wall.length_m - 0.04 - x1 - sides
            if high < low:
                continue
            x = np.unique(np.concatenate([np.arange(low, high, 0.1), [high, 0.5 * (low + high)]]))
            beside = _front_of(wall, x + x0 - sides, x + x1 + sides, deep, heights)
            fits = self._free(beside, window=window)
            fits &= self._free(_front_of(wall, x + x0, x + x1, deep, heights), window=window)
            ahead = _front_of(wall, x + x0, x + x1, deep + front, (0.05, 1.5))
            fits &= self._inside(ahead) & ~_touches(ahead, self._bodies)
            for k in np.nonzero(fits)[0]:
                score = 0.6 * draws.uniform(f"spot {index} {k}") + _liking(prefer, wall, float(x[k]))
                if best is None or score > best[0]:
                    best = score, wall, float(x[k])
        if best is None:
            return None
        _, wall, at = best
        self.put_at_wall(piece, wall, at, window=window)
        self._clearances.append(_front_of(wall, at + x0, at + x1, deep + front, (0.02, 1.9)))
        return wall, at

    def open_spot(
        self, bounds: Array, draws: Draws, *, around: float, group: bool = False
    ) -> tuple[float, float] | None:
        """Return the most central place for `bounds` with `around` of free floor about it [m], or None."""
        rect = self.room.rect
        box = bounds + np.array([[-around, -around, _LIFT_M], [around, around, _LIFT_M]])
        low, high = np.array([rect.x0, rect.y0]) - box[0, :2], np.array([rect.x1, rect.y1]) - box[1, :2]
        if (high < low).any():
            return None
        share = np.array([[draws.uniform(f"{axis} {k}") for axis in "xy"] for k in range(80)])
        places = low + (high - low) * share
        boxes = box + np.append(places, np.zeros((80, 1)), axis=1)[:, None]
        away = (np.abs(places - rect.center) / (rect.width, rect.depth)).sum(axis=1)
        away[~self._free(boxes, group=group)] = np.inf
        best = int(np.argmin(away))
        return (float(places[best, 0]), float(places[best, 1])) if np.isfinite(away[best]) else None

    def roomiest(self, height_m: float) -> tuple[float, tuple[float, float, float]]:
        """Return the point at a height that is furthest from walls and bodies, after that distance [m]."""
        rect = self.room.rect
        spans = ((rect.x0, rect.x1), (rect.y0, rect.y1))
        axes = (np.arange(low + 0.2, high - 0.2, 0.1) for low, high in spans)
        x, y = (grid.reshape(-1) for grid in np.meshgrid(*axes))
        points = np.stack([x, y, np.full_like(x, height_m)], axis=1)
        clear = np.minimum.reduce([x - rect.x0, rect.x1 - x, y - rect.y0, rect.y1 - y])
        for body in self._bodies:
            gap = np.maximum(np.maximum(body[0, 0] - points, points - body[0, 1]), 0.0)
            clear = np.minimum(clear, np.linalg.norm(gap, axis=1))
        best = int(np.argmax(clear))
        return float(clear[best]), (float(x[best]), float(y[best]), height_m)


def _front_of(wall: Wall, x0: ArrayLike, x1: ArrayLike, depth: float, heights: tuple[float, float]) -> Array:
    """Return boxes in front of a wall, from x0 to x1 along it [m], shape [N, 2, 3]."""
    corners = wall.point(np.atleast_1d(x0), 0.0), wall.point(np.atleast_1d(x1), depth)
    ends = np.array([np.stack(corner) for corner in corners])
    boxes = np.empty((ends.shape[2], 2, 3))
    boxes[:, 0, :2], boxes[:, 1, :2] = ends.min(axis=0).T, ends.max(axis=0).T
    boxes[:, :, 2] = heights
    return boxes


def _touches(boxes: Array, others: list[Array]) -> NDArray[np.bool_]:
    """Return for each box whether it shares space with one of the others, shape [N]."""
    if not others:
        return np.zeros(len(boxes), bool)
    there = np.concatenate(others)
    apart = (boxes[:, None, 0] >= there[None, :, 1]) | (there[None, :, 0] >= boxes[:, None, 1])
    return np.asarray(np.any(~np.any(apart, axis=2), axis=1))


def _liking(prefer: Place, wall: Wall, x: float) -> float:
    off_middle = abs(x / wall.length_m - 0.5)
    windows = sum(opening.x1 - opening.x0 for opening in wall.openings)
    return {
        "anywhere": 0.0,
        "corner": 1.5 * off_middle,
        "middle": 0.25 * (wall.length_m - windows) - 2.5 * off_middle,
    }[prefer]
