"""Kitchens and bathrooms.

Every function returns a piece that stands on z = 0, centred on x = 0, with its back at y = 0 and its front
towards -y. Dimensions in metres.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.apartment.assembly import Piece, Surface
from neurosim_core.scene.apartment.geometry import (
    Part,
    box,
    cushion,
    cylinder,
    grid_surface,
    lathe,
    merge,
    quad,
    rounded_box,
    tube,
    without_slivers,
)
from neurosim_core.scene.apartment.looks import Look
from neurosim_core.scene.apartment.ornaments import bowl, vase

COUNTER_M = 0.91
"""Height of the kitchen's counter [m]."""


def kitchen_counter(rng: np.random.Generator, look: Look, splash: Surface, *, width: float) -> Piece:
    """A run of units: drawers, doors, oven and hob, sink and tap, tiles behind, cupboards and hood above."""
    piece = Piece("kitchen_counter")
    depth = 0.6
    units = max(3, round(width / 0.6))
    pitch = width / units
    hob, sink = (1, units - 1) if rng.uniform() < 0.5 else (units - 2, 0)
    piece.add(look.leather, box((width - 0.02, depth - 0.08, 0.1), center=(0.0, -0.5 * depth + 0.03, 0.05)))
    piece.add(
        look.white,
        box(
            (width - 0.008, depth - 0.03, COUNTER_M - 0.14),
            center=(0.0, -0.5 * depth + 0.01, 0.5 * (0.1 + COUNTER_M - 0.04)),
        ),
    )
    top = COUNTER_M
    piece.add(
        look.stone,
        rounded_box(
            (width, depth + 0.02, 0.04), 0.008, center=(0.0, -0.5 * depth - 0.01, top - 0.02), segments=2
        ),
    )
    tiled = quad((-0.5 * width, -0.008, top + 0.001), (width, 0.0, 0.0), (0.0, 0.0, 0.54))
    piece.add(splash, tiled)
    for index in range(units):
        x = (index - 0.5 * (units - 1)) * pitch
        if index == hob:
            _oven(piece, look, x, pitch, depth)
            _hob(piece, look, x, top)
        elif index % 3 == 1 or index == units // 2:
            for row, (low, high) in enumerate(((0.115, 0.40), (0.405, 0.66), (0.665, 0.855))):
                front = rounded_box(
                    (pitch - 0.006, 0.022, high - low), 0.004, center=(x, -depth + 0.004, 0.5 * (low + high))
                )
                piece.add(look.front, front)
                piece.add(look.steel, *_handle(x, -depth - 0.007, high - 0.05 - 0.01 * row, 0.16))
        else:
            piece.add(
                look.front,
                rounded_box((pitch - 0.006, 0.022, 0.74), 0.004, center=(x, -depth + 0.004, 0.485), grain=2),
            )
            piece.add(look.steel, *_handle(x, -depth - 0.007, 0.79, 0.16))
    _sink(piece, look, (sink - 0.5 * (units - 1)) * pitch, top)
    for index in range(units):
        x = (index - 0.5 * (units - 1)) * pitch
        if index == hob:
            _hood(piece, look, x)
            continue
        piece.add(look.white, box((pitch - 0.002, 0.31, 0.7), center=(x, -0.157, 1.81)))
        piece.add(
            look.front, rounded_box((pitch - 0.006, 0.022, 0.704), 0.004, center=(x, -0.32, 1.81), grain=2)
        )
        piece.add(look.steel, *_handle(x, -0.331, 1.5, 0.12))
    free = [k for k in range(units) if k not in (hob, sink)]
    spots = [(k - 0.5 * (units - 1)) * pitch for k in free]
    piece.include(bowl(look, scale=0.95), (spots[0], -0.33, top + 0.002))
    _jars(piece, rng, look, spots[-1], top)
    return piece


def _handle(x: float, y: float, z: float, width: float) -> list[Part]:
    half = 0.5 * width
    bar = tube([(x - half, y - 0.028, z), (x + half, y - 0.028, z)], 0.006, sides=10)
    posts = [
        tube([(x + s * 0.8 * half, y + 0.004, z), (x + s * 0.8 * half, y - 0.026, z)], 0.004, sides=8)
        for s in (-1.0, 1.0)
    ]
    return [bar, *posts]


