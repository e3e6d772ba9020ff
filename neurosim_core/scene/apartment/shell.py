"""The building itself: floors, walls with their openings, ceilings, mouldings, views, the outside."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from neurosim_core.scene.apartment.assembly import Assembly, Surface
from neurosim_core.scene.apartment.floorplan import OUTER_WALL_M, WALL_M, FloorPlan, Opening, Room, Wall
from neurosim_core.scene.apartment.geometry import (
    Part,
    box,
    panel_with_holes,
    picture_quad,
    quad,
    rounded_box,
    strip,
)

_SINK_M = 0.004
"""How deep mouldings reach into walls and floors, so that no two faces lie in one plane."""
_CASING_M = 0.075
"""Width of door and window casings."""
_BASEBOARD_M = 0.014
"""Thickness of baseboards."""
_CUT = Surface(name="cut wall", color=(0.06, 0.06, 0.065))
"""The tops of the walls, dark as in a plan."""


@dataclass(frozen=True, kw_only=True)
class RoomFinish:
    """What a room is lined with."""

    floor: Surface
    wall: Surface
    accent: Surface
    """For one wall of the room."""
    accent_wall: int
    """Which of `Room.walls` has it; -1 for none."""
    ceiling: Surface
    trim: Surface
    sill: Surface
    view: Callable[[float, float], Surface]
    """What is seen through a window of a width and a height [m]; emits light."""


def add_shell(
    assembly: Assembly, plan: FloorPlan, finishes: Mapping[str, RoomFinish], *, ceiling_m: float
) -> None:
    """Build every room of the plan.

    Ceilings are objects `ceiling_k` and the top is `roof_1`, so that they can be left out of a picture from
    above; the walls have tops just below the roof.
    """
    for room in plan.rooms:
        _add_room(assembly, room, finishes[room.name], ceiling_m)
    first = finishes[plan.rooms[0].name]
    _add_doorways(assembly, plan, first)
    _add_outside(assembly, plan, first, ceiling_m)


def _to_world(part: Part, wall: Wall) -> Part:
    return part.moved((*wall.origin, 0.0), yaw_rad=wall.yaw_rad)


def _add_room(assembly: Assembly, room: Room, finish: RoomFinish, ceiling_m: float) -> None:
    rect = room.rect
    floor = quad((rect.x0, rect.y0, 0.0), (rect.width, 0.0, 0.0), (0.0, rect.depth, 0.0))
    assembly.add(assembly.instance("floor"), finish.floor, floor)
    top = quad((rect.x0, rect.y1, ceiling_m), (rect.width, 0.0, 0.0), (0.0, -rect.depth, 0.0))
    assembly.add(assembly.instance("ceiling"), finish.ceiling, top)
    walls = assembly.instance("wall")
    trim = assembly.instance("baseboard")
    for index, wall in enumerate(room.walls):
        surface = finish.accent if index == finish.accent_wall else finish.wall
        holes = [(o.x0, o.z0, o.x1, o.z1) for o in wall.openings]
        assembly.add(walls, surface, _to_world(panel_with_holes(wall.length_m, ceiling_m, holes), wall))
        _add_baseboards(assembly, trim, wall, index, finish)
        for opening in wall.openings:
            if opening.kind == "window":
                _add_window(assembly, wall, opening, finish)
            else:
                _add_casing(assembly, assembly.instance("door_casing"), wall, opening, finish.trim)


def _add_baseboards(assembly: Assembly, instance: int, wall: Wall, index: int, finish: RoomFinish) -> None:
    thick = _BASEBOARD_M
    profile = [(-thick, 0.0), (-thick, 0.072), (-0.6 * thick, 0.084), (0.0, 0.086)]
    inset = thick if index % 2 else 0.0  # boards of two walls meet without sharing a face
    doors = [(o.x0 - 0.5 * _CASING_M, o.x1 + 0.5 * _CASING_M) for o in wall.openings if o.kind == "door"]
    ends = [inset, *(x for door in doors for x in door), wall.length_m - inset]
    for x0, x1 in zip(ends[0::2], ends[1::2], strict=True):
        if x1 - x0 > 0.01:
            assembly.add(
                instance, finish.trim, _to_world(strip(profile, x1 - x0).shifted((x0, 0.0, 0.0)), wall)
            )


def _add_casing(assembly: Assembly, instance: int, wall: Wall, opening: Opening, surface: Surface) -> None:
    """A moulded frame around a doorway, on this side of the wall."""
    proud, lip = 0.02, 0.006  # the lip leaves a shadow line of wall at the opening
    height = opening.z1 + lip + _CASING_M
    depth = proud + _SINK_M
    middle = 0.5 * (_SINK_M - proud)
    for x in (opening.x0 - lip - 0.5 * _CASING_M, opening.x1 + lip + 0.5 * _CASING_M):
        size = (_CASING_M, depth, height - 0.001)
        upright = rounded_box(size, 0.006, center=(x, middle, 0.5 * (height + 0.001)), grain=2)
        assembly.add(instance, surface, _to_world(upright, wall))
    width = opening.x1 - opening.x0 + 2.0 * lip + 2.0 * _CASING_M + 0.03
    head = rounded_box(
        (width, depth + 0.01, _CASING_M + 0.012),
        0.006,
        center=(0.5 * (opening.x0 + opening.x1), middle - 0.003, opening.z1 + lip + 0.5 * _CASING_M + 0.008),
    )
    assembly.add(instance, surface, _to_world(head, wall))


def _add_doorways(assembly: Assembly, plan: FloorPlan, finish: RoomFinish) -> None:
    """What one sees of the wall's thickness in each doorway: two jambs, a head and a threshold."""
    height = next(
        (o.z1 for room in plan.rooms for wall in room.walls for o in wall.openings if o.kind == "door"), 0.0
    )
    for door in plan.doors:
        instance = assembly.instance("doorway")
        width = door.high_m - door.low_m
        half = 0.5 * WALL_M
        jambs = [
            quad((0.0, half, 0.0), (0.0, -WALL_M, 0.0), (0.0, 0.0, height)),
            quad((width, -half, 0.0), (0.0, WALL_M, 0.0), (0.0, 0.0, height)),
            quad((0.0, half, height), (width, 0.0, 0.0), (0.0, -WALL_M, 0.0)),
        ]
        threshold = quad((0.0, -half, 0.0), (width, 0.0, 0.0), (0.0, WALL_M, 0.0))
        if door.axis == "y":
            offset, yaw = (door.low_m, door.at_m, 0.0), 0.0
        else:
            offset, yaw = (door.at_m, door.low_m, 0.0), 0.5 * math.pi
        assembly.add(instance, finish.trim, *(part.moved(offset, yaw_rad=yaw) for part in jambs))
        assembly.add(instance, finish.sill, threshold.moved(offset, yaw_rad=yaw))


