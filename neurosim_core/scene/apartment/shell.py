"""The building itself: floors, walls with their openings, ceilings, mouldings, views, the outside."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from neurosim_core.scene.apartment.draws import Draws
from neurosim_core.scene.apartment.floorplan import OUTER_WALL_M, WALL_M, FloorPlan, Opening, Room
from neurosim_core.scene.apartment.looks import Finish, Surface
from neurosim_core.scene.apartment.pieces import Piece, make_piece
from neurosim_core.scene.solids import Part, box, merge, quad

if TYPE_CHECKING:
    from neurosim_core.scene.apartment.apartment import ApartmentConfig

_CASING_M = 0.0375
"""How far the middle of a door's casing is from the doorway."""
_NO_DRAWS = Draws()


def make_shell(
    plan: FloorPlan, finishes: Sequence[Finish], surfaces: Mapping[str, Surface], config: ApartmentConfig
) -> list[Piece]:
    """Build every room of the plan, where it stands, of the surfaces that each is lined with.

    Ceilings are pieces `ceiling` and the top is `roof`, so that they can be left out of a picture from above;
    the walls have tops just below the roof.

    `finishes` is what each room is lined with; `surfaces` are those of all else, by name.
    """
    pieces = []
    for room, finish in zip(plan.rooms, finishes, strict=True):
        pieces += _room(room, finish, surfaces, config.ceiling_m)
    for door in plan.doors:
        width, along_x = door.high_m - door.low_m, door.axis == "y"
        way = make_piece("doorway", surfaces, _NO_DRAWS, w=width, h=config.door_height_m, t=WALL_M)
        offset = (door.low_m, door.at_m, 0.0) if along_x else (door.at_m, door.low_m, 0.0)
        pieces.append(way.moved(offset, 0.0 if along_x else 0.5 * math.pi))
    return pieces + _outside(plan, surfaces, config.ceiling_m)


def _room(room: Room, finish: Finish, surfaces: Mapping[str, Surface], ceiling_m: float) -> list[Piece]:
    rect = room.rect
    floor = quad((rect.x0, rect.y0, 0.0), (rect.width, 0.0, 0.0), (0.0, rect.depth, 0.0))
    top = quad((rect.x0, rect.y1, ceiling_m), (rect.width, 0.0, 0.0), (0.0, -rect.depth, 0.0))
    walls, boards, fittings = Piece("wall"), Piece("baseboard"), []
    for index, (wall, surface) in enumerate(zip(room.walls, finish.walls, strict=True)):
        place = (*wall.origin, 0.0), wall.yaw_rad
        panel = Piece("", [(_panel(wall.length_m, ceiling_m, wall.openings), surface)])
        walls.include(panel.moved(*place))
        inset = 0.014 * (index % 2)  # boards of two walls meet without sharing a face
        doors = [(o.x0 - _CASING_M, o.x1 + _CASING_M) for o in wall.openings if o.kind == "door"]
        for x0, x1 in _pairs([inset, *itertools.chain(*doors), wall.length_m - inset]):
            if x1 - x0 > 0.01:
                board = make_piece("baseboard", surfaces, _NO_DRAWS, l=x1 - x0)
                boards.include(board.moved((x0, 0.0, 0.0)).moved(*place))
        for o in wall.openings:
            for kind in ("door_casing",) if o.kind == "door" else ("window", "view"):
                fitting = make_piece(kind, surfaces, _NO_DRAWS, w=o.x1 - o.x0, z0=o.z0, z1=o.z1)
                fittings.append(fitting.moved((0.5 * (o.x0 + o.x1), 0.0, 0.0)).moved(*place))
    lined = [Piece("floor", [(floor, finish.floor)]), Piece("ceiling", [(top, surfaces["ceiling"])])]
    return [*lined, walls, boards, *fittings]


def _pairs(ends: Sequence[float]) -> list[tuple[float, float]]:
    return list(zip(ends[0::2], ends[1::2], strict=True))


def _panel(width_m: float, height_m: float, holes: Sequence[Opening]) -> Part:
    """Return a wall in the plane y = 0 that faces -y, from x = 0 and z = 0 on, without its openings."""
    x_lines = sorted({0.0, width_m, *(x for hole in holes for x in (hole.x0, hole.x1))})
    parts = []
    for x0, x1 in itertools.pairwise(x_lines):
        over = sorted((hole.z0, hole.z1) for hole in holes if hole.x0 < 0.5 * (x0 + x1) < hole.x1)
        for z0, z1 in _pairs([0.0, *itertools.chain(*over), height_m]):
            if z1 > z0:
                parts.append(quad((x0, 0.0, z0), (x1 - x0, 0.0, 0.0), (0.0, 0.0, z1 - z0)))
    return merge(parts)


def _outside(plan: FloorPlan, surfaces: Mapping[str, Surface], ceiling_m: float) -> list[Piece]:
    """Return the outer faces of the building, and the tops of the walls as a plan shows them."""
    outer = plan.outline.grown(OUTER_WALL_M)
    hull = box((outer.width, outer.depth, ceiling_m + 0.5)).moved((*outer.center, 0.5 * ceiling_m))
    up = np.all(hull.normals[hull.faces[:, 0]] == (0.0, 0.0, 1.0), axis=1)
    pieces = []
    for kind, keep in (("outer_wall", ~up), ("roof", up)):
        pieces.append(Piece(kind, [(replace(hull, faces=hull.faces[keep]), surfaces["ceiling"])]))
    rects = [room.rect for room in plan.rooms]
    xs = sorted({outer.x0, outer.x1, *(x for rect in rects for x in (rect.x0, rect.x1))})
    ys = sorted({outer.y0, outer.y1, *(y for rect in rects for y in (rect.y0, rect.y1))})
    tops = Piece("wall_top")
    for (x0, x1), (y0, y1) in itertools.product(itertools.pairwise(xs), itertools.pairwise(ys)):
        if not any(rect.x0 <= x0 < rect.x1 and rect.y0 <= y0 < rect.y1 for rect in rects):
            top = quad((x0, y0, ceiling_m), (x1 - x0, 0, 0), (0, y1 - y0, 0))
            tops.parts.append((top, surfaces["cut_wall"]))
    return [*pieces, tops]
