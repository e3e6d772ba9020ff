"""Books, vases, bowls, plants, pictures, curtains, rugs and radiators.

Pieces that stand are centred on x = y = 0, with z = 0 below; those that hang on a wall have their back at
y = 0 and their height as they hang. Dimensions in metres.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.apartment.assembly import Piece, Surface
from neurosim_core.scene.apartment.geometry import (
    Part,
    box,
    cushion,
    grid_surface,
    lathe,
    picture_quad,
    rounded_box,
    tube,
)
from neurosim_core.scene.apartment.looks import Look
from neurosim_core.scene.apartment.pictures import SPINE_COLUMNS, SPINE_ROWS


def book(rng: np.random.Generator, size: tuple[float, float, float]) -> Part:
    """A standing book (thickness, depth, height): its spine faces -y at y = 0; uv chooses its colours."""
    _, deep, tall = size
    part = box(size, center=(0.0, 0.5 * deep, 0.5 * tall))
    cell = int(rng.integers(SPINE_COLUMNS * SPINE_ROWS - 1))
    low = np.array([cell % SPINE_COLUMNS, SPINE_ROWS - 1 - cell // SPINE_COLUMNS])
    paper = np.array([SPINE_COLUMNS - 1, 0])
    corners = np.array([[0.06, 0.02], [0.94, 0.02], [0.06, 0.98], [0.94, 0.98]])
    cover = np.array([[0.4, 0.02], [0.6, 0.02], [0.4, 0.98], [0.6, 0.98]])
    faces = (low + cover, low + cover, low + corners, low + corners, paper + corners, paper + corners)
    return replace(part, uv=np.concatenate(faces) / np.array([SPINE_COLUMNS, SPINE_ROWS]))


def books(rng: np.random.Generator, look: Look, *, count: int) -> Piece:
    """A pile of lying books, the largest below."""
    piece = Piece("books")
    z = 0.0
    for index in range(count):
        thick = rng.uniform(0.018, 0.04)
        tall = 0.27 - 0.022 * index - rng.uniform(0.0, 0.01)
        lying = (
            book(rng, (thick, 0.72 * tall, tall))
            .shifted((0.0, -0.36 * tall, -0.5 * tall))
            .turned(0.5 * np.pi, axis=1)
        )
        piece.add(
            look.spines, lying.turned(rng.uniform(-0.25, 0.25), axis=2).shifted((0.0, 0.0, z + 0.5 * thick))
        )
        z += thick + 0.0008
    return piece


def vase(rng: np.random.Generator, look: Look, *, scale: float = 1.0, twigs: bool = True) -> Piece:
    """A turned vase, often with dry twigs."""
    piece = Piece("vase")
    belly, neck, tall = rng.uniform(0.06, 0.1), rng.uniform(0.022, 0.04), rng.uniform(0.22, 0.32)
    height = np.linspace(0.0, 1.0, 11)
    swell = neck + (belly - neck) * np.sin(np.pi * height ** rng.uniform(0.55, 0.9)) ** 1.3
    swell[0] = max(swell[0], 0.6 * belly)
    outline = [
        (0.0, 0.0),
        *zip(swell, height * tall, strict=True),
        (swell[-1] - 0.006, tall),
        (swell[-1] - 0.008, tall - 0.05),
    ]
    surface = (look.pot, look.ceramic, look.stone)[int(rng.integers(3))]
    piece.add(surface, lathe(np.array(outline) * scale, sides=24))
    if twigs and rng.uniform() < 0.6:
        for _ in range(6):
            lean = rng.uniform(-0.5, 0.5, 2)
            top = np.array([*(0.22 * lean), tall + rng.uniform(0.12, 0.26)])
            root = np.array([0.0, 0.0, tall - 0.1])
            middle = 0.5 * (root + top) + 0.02 * rng.standard_normal(3)
            piece.add(
                look.wood,
                tube(
                    np.stack([root, middle, top]) * scale,
                    [0.003 * scale, 0.0024 * scale, 0.0015 * scale],
                    sides=6,
                ),
            )
            for share in (0.5, 0.75, 0.98):
                # Buds sit on the twig, each turned its own way, so that no facets of two lie in one plane.
                at = root + share * (top - root) + 0.006 * rng.standard_normal(3)
                bud = cushion((0.02, 0.023, 0.032), power=(2, 2, 2), segments=2)
                bud = bud.turned(rng.uniform(0.2, 0.6), axis=0).turned(rng.uniform(0.0, 6.0), axis=2)
                piece.add(look.linen, replace(bud, vertices=scale * (bud.vertices + at)))
    return piece


def bowl(look: Look, *, scale: float = 1.0) -> Piece:
    """A shallow bowl with fruit."""
    piece = Piece("bowl")
    outline = [
        (0.0, 0.0),
        (0.05, 0.0),
        (0.055, 0.008),
        (0.1, 0.035),
        (0.13, 0.075),
        (0.126, 0.077),
        (0.095, 0.043),
        (0.05, 0.018),
        (0.0, 0.016),
    ]
    piece.add(look.pot, lathe(np.array(outline) * scale, sides=26, crease_rad=0.8))
    for index, (surface, angle) in enumerate(
        zip((look.accent, look.fabric, look.leaf), (0.3, 2.4, 4.5), strict=True)
    ):
        at = np.array([0.045 * np.cos(angle), 0.045 * np.sin(angle), 0.062 + 0.002 * index]) * scale
        piece.add(
            replace(surface, texture=None, exact=False),
            cushion((0.078 * scale, 0.078 * scale, 0.072 * scale), center=at, power=(2, 2, 2), segments=6),
        )
    return piece


def plant(rng: np.random.Generator, look: Look, *, height: float = 1.2) -> Piece:
    """A plant in a pot: a rosette of arching leaves, or a stem with broad ones."""
    piece = Piece("plant")
    size = min(0.17, 0.14 * height + 0.03)
    tall = 1.7 * size
    outline = [
        (0.0, 0.0),
        (0.72 * size, 0.0),
        (0.76 * size, 0.01),
        (0.98 * size, tall - 0.02),
        (size, tall),
        (0.92 * size, tall),
        (0.9 * size, tall - 0.04),
    ]
    piece.add(look.pot, lathe(outline, sides=36))
    piece.add(
        look.soil,
        lathe([(0.0, tall - 0.035), (0.92 * size, tall - 0.035)], sides=24)
        .turned(np.pi, axis=0)
        .shifted((0, 0, 2 * tall - 0.07)),
    )
    if rng.uniform() < 0.5:
        count = 26
        for index in range(count):
            turn = 2.4 * index + rng.uniform(-0.2, 0.2)
            reach = (0.25 + 0.75 * (index / count)) * min(0.42, 0.4 * height)
            rise = (height - tall) * (1.0 - 0.55 * index / count) * rng.uniform(0.85, 1.0)
            share = np.linspace(0.0, 1.0, 7)
            along = np.stack([0.03 + reach * share**1.4, rise * (1.55 * share - 0.55 * share**3.0)], axis=1)
            blade = _blade(along, 0.028 + 0.02 * height * np.sin(np.pi * np.clip(share, 0.06, 0.97)) ** 0.8)
            piece.add(look.leaf, blade.turned(turn, axis=2).shifted((0.0, 0.0, tall - 0.045)))
    else:
        stems = int(rng.integers(3, 5))
        for stem in range(stems):
            lean = 2.0 * np.pi * (stem + rng.uniform(0.0, 0.5)) / stems
            top = (height - tall) * rng.uniform(0.7, 0.95)
            share = np.linspace(0.0, 1.0, 6)
            offset = 0.05 + 0.12 * height * share**1.5
            path = np.stack([offset * np.cos(lean), offset * np.sin(lean), tall - 0.06 + top * share], axis=1)
            piece.add(look.soil, tube(path, np.linspace(0.012, 0.005, 6), sides=8))
            for index in range(8):
                at = 0.3 + 0.7 * index / 7.0
                spot = np.array([np.interp(at, share, path[:, axis]) for axis in range(3)])
                length = (0.12 + 0.1 * height) * rng.uniform(0.7, 1.0)
                run = np.linspace(0.0, 1.0, 6)
                along = np.stack([length * run, 0.3 * length * np.sin(2.6 * run)], axis=1)
                wide = 0.004 + 0.26 * length * np.sin(np.pi * np.clip(run, 0.03, 0.98)) ** 0.7
                piece.add(look.leaf, _blade(along, wide).turned(lean + 2.4 * index, axis=2).shifted(spot))
    return piece


def _blade(
    along: NDArray[np.float64],
    half_width: NDArray[np.float64],
) -> Part:
    """A leaf along x, rising in z, folded along its rib; uv runs over the leaf once."""
    count = len(along)
    points = np.zeros((3, count, 3))
    for row, side in enumerate((-1.0, 0.0, 1.0)):
        points[row, :, 0], points[row, :, 2] = along.T
        points[row, :, 1] = side * half_width
        points[row, :, 2] += 0.25 * abs(side) * half_width
    share = np.linspace(0.02, 0.98, count)
    uv = np.stack(np.broadcast_arrays(share[None], np.array([0.02, 0.5, 0.98])[:, None]), axis=-1)
    return grid_surface(points, uv)


def picture(look: Look, poster: Surface, *, width: float, height: float, middle: float = 1.55) -> Piece:
    """A framed print on the wall: the frame's bars are bevelled towards the print."""
    piece = Piece("picture")
    for turn, long, across in (
        (0.0, width, height),
        (0.5, height, width),
        (1.0, width, height),
        (1.5, height, width),
    ):
        half = 0.5 * long
        out, lip = 0.028, 0.012
        # Corners of the lower bar from outside in: wall, front, front, print; mitred at both ends.
        rows = [(0.025, -0.001), (0.025, -out), (0.012, -out), (0.0, -lip)]
        for (wide0, y0), (wide1, y1) in itertools.pairwise(rows):
            z0, z1 = (-0.5 * across - wide for wide in (wide0, wide1))
            points = np.array(
                [
                    [(-half - wide0, y0, z0), (half + wide0, y0, z0)],
                    [(-half - wide1, y1, z1), (half + wide1, y1, z1)],
                ]
            )
            bar = grid_surface(
                points, points[..., [0, 1]] + points[..., [0, 2]], normals=_flat_normals(points)
            )
            piece.add(look.dark_wood, bar.turned(-turn * np.pi, axis=1).shifted((0.0, 0.0, middle)))
    corner = (-0.5 * width, -0.012, middle - 0.5 * height)
    piece.add(poster, picture_quad(corner, (width, 0.0, 0.0), (0.0, 0.0, height)))
    return piece


