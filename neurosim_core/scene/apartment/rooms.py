"""Furnishes rooms by the steps of `rooms.yaml`."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from neurosim_core.scene.apartment.assembly import Assembly
from neurosim_core.scene.apartment.draws import Draws
from neurosim_core.scene.apartment.floorplan import Room, Wall
from neurosim_core.scene.apartment.furnishing import WALL_GAP_M, RoomSpace
from neurosim_core.scene.apartment.looks import Finish, Palette
from neurosim_core.scene.apartment.pieces import Piece, make_piece

_ON_RUG_M = 0.014


@functools.cache
def _steps() -> dict[str, list[dict[str, dict[str, Any]]]]:
    table: dict[str, Any] = yaml.load(Path(__file__).with_name("rooms.yaml").read_bytes(), yaml.CSafeLoader)
    return table


def furnish(
    room: Room,
    index: int,
    assembly: Assembly,
    palette: Palette,
    finish: Finish,
    *,
    seed: int,
    density: float,
    ceiling_m: float,
) -> RoomSpace:
    """Furnish one room; its furniture depends on its name and the seed, not on the other rooms.

    Args:
        room: The room.
        index: Its number in the plan.
        assembly: Receives the furniture and the lamps.
        palette: Surfaces of the flat.
        finish: What the room is lined with.
        seed: Chooses the furniture.
        density: Share of the optional things that are there, 0 to 1.
        ceiling_m: Height of the room [m].

    Returns:
        What space is left.
    """
    space = RoomSpace(room, assembly, ceiling_m)
    furnisher = Furnisher(space, Draws(seed, room.name), palette, finish, index, density)
    for number, step in enumerate(_steps()[room.role]):
        ((method, options),) = step.items()
        furnisher.step(f"{method} {number}", method, **options)
    furnisher.dress_windows()
    furnisher.hang_pictures()
    for k in range(2):
        furnisher.step(f"plant {k}", "along_wall", kind="plant", chance=0.75, front=0.05, prefer="corner")
    return space


class Furnisher:
    """Arranges the furniture of one room. Each step has random numbers of its own."""

    def __init__(
        self, space: RoomSpace, draws: Draws, palette: Palette, finish: Finish, index: int, density: float
    ) -> None:
        """Take the empty room, see `furnish`."""
        self._space = space
        self._room = space.room
        self._all_draws = self._draws = draws
        self._palette = palette
        self._surfaces = palette.look(space.room.name) | {"splash": finish.splash}
        self._index = index
        self._density = density
        self._prints = 0

    def step(self, name: str, method: str, *, chance: float | None = None, **options: Any) -> None:
        """Do one step of that name, or not if it is optional."""
        self._draws = self._all_draws.under(name)
        if chance is None or self._wants("wanted", chance):
            getattr(self, method)(**options)

    def _wants(self, name: str, chance: float) -> bool:
        return self._draws.chance(name, chance * self._density)

    def _make(self, kind: str, *name: object, **given: Any) -> Piece:
        """Make a piece that stands with its back at y = 0."""
        piece = make_piece(kind, self._surfaces, self._draws.under(kind, *name), **given)
        return piece.moved((0.0, -piece.bounds[1, 1] - 0.02, 0.0)) if kind == "plant" else piece

    def along_wall(
        self,
        kind: str,
        *,
        sizes: Sequence[dict[str, Any]] = ({},),
        count: int = 1,
        above: str | None = None,
        **options: Any,
    ) -> None:
        """Place pieces along the walls, each in the first of its sizes that fits, with something above."""
        for k in range(count):
            for given in sizes:
                spot = self._space.along_wall(
                    self._make(kind, k, **given), self._draws.under("at", k), **options
                )
                if spot:
                    if above:
                        self._space.hang(self._make(above), *spot)
                    break

    def hang(self, kind: str) -> None:
        """Hang a piece on the first stretch of wall that is free."""
        for wall, share in itertools.product(self._room.walls, (0.5, 0.35, 0.65, 0.2, 0.8)):
            if self._space.hang(self._make(kind), wall, share * wall.length_m):
                return

    def sofa_group(self) -> None:
        """A sofa, a rug and a low table in front, an armchair beside it and a television across the room."""
        space = self._space
        for width, front, window in (
            (2.3, 1.7, False),
            (2.3, 1.3, False),
            (1.8, 1.3, False),
            (2.3, 1.3, True),
            (1.8, 0.8, True),
        ):
            sofa = self._make("sofa", w=width)
            place = self._draws.under("at", width, front)
            spot = space.along_wall(sofa, place, front=front, sides=0.1, prefer="middle", window=window)
            if spot:
                break
        else:
            return
        wall, x = spot
        self._pictures_above(wall, x)
        edge, rug_width = WALL_GAP_M - float(sofa.bounds[0, 1]), width + 0.1
        on_rug = space.put_at_wall(self._rug(rug_width, 1.55), wall, x, out=edge + 0.04, group=True)
        table = self._make("coffee_table")
        space.put_at_wall(table, wall, x, out=edge + 0.42, lift=_ON_RUG_M if on_rug else 0.0, group=True)
        chair = self._make("armchair")
        for side in (-1.0, 1.0) if self._draws.chance("left", 0.5) else (1.0, -1.0):
            # Its front towards the table: turned by a quarter, its depth runs along the wall.
            at = x + side * (0.5 * rug_width + 0.06 - float(chair.bounds[0, 1]))
            if space.put_at_wall(chair, wall, at, out=edge + 0.75, yaw_rad=-side * 0.5 * math.pi, group=True):
                break
        across = self._room.walls[(self._room.walls.index(wall) + 2) % 4]
        board = self._make("sideboard", tv=True)
        board.kind = "television_board"
        shifts = (0.0, 0.4, -0.4, 0.8, -0.8, 1.2, -1.2)
        if not any(space.put_at_wall(board, across, across.length_m - x + shift) for shift in shifts):
            space.along_wall(board, self._draws.under("board"), prefer="middle")
        lamp = self._make("floor_lamp", strength=0.5)
        ends = (x - 0.5 * width - 0.32, x + 0.5 * width + 0.32)
        any(space.put_at_wall(lamp, wall, at, group=True) for at in ends)

    def bed_group(self, widths: Sequence[float]) -> None:
        """A bed with nightstands and lamps on both sides, and rugs beside it."""
        space = self._space
        bed = self._make("bed", w=self._draws.pick("width", widths))
        for sides, front, window in (
            (0.5, 0.55, False),
            (0.5, 0.3, True),
            (0.1, 0.55, False),
            (0.1, 0.3, True),
        ):
            place = self._draws.under("at", sides, front)
            spot = space.along_wall(bed, place, front=front, sides=sides, prefer="middle", window=window)
            if spot:
                break
        else:
            return
        wall, x = spot
        if self._wants("pictures", 0.7):
            self._pictures_above(wall, x)
        half = float(bed.bounds[1, 0])
        for side in (-1.0, 1.0):
            stand = self._make("nightstand", side)
            (_, front, _), (_, _, top) = stand.bounds
            at, out = x + side * (half + 0.28), WALL_GAP_M - 0.5 * float(front)
            if space.put_at_wall(stand, wall, at, group=True):
                lamp = self._make("table_lamp")
                space.put_at_wall(lamp, wall, at, out=out, lift=float(top) + 0.002, group=True)
                out = WALL_GAP_M - float(front) + 0.1
                space.put_at_wall(self._rug(0.75, 1.5), wall, x + side * (half + 0.46), out=out, group=True)

    def kitchen_line(self, widths: Sequence[float]) -> None:
        """The longest counter that fits, and a fridge near it."""
        space = self._space
        for width in widths:
            counter = self._make("kitchen_counter", w=width)
            spot = space.along_wall(counter, self._draws.under("at", width), front=0.8, prefer="corner")
            if spot:
                wall, x = spot
                fridge = self._make("refrigerator")
                ends = (x - 0.5 * width - 0.37, x + 0.5 * width + 0.37)
                if not any(space.put_at_wall(fridge, wall, at, group=True) for at in ends):
                    space.along_wall(fridge, self._draws.under("fridge"), prefer="corner")
                return

    def dining_group(self, seats: Sequence[int]) -> None:
        """A table with chairs on two sides, a lamp above it."""
        space, draws = self._space, self._draws
        turn = 0.0 if self._room.rect.width >= self._room.rect.depth else 0.5 * math.pi
        for count, around in ((draws.pick("seats", seats), 0.45), (4, 0.4), (4, 0.15), (2, 0.15)):
            name = (count, around)
            if count == 2 or (count == 4 and draws.chance(f"round {name}", 0.4)):
                table = self._make("round_table", r=0.5 if count == 2 else 0.58)
            else:
                table = self._make("table", w=0.4 + 0.33 * count)
            table.kind = "table"
            table = table.moved((0.0, -0.5 * table.bounds[:, 1].sum(), 0.0))
            group = [(table, 0.0, 0.0, 0.0)]
            chair = self._make("chair")
            for side, k in itertools.product((-1.0, 1.0), range(count // 2)):
                # The front of a chair is 0.46 m before its back, and looks at the table.
                yaw = (0.0 if side > 0.0 else math.pi) + draws.uniform(
                    f"chair {name} {side} {k}", -0.12, 0.12
                )
                at = 0.62 * (k - 0.5 * (count // 2 - 1))
                group.append((chair, at, side * (float(table.bounds[1, 1]) + 0.56), yaw))
            whole = Piece("group")
            for piece, x, y, yaw in group:
                whole.include(piece.moved((x, y, 0.0), yaw))
            for heading in (turn, turn + 0.5 * math.pi):
                bounds = whole.moved((0.0, 0.0, 0.0), heading).bounds
                spot = space.open_spot(bounds, draws.under("at", name, heading), around=around)
                if spot is None:
                    continue
                c, s = math.cos(heading), math.sin(heading)
                for piece, x, y, yaw in group:
                    space.put(piece, (spot[0] + c * x - s * y, spot[1] + s * x + c * y, 0.0), heading + yaw)
                center = self._make("bowl" if draws.chance("fruit", 0.5) else "vase")
                space.put(center, (*spot, float(table.bounds[1, 2]) + 0.002))
                lamp = self._make("pendant", c=space.ceiling_m, low=1.68, strength=0.75)
                space.put(lamp, (*spot, -0.002))
                return

    def desk_group(self) -> None:
        """A desk, at a window too, and a chair in front of it."""
        space, desk, chair = self._space, self._make("desk"), self._make("office_chair")
        spot = space.along_wall(desk, self._draws.under("at"), front=0.9, prefer="middle", window=True)
        if spot:
            out = WALL_GAP_M - float(desk.bounds[0, 1]) + 0.1 - float(chair.bounds[0, 1])
            yaw = math.pi + self._draws.uniform("turn", -0.2, 0.2)
            space.put_at_wall(chair, spot[0], spot[1] - 0.1, out=out, yaw_rad=yaw, group=True)

    def shelves(self, count: int) -> None:
        """Bookshelves of one height, next to each other where there is room."""
        height = self._draws.pick("height", (1.75, 2.0, 2.15))
        spot: tuple[Wall, float] | None = None
        for k in range(count):
            shelf = self._make("bookshelf", k, h=height)
            beside = [(spot[0], spot[1] + side * 0.935) for side in (-1.0, 1.0)] if spot else []
            spot = next((at for at in beside if self._space.put_at_wall(shelf, *at)), None)
            spot = spot or self._space.along_wall(shelf, self._draws.under("at", k), prefer="corner")

    def rug(self, w: float, d: float) -> None:
        """A rug in the open."""
        rug, rect = self._rug(w, d), self._room.rect
        turn = 0.0 if rect.width >= rect.depth else 0.5 * math.pi
        bounds = rug.moved((0.0, 0.0, 0.0), turn).bounds
        spot = self._space.open_spot(bounds, self._draws.under("at"), around=0.0, group=True)
        if spot:
            self._space.put(rug, (*spot, 0.0), turn, group=True)

    def _rug(self, width: float, depth: float) -> Piece:
        pattern = self._palette.rug(self._index, width, depth)
        return self._make("rug", w=width, d=depth, pattern=pattern)

    def main_lamps(self, strength: float) -> None:
        """One lamp in the middle of the ceiling, two in a long room."""
        rect, ceiling = self._room.rect, self._space.ceiling_m
        kind = self._draws.pick("kind", ("pendant", "ceiling_lamp"))
        if self._room.role in ("bathroom", "kitchen"):
            kind = "spots"
        given = {"low": ceiling - 0.55} if kind == "pendant" else {}
        count = 2 if rect.width * rect.depth > 21.0 else 1
        for k in range(count):
            share = (k + 0.5) / count
            along_x = rect.width >= rect.depth
            x = rect.x0 + rect.width * (share if along_x else 0.5)
            y = rect.y0 + rect.depth * (0.5 if along_x else share)
            lamp = self._make(kind, c=ceiling, strength=strength, **given)
            for dx, dy in ((0.0, 0.0), (0.4, 0.4), (-0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)):
                if self._space.put(lamp, (x + dx, y + dy, -0.002), group=True):
                    break

    def dress_windows(self) -> None:
        """Curtains at windows outside of wet rooms, radiators below windows."""
        self._draws = self._all_draws.under("windows")
        fabric = self._surfaces["linen" if self._draws.chance("linen", 0.5) else "accent"]
        for index, wall in enumerate(self._room.walls):
            for k, o in enumerate(o for o in wall.openings if o.kind == "window"):
                x, width = 0.5 * (o.x0 + o.x1), o.x1 - o.x0
                if self._room.role not in ("kitchen", "bathroom") and self._wants(
                    f"curtain {index} {k}", 0.8
                ):
                    self._curtains(wall, x, width, o.z0, o.z1 + 0.12, fabric=fabric)
                if o.z0 > 0.75:
                    self._space.hang(self._make("radiator", w=width - 0.2), wall, x, window=True)

    def _curtains(self, wall: Wall, x: float, width: float, sill: float, top: float, **look: Any) -> None:
        """Two panels beside a window on a rod above it, the longest that what stands there allows."""
        panel_width = 0.34
        put = functools.partial(self._space.put_at_wall, out=0.0, group=True, window=True)
        rail = self._make("curtain_rail", w=width + 2.0 * panel_width + 0.1, h=top + 0.028)
        if put(rail, wall, x, lift=-0.002):
            for side in (-1.0, 1.0):
                at = x + side * (0.5 * width + 0.5 * panel_width - 0.06)
                for low in (0.03, sill - 0.2):
                    if put(self._make("curtain", x, side, w=panel_width, low=low, top=top, **look), wall, at):
                        break

    def _picture(self, width: float, height: float) -> Piece:
        poster = self._palette.poster(2 * self._index + self._prints % 2, width, height)
        self._prints += 1
        return self._make("picture", w=width, h=height, print=poster)

    def _pictures_above(self, wall: Wall, x: float) -> None:
        """Two or three prints in a row above a piece of furniture."""
        count = self._draws.pick("prints", (2, 3))
        for k in range(count):
            picture = self._picture(*((0.6, 0.8) if count == 2 else (0.45, 0.6)))
            self._space.hang(picture, wall, x + 0.74 * (k - 0.5 * (count - 1)))

    def hang_pictures(self) -> None:
        """Prints on free stretches of wall, above whatever stands there."""
        self._draws = self._all_draws.under("pictures")
        formats = ((0.6, 0.8), (0.45, 0.6), (0.75, 1.0), (0.36, 0.48))
        for index, wall in enumerate(self._room.walls):
            hung = 0
            for share in (0.5, 0.32, 0.68, 0.16, 0.84):
                name = f"{index} {share}"
                if hung < 2 and self._wants(f"wanted {name}", 0.7):
                    picture = self._picture(*self._draws.pick(f"format {name}", formats))
                    hung += self._space.hang(picture, wall, share * wall.length_m)
