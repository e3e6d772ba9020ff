"""Tables, shelves, cupboards and desks.

Every function returns a piece that stands on z = 0, centred on x = 0, with its back at y = 0 and its front
towards -y. Dimensions in metres.
"""

from __future__ import annotations

import numpy as np

from neurosim_core.scene.apartment.assembly import Piece, Surface
from neurosim_core.scene.apartment.geometry import box, cushion, lathe, picture_quad, rounded_box, tube
from neurosim_core.scene.apartment.looks import Look
from neurosim_core.scene.apartment.ornaments import book, books, bowl, vase
from neurosim_core.scene.apartment.seating import legs


def table(
    rng: np.random.Generator, look: Look, *, width: float = 1.6, depth: float = 0.9, height: float = 0.75
) -> Piece:
    """A dining table with a bevelled top, an apron and tapered legs."""
    piece = Piece("table")
    wood = look.wood if rng.uniform() < 0.6 else look.dark_wood
    piece.add(
        wood,
        rounded_box((width, depth, 0.036), 0.014, center=(0.0, -0.5 * depth, height - 0.018), segments=2),
    )
    for y in (-0.09, 0.09 - depth):
        piece.add(wood, box((width - 0.24, 0.02, 0.08), center=(0.0, y, height - 0.07)))
    for x in (0.11 - 0.5 * width, 0.5 * width - 0.11):
        piece.add(wood, box((0.02, depth - 0.22, 0.078), center=(x, -0.5 * depth, height - 0.07), grain=1))
    piece.add(
        wood,
        *(
            part.shifted((0.0, -0.06, 0.0))
            for part in legs(width - 0.12, depth - 0.12, height - 0.04, radius=0.036)
        ),
    )
    return piece


def round_table(look: Look, *, radius: float = 0.55, height: float = 0.74) -> Piece:
    """A round table on a turned column."""
    piece = Piece("table")
    center = (0.0, -radius, 0.0)
    top = [
        (0.0, height - 0.03),
        (radius - 0.02, height - 0.03),
        (radius, height - 0.012),
        (radius - 0.006, height),
        (0.0, height),
    ]
    piece.add(look.wood, lathe(top, sides=48, center=center))
    foot = [
        (0.0, 0.0),
        (0.27, 0.0),
        (0.27, 0.02),
        (0.1, 0.05),
        (0.05, 0.1),
        (0.036, 0.3),
        (0.04, 0.55),
        (0.12, height - 0.025),
    ]
    piece.add(look.metal, lathe(foot, sides=32, center=center))
    return piece


def coffee_table(rng: np.random.Generator, look: Look) -> Piece:
    """A low table, rectangular with a shelf or round, with something on it."""
    piece = Piece("coffee_table")
    height = 0.42
    if rng.uniform() < 0.5:
        radius = 0.42
        rim = [
            (0.0, height - 0.035),
            (radius - 0.02, height - 0.035),
            (radius, height - 0.02),
            (radius, height - 0.006),
            (radius - 0.006, height),
            (0.0, height),
        ]
        piece.add(look.wood, lathe(rim, sides=48, center=(0.0, -radius, 0.0)))
        for angle in np.arange(3) * 2.0 * np.pi / 3.0 + 0.5:
            reach = np.array([np.cos(angle), np.sin(angle), 0.0])
            top = 0.24 * reach + (0.0, -radius, height - 0.025)
            piece.add(look.wood, tube([0.36 * reach + (0.0, -radius, 0.006), top], [0.014, 0.022], sides=12))
        depth = 2.0 * radius
    else:
        width, depth = 1.1, 0.6
        piece.add(
            look.wood,
            rounded_box((width, depth, 0.035), 0.012, center=(0.0, -0.5 * depth, height - 0.018), segments=2),
        )
        piece.add(look.metal, *legs(width - 0.06, depth, height - 0.03, radius=0.018))
        piece.add(
            look.dark_wood,
            rounded_box((width - 0.1, depth - 0.08, 0.02), 0.006, center=(0.0, -0.5 * depth, 0.16)),
        )
    piece.include(
        books(rng, look, count=int(rng.integers(2, 4))), (-0.14, -0.5 * depth + 0.06, height + 0.002), 0.3
    )
    piece.include(
        vase(rng, look, scale=0.7) if rng.uniform() < 0.5 else bowl(look),
        (0.16, -0.5 * depth - 0.08, height + 0.002),
    )
    return piece


