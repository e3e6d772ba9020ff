"""Furnishes rooms by the steps of `rooms.yaml`."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from neurosim_core.scene.apartment.draws import Draws
from neurosim_core.scene.apartment.floorplan import Room, Wall
from neurosim_core.scene.apartment.furnishing import WALL_GAP_M, RoomSpace
from neurosim_core.scene.apartment.looks import Finish, Palette
from neurosim_core.scene.apartment.pieces import FUNCTIONS, Piece, evaluate, make_piece
from neurosim_core.settings_file import read_table

if TYPE_CHECKING:
    from neurosim_core.scene.apartment.apartment import ApartmentConfig

_PLACE = ("front", "sides", "window")


class Furnisher:
    """Arranges the furniture of one room. Each step has random numbers of its own.

    The furniture depends on the name of the room and the seed, not on the other rooms.
    """

    def __init__(
        self, room: Room, index: int, palette: Palette, finish: Finish, config: ApartmentConfig
    ) -> None:
        """Take an empty room, of this number in the plan."""
        self._room, self._index, self._palette = room, index, palette
        self._space = RoomSpace(room, config.ceiling_m)
        self._all_draws = self._draws = Draws(config.seed, room.name)
        self._surfaces = palette.look(room.name) | {"splash": finish.splash}
        self._density = config.furniture
        self._prints = 0

    def furnish(self) -> RoomSpace:
        """Do all steps, and return the furniture, the lamps and what space is left."""
        for number, step in enumerate(read_table(__file__, "rooms")[self._room.role]):
            ((method, options),) = step.items()
            self._do(f"{method} {number}", method, **options)
        self._do("windows", "_dress_windows")
        self._do("pictures", "_hang_pictures")
        for k in range(2):
            self._do(f"plant {k}", "along_wall", kind="plant", chance=0.75, front=0.05, prefer="corner")
        return self._space

    def _do(self, name: str, method: str, *, chance: float | None = None, **options: Any) -> None:
        """Do one step of that name, or not if it is optional."""
        self._draws = self._all_draws.under(name)
        if chance is None or self._wants("wanted", chance):
            getattr(self, method)(**options)

    def _wants(self, name: str, chance: float) -> bool:
        return self._draws.chance(name, chance * self._density)

    def _make(self, kind: str, *name: object, **given: Any) -> Piece:
        if kind == "rug":
            given["pattern"] = self._palette.rug(self._index, given["w"], given["d"])
        elif kind == "picture":
            number = 2 * self._index + self._prints % 2
            given["print"] = self._palette.poster(number, given["w"], given["h"])
            self._prints += 1
        return make_piece(kind, self._surfaces, self._draws.under(kind, *name), **given)

    def along_wall(
        self,
        kind: str,
        *,
        tries: Sequence[dict[str, Any]] = ({},),
        count: int = 1,
        beside: float | None = None,
        pictures: float = 0.0,
        around: Sequence[dict[str, Any]] = (),
        **options: Any,
    ) -> None:
        """Place `count` pieces along the walls, each in the first way that fits, with what belongs to them.

        `rooms.yaml` documents the options; those that are not named here hold for all `tries`.
        """
        common = evaluate(options.pop("with", {}), dict(FUNCTIONS), self._draws, "with")
        spot: tuple[Wall, float] | None = None
        for k in range(count):
            piece, made = Piece(kind), None
            for number, way in enumerate(tries):
                place = options | {key: value for key, value in way.items() if key in _PLACE}
                given = common | {key: value for key, value in way.items() if key not in _PLACE}
                if given != made:
                    piece, made = self._make(kind, k, **given), given
                near = [(spot[0], spot[1] + side * beside) for side in (-1.0, 1.0)] if spot and beside else []
                spot = next((at for at in near if self._space.put_at_wall(piece, *at)), None)
                spot = spot or self._space.along_wall(piece, self._draws.under("at", k, number), **place)
                if spot:
                    if pictures and self._wants("pictures", pictures):
                        self._pictures_above(*spot)
                    self._put_around(piece, *spot, WALL_GAP_M, given, around)
                    break

    def _put_around(
        self,
        piece: Piece,
        wall: Wall,
        at: float,
        out: float,
        variables: dict[str, Any],
        around: Sequence[dict[str, Any]],
    ) -> None:
        """Place what stands around a piece, in the frame of its wall."""
        (_, front, _), (half, _, top) = (corner.tolist() for corner in piece.bounds)
        scope = FUNCTIONS | variables | {"half": half, "deep": -front, "top": top, "edge": out - front}
        for number, data in enumerate(around):
            draws = self._draws.under("around", data["kind"], number)
            given = evaluate(data.get("with", {}), scope, draws, "with")
            other = self._make(data["kind"], number, at, **given)
            scope["own"] = -float(other.bounds[0, 1])
            side, middle = wall, at
            if data.get("across", False):
                side = self._room.walls[(self._room.walls.index(wall) + 2) % 4]
                middle = side.length_m - at
            scope["placed"], placed = False, scope.get("placed", False)
            for x in evaluate(data.get("x", [0.0]), scope, draws, "x"):
                inner = scope | {"x": x, "placed": placed}
                distance, lift, yaw = (
                    evaluate(data.get(key, default), inner, draws, key)
                    for key, default in (("out", WALL_GAP_M), ("lift", 0.0), ("yaw", 0.0))
                )
                if self._space.put_at_wall(
                    other, side, middle + x, out=distance, yaw_rad=yaw, lift=lift, group=True
                ):
                    scope["placed"] = True
                    nested = given | {"x": x}
                    self._put_around(other, side, middle + x, distance, nested, data.get("around", ()))
                    if not data.get("every", False):
                        break
            if "elsewhere" in data and not scope["placed"]:
                self._space.along_wall(other, draws, prefer=data["elsewhere"])

    def hang(self, kind: str) -> None:
        """Hang a piece on the first stretch of wall that is free."""
        piece = self._make(kind)
        for wall, share in itertools.product(self._room.walls, (0.5, 0.35, 0.65, 0.2, 0.8)):
            if self._space.hang(piece, wall, share * wall.length_m):
                return

    def dining_group(self, seats: Sequence[int]) -> None:
        """A table with chairs on two sides, a lamp above it."""
        space, draws = self._space, self._draws
        turn = 0.0 if self._room.rect.width >= self._room.rect.depth else 0.5 * math.pi
        for count, around in ((draws.pick("seats", seats), 0.45), (4, 0.4), (4, 0.15), (2, 0.15)):
            name = count, around
            circular = count == 2 or (count == 4 and draws.chance(f"round {name}", 0.4))
            size = {"r": 0.5 if count == 2 else 0.58} if circular else {"w": 0.4 + 0.33 * count}
            table = self._make("round_table" if circular else "table", **size)
            table = table.moved((0.0, -0.5 * table.bounds[:, 1].sum(), 0.0))
            group = [(table, 0.0, 0.0, 0.0)]
            chair = self._make("chair")
            for side, k in itertools.product((-1.0, 1.0), range(count // 2)):
                # The front of a chair is 0.46 m before its back, and looks at the table.
                turned = draws.uniform(f"chair {name} {side} {k}", -0.12, 0.12)
                yaw = (0.0 if side > 0.0 else math.pi) + turned
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

    def rug(self, w: float, d: float) -> None:
        """A rug in the open."""
        rug, rect = self._make("rug", w=w, d=d), self._room.rect
        turn = 0.0 if rect.width >= rect.depth else 0.5 * math.pi
        bounds = rug.moved((0.0, 0.0, 0.0), turn).bounds
        spot = self._space.open_spot(bounds, self._draws.under("at"), around=0.0, group=True)
        if spot:
            self._space.put(rug, (*spot, 0.0), turn, group=True)

    def main_lamps(self, strength: float, kind: str = "") -> None:
        """One lamp in the middle of the ceiling, two in a long room."""
        rect, ceiling = self._room.rect, self._space.ceiling_m
        kind = kind or self._draws.pick("kind", ("pendant", "ceiling_lamp"))
        given = {"low": ceiling - 0.55} if kind == "pendant" else {}
        count = 2 if rect.width * rect.depth > 21.0 else 1
        for k in range(count):
            share = (k + 0.5) / count
            shares = (share, 0.5) if rect.width >= rect.depth else (0.5, share)
            x, y = rect.x0 + rect.width * shares[0], rect.y0 + rect.depth * shares[1]
            lamp = self._make(kind, c=ceiling, strength=strength, **given)
            for dx, dy in ((0.0, 0.0), (0.4, 0.4), (-0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)):
                if self._space.put(lamp, (x + dx, y + dy, -0.002), group=True):
                    break

    def _dress_windows(self) -> None:
        """Curtains at windows outside of wet rooms, radiators below windows."""
        fabric = self._surfaces["linen" if self._draws.chance("linen", 0.5) else "accent"]
        for index, wall in enumerate(self._room.walls):
            for k, o in enumerate(o for o in wall.openings if o.kind == "window"):
                x, width = 0.5 * (o.x0 + o.x1), o.x1 - o.x0
                dry = self._room.role not in ("kitchen", "bathroom")
                if dry and self._wants(f"curtain {index} {k}", 0.8):
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

    def _pictures_above(self, wall: Wall, x: float) -> None:
        """Two or three prints in a row above a piece of furniture."""
        count = self._draws.pick("prints", (2, 3))
        w, h = (0.6, 0.8) if count == 2 else (0.45, 0.6)
        for k in range(count):
            self._space.hang(self._make("picture", w=w, h=h), wall, x + 0.74 * (k - 0.5 * (count - 1)))

    def _hang_pictures(self) -> None:
        """Prints on free stretches of wall, above whatever stands there."""
        formats = ((0.6, 0.8), (0.45, 0.6), (0.75, 1.0), (0.36, 0.48))
        for index, wall in enumerate(self._room.walls):
            hung = 0
            for name, share in ((f"{index} {share}", share) for share in (0.5, 0.32, 0.68, 0.16, 0.84)):
                if hung < 2 and self._wants(f"wanted {name}", 0.7):
                    w, h = self._draws.pick(f"format {name}", formats)
                    hung += self._space.hang(self._make("picture", w=w, h=h), wall, share * wall.length_m)
