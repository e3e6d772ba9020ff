"""Sofas, chairs and beds.

Every function returns a piece that stands on z = 0, centred on x = 0, with its back at y = 0 and its front
towards -y. Dimensions in metres.
"""

from __future__ import annotations

import numpy as np

from neurosim_core.scene.apartment.assembly import Piece, Surface
from neurosim_core.scene.apartment.geometry import Part, box, cushion, cylinder, lathe, rounded_box, tube
from neurosim_core.scene.apartment.looks import Look


def legs(
    width: float, depth: float, height: float, *, radius: float = 0.02, splay: float = 0.0
) -> list[Part]:
    """Four round, tapered legs below a rectangle whose back is at y = 0; they reach into what they carry."""
    parts = []
    for sx in (-1.0, 1.0):
        for y, sy in ((-radius, 1.0), (radius - depth, -1.0)):
            x = sx * (0.5 * width - radius)
            foot = (
                x + sx * splay * height,
                y + sy * splay * height * (0.0 if sy > 0.0 else 1.0),
                0.7 * radius * splay,
            )
            parts.append(tube([foot, (x, y, height + 0.008)], [0.65 * radius, radius], sides=12))
    return parts


def pillow(size: float, *, thick: float = 0.16) -> Part:
    """A square throw pillow that stands on its edge and faces -y; its middle is the origin."""
    return cushion((size, thick, size), power=(3.4, 1.6, 3.4), segments=6)


def sofa(rng: np.random.Generator, look: Look, *, width: float = 2.2) -> Piece:
    """A sofa with seat and back cushions, round arms and throw pillows."""
    piece = Piece("sofa")
    depth, arm, seat = 0.92, 0.19, 0.44
    fabric = look.fabric if rng.uniform() < 0.75 else look.leather
    piece.add(
        look.wood,
        *(part.shifted((0.0, -0.05, 0.0)) for part in legs(width - 0.2, depth - 0.12, 0.12, radius=0.026)),
    )
    piece.add(
        fabric,
        rounded_box((width - 0.04, depth - 0.04, 0.2), 0.04, center=(0.0, -0.5 * depth, 0.22), segments=2),
    )
    back = rounded_box((width - 0.02, 0.2, 0.66), 0.07, center=(0.0, -0.11, 0.46), segments=3)
    piece.add(fabric, back)
    for side in (-1.0, 1.0):
        x = side * 0.5 * (width - arm)
        piece.add(
            fabric, rounded_box((arm, depth, 0.496), 0.075, center=(x, -0.5 * depth, 0.372), segments=3)
        )
    count = 3 if width > 2.0 else 2
    pitch = (width - 2.0 * arm) / count
    for index in range(count):
        x = (index - 0.5 * (count - 1)) * pitch
        seat_size = (pitch + 0.005, depth - 0.22, 0.18)
        piece.add(
            fabric,
            cushion(
                seat_size, center=(x, -0.2 - 0.5 * seat_size[1], seat - 0.05), power=(7, 7, 2.6), segments=7
            ),
        )
        tilted = cushion((pitch + 0.003, 0.2, 0.44), power=(5.0, 2.0, 4.0), segments=6).turned(-0.16, axis=0)
        piece.add(fabric, tilted.shifted((x, -0.28, seat + 0.25)))
    for side in (-1.0, 1.0):
        for step in range(int(rng.integers(1, 3))):
            size = 0.42 - 0.05 * step
            surface = (look.accent, look.knit, look.linen)[int(rng.integers(3))]
            lean = pillow(size).turned(-0.3, axis=0).turned(side * (-0.25 + 0.4 * step), axis=2)
            x = side * (0.5 * width - arm - 0.22 - 0.3 * step)
            piece.add(surface, lean.shifted((x, -0.43 - 0.07 * step, seat + 0.25)))
    return piece


def armchair(rng: np.random.Generator, look: Look) -> Piece:
    """An upholstered chair with a raked back and wooden arms on tapered legs."""
    piece = Piece("armchair")
    width, depth, seat = 0.72, 0.78, 0.40
    for side in (-1.0, 1.0):
        x = side * (0.5 * width - 0.025)
        front, back = -depth + 0.07, -0.12
        piece.add(look.wood, tube([(x, front - 0.03, 0.003), (x, front, 0.58)], [0.014, 0.02], sides=12))
        piece.add(look.wood, tube([(x, back + 0.06, 0.003), (x, back, 0.55)], [0.014, 0.02], sides=12))
        rest = rounded_box((0.06, depth - 0.08, 0.03), 0.014, center=(x, -0.5 * depth, 0.585), grain=1)
        piece.add(look.wood, rest)
        rail = box((0.02, depth - 0.16, 0.05), center=(x, -0.5 * depth, 0.27), grain=1)
        piece.add(look.wood, rail)
    piece.add(look.wood, box((width - 0.05, 0.02, 0.05), center=(0.0, -depth + 0.07, 0.272)))
    cloth = look.accent
    wide = width - 0.11
    piece.add(cloth, rounded_box((wide, depth - 0.14, 0.1), 0.03, center=(0.0, -0.5 * depth - 0.03, 0.29)))
    pad = cushion((wide, depth - 0.16, 0.15), power=(8.0, 8.0, 2.8), segments=7).turned(-0.06, axis=0)
    piece.add(cloth, pad.shifted((0.0, -0.5 * depth - 0.04, seat + 0.01)))
    back_pad = cushion((wide, 0.15, 0.62), power=(8.0, 2.6, 6.0), segments=7).turned(-0.26, axis=0)
    piece.add(cloth, back_pad.shifted((0.0, -0.17, seat + 0.27)))
    if rng.uniform() < 0.6:
        piece.add(look.knit, pillow(0.38).turned(-0.32, axis=0).shifted((0.0, -0.31, seat + 0.27)))
    return piece