def _flat_normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The normal of a planar four-cornered patch, for each of its corners, shape [2, 2, 3]."""
    normal = np.cross(points[0, 1] - points[0, 0], points[1, 0] - points[0, 0])
    return np.broadcast_to(normal / np.linalg.norm(normal), (2, 2, 3))


def mirror(look: Look, *, width: float = 0.6, height: float = 0.8, middle: float = 1.55) -> Piece:
    """A mirror; it looks like pale glass, reflections are not rendered."""
    glass = Surface(
        name="mirror",
        color=(0.62, 0.7, 0.72),
        texture="plaster",
        tile_m=(3.0, 3.0),
        emission=(0.03, 0.04, 0.05),
    )
    piece = picture(look, glass, width=width, height=height, middle=middle)
    return replace(piece, kind="mirror")


def clock(look: Look, *, middle: float = 1.9) -> Piece:
    """A round wall clock."""
    piece = Piece("clock")
    rim = [(0.0, 0.002), (0.16, 0.002), (0.165, 0.01), (0.165, 0.036), (0.152, 0.04), (0.15, 0.024)]
    flat = lathe(rim, sides=48).turned(0.5 * np.pi, axis=0)
    face = (
        lathe([(0.0, 0.02), (0.153, 0.02)], sides=36)
        .turned(np.pi, axis=0)
        .shifted((0, 0, 0.04))
        .turned(0.5 * np.pi, axis=0)
    )
    piece.add(look.dark_wood, flat.shifted((0.0, 0.0, middle)))
    piece.add(look.white, face.shifted((0.0, 0.0, middle)))
    for hour in range(12):
        angle = np.pi * hour / 6.0
        mark = box((0.007, 0.004, 0.022), center=(0.0, -0.023, 0.125)).turned(angle, axis=1)
        piece.add(look.leather, mark.shifted((0.0, 0.0, middle)))
    for angle, length, y in ((0.9, 0.08, -0.027), (-0.7, 0.115, -0.031)):
        hand = box((0.008, 0.002, length), center=(0.0, y, 0.45 * length)).turned(angle, axis=1)
        piece.add(look.leather, hand.shifted((0.0, 0.0, middle)))
    return piece


def curtain(rng: np.random.Generator, fabric: Surface, *, width: float, bottom: float, top: float) -> Piece:
    """One gathered curtain panel, hanging 10 cm off the wall."""
    piece = Piece("curtain")
    folds = max(3, round(width / 0.075))
    across = np.linspace(0.0, 1.0, 8 * folds + 1)
    rows = np.array([0.0, 0.35, 0.7, 1.0])
    phase = rng.uniform(0.0, 2.0 * np.pi)
    points = np.empty((4, len(across), 3))
    for row, share in enumerate(rows):
        flare = 1.0 - 0.12 * np.sin(np.pi * share)
        points[row, :, 0] = (across - 0.5) * width * flare
        points[row, :, 1] = -0.1 + (0.034 - 0.014 * share) * np.sin(
            2.0 * np.pi * folds * across + phase + 0.5 * share
        )
        points[row, :, 2] = bottom + share * (top - bottom)
    uv = np.stack(np.broadcast_arrays(1.8 * width * across[None], points[:, :, 2]), axis=-1)
    piece.add(fabric, grid_surface(points, uv))
    return piece


def curtain_rail(look: Look, *, width: float, height: float) -> Piece:
    """A rod with turned ends."""
    piece = Piece("curtain_rail")
    half = 0.5 * width
    piece.add(look.metal, tube([(-half, -0.1, height), (half, -0.1, height)], 0.011, sides=14))
    for side in (-1.0, 1.0):
        piece.add(
            look.metal,
            cushion((0.05, 0.05, 0.05), center=(side * half, -0.1, height), power=(2, 2, 2), segments=3),
        )
        piece.add(
            look.metal,
            tube(
                [(side * (half - 0.08), -0.002, height), (side * (half - 0.08), -0.1, height)],
                0.007,
                sides=10,
            ),
        )
    return piece


def rug(surface: Surface, *, width: float, depth: float) -> Piece:
    """A rug with rounded edges; its middle is x = 0, y = -depth / 2."""
    piece = Piece("rug")
    body = rounded_box((width, depth, 0.012), 0.005, center=(0.5 * width, 0.5 * depth, 0.006))
    piece.add(surface, replace(body, uv=body.vertices[:, :2].copy()).shifted((-0.5 * width, -depth, 0.0)))
    return piece


def radiator(look: Look, *, width: float = 1.0, height: float = 0.55) -> Piece:
    """A column radiator that hangs below a window."""
    piece = Piece("radiator")
    count = round(width / 0.06)
    for index in range(count):
        x = (index - 0.5 * (count - 1)) * 0.06
        for y in (-0.055, -0.1):
            piece.add(look.ceramic, tube([(x, y, 0.1), (x, y, 0.1 + height)], 0.02, sides=8))
    for z in (0.16, height + 0.03):
        bar = tube([(-0.5 * width - 0.01, -0.0775, z), (0.5 * width + 0.01, -0.0775, z)], 0.013, sides=10)
        piece.add(look.ceramic, bar)
    return piece