def _oven(piece: Piece, look: Look, x: float, pitch: float, depth: float) -> None:
    piece.add(look.steel, rounded_box((pitch - 0.006, 0.024, 0.1), 0.004, center=(x, -depth + 0.004, 0.80)))
    for step in range(4):
        knob = lathe([(0.0, 0.0), (0.017, 0.0), (0.014, 0.022), (0.0, 0.024)], sides=24).turned(
            0.5 * np.pi, axis=0
        )
        piece.add(look.metal, knob.shifted((x - 0.15 + 0.1 * step, -depth - 0.007, 0.80)))
    piece.add(look.steel, rounded_box((pitch - 0.006, 0.022, 0.62), 0.004, center=(x, -depth + 0.004, 0.43)))
    piece.add(look.glass, rounded_box((pitch - 0.12, 0.012, 0.34), 0.005, center=(x, -depth - 0.006, 0.42)))
    piece.add(look.steel, *_handle(x, -depth - 0.007, 0.68, 0.42))


def _hob(piece: Piece, look: Look, x: float, top: float) -> None:
    piece.add(look.glass, rounded_box((0.54, 0.48, 0.012), 0.004, center=(x, -0.31, top + 0.005)))
    for dx, dy, radius in (
        (-0.13, -0.1, 0.095),
        (0.13, -0.1, 0.075),
        (-0.13, 0.12, 0.075),
        (0.13, 0.12, 0.095),
    ):
        ring = [(radius, 0.0), (radius, 0.003), (radius - 0.008, 0.003), (radius - 0.008, 0.0)]
        piece.add(look.steel, lathe(ring, sides=36, center=(x + dx, -0.31 + dy, top + 0.0105)))
    pot = [
        (0.0, 0.0),
        (0.088, 0.0),
        (0.092, 0.006),
        (0.092, 0.13),
        (0.094, 0.134),
        (0.09, 0.134),
        (0.0, 0.155),
    ]
    piece.add(look.steel, lathe(pot, sides=36, center=(x + 0.13, -0.19, top + 0.0145)))
    piece.add(
        look.leather,
        cushion((0.03, 0.03, 0.025), center=(x + 0.13, -0.19, top + 0.178), power=(2, 2, 2), segments=4),
    )
    for side in (-1.0, 1.0):
        loop = [(0.09, 0.02, 0.1), (0.125, 0.02, 0.1), (0.125, -0.02, 0.1), (0.09, -0.02, 0.1)]
        path = np.array(loop) * (side, 1.0, 1.0) + (x + 0.13, -0.19, top + 0.0145)
        piece.add(look.metal, tube(path, 0.006, sides=8))


def _hood(piece: Piece, look: Look, x: float) -> None:
    piece.add(look.steel, rounded_box((0.6, 0.46, 0.05), 0.006, center=(x, -0.235, 1.66)))
    slope = lathe([(0.38, 0.0), (0.17, 0.16)], sides=4).turned(0.25 * np.pi, axis=2)
    flat = replace(slope, vertices=slope.vertices * (1.05, 0.75, 1.0))
    piece.add(look.steel, _faceted(flat).shifted((x, -0.21, 1.68)))
    piece.add(look.steel, box((0.24, 0.2, 0.36), center=(x, -0.2, 2.0), grain=2))


