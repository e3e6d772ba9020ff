"""Procedural textures of building materials: seamless, with contrast at every scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy  # which imports its parts when they are used
from numpy.typing import NDArray

Field = NDArray[np.float32]
"""One value per texel, shape [H, W]."""
Picture = NDArray[np.float32]
"""sRGB in [0, 1], shape [H, W, 3]."""

SIZE_PX = 512


def rgb(color: str) -> NDArray[np.float32]:
    """Return an sRGB colour such as "#c8a27a" as three numbers in [0, 1]."""
    return np.array([int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)], np.float32)


def noise(
    rng: np.random.Generator, slope: float = 1.0, *, stretch: float = 1.0, coarsest: float = 1.0
) -> Field:
    """Return tileable noise of mean 0 and standard deviation 1 whose amplitude falls as frequency^-slope.

    A slope of 0 is white, 1 has equal contrast in each octave, 2 is cloudy. Its structures are `stretch`
    times longer along u than along v; below `coarsest` periods per tile the spectrum is flat.
    """
    spectrum = scipy.fft.rfft2(rng.standard_normal((SIZE_PX, SIZE_PX), dtype=np.float32))
    across = np.fft.fftfreq(SIZE_PX, 1.0 / SIZE_PX).astype(np.float32)[:, None]
    along = np.arange(SIZE_PX // 2 + 1, dtype=np.float32)[None, :] * np.float32(stretch)
    spectrum *= np.maximum(np.hypot(across, along), np.float32(coarsest)) ** np.float32(-slope)
    spectrum[0, 0] = 0.0
    field = scipy.fft.irfft2(spectrum, s=(SIZE_PX, SIZE_PX))
    return np.asarray(field / field.std(), np.float32)


def blend(low: str | Picture, high: str | Picture, share: NDArray[np.floating[Any]]) -> Picture:
    """Return the way from colour (or picture) `low` to `high` by a share that is clipped to [0, 1]."""
    first, last = (rgb(color) if isinstance(color, str) else color for color in (low, high))
    return np.asarray(first + (last - first) * np.clip(share, 0.0, 1.0)[..., None], np.float32)


def texel_grid(width: int = SIZE_PX, height: int = SIZE_PX) -> tuple[Field, Field]:
    """Return column and row of the centre of each texel in units of the width, each of shape [H, W]."""
    column, row = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return (column + np.float32(0.5)) / np.float32(width), (row + np.float32(0.5)) / np.float32(width)


def _texels(share: Field) -> NDArray[np.int64]:
    return np.floor(share * SIZE_PX).astype(np.int64) % SIZE_PX


def _edge(share: Field, count: float) -> Field:
    """Return the distance from the nearest of `count` equally spaced lines, in parts of the tile."""
    phase = share * np.float32(count) % 1.0
    return np.asarray(np.minimum(phase, 1.0 - phase) / count, np.float32)


def wood(rng: np.random.Generator, dark: str = "#000000", light: str = "#ffffff") -> Picture:
    """Return continuous grain along u: wavy year rings, fibres and pores."""
    _, v = texel_grid()
    warp = noise(rng, 2.2, stretch=5.0) * 0.018
    rings = np.sin(2.0 * np.pi * (9.0 * v + 26.0 * warp)).astype(np.float32)
    fibre = noise(rng, 0.9, stretch=26.0, coarsest=10.0)
    pores = np.clip(noise(rng, 0.35, stretch=18.0, coarsest=60.0) - 1.4, 0.0, 1.0)
    return blend(dark, light, 0.55 + 0.17 * rings + 0.17 * fibre - 0.5 * pores + 2.0 * warp)


def planks(rng: np.random.Generator, dark: str, light: str) -> Picture:
    """Return floor boards along u, each with a tone, a grain and an end of its own, and dark joints."""
    rows = 12
    u, v = texel_grid()
    row = np.floor(v * rows).astype(np.int64)
    along = (u + (rng.permutation(rows) / rows).astype(np.float32)[row]) * 2.0
    board = np.floor(along).astype(np.int64) % 2
    tone = rng.uniform(-1.0, 1.0, (rows, 2)).astype(np.float32)[row, board]
    shift = rng.integers(0, SIZE_PX, (rows, 2))[row, board]
    grain = wood(rng)[(_texels(v) + shift) % SIZE_PX, (_texels(u) + 3 * shift) % SIZE_PX, 0]
    to_end = np.minimum(along % 1.0, 1.0 - along % 1.0) / 2.0
    joint = np.clip(np.minimum(_edge(v, rows), to_end) * SIZE_PX / 1.4, 0.0, 1.0)
    picture = blend(dark, light, 0.12 + 0.66 * grain + 0.19 * tone)
    return np.asarray(picture * (0.3 + 0.7 * joint[..., None]), np.float32)


def chevron(rng: np.random.Generator, dark: str, light: str) -> Picture:
    """Return parquet of boards that meet at an angle, in columns along v."""
    columns, boards = 4, 16
    u, v = texel_grid()
    column, inside = np.floor(u * columns).astype(np.int64), u * columns % 1.0
    across = v + np.float32(0.275) * np.where(column % 2 == 0, inside, 1.0 - inside).astype(np.float32)
    board = np.floor(across * boards).astype(np.int64) % boards
    tone = rng.uniform(-1.0, 1.0, (columns, boards)).astype(np.float32)[column, board]
    shift = rng.uniform(size=(columns, boards)).astype(np.float32)[column, board]
    grain = wood(rng)[_texels(across + shift), _texels(inside * 0.33 + shift * 1.7), 0]
    joint = np.clip(np.minimum(_edge(across, boards), _edge(u, columns)) * SIZE_PX / 1.3, 0.0, 1.0)
    picture = blend(dark, light, 0.15 + 0.62 * grain + 0.2 * tone)
    return np.asarray(picture * (0.35 + 0.65 * joint[..., None]), np.float32)


def tiles(
    rng: np.random.Generator,
    colors: Sequence[str],
    grout: str,
    *,
    grid: tuple[int, int] = (4, 4),
    bond: bool = False,
    checker: bool = False,
) -> Picture:
    """Return glazed tiles with grout: mixed or alternating colours, in a grid or in running bond."""
    columns, rows = grid
    gap_px = 2.2
    u, v = texel_grid()
    row = np.floor(v * rows).astype(np.int64)
    shifted = u + (0.5 / columns * (row % 2)).astype(np.float32) * bond
    column = np.floor(shifted * columns).astype(np.int64) % columns
    mixed = (row + column) % len(colors)
    if not checker:
        mixed = rng.integers(0, len(colors), (rows, columns))[row, column]
    tone = rng.uniform(-1.0, 1.0, (rows, columns)).astype(np.float32)[row, column]
    glaze = 0.022 * noise(rng, 1.4, coarsest=3.0) + 0.016 * noise(rng, 0.5, coarsest=40.0) + 0.05 * tone
    edge = np.minimum(_edge(shifted, columns), _edge(v, rows)) * SIZE_PX
    rim = 1.0 - 0.10 * np.clip(1.0 - (edge - gap_px) / 4.0, 0.0, 1.0)
    picture = np.stack([rgb(color) for color in colors])[mixed] * ((1.0 + glaze) * rim)[..., None]
    sandy = rgb(grout) * (1.0 + 0.08 * noise(rng, 0.3))[..., None]
    return blend(sandy, picture, edge - gap_px + 0.5)


def terrazzo(rng: np.random.Generator, ground: str, chips: Sequence[str]) -> Picture:
    """Return ground stone chips of several sizes in cement."""
    picture = blend(rgb(ground) * 0.93, ground, 0.5 + 0.3 * noise(rng, 0.5))
    for index, chip in enumerate(chips):
        grain = noise(rng, 3.0, coarsest=26.0 - 5.0 * index)
        picture = blend(picture, rgb(chip) * (1.0 + 0.04 * grain[..., None]), (grain - 1.05) * 9.0)
    return picture


def marble(rng: np.random.Generator, ground: str, vein: str) -> Picture:
    """Return polished stone with branching veins and cloudy depth."""
    cloud = noise(rng, 1.9)
    veins = np.exp(-12.0 * np.abs(noise(rng, 1.75, stretch=0.6) + 0.25 * cloud))
    fine = np.exp(-16.0 * np.abs(noise(rng, 1.5, coarsest=3.0)))
    share = 0.12 + 0.1 * cloud + 0.62 * veins + 0.25 * fine + 0.05 * noise(rng, 0.2)
    return blend(ground, vein, share)


def wallpaper(rng: np.random.Generator, ground: str, motif: str, ink: Field) -> Picture:
    """Return paper that is printed with a share of ink."""
    ink = ink * (0.93 + 0.05 * noise(rng, 0.5))
    paper = 1.0 + 0.022 * noise(rng, 0.5) + 0.018 * noise(rng, 1.5)
    return np.asarray(blend(ground, motif, ink) * paper[..., None], np.float32)


def scales(_: np.random.Generator) -> Field:
    """Return overlapping arcs."""
    u, v = texel_grid()
    share = np.zeros_like(u)
    for row in range(-1, 17):  # later rows lie over earlier ones
        below = v * 16.0 - row - 1.0
        radius = np.hypot((u * 8.0 + 0.5 * (row % 2)) % 1.0 - 0.5, below / 2.0)
        arc = np.where(radius > 0.46, 1.0, 0.375 + 0.375 * np.cos(10.0 * np.pi * radius))
        share = np.where((radius < 0.5) & (below < 0.0), arc, share)
    return share


def lattice(_: np.random.Generator) -> Field:
    """Return diamonds."""
    u, v = texel_grid()
    a, b = np.abs((u + v) * 6.0 % 1.0 - 0.5), np.abs((u - v) * 6.0 % 1.0 - 0.5)
    share = np.where(np.minimum(a, b) < 0.05, 0.95, np.where(a + b < 0.62, 0.0, 0.45))
    return np.where(np.hypot(a - 0.5, b - 0.5) < 0.13, 0.95, share)


def leaves(rng: np.random.Generator) -> Field:
    """Return leaves in all directions with ribs and veins."""
    share = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    window = np.arange(-(SIZE_PX // 10), SIZE_PX // 10 + 1)
    dv, du = np.meshgrid(window / np.float32(SIZE_PX), window / np.float32(SIZE_PX), indexing="ij")
    places = (np.stack(np.meshgrid(np.arange(10), np.arange(10)), axis=-1).reshape(-1, 2) + 0.5) / 10.0
    for place in places + rng.uniform(-0.03, 0.03, places.shape):
        angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 0.095)
        s = (du * np.cos(angle) + dv * np.sin(angle)) / length
        t = (dv * np.cos(angle) - du * np.sin(angle)) / length
        vein = np.abs((s + 1.6 * np.abs(t)) * 4.0 % 1.0 - 0.5) * 0.4
        tone = rng.uniform(0.55, 1.0) - np.where(np.minimum(np.abs(t), vein) < 0.04, 0.25, 0.0)
        region = np.ix_(*((np.floor(at * SIZE_PX).astype(np.int64) + window) % SIZE_PX for at in place))
        blade = (np.abs(s) < 1.0) & (np.abs(t) < 0.36 * (1.0 - s * s))
        share[region] = np.where(blade, tone, share[region])
    return share


PAINTERS = (noise, wood, planks, chevron, tiles, terrazzo, marble, wallpaper, scales, lattice, leaves)
"""What an expression of a texture can use; each takes a source of randomness first."""