def chair(rng: np.random.Generator, look: Look, *, wood: Surface | None = None) -> Piece:
    """A dining chair with a padded seat and a slatted or solid back."""
    piece = Piece("chair")
    wood = wood or look.wood
    width, depth, seat = 0.44, 0.46, 0.45
    piece.add(
        wood,
        *(
            part.shifted((0.0, -0.03, 0.0))
            for part in legs(width - 0.04, depth - 0.05, seat - 0.03, radius=0.019, splay=0.04)
        ),
    )
    piece.add(
        wood, rounded_box((width, depth, 0.035), 0.015, center=(0.0, -0.5 * depth, seat - 0.02), segments=1)
    )
    piece.add(
        look.fabric,
        cushion(
            (width - 0.05, depth - 0.06, 0.05),
            center=(0.0, -0.5 * depth - 0.01, seat + 0.01),
            power=(6, 6, 2.2),
            segments=4,
        ),
    )
    top = 0.86
    for side in (-1.0, 1.0):
        x = side * (0.5 * width - 0.03)
        piece.add(
            wood,
            tube(
                [(x, -0.05, seat - 0.05), (x, -0.04, seat + 0.2), (x, -0.016, top)],
                [0.017, 0.015, 0.012],
                sides=10,
            ),
        )
    piece.add(
        wood, rounded_box((width - 0.02, 0.022, 0.11), 0.01, center=(0.0, -0.02, top - 0.04), segments=1)
    )
    if rng.uniform() < 0.6:
        for x in np.linspace(-0.1, 0.1, 4):
            piece.add(wood, tube([(x, -0.04, seat - 0.02), (x, -0.022, top - 0.07)], 0.008, sides=8))
    else:
        piece.add(wood, rounded_box((width - 0.07, 0.016, 0.06), 0.007, center=(0.0, -0.032, 0.64)))
    return piece


def stool(look: Look) -> Piece:
    """A round bar stool with a footrest ring."""
    piece = Piece("stool")
    height, radius = 0.66, 0.17
    piece.add(
        look.wood,
        lathe(
            [
                (0.0, height - 0.05),
                (radius - 0.01, height - 0.05),
                (radius, height - 0.035),
                (radius, height - 0.012),
                (radius - 0.012, height),
                (0.0, height),
            ],
            sides=32,
            center=(0.0, -0.2, 0.0),
        ),
    )
    for angle in np.arange(4) * 0.5 * np.pi + 0.25 * np.pi:
        reach = np.array([np.cos(angle), np.sin(angle), 0.0])
        foot, head = 0.18 * reach + (0.0, -0.2, 0.003), 0.11 * reach + (0.0, -0.2, height - 0.04)
        piece.add(look.metal, tube([foot, head], 0.011, sides=10))
    ring = np.linspace(0.0, 2.0 * np.pi, 33)
    path = np.stack([0.158 * np.cos(ring), 0.158 * np.sin(ring) - 0.2, np.full_like(ring, 0.22)], axis=1)
    piece.add(look.metal, tube(path, 0.008, sides=8))
    return piece