def nightstand(rng: np.random.Generator, look: Look) -> Piece:
    """A bedside cabinet with a drawer and an open shelf."""
    piece = Piece("nightstand")
    width, depth, height = 0.44, 0.38, 0.5
    wood = look.wood
    piece.add(
        wood,
        *(part.shifted((0.0, -0.02, 0.0)) for part in legs(width - 0.04, depth - 0.04, 0.17, radius=0.016)),
    )
    piece.add(
        wood, rounded_box((width, depth, 0.03), 0.01, center=(0.0, -0.5 * depth, height - 0.015), segments=2)
    )
    piece.add(
        wood, rounded_box((width - 0.014, depth - 0.012, 0.024), 0.006, center=(0.0, -0.5 * depth, 0.18))
    )
    for side in (-1.0, 1.0):
        piece.add(
            wood,
            box(
                (0.02, depth - 0.02, 0.3), center=(side * (0.5 * width - 0.015), -0.5 * depth, 0.33), grain=2
            ),
        )
    piece.add(wood, box((width - 0.06, 0.01, 0.3), center=(0.0, -0.012, 0.33)))
    piece.add(
        look.front,
        rounded_box((width - 0.056, depth - 0.03, 0.13), 0.006, center=(0.0, -0.5 * depth - 0.008, 0.405)),
    )
    piece.add(
        look.steel,
        lathe(
            [(0.0, 0.0), (0.008, 0.0), (0.008, 0.012), (0.014, 0.02), (0.008, 0.026), (0.0, 0.027)], sides=24
        )
        .turned(0.5 * np.pi, axis=0)
        .shifted((0.0, -depth + 0.006, 0.405)),
    )
    piece.include(books(rng, look, count=2), (0.0, -0.2, 0.194), 0.2)
    return piece


def sideboard(
    rng: np.random.Generator,
    look: Look,
    *,
    width: float = 1.7,
    height: float = 0.55,
    television: bool = False,
) -> Piece:
    """A low cupboard with doors, and a television or ornaments on it."""
    piece = Piece("television_board" if television else "sideboard")
    depth = 0.42
    piece.add(
        look.metal,
        *(part.shifted((0.0, -0.04, 0.0)) for part in legs(width - 0.1, depth - 0.08, 0.13, radius=0.016)),
    )
    middle = 0.5 * (0.12 + height)
    piece.add(
        look.wood,
        rounded_box((width, depth, height - 0.12), 0.012, center=(0.0, -0.5 * depth, middle), segments=2),
    )
    count = 4 if width > 1.5 else 3
    pitch = (width - 0.04) / count
    for index in range(count):
        x = (index - 0.5 * (count - 1)) * pitch
        front = look.front if index in (0, count - 1) else look.dark_wood
        size = (pitch - 0.012, 0.03, height - 0.12 - 0.04)
        piece.add(front, rounded_box(size, 0.005, center=(x, -depth - 0.006, middle), grain=2))
        side = 1.0 if index % 2 else -1.0
        piece.add(
            look.metal,
            tube(
                [
                    (x - side * 0.4 * pitch, -depth - 0.028, middle - 0.06),
                    (x - side * 0.4 * pitch, -depth - 0.028, middle + 0.06),
                ],
                0.006,
                sides=8,
            ),
        )
    if television:
        wide, high = 1.22, 0.70
        z = height + 0.06 + 0.5 * high
        piece.add(look.glass, rounded_box((wide, 0.035, high), 0.008, center=(0.0, -0.2, z)))
        piece.add(look.glass, rounded_box((0.5, 0.2, 0.014), 0.005, center=(0.0, -0.2, height + 0.009)))
        piece.add(look.glass, rounded_box((0.12, 0.03, 0.1), 0.006, center=(0.0, -0.2, height + 0.05)))
        picture = Surface(
            name="television",
            texture="view",
            tile_m=(wide - 0.03, high - 0.03),
            exact=True,
            emission=(0.1, 0.1, 0.11),
            color=(0.7, 0.75, 0.8),
        )
        piece.add(
            picture,
            picture_quad(
                (-0.5 * wide + 0.015, -0.2195, z - 0.5 * high + 0.015),
                (wide - 0.03, 0, 0),
                (0, 0, high - 0.03),
            ),
        )
    else:
        piece.include(vase(rng, look), (-0.34 * width, -0.2, height + 0.002))
        piece.include(books(rng, look, count=3), (0.05, -0.2, height + 0.002), 0.15)
        piece.include(bowl(look), (0.33 * width, -0.2, height + 0.002))
    return piece


