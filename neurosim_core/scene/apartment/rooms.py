"""What each kind of room contains, and in which order it is placed: the large and necessary things first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from neurosim_core.scene.apartment import cabinets, lamps, ornaments, seating, wetrooms
from neurosim_core.scene.apartment.assembly import Assembly, Piece, Surface
from neurosim_core.scene.apartment.floorplan import Opening, Role, Room, Wall, stream
from neurosim_core.scene.apartment.furnishing import (
    WALL_GAP_M,
    RoomSpace,
    corner_liking,
    middle_liking,
    opposite,
)
from neurosim_core.scene.apartment.looks import Look, Palette
from neurosim_core.scene.apartment.shell import RoomFinish

_ON_RUG_M = 0.014


@dataclass
class _Furnisher:
    """Everything that the arrangement of one room needs."""

    space: RoomSpace
    rng: np.random.Generator
    look: Look
    palette: Palette
    finish: RoomFinish
    index: int
    """Number of the room in the plan."""
    density: float
    prints: int = 0

    @property
    def room(self) -> Room:
        """The room."""
        return self.space.room

    def wants(self, chance: float) -> bool:
        """Whether an optional thing shall be there."""
        return float(self.rng.uniform()) < chance * self.density


def furnish(
    room: Room,
    index: int,
    assembly: Assembly,
    palette: Palette,
    finish: RoomFinish,
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
    make = _Furnisher(
        space=RoomSpace(room, assembly, ceiling_m),
        rng=stream(seed, "furniture", room.name),
        look=palette.look(room.name),
        palette=palette,
        finish=finish,
        index=index,
        density=density,
    )
    _ARRANGEMENTS[room.role](make)
    _dress_windows(make)
    _hang_pictures(make)
    for _ in range(2):
        if make.wants(0.75):
            green = ornaments.plant(make.rng, make.look, height=float(make.rng.uniform(0.6, 1.35)))
            half = 0.5 * (green.bounds[1] - green.bounds[0])
            green = green.moved((0.0, -float(half[1]) - 0.02, 0.0))
            make.space.along_wall(green, make.rng, front_m=0.05, liking=corner_liking)
    return make.space


def _studio(make: _Furnisher) -> None:
    _kitchen_line(make, widths=(3.0, 2.4))
    _bed_group(make, width=1.4)
    _sofa_group(make)
    _dining_group(make, seats=4)
    _shelves(make, count=2)
    _main_lamps(make, strength=1.25)
    _floor_lamp(make)


def _living(make: _Furnisher) -> None:
    _sofa_group(make)
    _shelves(make, count=2)
    if make.wants(0.85):
        _dining_group(make, seats=int(make.rng.choice([4, 6])))
    if make.wants(0.7):
        make.space.along_wall(cabinets.sideboard(make.rng, make.look, width=1.5, height=0.78), make.rng)
    _main_lamps(make, strength=1.2)
    _floor_lamp(make)


def _bedroom(make: _Furnisher) -> None:
    _bed_group(make, width=float(make.rng.choice([1.4, 1.6, 1.8])))
    for width in (2.0, 1.5, 1.0):
        if make.space.along_wall(
            cabinets.wardrobe(make.rng, make.look, width=width), make.rng, liking=corner_liking
        ):
            break
    spot = make.space.along_wall(cabinets.dresser(make.rng, make.look), make.rng, liking=middle_liking)
    if spot:
        make.space.hang(ornaments.mirror(make.look, middle=1.6), *spot)
    if make.wants(0.6):
        make.space.along_wall(
            seating.armchair(make.rng, make.look), make.rng, front_m=0.4, liking=corner_liking
        )
    _main_lamps(make, strength=1.0)
    _floor_lamp(make)


def _kitchen(make: _Furnisher) -> None:
    _kitchen_line(make, widths=(3.6, 3.0, 2.4, 1.8))
    _dining_group(make, seats=4)
    if make.wants(0.5):
        for _ in range(2):
            make.space.along_wall(seating.stool(make.look), make.rng, front_m=0.2)
    if make.wants(0.6):
        make.space.along_wall(cabinets.bookshelf(make.rng, make.look, width=0.8, height=1.5), make.rng)
    _main_lamps(make, strength=1.0)
    clock = ornaments.clock(make.look)
    for wall in make.room.walls:
        if any(make.space.hang(clock, wall, share * wall.length_m) for share in (0.5, 0.35, 0.65, 0.2, 0.8)):
            break


def _study(make: _Furnisher) -> None:
    desk = cabinets.desk(make.rng, make.look, width=1.5)
    spot = make.space.along_wall(desk, make.rng, front_m=0.9, liking=middle_liking, window=True)
    if spot:
        wall, x = spot
        deep = -float(desk.bounds[0, 1])
        chair = seating.office_chair(make.rng, make.look)
        reach = -float(chair.bounds[0, 1])
        turn = np.pi + float(make.rng.uniform(-0.2, 0.2))
        make.space.put_at_wall(
            chair, wall, x - 0.1, out=WALL_GAP_M + deep + 0.1 + reach, yaw_rad=turn, group=True
        )
    _shelves(make, count=3)
    if make.wants(0.8):
        make.space.along_wall(
            seating.armchair(make.rng, make.look), make.rng, front_m=0.5, liking=corner_liking
        )
    if make.wants(0.8):
        make.space.along_wall(cabinets.sideboard(make.rng, make.look, width=1.2, height=0.7), make.rng)
    _rug_in_the_open(make, 1.9, 1.3)
    _main_lamps(make, strength=0.95)
    _floor_lamp(make)


def _bathroom(make: _Furnisher) -> None:
    space, rng, look = make.space, make.rng, make.look
    space.along_wall(wetrooms.bathtub(look), rng, front_m=0.4, liking=corner_liking)
    stand = space.along_wall(wetrooms.washstand(rng, look), rng, front_m=0.5, liking=middle_liking)
    if stand:
        space.hang(ornaments.mirror(look, width=0.7, height=0.8, middle=1.6), *stand)
    space.along_wall(wetrooms.toilet(look), rng, front_m=0.4, sides_m=0.12)
    space.along_wall(wetrooms.washing_machine(look), rng, front_m=0.4, liking=corner_liking)
    spots = space.spots(wetrooms.towel_rail(look), rng, front_m=0.2)
    if spots:
        space.hang(wetrooms.towel_rail(look), *spots[0])
    _rug_in_the_open(make, 0.9, 0.6)
    _main_lamps(make, strength=0.85)


def _dining(make: _Furnisher) -> None:
    _dining_group(make, seats=6)
    for height in (0.8, 0.78):
        if make.wants(0.9):
            board = cabinets.sideboard(make.rng, make.look, width=1.6, height=height)
            make.space.along_wall(board, make.rng, liking=middle_liking)
    _shelves(make, count=1)
    _main_lamps(make, strength=1.0)
    _floor_lamp(make)


_ARRANGEMENTS: dict[Role, Callable[[_Furnisher], None]] = {
    "studio": _studio,
    "living": _living,
    "kitchen": _kitchen,
    "bedroom": _bedroom,
    "study": _study,
    "bathroom": _bathroom,
    "dining": _dining,
}


def _sofa_group(make: _Furnisher) -> None:
    """A sofa with a rug and a low table in front, an armchair beside it and a television across the room."""
    space, rng, look = make.space, make.rng, make.look
    for width, front, window in (
        (2.3, 1.7, False),
        (2.3, 1.3, False),
        (1.8, 1.3, False),
        (2.3, 1.3, True),
        (1.8, 0.8, True),
    ):
        sofa = seating.sofa(rng, look, width=width)
        spot = space.along_wall(sofa, rng, front_m=front, sides_m=0.1, liking=middle_liking, window=window)
        if spot:
            break
    else:
        return
    wall, x = spot
    _pictures_above(make, wall, x)
    edge = WALL_GAP_M - float(sofa.bounds[0, 1])
    rug_width, rug_depth = width + 0.1, 1.55
    rug = ornaments.rug(make.palette.rug(make.index, rug_width, rug_depth), width=rug_width, depth=rug_depth)
    on_rug = space.put_at_wall(rug, wall, x, out=edge + 0.04, group=True)
    lift = _ON_RUG_M if on_rug else 0.0
    space.put_at_wall(cabinets.coffee_table(rng, look), wall, x, out=edge + 0.42, lift=lift, group=True)
    chair = seating.armchair(rng, look)
    for side in rng.permutation([-1.0, 1.0]):
        # Its front towards the table: turned by a quarter, its depth runs along the wall.
        at = x + side * (0.5 * rug_width + 0.06 + float(-chair.bounds[0, 1]))
        if space.put_at_wall(chair, wall, at, out=edge + 0.75, yaw_rad=-side * 0.5 * np.pi, group=True):
            break
    across = opposite(make.room, wall)
    board = cabinets.sideboard(rng, look, television=True)
    for shift in (0.0, 0.4, -0.4, 0.8, -0.8, 1.2, -1.2):
        if space.put_at_wall(board, across, across.length_m - x + shift):
            break
    else:
        space.along_wall(board, rng, liking=middle_liking)
    for side in (-1.0, 1.0):
        if space.put_at_wall(
            lamps.floor_lamp(rng, look, strength=0.5), wall, x + side * (0.5 * width + 0.32), group=True
        ):
            break


def _bed_group(make: _Furnisher, *, width: float) -> None:
    """A bed with nightstands and lamps on both sides, a rug at its foot or side."""
    space, rng, look = make.space, make.rng, make.look
    bed = seating.bed(rng, look, width=width)
    for sides, front, window in ((0.5, 0.55, False), (0.5, 0.3, True), (0.1, 0.55, False), (0.1, 0.3, True)):
        spot = space.along_wall(bed, rng, front_m=front, sides_m=sides, liking=middle_liking, window=window)
        if spot:
            break
    else:
        return
    wall, x = spot
    if make.wants(0.7):
        _pictures_above(make, wall, x)
    stand = cabinets.nightstand(rng, look)
    high, deep = float(stand.bounds[1, 2]), -float(stand.bounds[0, 1])
    half = float(bed.bounds[1, 0])
    for side in (-1.0, 1.0):
        at = x + side * (half + 0.06 + 0.22)
        if space.put_at_wall(stand, wall, at, group=True):
            space.put_at_wall(
                lamps.table_lamp(look), wall, at, out=WALL_GAP_M + 0.5 * deep, lift=high + 0.002, group=True
            )
            beside = ornaments.rug(make.palette.rug(make.index, 0.75, 1.5), width=0.75, depth=1.5)
            space.put_at_wall(beside, wall, x + side * (half + 0.46), out=WALL_GAP_M + deep + 0.1, group=True)


def _kitchen_line(make: _Furnisher, *, widths: tuple[float, ...]) -> None:
    """The longest counter that fits, and a fridge near it."""
    space, rng, look = make.space, make.rng, make.look
    for width in widths:
        counter = wetrooms.kitchen_counter(rng, look, make.finish.accent, width=width)
        spot = space.along_wall(counter, rng, front_m=0.8, liking=corner_liking)
        if spot:
            break
    else:
        return
    wall, x = spot
    fridge = wetrooms.refrigerator(look)
    for side in (-1.0, 1.0):
        if space.put_at_wall(fridge, wall, x + side * (0.5 * width + 0.37), group=True):
            return
    space.along_wall(fridge, rng, front_m=0.5, liking=corner_liking)


def _dining_group(make: _Furnisher, *, seats: int) -> None:
    """A table with chairs on two sides, a lamp above it."""
    space, rng, look = make.space, make.rng, make.look
    turn = 0.0 if make.room.rect.width >= make.room.rect.depth else 0.5 * np.pi
    for count, around in ((seats, 0.45), (4, 0.4), (4, 0.15), (2, 0.15)):
        if count == 2 or (count == 4 and rng.uniform() < 0.4):
            table = cabinets.round_table(look, radius=0.5 if count == 2 else 0.58)
        else:
            table = cabinets.table(rng, look, width=0.4 + 0.33 * count, depth=0.88)
        (x0, y0, _), (x1, y1, _) = table.bounds
        table = table.moved((-0.5 * float(x0 + x1), -0.5 * float(y0 + y1), 0.0))
        half = 0.5 * float(y1 - y0)
        group = [(table, 0.0, 0.0, 0.0)]
        per_side = count // 2
        chair = seating.chair(rng, look)
        for side in (-1.0, 1.0):
            for k in range(per_side):
                at = (k - 0.5 * (per_side - 1)) * (0.62 if per_side > 1 else 0.0)
                # A chair's front is 0.46 m before its back, and looks at the table.
                turned = (0.0 if side > 0.0 else np.pi) + float(rng.uniform(-0.12, 0.12))
                group.append((chair, at, side * (half + 0.56), turned))
        whole = Piece("group")
        for piece, px, py, yaw in group:
            whole.include(piece, (px, py, 0.0), yaw)
        for heading in (turn, turn + 0.5 * np.pi):
            spot = space.open_spot(whole.moved((0, 0, 0), heading).bounds, rng, around_m=around)
            if spot is None:
                continue
            c, s = float(np.cos(heading)), float(np.sin(heading))
            for piece, px, py, yaw in group:
                space.put(piece, (spot[0] + c * px - s * py, spot[1] + s * px + c * py, 0.0), heading + yaw)
            center = ornaments.bowl(look) if rng.uniform() < 0.5 else ornaments.vase(rng, look)
            space.put(center, (*spot, float(table.bounds[1, 2]) + 0.002))
            lamp = lamps.pendant(rng, look, ceiling=space.ceiling_m, bottom=1.68, strength=0.75)
            space.put(lamp, (*spot, -0.002))
            return


def _shelves(make: _Furnisher, *, count: int) -> None:
    """Bookshelves, next to each other where there is room."""
    space, rng = make.space, make.rng
    height = float(rng.choice([1.75, 2.0, 2.15]))
    spot: tuple[Wall, float] | None = None
    for _ in range(count):
        shelf = cabinets.bookshelf(rng, make.look, width=0.9, height=height)
        if spot:
            wall, x = spot
            for side in (-1.0, 1.0):
                if space.put_at_wall(shelf, wall, x + side * 0.935):
                    spot = wall, x + side * 0.935
                    break
            else:
                spot = space.along_wall(shelf, rng, liking=corner_liking)
        else:
            spot = space.along_wall(shelf, rng, liking=corner_liking)


def _rug_in_the_open(make: _Furnisher, width: float, depth: float) -> None:
    rug = ornaments.rug(make.palette.rug(make.index, width, depth), width=width, depth=depth)
    turn = 0.0 if make.room.rect.width >= make.room.rect.depth else 0.5 * np.pi
    spot = make.space.open_spot(rug.moved((0, 0, 0), turn).bounds, make.rng, around_m=0.0, group=True)
    if spot:
        make.space.put(rug, (*spot, 0.0), turn, group=True)


def _floor_lamp(make: _Furnisher) -> None:
    if make.wants(0.6):
        lamp = lamps.floor_lamp(make.rng, make.look, strength=0.45)
        make.space.along_wall(lamp, make.rng, front_m=0.1, liking=corner_liking)


def _main_lamps(make: _Furnisher, *, strength: float) -> None:
    """One lamp in the middle of the ceiling, two in a long room."""
    space, rng, look = make.space, make.rng, make.look
    rect = make.room.rect
    count = 2 if rect.width * rect.depth > 21.0 else 1
    kind = "bathroom" if make.room.role in ("bathroom", "kitchen") else str(rng.choice(["pendant", "disc"]))
    for k in range(count):
        share = (k + 0.5) / count
        along_x = rect.width >= rect.depth
        x = rect.x0 + rect.width * (share if along_x else 0.5)
        y = rect.y0 + rect.depth * (0.5 if along_x else share)
        if kind == "pendant":
            lamp = lamps.pendant(
                rng, look, ceiling=space.ceiling_m, bottom=space.ceiling_m - 0.55, strength=strength
            )
        elif kind == "disc":
            lamp = lamps.ceiling_lamp(look, ceiling=space.ceiling_m, strength=strength)
        else:
            lamp = lamps.spot_bar(look, ceiling=space.ceiling_m, strength=strength)
        for dx, dy in ((0.0, 0.0), (0.4, 0.4), (-0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)):
            if space.put(lamp, (x + dx, y + dy, -0.002), group=True):
                break


def _dress_windows(make: _Furnisher) -> None:
    """Curtains at windows outside of wet rooms, radiators below windows."""
    space, rng, look = make.space, make.rng, make.look
    fabric = look.linen if rng.uniform() < 0.5 else look.accent
    for wall in make.room.walls:
        for opening in (o for o in wall.openings if o.kind == "window"):
            if make.room.role not in ("kitchen", "bathroom") and make.wants(0.8):
                _curtains(make, wall, opening, fabric)
            if opening.z0 > 0.75:
                width = opening.x1 - opening.x0 - 0.2
                space.hang(
                    ornaments.radiator(look, width=width), wall, 0.5 * (opening.x0 + opening.x1), window=True
                )


def _curtains(make: _Furnisher, wall: Wall, opening: Opening, fabric: Surface) -> None:
    """Two panels beside a window on a rod above it, the longest that what stands there allows."""
    top = opening.z1 + 0.12
    width = 0.34
    rail = ornaments.curtain_rail(
        make.look, width=opening.x1 - opening.x0 + 2.0 * width + 0.1, height=top + 0.028
    )
    if not make.space.put_at_wall(
        rail, wall, 0.5 * (opening.x0 + opening.x1), out=0.0, lift=-0.002, group=True, window=True
    ):
        return
    for bottoms, x in (
        ((0.03, opening.z0 - 0.2), opening.x0 - 0.5 * width + 0.06),
        ((0.03, opening.z0 - 0.2), opening.x1 + 0.5 * width - 0.06),
    ):
        for bottom in bottoms:
            panel = ornaments.curtain(make.rng, fabric, width=width, bottom=bottom, top=top)
            if make.space.put_at_wall(panel, wall, x, out=0.0, group=True, window=True):
                break


def _picture(make: _Furnisher, width: float, height: float) -> Piece:
    poster = make.palette.poster(2 * make.index + make.prints % 2, width, height)
    make.prints += 1
    return ornaments.picture(make.look, poster, width=width, height=height, middle=1.6)


def _pictures_above(make: _Furnisher, wall: Wall, x: float) -> None:
    """Two or three prints in a row above a piece of furniture."""
    count = int(make.rng.integers(2, 4))
    for k in range(count):
        at = x + 0.74 * (k - 0.5 * (count - 1))
        make.space.hang(_picture(make, *((0.6, 0.8) if count == 2 else (0.45, 0.6))), wall, at)


def _hang_pictures(make: _Furnisher) -> None:
    """Prints on free stretches of wall, above whatever stands there."""
    formats = ((0.6, 0.8), (0.45, 0.6), (0.75, 1.0), (0.36, 0.48))
    for wall in make.room.walls:
        hung = 0
        for share in (0.5, 0.32, 0.68, 0.16, 0.84):
            if hung < 2 and make.wants(0.7):
                size = formats[int(make.rng.integers(len(formats)))]
                hung += make.space.hang(_picture(make, *size), wall, share * wall.length_m)
