"""The building itself: floors, walls with their openings, ceilings, mouldings, views, the outside."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from neurosim_core.scene.apartment.assembly import Assembly
from neurosim_core.scene.apartment.draws import Draws
from neurosim_core.scene.apartment.floorplan import OUTER_WALL_M, WALL_M, FloorPlan, Opening, Room
from neurosim_core.scene.apartment.geometry import Part, box, merge, quad
from neurosim_core.scene.apartment.looks import Finish, Surface
from neurosim_core.scene.apartment.pieces import Piece, make_piece

_CASING_M = 0.0375
"""How far the middle of a door's casing is from the doorway."""
_NO_DRAWS = Draws()


def add_shell(
    assembly: Assembly,
    plan: FloorPlan,
    finishes: Mapping[str, Finish],
    surfaces: Mapping[str, Surface],
    *,
    ceiling_m: float,
) -> None:
    """Build every room of the plan.

    Ceilings are objects `ceiling_k` and the top is `roof_1`, so that they can be left out of a picture from
    above; the walls have tops just below the roof.

    Args:
        assembly: Receives the building.
        plan: The rooms.
        finishes: What each room is lined with, by name.
        surfaces: Of ceilings, mouldings, windows and doors, by name.
        ceiling_m: Height of the rooms [m].
    """
    for room in plan.rooms:
        _add_room(assembly, room, finishes[room.name], surfaces, ceiling_m)
    for door in plan.doors:
        along_x = door.axis == "y"
        offset = (door.low_m, door.at_m, 0.0) if along_x else (door.at_m, door.low_m, 0.0)
        way = make_piece(
            "doorway", surfaces, _NO_DRAWS, w=door.high_m - door.low_m, h=plan.door_height_m, t=WALL_M
        )
        assembly.place(way.moved(offset, 0.0 if along_x else 0.5 * math.pi))
    _add_outside(assembly, plan, surfaces, ceiling_m)


def _add_room(
    assembly: Assembly, room: Room, finish: Finish, surfaces: Mapping[str, Surface], ceiling_m: float
) -> None:
    rect = room.rect
    floor = quad((rect.x0, rect.y0, 0.0), (rect.width, 0.0, 0.0), (0.0, rect.depth, 0.0))
    top = quad((rect.x0, rect.y1, ceiling_m), (rect.width, 0.0, 0.0), (0.0, -rect.depth, 0.0))
    assembly.add("floor", [(floor, finish.floor)])
    assembly.add("ceiling", [(top, surfaces["ceiling"])])
    walls, boards, fittings = Piece("wall"), Piece("baseboard"), []
    for index, (wall, surface) in enumerate(zip(room.walls, finish.walls, strict=True)):
        panel = _panel(wall.length_m, ceiling_m, wall.openings).moved(
            (*wall.origin, 0.0), yaw_rad=wall.yaw_rad
        )
        walls.parts.append((panel, surface))
        inset = 0.014 * (index % 2)  # boards of two walls meet without sharing a face
        doors = [(o.x0 - _CASING_M, o.x1 + _CASING_M) for o in wall.openings if o.kind == "door"]
        ends = [inset, *itertools.chain(*doors), wall.length_m - inset]
        for x0, x1 in zip(ends[0::2], ends[1::2], strict=True):
            if x1 - x0 > 0.01:
                board = make_piece("baseboard", surfaces, _NO_DRAWS, l=x1 - x0).moved((x0, 0.0, 0.0))
                boards.include(board.moved((*wall.origin, 0.0), wall.yaw_rad))
        for o in wall.openings:
            sizes = (
                {"w": o.x1 - o.x0, "h": o.z1}
                if o.kind == "door"
                else {"w": o.x1 - o.x0, "z0": o.z0, "z1": o.z1}
            )
            for kind in ("door_casing",) if o.kind == "door" else ("window", "view"):
                fitting = make_piece(kind, surfaces, _NO_DRAWS, **sizes).moved(
                    (0.5 * (o.x0 + o.x1), 0.0, 0.0)
                )
                fittings.append(fitting.moved((*wall.origin, 0.0), wall.yaw_rad))
    for piece in (walls, boards, *fittings):
        assembly.place(piece)


def _panel(width_m: float, height_m: float, holes: Sequence[Opening]) -> Part:
    """Return a wall in the plane y = 0 that faces -y, from x = 0 and z = 0 on, without its openings."""
    x_lines = sorted({0.0, width_m, *(x for hole in holes for x in (hole.x0, hole.x1))})
    parts = []
    for x0, x1 in itertools.pairwise(x_lines):
        over = sorted((hole.z0, hole.z1) for hole in holes if hole.x0 < 0.5 * (x0 + x1) < hole.x1)
        ends = [0.0, *itertools.chain(*over), height_m]
        for z0, z1 in zip(ends[0::2], ends[1::2], strict=True):
            if z1 > z0:
                parts.append(quad((x0, 0.0, z0), (x1 - x0, 0.0, 0.0), (0.0, 0.0, z1 - z0)))
    return merge(parts)


def _add_outside(
    assembly: Assembly, plan: FloorPlan, surfaces: Mapping[str, Surface], ceiling_m: float
) -> None:
    """Add the outer faces of the building, and the tops of the walls as a plan shows them."""
    outer = plan.outline.grown(OUTER_WALL_M)
    low, high = -0.25, ceiling_m + 0.25
    middle = (*outer.center, 0.5 * (low + high))
    hull = box((outer.width, outer.depth, high - low)).moved(middle)
    up = np.all(hull.normals[hull.faces[:, 0]] == (0.0, 0.0, 1.0), axis=1)
    for kind, keep in (("outer_wall", ~up), ("roof", up)):
        assembly.add(kind, [(replace(hull, faces=hull.faces[keep]), surfaces["ceiling"])])
    rects = [room.rect for room in plan.rooms]
    xs = sorted({outer.x0, outer.x1, *(x for rect in rects for x in (rect.x0, rect.x1))})
    ys = sorted({outer.y0, outer.y1, *(y for rect in rects for y in (rect.y0, rect.y1))})
    tops = []
    for (x0, x1), (y0, y1) in itertools.product(itertools.pairwise(xs), itertools.pairwise(ys)):
        x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
        if not any(rect.x0 < x < rect.x1 and rect.y0 < y < rect.y1 for rect in rects):
            tops.append((quad((x0, y0, ceiling_m), (x1 - x0, 0, 0), (0, y1 - y0, 0)), surfaces["cut_wall"]))
    assembly.add("wall_top", tops)