def _add_window(assembly: Assembly, wall: Wall, opening: Opening, finish: RoomFinish) -> None:
    """A deep reveal, a sill board, a frame with mullions, and the view as a bright picture behind it."""
    instance = assembly.instance("window")
    deep = 0.5 * WALL_M + OUTER_WALL_M - 0.1
    x0, x1, z0, z1 = opening.x0, opening.x1, opening.z0, opening.z1
    width, height = x1 - x0, z1 - z0
    reveal = [
        quad((x0, deep, z0), (0.0, -deep, 0.0), (0.0, 0.0, height)),
        quad((x1, 0.0, z0), (0.0, deep, 0.0), (0.0, 0.0, height)),
        quad((x0, deep, z1), (width, 0.0, 0.0), (0.0, -deep, 0.0)),
        quad((x0, 0.0, z0), (width, 0.0, 0.0), (0.0, deep, 0.0)),
    ]
    view = picture_quad((x0, deep, z0), (width, 0.0, 0.0), (0.0, 0.0, height))
    board = rounded_box((width + 0.12, 0.16 + 0.06, 0.03), 0.008, center=(0.5 * (x0 + x1), 0.05, z0 + 0.011))
    bar, thick = 0.055, 0.05
    at = deep - 0.06
    bars = [
        box((bar, thick, height + 0.008), center=(x, at, 0.5 * (z0 + z1)), grain=2)
        for x in (x0 + 0.4 * bar, x1 - 0.4 * bar)
    ]
    panes = max(2, round(width / 0.7))
    slim = 0.038
    bars += [
        box((slim, thick - 0.01, height - 0.02), center=(x, at, 0.5 * (z0 + z1)), grain=2)
        for x in np.linspace(x0, x1, panes + 1)[1:-1]
    ]
    bars += [
        box((width + 0.008, thick + 0.006, bar), center=(0.5 * (x0 + x1), at, z), grain=0)
        for z in (z0 + 0.4 * bar, z1 - 0.4 * bar)
    ]
    if height > 1.2:
        bars.append(
            box((width + 0.006, thick - 0.016, slim), center=(0.5 * (x0 + x1), at, z0 + 0.7 * height))
        )
    assembly.add(instance, finish.trim, *(_to_world(part, wall) for part in (*reveal, *bars)))
    assembly.add(instance, finish.sill, _to_world(board, wall))
    assembly.add(assembly.instance("view"), finish.view(width, height), _to_world(view, wall))
    lip, proud = 0.004, 0.016
    for x, z, w, h in (
        (x0 - lip - 0.03, 0.5 * (z0 + z1) + 0.03, 0.06, height),
        (x1 + lip + 0.03, 0.5 * (z0 + z1) + 0.03, 0.06, height),
        (0.5 * (x0 + x1), z1 + lip + 0.035, width + 0.16, 0.07),
    ):
        size = (w, proud + _SINK_M + (0.004 if w > h else 0.0), h)
        frame = rounded_box(size, 0.005, center=(x, 0.5 * (_SINK_M - proud), z), grain=0 if w > h else 2)
        assembly.add(instance, finish.trim, _to_world(frame, wall))


def _add_outside(assembly: Assembly, plan: FloorPlan, finish: RoomFinish, ceiling_m: float) -> None:
    """The outer faces of the building, and the tops of the walls as a plan shows them."""
    outer = plan.outline.grown(OUTER_WALL_M)
    low, high = -0.25, ceiling_m + 0.25
    hull = box((outer.width, outer.depth, high - low), center=(*outer.center, 0.5 * (low + high)))
    up = np.all(hull.normals[hull.faces[:, 0]] == (0.0, 0.0, 1.0), axis=1)
    for kind, keep in (("outer_wall", ~up), ("roof", up)):
        part = Part(vertices=hull.vertices, normals=hull.normals, uv=hull.uv, faces=hull.faces[keep])
        assembly.add(assembly.instance(kind), finish.ceiling, part)
    xs = sorted({outer.x0, outer.x1, *(x for room in plan.rooms for x in (room.rect.x0, room.rect.x1))})
    ys = sorted({outer.y0, outer.y1, *(y for room in plan.rooms for y in (room.rect.y0, room.rect.y1))})
    tops = assembly.instance("wall_top")
    for x0, x1 in itertools.pairwise(xs):
        for y0, y1 in itertools.pairwise(ys):
            x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
            inside = any(r.rect.x0 < x < r.rect.x1 and r.rect.y0 < y < r.rect.y1 for r in plan.rooms)
            if not inside:
                assembly.add(tops, _CUT, quad((x0, y0, ceiling_m), (x1 - x0, 0, 0), (0, y1 - y0, 0)))