def bookshelf(rng: np.random.Generator, look: Look, *, width: float = 0.9, height: float = 2.0) -> Piece:
    """A case of shelves full of books, some leaning, with ornaments between them."""
    piece = Piece("bookshelf")
    depth, board = 0.3, 0.024
    wood = look.wood if rng.uniform() < 0.6 else look.dark_wood
    for side in (-1.0, 1.0):
        piece.add(
            wood,
            rounded_box(
                (board, depth, height),
                0.004,
                center=(side * 0.5 * (width - board), -0.5 * depth, 0.5 * height),
                grain=2,
            ),
        )
    piece.add(wood, box((width - board, 0.01, height - 0.06), center=(0.0, -0.008, 0.5 * height), grain=2))
    count = max(2, round(height / 0.36))
    pitch = (height - 0.1) / count
    for index in range(count + 1):
        z = 0.06 + index * pitch
        piece.add(
            wood,
            box((width - 1.4 * board, depth - 0.012, board), center=(0.0, -0.5 * depth, z)),
        )
        if index < count:
            _fill_shelf(
                piece, rng, look, width - 2.0 * board - 0.02, z + 0.5 * board + 0.001, pitch - board - 0.03
            )
    return piece


def _fill_shelf(
    piece: Piece, rng: np.random.Generator, look: Look, width: float, z: float, clear: float
) -> None:
    x, end = -0.5 * width, 0.5 * width
    while x < end - 0.06:
        if rng.uniform() < 0.14 and end - x > 0.36:
            kind = int(rng.choice([0, 1, 1, 2]))
            if kind == 0:
                piece.include(vase(rng, look, scale=0.55, twigs=False), (x + 0.16, -0.16, z))
            elif kind == 1:
                piece.include(books(rng, look, count=4), (x + 0.16, -0.155, z))
            else:
                piece.include(bowl(look, scale=0.7), (x + 0.16, -0.16, z))
            x += 0.33
            continue
        run_end = min(end, x + rng.uniform(0.18, 0.5))
        base = rng.uniform(0.17, clear - 0.02)
        while x < run_end:
            thick = rng.uniform(0.016, 0.042)
            if x + thick > end:
                return
            tall = min(clear, base + rng.uniform(-0.025, 0.025))
            piece.add(
                look.spines,
                book(rng, (thick - 0.001, rng.uniform(0.15, 0.21), tall)).shifted(
                    (x + 0.5 * thick, -0.285, z)
                ),
            )
            x += thick
        x += rng.uniform(0.01, 0.05)


def wardrobe(rng: np.random.Generator, look: Look, *, width: float = 1.6, height: float = 2.15) -> Piece:
    """A wardrobe with framed doors, handles, a plinth and a cornice."""
    piece = Piece("wardrobe")
    depth = 0.6
    wood = look.front if rng.uniform() < 0.5 else look.wood
    piece.add(
        look.dark_wood, box((width - 0.06, depth - 0.05, 0.09), center=(0.0, -0.5 * depth + 0.01, 0.045))
    )
    piece.add(
        wood,
        rounded_box(
            (width, depth, height - 0.12), 0.006, center=(0.0, -0.5 * depth, 0.5 * height + 0.02), grain=2
        ),
    )
    piece.add(
        wood,
        rounded_box(
            (width + 0.04, depth + 0.04, 0.045),
            0.016,
            center=(0.0, -0.5 * depth - 0.008, height - 0.022),
            segments=2,
        ),
    )
    count = max(2, round(width / 0.5))
    pitch = (width - 0.02) / count
    tall = height - 0.2
    for index in range(count):
        x = (index - 0.5 * (count - 1)) * pitch
        piece.add(
            wood,
            rounded_box(
                (pitch - 0.008, 0.024, tall), 0.005, center=(x, -depth - 0.008, 0.5 * height + 0.01), grain=2
            ),
        )
        for low, high in ((0.04, 0.56), (0.6, 0.96)):
            size = (pitch - 0.14, 0.012, (high - low) * tall - 0.06)
            z = 0.5 * height + 0.01 + (0.5 * (low + high) - 0.5) * tall
            piece.add(wood, rounded_box(size, 0.0055, center=(x, -depth - 0.022, z), grain=2))
        knob = x + (0.5 * pitch - 0.04) * (1.0 if index % 2 == 0 else -1.0)
        piece.add(
            look.steel, tube([(knob, -depth - 0.045, 0.95), (knob, -depth - 0.045, 1.15)], 0.007, sides=10)
        )
        for z in (0.96, 1.14):
            piece.add(
                look.steel, tube([(knob, -depth - 0.015, z), (knob, -depth - 0.043, z)], 0.005, sides=8)
            )
    return piece