def _faceted(part: Part) -> Part:
    """Each face with its own normal."""
    corners = part.vertices[part.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Part(
        vertices=corners.reshape(-1, 3),
        normals=np.repeat(normal, 3, axis=0),
        uv=part.uv[part.faces].reshape(-1, 2),
        faces=np.arange(3 * len(corners)).reshape(-1, 3),
    )


def _sink(piece: Piece, look: Look, x: float, top: float) -> None:
    """A shallow steel basin that stands on the counter, and a swan-neck tap."""
    piece.add(look.steel, _basin(0.46, 0.36, 0.035, 0.028).shifted((x, -0.33, top - 0.006)))
    turn = np.linspace(0.0, np.pi, 13)
    neck = np.stack(
        [np.zeros(13), -0.07 - 0.08 * (1.0 - np.cos(turn)), top + 0.24 + 0.08 * np.sin(turn)], axis=1
    )
    path = np.concatenate([[(0.0, -0.07, top - 0.01)], neck, [(0.0, -0.23, top + 0.2)]])
    path[:, 0] += x
    piece.add(look.steel, tube(path, 0.012, sides=14))
    piece.add(
        look.steel, tube([(x, -0.07, top + 0.06), (x + 0.07, -0.07, top + 0.08)], [0.009, 0.006], sides=10)
    )


def _basin(
    width: float,
    depth: float,
    height: float,
    hollow: float,
    *,
    rim: float = 0.02,
    power: float = 8.0,
    floor: float = 0.8,
) -> Part:
    """An open vessel with a superelliptic rim, standing on z = 0: outside, rim and inside.

    Args:
        width: Outer size along x [m].
        depth: Outer size along y [m].
        height: Height of the rim [m].
        hollow: Depth of the inside [m].
        rim: Thickness of the wall at the top [m].
        power: 2 is an ellipse, 8 nearly a rectangle.
        floor: Size of the bottom relative to the rim.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    unit /= (np.abs(unit) ** power).sum(axis=1, keepdims=True) ** (1.0 / power)
    unit[-1] = unit[0]
    half = 0.5 * np.array([width, depth])
    base = height - hollow
    sections = (
        [(floor, 0.0, 0.0), (0.5 * (1 + floor) + 0.04, 0.0, 0.4 * height), (1.0, 0.0, height - 0.004)],
        [
            (1.0, 0.0, height - 0.004),
            (1.0, 0.3 * rim, height),
            (1.0, 0.8 * rim, height),
            (1.0, rim, height - 0.006),
        ],
        [
            (1.0, rim, height - 0.006),
            (0.5 * (1 + floor) + 0.03, rim, base + 0.35 * hollow),
            (floor, rim, base + 0.05 * hollow),
            (0.55 * floor, rim, base),
        ],
    )
    parts = []
    for section in sections:
        points = np.empty((len(section), len(angle), 3))
        for row, (scale, inset, z) in enumerate(section):
            points[row, :, :2] = unit * (half - inset) * scale
            points[row, :, 2] = z
        uv = np.stack(
            [
                0.5 * width * angle[None] + np.zeros((len(section), 1)),
                np.cumsum(np.full((len(section), len(angle)), 0.1), axis=0),
            ],
            axis=-1,
        )
        parts.append(grid_surface(points, uv, closed_u=True))
    rim_of_floor = np.append(0.55 * floor * unit * (half - rim), np.full((len(angle), 1), base), axis=1)
    middle = np.broadcast_to((0.0, 0.0, base), rim_of_floor.shape)
    points = np.stack([rim_of_floor, middle])
    parts.append(
        grid_surface(points, points[..., :2], normals=np.broadcast_to((0.0, 0.0, 1.0), points.shape))
    )
    return without_slivers(merge(parts))


def _jars(piece: Piece, rng: np.random.Generator, look: Look, x: float, top: float) -> None:
    for index, surface in enumerate((look.pot, look.ceramic, look.wood)):
        radius, tall = rng.uniform(0.04, 0.055), rng.uniform(0.12, 0.2)
        outline = [
            (0.0, 0.0),
            (radius - 0.006, 0.0),
            (radius, 0.008),
            (radius, tall - 0.012),
            (radius - 0.01, tall),
            (0.014, tall + 0.004),
            (0.014, tall + 0.018),
            (0.0, tall + 0.02),
        ]
        piece.add(surface, lathe(outline, sides=30, center=(x - 0.14 + 0.14 * index, -0.14, top + 0.002)))


def refrigerator(look: Look) -> Piece:
    """A two-door fridge with long handles."""
    piece = Piece("refrigerator")
    width, depth, height = 0.62, 0.64, 1.86
    piece.add(
        look.steel,
        box(
            (width - 0.01, depth - 0.05, height - 0.06),
            center=(0.0, -0.5 * depth + 0.02, 0.5 * height + 0.02),
            grain=2,
        ),
    )
    piece.add(look.leather, box((width - 0.06, depth - 0.1, 0.06), center=(0.0, -0.5 * depth + 0.02, 0.03)))
    for low, high in ((0.06, 0.68), (0.69, height)):
        door = rounded_box(
            (width, 0.06, high - low),
            0.016,
            center=(0.0, -depth + 0.03, 0.5 * (low + high)),
            segments=2,
            grain=2,
        )
        piece.add(look.steel, door)
    for low, high in ((0.4, 0.64), (0.75, 1.2)):
        piece.add(
            look.metal, tube([(-0.25, -depth - 0.03, low), (-0.25, -depth - 0.03, high)], 0.009, sides=10)
        )
        for z in (low + 0.02, high - 0.02):
            piece.add(
                look.metal, tube([(-0.25, -depth + 0.002, z), (-0.25, -depth - 0.028, z)], 0.006, sides=8)
            )
    return piece


def washing_machine(look: Look) -> Piece:
    """A front loader with its porthole."""
    piece = Piece("washing_machine")
    size = (0.6, 0.58, 0.85)
    piece.add(look.ceramic, rounded_box(size, 0.014, center=(0.0, -0.29, 0.425), segments=2))
    ring = [(0.0, 0.0), (0.19, 0.0), (0.19, 0.02), (0.165, 0.034), (0.145, 0.02)]
    piece.add(look.steel, lathe(ring, sides=44).turned(0.5 * np.pi, axis=0).shifted((0.0, -0.577, 0.42)))
    glass = lathe([(0.147, 0.018), (0.1, 0.036), (0.0, 0.044)], sides=40).turned(0.5 * np.pi, axis=0)
    piece.add(look.glass, glass.shifted((0.0, -0.577, 0.42)))
    piece.add(look.steel, rounded_box((0.56, 0.01, 0.09), 0.004, center=(0.0, -0.582, 0.775)))
    piece.add(
        look.metal,
        lathe([(0.0, 0.0), (0.03, 0.0), (0.026, 0.022), (0.0, 0.024)], sides=28)
        .turned(0.5 * np.pi, axis=0)
        .shifted((0.12, -0.586, 0.775)),
    )
    piece.add(look.glass, box((0.14, 0.004, 0.04), center=(-0.14, -0.588, 0.775)))
    return piece


def bathtub(look: Look) -> Piece:
    """A free-standing tub with a tap, a towel over its rim."""
    piece = Piece("bathtub")
    piece.add(
        look.ceramic,
        _basin(1.66, 0.74, 0.57, 0.45, rim=0.045, power=3.2, floor=0.72).shifted((0.0, -0.37, 0.0)),
    )
    piece.add(
        look.steel,
        tube(
            [(0.6, -0.02, 0.0), (0.6, -0.02, 0.78), (0.6, -0.05, 0.84), (0.6, -0.14, 0.85), (0.6, -0.2, 0.8)],
            0.014,
            sides=14,
        ),
    )
    piece.add(look.steel, tube([(0.6, -0.02, 0.66), (0.66, -0.02, 0.7)], 0.008, sides=10))
    towel = [rounded_box((0.4, 0.016, 0.35), 0.007, center=(-0.25, -0.755, 0.42), segments=2)]
    towel.append(rounded_box((0.402, 0.09, 0.016), 0.007, center=(-0.25, -0.722, 0.592), segments=2))
    piece.add(look.knit, *towel)
    return piece


def toilet(look: Look) -> Piece:
    """A toilet with cistern and lid."""
    piece = Piece("toilet")
    piece.add(look.ceramic, rounded_box((0.38, 0.17, 0.36), 0.03, center=(0.0, -0.086, 0.62), segments=3))
    piece.add(
        look.ceramic, rounded_box((0.395, 0.185, 0.03), 0.012, center=(0.0, -0.0935, 0.812), segments=2)
    )
    piece.add(look.steel, cylinder(0.022, 0.825, 0.834, y=-0.09, sides=28, edge_m=0.003))
    foot = lathe(
        [
            (0.0, 0.0),
            (0.13, 0.0),
            (0.125, 0.05),
            (0.11, 0.2),
            (0.15, 0.32),
            (0.18, 0.38),
            (0.18, 0.4),
            (0.0, 0.4),
        ],
        sides=40,
    )
    stretched = replace(foot, vertices=foot.vertices * (1.0, 1.35, 1.0))
    stretched = replace(stretched, normals=_unit(foot.normals / (1.0, 1.35, 1.0)))
    piece.add(look.ceramic, stretched.shifted((0.0, -0.36, 0.0)))
    lid = cushion((0.375, 0.49, 0.05), center=(0.0, -0.372, 0.42), power=(2.4, 2.6, 5.0), segments=10)
    piece.add(look.white, lid)
    return piece


def _unit(
    vectors: NDArray[np.float64],
) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def washstand(rng: np.random.Generator, look: Look, *, width: float = 0.9) -> Piece:
    """A cabinet with a vessel basin, a tap and a soap bottle."""
    piece = Piece("washstand")
    depth, top = 0.46, 0.8
    piece.add(
        look.wood, rounded_box((width, depth, 0.5), 0.008, center=(0.0, -0.5 * depth, 0.53), segments=2)
    )
    piece.add(
        look.stone,
        rounded_box(
            (width + 0.02, depth + 0.02, 0.03),
            0.008,
            center=(0.0, -0.5 * depth - 0.005, top - 0.012),
            segments=2,
        ),
    )
    for side in (-1.0, 1.0):
        x = 0.25 * side * width
        piece.add(
            look.wood,
            rounded_box((0.5 * width - 0.02, 0.022, 0.45), 0.005, center=(x, -depth - 0.004, 0.53), grain=2),
        )
        piece.add(look.steel, *_handle(x, -depth - 0.015, 0.70, 0.16))
    piece.add(
        look.ceramic,
        _basin(0.5, 0.36, 0.13, 0.1, rim=0.016, power=2.6, floor=0.55).shifted((0.0, -0.25, top + 0.004)),
    )
    piece.add(
        look.steel,
        tube(
            [
                (0.0, -0.045, top - 0.01),
                (0.0, -0.045, top + 0.2),
                (0.0, -0.06, top + 0.235),
                (0.0, -0.15, top + 0.235),
                (0.0, -0.16, top + 0.215),
            ],
            0.011,
            sides=14,
        ),
    )
    bottle = [
        (0.0, 0.0),
        (0.028, 0.0),
        (0.03, 0.01),
        (0.03, 0.1),
        (0.012, 0.125),
        (0.01, 0.155),
        (0.0, 0.157),
    ]
    piece.add(look.pot, lathe(bottle, sides=28, center=(0.34 * width, -0.18, top + 0.004)))
    piece.include(vase(rng, look, scale=0.5), (-0.36 * width, -0.16, top + 0.004))
    return piece


def towel_rail(look: Look, *, middle: float = 1.25) -> Piece:
    """A ladder radiator on the wall with a folded towel."""
    piece = Piece("towel_rail")
    low, high = middle - 0.45, middle + 0.45
    for side in (-1.0, 1.0):
        piece.add(look.steel, tube([(side * 0.22, -0.06, low), (side * 0.22, -0.06, high)], 0.014, sides=12))
        for z in (low + 0.08, high - 0.08):
            piece.add(look.steel, tube([(side * 0.22, -0.002, z), (side * 0.22, -0.06, z)], 0.008, sides=8))
    for z in np.linspace(low + 0.04, high - 0.04, 14):
        piece.add(look.steel, tube([(-0.22, -0.064, z), (0.22, -0.064, z)], 0.009, sides=8))
    for y, tall, size in ((-0.088, 0.46, 0.36), (-0.042, 0.34, 0.358)):
        piece.add(
            look.accent,
            rounded_box((size, 0.014, tall), 0.006, center=(-0.02, y, high - 0.1 - 0.5 * tall), segments=2),
        )
    piece.add(
        look.accent,
        rounded_box((0.359, 0.062, 0.014), 0.006, center=(-0.02, -0.065, high - 0.096), segments=2),
    )
    return piece
