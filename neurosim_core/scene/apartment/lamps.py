"""Lamps: glowing geometry with a point light just outside of it, where nothing of the lamp shades it."""

from __future__ import annotations

import numpy as np

from neurosim_core.scene.apartment.assembly import Lamp, Piece
from neurosim_core.scene.apartment.geometry import cushion, cylinder, lathe, rounded_box, tube
from neurosim_core.scene.apartment.looks import Look

_WARM = np.array([1.0, 0.9, 0.76])
_GAIN = 1.5
"""Brings walls and floors of furnished rooms to a radiance of about 0.2 to 0.6."""
_LIGHT_BELOW_M = 0.16
"""Distance from a lamp to its light [m]: renderers may give lights a radius, which must stay free."""


def _lamp(x: float, y: float, z: float, strength: float) -> Lamp:
    r, g, b = (float(value) for value in strength * _GAIN * _WARM)
    return Lamp(position=(x, y, z), intensity=(r, g, b))


def pendant(rng: np.random.Generator, look: Look, *, ceiling: float, bottom: float, strength: float) -> Piece:
    """A hanging lamp on x = y = 0, from the ceiling down: a metal bell, a paper ball or a cloth drum."""
    piece = Piece("pendant")
    kind = int(rng.integers(3))
    if kind == 0:
        tall = 0.24
        outer = [(0.2, 0.0), (0.195, 0.05), (0.15, 0.13), (0.08, 0.19), (0.035, tall), (0.0, tall)]
        inner = [(0.0, 0.225), (0.03, 0.225), (0.074, 0.18), (0.142, 0.125), (0.187, 0.05), (0.2, 0.0)]
        piece.add(look.metal, lathe(outer, sides=32, crease_rad=0.9, center=(0, 0, bottom)))
        piece.add(look.glow, lathe(inner, sides=32, crease_rad=0.9, center=(0, 0, bottom)))
        piece.add(
            look.bulb,
            cushion((0.09, 0.09, 0.11), center=(0.0, 0.0, bottom + 0.1), power=(2, 2, 2), segments=4),
        )
    elif kind == 1:
        tall = 0.36
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17)
        ribs = 0.2 + 0.004 * np.cos(16.0 * angle)
        ball = np.stack([ribs * np.cos(angle), 0.18 + 0.9 * ribs * np.sin(angle)], axis=1)
        ball[0, 0] = ball[-1, 0] = 0.0
        piece.add(look.glow, lathe(ball, sides=32, crease_rad=1.2, center=(0, 0, bottom)))
    else:
        tall = 0.22
        drum = [(0.18, 0.0), (0.18, tall), (0.174, tall), (0.174, 0.0), (0.18, 0.0)]
        piece.add(look.glow, lathe(drum, sides=36, center=(0, 0, bottom)))
        piece.add(
            look.bulb,
            cushion((0.09, 0.09, 0.11), center=(0.0, 0.0, bottom + 0.11), power=(2, 2, 2), segments=4),
        )
        for turn in (0.0, np.pi / 2.0):
            spoke = tube([(-0.176, 0.0, tall - 0.01), (0.176, 0.0, tall - 0.01)], 0.003, sides=6).turned(
                turn, axis=2
            )
            piece.add(look.metal, spoke.shifted((0, 0, bottom + 0.004 * turn)))
    piece.add(look.metal, cylinder(0.004, bottom + tall - 0.02, ceiling - 0.01, sides=8))
    piece.add(look.metal, cylinder(0.05, ceiling - 0.03, ceiling - 0.001, sides=32, edge_m=0.006))
    piece.lamps.append(_lamp(0.0, 0.0, bottom - _LIGHT_BELOW_M, strength))
    return piece


def ceiling_lamp(look: Look, *, ceiling: float, strength: float) -> Piece:
    """A flat disc lamp at the ceiling."""
    piece = Piece("ceiling_lamp")
    piece.add(look.steel, cylinder(0.19, ceiling - 0.05, ceiling - 0.001, sides=40, edge_m=0.008))
    dome = [(0.0, -0.095), (0.08, -0.09), (0.14, -0.075), (0.172, -0.045)]
    piece.add(look.bulb, lathe(dome, sides=40, center=(0, 0, ceiling)))
    piece.lamps.append(_lamp(0.0, 0.0, ceiling - 0.1 - _LIGHT_BELOW_M, strength))
    return piece