def dresser(rng: np.random.Generator, look: Look, *, width: float = 1.1, height: float = 0.85) -> Piece:
    """A chest of drawers with round knobs, ornaments on top."""
    piece = Piece("dresser")
    depth = 0.46
    wood = look.wood
    piece.add(
        wood,
        *(part.shifted((0.0, -0.03, 0.0)) for part in legs(width - 0.08, depth - 0.06, 0.14, radius=0.022)),
    )
    piece.add(
        wood,
        rounded_box((width, depth, height - 0.15), 0.008, center=(0.0, -0.5 * depth, 0.5 * (height + 0.11))),
    )
    piece.add(
        wood,
        rounded_box(
            (width + 0.03, depth + 0.03, 0.028),
            0.012,
            center=(0.0, -0.5 * depth - 0.005, height - 0.014),
            segments=2,
        ),
    )
    rows = 3
    pitch = (height - 0.21) / rows
    knob = lathe(
        [(0.0, 0.0), (0.008, 0.0), (0.008, 0.014), (0.017, 0.02), (0.017, 0.027), (0.0, 0.032)], sides=24
    )
    for row in range(rows):
        z = 0.155 + (row + 0.5) * pitch
        for side in (-1.0, 1.0):
            x = side * 0.25 * (width - 0.02)
            piece.add(
                look.front,
                rounded_box((0.5 * width - 0.03, 0.022, pitch - 0.014), 0.005, center=(x, -depth - 0.006, z)),
            )
            piece.add(look.steel, knob.turned(0.5 * np.pi, axis=0).shifted((x, -depth - 0.014, z)))
    piece.include(vase(rng, look, scale=0.9), (-0.3 * width, -0.22, height + 0.002))
    piece.include(books(rng, look, count=3), (0.28 * width, -0.2, height + 0.002), -0.2)
    return piece


def desk(rng: np.random.Generator, look: Look, *, width: float = 1.5) -> Piece:
    """A desk with drawers, a monitor, a keyboard, a mug, books and a lamp without light."""
    piece = Piece("desk")
    depth, height = 0.72, 0.74
    piece.add(
        look.wood,
        rounded_box((width, depth, 0.032), 0.008, center=(0.0, -0.5 * depth, height - 0.016), segments=2),
    )
    for y in (-0.06, 0.06 - depth):
        piece.add(
            look.metal,
            box((0.04, 0.04, height - 0.034), center=(0.04 - 0.5 * width, y, 0.5 * (height - 0.03)), grain=2),
        )
    piece.add(
        look.metal, box((0.03, depth - 0.16, 0.03), center=(0.04 - 0.5 * width, -0.5 * depth, 0.1), grain=1)
    )
    block = 0.4
    x = 0.5 * (width - block) - 0.02
    piece.add(
        look.white,
        rounded_box(
            (block, depth - 0.06, height - 0.04),
            0.005,
            center=(x, -0.5 * depth + 0.01, 0.5 * (height - 0.034)),
        ),
    )
    for index in range(3):
        z = 0.13 + 0.225 * index
        piece.add(look.front, rounded_box((block - 0.012, 0.024, 0.21), 0.004, center=(x, -depth + 0.034, z)))
        piece.add(
            look.steel,
            tube(
                [(x - 0.06, -depth + 0.012, z + 0.06), (x + 0.06, -depth + 0.012, z + 0.06)], 0.005, sides=8
            ),
        )
    wide, high = 0.66, 0.39
    z = height + 0.15 + 0.5 * high
    piece.add(look.glass, rounded_box((wide, 0.03, high), 0.006, center=(-0.1, -0.18, z)))
    fit = Surface(
        name="screen",
        texture="screen",
        tile_m=(wide - 0.02, high - 0.02),
        exact=True,
        emission=look.screen.emission,
    )
    piece.add(
        fit,
        picture_quad(
            (-0.1 - 0.5 * wide + 0.01, -0.1965, z - 0.5 * high + 0.01),
            (wide - 0.02, 0, 0),
            (0, 0, high - 0.02),
        ),
    )
    piece.add(look.steel, tube([(-0.1, -0.13, height + 0.01), (-0.1, -0.14, z)], 0.018, sides=16))
    piece.add(look.steel, rounded_box((0.24, 0.18, 0.012), 0.005, center=(-0.1, -0.15, height + 0.008)))
    piece.add(look.white, rounded_box((0.42, 0.13, 0.016), 0.006, center=(-0.1, -0.44, height + 0.010)))
    for row in range(4):
        for column in range(13):
            at = (-0.1 + (column - 6.0) * 0.0305, -0.396 - 0.028 * row, height + 0.0195)
            piece.add(look.leather, box((0.025, 0.022, 0.009), center=at))
    piece.add(
        look.leather,
        cushion((0.06, 0.1, 0.035), center=(0.2, -0.45, height + 0.02), power=(2.4, 2.6, 2.2), segments=5),
    )
    mug = [(0.0, 0.0), (0.036, 0.0), (0.04, 0.01), (0.041, 0.09), (0.037, 0.09), (0.035, 0.012), (0.0, 0.012)]
    piece.add(look.pot, lathe(mug, sides=28, center=(0.34, -0.3, height + 0.002)))
    piece.include(
        books(rng, look, count=int(rng.integers(3, 6))),
        (-0.58 * 0.5 * width - 0.2, -0.24, height + 0.002),
        0.1,
    )
    return piece