def office_chair(rng: np.random.Generator, look: Look) -> Piece:
    """A swivel chair on five castors."""
    piece = Piece("office_chair")
    center = np.array([0.0, -0.32, 0.0])
    turn = rng.uniform(0.0, 1.0)
    for index in range(5):
        angle = 2.0 * np.pi * index / 5.0 + turn
        reach = np.array([np.cos(angle), np.sin(angle), 0.0])
        piece.add(
            look.metal,
            tube(
                [np.array([0.0, -0.32, 0.11]), center + 0.27 * reach + (0, 0, 0.075)],
                [0.024, 0.014],
                sides=10,
            ),
        )
        axle = 0.018 * np.array([-reach[1], reach[0], 0.0])
        at = center + 0.27 * reach + (0.0, 0.0, 0.032)
        piece.add(look.leather, tube([at - axle, at + axle], 0.03, sides=16))
    piece.add(look.steel, cylinder(0.022, 0.09, 0.43, x=0.0, y=-0.32, sides=24))
    piece.add(
        look.leather, cushion((0.48, 0.47, 0.09), center=(0.0, -0.33, 0.47), power=(4, 4, 2.6), segments=6)
    )
    back = cushion((0.44, 0.07, 0.56), power=(4.0, 2.4, 4.0), segments=7).turned(-0.1, axis=0)
    piece.add(look.leather, back.shifted((0.0, -0.07, 0.82)))
    piece.add(
        look.metal,
        tube(
            [(0.0, -0.25, 0.42), (0.0, -0.06, 0.44), (0.0, -0.03, 0.55), (0.0, -0.03, 0.72)], 0.018, sides=10
        ),
    )
    for side in (-1.0, 1.0):
        x = side * 0.27
        piece.add(look.metal, tube([(0.8 * x, -0.3, 0.46), (x, -0.3, 0.48), (x, -0.3, 0.66)], 0.012, sides=8))
        piece.add(look.leather, rounded_box((0.06, 0.26, 0.03), 0.013, center=(x, -0.32, 0.67), segments=2))
    return piece


def bed(rng: np.random.Generator, look: Look, *, width: float = 1.6) -> Piece:
    """A bed with an upholstered or wooden headboard, mattress, duvet, blanket and pillows."""
    piece = Piece("bed")
    length = 2.1
    piece.add(
        look.wood,
        *(part.shifted((0.0, -0.1, 0.0)) for part in legs(width - 0.16, length - 0.2, 0.14, radius=0.035)),
    )
    piece.add(
        look.wood,
        rounded_box((width + 0.06, length, 0.16), 0.02, center=(0.0, -0.5 * length, 0.21), segments=2),
    )
    piece.add(
        look.linen,
        rounded_box(
            (width - 0.02, length - 0.12, 0.22), 0.06, center=(0.0, -0.5 * length - 0.02, 0.38), segments=3
        ),
    )
    if rng.uniform() < 0.6:
        count = 4
        for index in range(count):
            x = (index - 0.5 * (count - 1)) * (width + 0.1) / count
            part = cushion(
                ((width + 0.1) / count + 0.002, 0.1, 0.78),
                center=(x, -0.052, 0.66),
                power=(4.0, 2.6, 6.0),
                segments=7,
            )
            piece.add(look.accent, part)
    else:
        piece.add(
            look.wood, rounded_box((width + 0.1, 0.045, 0.9), 0.02, center=(0.0, -0.024, 0.55), segments=2)
        )
        for x in np.linspace(-0.36, 0.36, 4) * width:
            piece.add(look.dark_wood, rounded_box((0.02, 0.02, 0.5), 0.006, center=(x, -0.05, 0.76), grain=2))
    duvet = _draped(width + 0.1, 1.42, 0.13, rng)
    piece.add(look.linen if rng.uniform() < 0.5 else look.fabric, duvet.shifted((0.0, -0.72 - 0.71, 0.45)))
    throw = _draped(width + 0.14, 0.5, 0.15, rng)
    piece.add(look.knit, throw.shifted((0.0, -1.72, 0.452)))
    for side in (-1.0, 1.0):
        x = side * 0.25 * width
        big = cushion((0.44 * width, 0.44, 0.17), power=(3.6, 3.0, 1.8), segments=7).turned(0.45, axis=0)
        piece.add(look.linen, big.shifted((x, -0.32, 0.59)))
        small = cushion((0.36 * width, 0.36, 0.14), power=(3.4, 3.0, 1.7), segments=6).turned(0.6, axis=0)
        piece.add(look.accent, small.shifted((0.95 * x, -0.53, 0.58)))
    return piece


def _draped(width: float, length: float, thick: float, rng: np.random.Generator) -> Part:
    """A soft cover over a mattress, its middle at the origin, with shallow folds."""
    part = cushion((width, length, 2.0 * thick), power=(9.0, 9.0, 3.2), segments=11)
    x, y, z = part.vertices.T
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    fold = np.sin(9.0 * x + 3.0 * y + phase[0]) + 0.7 * np.sin(5.0 * x - 8.0 * y + phase[1])
    lifted = part.vertices.copy()
    lifted[:, 2] = np.where(z > 0.0, z + 0.006 * fold * np.clip(z / thick, 0.0, 1.0), z)
    slope_x = 0.006 * (
        9.0 * np.cos(9.0 * x + 3.0 * y + phase[0]) + 3.5 * np.cos(5.0 * x - 8.0 * y + phase[1])
    )
    slope_y = 0.006 * (
        3.0 * np.cos(9.0 * x + 3.0 * y + phase[0]) - 5.6 * np.cos(5.0 * x - 8.0 * y + phase[1])
    )
    bent = part.normals - np.stack([slope_x, slope_y, np.zeros_like(x)], axis=1) * np.clip(
        part.normals[:, 2:], 0.0, 1.0
    )
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    return Part(vertices=lifted, normals=bent, uv=part.uv, faces=part.faces)