def floor_lamp(rng: np.random.Generator, look: Look, *, strength: float) -> Piece:
    """A standing lamp with a cloth shade: on one pole, or on three legs. Its middle is x = 0, y = -0.22."""
    piece = Piece("floor_lamp")
    height, radius = 1.55, 0.21
    center = (0.0, -0.22, 0.0)
    if rng.uniform() < 0.5:
        foot = [
            (0.0, 0.0),
            (0.15, 0.0),
            (0.15, 0.012),
            (0.02, 0.03),
            (0.011, 0.04),
            (0.011, height - 0.1),
            (0.0, height - 0.1),
        ]
        piece.add(look.metal, lathe(foot, sides=36, center=center))
    else:
        for angle in np.arange(3) * 2.0 * np.pi / 3.0 + rng.uniform(0.0, 2.0):
            reach = np.array([np.cos(angle), np.sin(angle), 0.0])
            head = 0.03 * reach + center + (0.0, 0.0, height - 0.24)
            piece.add(
                look.wood, tube([0.19 * reach + center + (0.0, 0.0, 0.003), head], [0.013, 0.016], sides=14)
            )
        piece.add(
            look.wood, cylinder(0.05, height - 0.27, height - 0.23, x=0.0, y=-0.22, sides=28, edge_m=0.008)
        )
    shade = [
        (radius, height - 0.28),
        (0.8 * radius, height),
        (0.8 * radius - 0.005, height),
        (radius - 0.005, height - 0.28),
        (radius, height - 0.28),
    ]
    piece.add(look.glow, lathe(shade, sides=36, center=center))
    piece.add(
        look.bulb, cushion((0.07, 0.07, 0.1), center=(0.0, -0.22, height - 0.14), power=(2, 2, 2), segments=4)
    )
    piece.lamps.append(_lamp(0.0, -0.22, height + _LIGHT_BELOW_M, strength))
    return piece


def table_lamp(look: Look) -> Piece:
    """A small lamp with a turned foot and a cloth shade; it glows, the room's lights do the lighting."""
    piece = Piece("table_lamp")
    foot = [
        (0.0, 0.0),
        (0.07, 0.0),
        (0.075, 0.015),
        (0.06, 0.06),
        (0.075, 0.11),
        (0.05, 0.17),
        (0.012, 0.2),
        (0.012, 0.27),
        (0.0, 0.27),
    ]
    piece.add(look.pot, lathe(foot, sides=36, crease_rad=1.0))
    shade = [(0.13, 0.24), (0.09, 0.42), (0.086, 0.42), (0.126, 0.24), (0.13, 0.24)]
    piece.add(look.glow, lathe(shade, sides=40))
    return piece


def desk_lamp(look: Look) -> Piece:
    """An articulated work lamp."""
    piece = Piece("desk_lamp")
    piece.add(look.metal, cylinder(0.085, 0.0, 0.018, sides=36, edge_m=0.005))
    piece.add(look.metal, tube([(0, 0, 0.01), (0.0, 0.06, 0.24)], 0.008, sides=10))
    piece.add(look.metal, tube([(0, 0.06, 0.24), (0.0, -0.14, 0.44)], 0.008, sides=10))
    piece.add(look.metal, cushion((0.03, 0.03, 0.03), center=(0.0, 0.06, 0.24), power=(2, 2, 2), segments=4))
    bell = [
        (0.0, 0.0),
        (0.03, 0.0),
        (0.034, -0.04),
        (0.075, -0.11),
        (0.071, -0.11),
        (0.028, -0.035),
        (0.0, -0.03),
    ]
    piece.add(look.metal, lathe(bell[::-1], sides=32, crease_rad=0.9).shifted((0.0, -0.16, 0.47)))
    return piece


def spot_bar(look: Look, *, width: float = 0.6, ceiling: float, strength: float) -> Piece:
    """A bar with three spots below the ceiling."""
    piece = Piece("spots")
    piece.add(look.white, rounded_box((width, 0.06, 0.03), 0.01, center=(0.0, 0.0, ceiling - 0.016)))
    for x in np.linspace(-0.4, 0.4, 3) * width:
        piece.add(look.steel, tube([(x, 0.0, ceiling - 0.02), (x, 0.0, ceiling - 0.09)], 0.008, sides=8))
        piece.add(
            look.white, cylinder(0.032, ceiling - 0.17, ceiling - 0.07, x=float(x), sides=28, edge_m=0.004)
        )
        piece.add(
            look.bulb,
            lathe([(0.0, ceiling - 0.172), (0.026, ceiling - 0.172)], sides=24, center=(float(x), 0.0, 0.0)),
        )
    piece.lamps.append(_lamp(0.0, 0.0, ceiling - 0.17 - _LIGHT_BELOW_M, strength))
    return piece
