"""Procedural textures of building materials and cloth: seamless, with contrast at every scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Field = NDArray[np.float32]
"""One value per texel, shape [H, W]."""
Picture = NDArray[np.float32]
"""sRGB in [0, 1], shape [H, W, 3]."""

SIZE_PX = 512


def rgb(color: str) -> NDArray[np.float32]:
    """An sRGB colour such as "#c8a27a" as three numbers in [0, 1]."""
    return np.array([int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)], np.float32)


def noise(
    rng: np.random.Generator,
    *,
    slope: float = 1.0,
    stretch: float = 1.0,
    coarsest: float = 1.0,
    size: int = SIZE_PX,
) -> Field:
    """Tileable noise of mean 0 and standard deviation 1 whose amplitude falls as frequency^-slope.

    Args:
        rng: Source of randomness.
        slope: 0 is white, 1 has equal contrast in each octave, 2 is cloudy.
        stretch: How many times longer its structures are along u than along v.
        coarsest: Below this many periods per tile the spectrum is flat.
        size: Edge of the square [px].
    """
    spectrum = scipy.fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    across = np.fft.fftfreq(size, 1.0 / size).astype(np.float32)[:, None]
    along = np.arange(size // 2 + 1, dtype=np.float32)[None, :] * np.float32(stretch)
    spectrum *= np.maximum(np.hypot(across, along), np.float32(coarsest)) ** np.float32(-slope)
    spectrum[0, 0] = 0.0
    field = scipy.fft.irfft2(spectrum, s=(size, size))
    return np.asarray(field / field.std(), np.float32)


def blend(low: NDArray[np.float32], high: NDArray[np.float32], share: NDArray[np.floating[Any]]) -> Picture:
    """From colour (or picture) `low` to `high` by a share that is clipped to [0, 1]."""
    weight = np.clip(share, 0.0, 1.0)[..., None]
    return np.asarray(low + (high - low) * weight, np.float32)


def quantize(picture: Picture) -> NDArray[np.uint8]:
    """8-bit sRGB."""
    return np.asarray(np.clip(picture * 255.0 + 0.5, 0.0, 255.0), np.uint8)


def grid_px(size: int = SIZE_PX) -> tuple[Field, Field]:
    """Column u and row v of each texel's centre, in [0, 1), both of shape [size, size]."""
    line = (np.arange(size, dtype=np.float32) + np.float32(0.5)) / np.float32(size)
    column, row = np.meshgrid(line, line)
    return column, row


def _texels(share: Field) -> NDArray[np.int64]:
    """Indices of the texels at positions in periods of the tile."""
    return np.floor(share * SIZE_PX).astype(np.int64) % SIZE_PX


def _edge(share: Field, count: float) -> Field:
    """Distance from the nearest of `count` equally spaced lines, in parts of the tile."""
    phase = share * np.float32(count) % 1.0
    return np.asarray(np.minimum(phase, 1.0 - phase) / count, np.float32)


def plaster(rng: np.random.Generator) -> Picture:
    """Rolled wall paint: nearly white, with the roller's grain, faint clouds and a few rubbed spots."""
    grain = 0.6 * noise(rng, slope=0.8, coarsest=20.0) + 0.5 * noise(rng, slope=1.7)
    return blend(rgb("#c4c3c0"), rgb("#ffffff"), 0.68 + 0.15 * grain)


def wood(rng: np.random.Generator, dark: str, light: str) -> Picture:
    """Continuous grain along u: wavy year rings, fibres and pores."""
    _, v = grid_px()
    warp = noise(rng, slope=2.2, stretch=5.0) * 0.018
    rings = np.sin(2.0 * np.pi * (9.0 * v + 26.0 * warp)).astype(np.float32)
    fibre = noise(rng, slope=0.9, stretch=26.0, coarsest=10.0)
    pores = np.clip(noise(rng, slope=0.35, stretch=18.0, coarsest=60.0) - 1.4, 0.0, 1.0)
    return blend(rgb(dark), rgb(light), 0.55 + 0.17 * rings + 0.17 * fibre - 0.5 * pores + 2.0 * warp)


def planks(rng: np.random.Generator, dark: str, light: str, *, rows: int = 12) -> Picture:
    """Floor boards along u: each with a tone, a grain and an end of its own, dark joints between them."""
    u, v = grid_px()
    row = np.floor(v * rows).astype(np.int64)
    along = (u + (rng.permutation(rows) / rows).astype(np.float32)[row]) * 2.0
    board = np.floor(along).astype(np.int64) % 2
    tone = rng.uniform(-1.0, 1.0, (rows, 2)).astype(np.float32)[row, board]
    shift = rng.integers(0, SIZE_PX, (rows, 2))[row, board]
    grain = wood(rng, "#000000", "#ffffff")[..., 0]
    grain = grain[(_texels(v) + shift) % SIZE_PX, (_texels(u) + 3 * shift) % SIZE_PX]
    picture = blend(rgb(dark), rgb(light), 0.12 + 0.66 * grain + 0.19 * tone)
    to_end = np.minimum(along % 1.0, 1.0 - along % 1.0) / 2.0
    joint = np.clip(np.minimum(_edge(v, rows), to_end) * SIZE_PX / 1.4, 0.0, 1.0)
    return np.asarray(picture * (0.3 + 0.7 * joint[..., None]), np.float32)


def chevron(rng: np.random.Generator, dark: str, light: str) -> Picture:
    """Parquet of boards that meet at an angle, in columns along v."""
    u, v = grid_px()
    columns, boards = 4, 16
    column = np.floor(u * columns).astype(np.int64)
    inside = u * columns % 1.0
    slant = np.where(column % 2 == 0, inside, 1.0 - inside).astype(np.float32)
    across = v + np.float32(0.25 * 1.1) * slant
    board = np.floor(across * boards).astype(np.int64) % boards
    tone = rng.uniform(-1.0, 1.0, (columns, boards)).astype(np.float32)[column, board]
    shift = rng.uniform(size=(columns, boards)).astype(np.float32)[column, board]
    grain = wood(rng, "#000000", "#ffffff")[..., 0][
        _texels(across + shift), _texels(inside * 0.33 + shift * 1.7)
    ]
    picture = blend(rgb(dark), rgb(light), 0.15 + 0.62 * grain + 0.2 * tone)
    joint = np.clip(np.minimum(_edge(across, boards), _edge(u, columns)) * SIZE_PX / 1.3, 0.0, 1.0)
    return np.asarray(picture * (0.35 + 0.65 * joint[..., None]), np.float32)


def tiles(
    rng: np.random.Generator,
    colors: Sequence[str],
    grout: str,
    *,
    columns: int = 4,
    rows: int = 4,
    bond: bool = False,
    checker: bool = False,
    gap_px: float = 2.2,
) -> Picture:
    """Glazed tiles with grout: mixed or alternating colours, in a grid or in running bond."""
    u, v = grid_px()
    row = np.floor(v * rows).astype(np.int64)
    shifted = u + (0.5 / columns * (row % 2)).astype(np.float32) * bond
    column = np.floor(shifted * columns).astype(np.int64) % columns
    index = (
        (row + column) % len(colors)
        if checker
        else rng.integers(0, len(colors), (rows, columns))[row, column]
    )
    picture = np.stack([rgb(color) for color in colors])[index]
    tone = rng.uniform(-1.0, 1.0, (rows, columns)).astype(np.float32)[row, column]
    glaze = (
        0.022 * noise(rng, slope=1.4, coarsest=3.0)
        + 0.016 * noise(rng, slope=0.5, coarsest=40.0)
        + 0.05 * tone
    )
    picture = picture * (1.0 + glaze[..., None])
    edge = np.minimum(_edge(shifted, columns), _edge(v, rows)) * SIZE_PX
    rim = 1.0 - 0.10 * np.clip(1.0 - (edge - gap_px) / 4.0, 0.0, 1.0)
    sandy = rgb(grout) * (1.0 + 0.08 * noise(rng, slope=0.3))[..., None]
    return blend(sandy, picture * rim[..., None], edge - gap_px + 0.5)


def terrazzo(rng: np.random.Generator, ground: str, chips: Sequence[str]) -> Picture:
    """Ground stone chips of several sizes in cement."""
    picture = blend(rgb(ground) * 0.93, rgb(ground), 0.5 + 0.3 * noise(rng, slope=0.5))
    for index, chip in enumerate(chips):
        grain = noise(rng, slope=3.0, coarsest=26.0 - 5.0 * index)
        picture = blend(picture, rgb(chip) * (1.0 + 0.04 * grain[..., None]), (grain - 1.05) * 9.0)
    return picture


def marble(rng: np.random.Generator, ground: str, vein: str) -> Picture:
    """Polished stone with branching veins and cloudy depth."""
    cloud = noise(rng, slope=1.9)
    veins = np.exp(-12.0 * np.abs(noise(rng, slope=1.75, stretch=0.6) + 0.25 * cloud))
    fine = np.exp(-16.0 * np.abs(noise(rng, slope=1.5, coarsest=3.0)))
    speckle = 0.05 * noise(rng, slope=0.2)
    return blend(rgb(ground), rgb(vein), 0.12 + 0.1 * cloud + 0.62 * veins + 0.25 * fine + speckle)


def weave(rng: np.random.Generator, *, threads: int = 88) -> Picture:
    """Nearly white plain-woven cloth with slubs, to be tinted."""
    u, v = grid_px()
    warp = np.sin(np.pi * threads * u) ** 2
    weft = np.sin(np.pi * threads * v) ** 2
    over = (np.floor(u * threads) + np.floor(v * threads)).astype(np.int64) % 2 == 0
    thread = np.where(over, warp, weft)
    slub = noise(rng, slope=0.8, stretch=16.0, coarsest=8.0) + noise(
        rng, slope=0.8, stretch=1 / 16, coarsest=8.0
    )
    return blend(
        rgb("#5e5c58"), rgb("#ffffff"), 0.47 + 0.30 * thread + 0.11 * slub + 0.05 * noise(rng, slope=1.6)
    )


def knit(rng: np.random.Generator) -> Picture:
    """Nearly white chunky knitwear in columns of plaits along v, to be tinted."""
    u, v = grid_px()
    columns, loops = 24, 32
    inside = u * columns % 1.0
    plait = v * loops + 0.7 * np.abs(inside - 0.5)
    loop = np.sin(np.pi * (plait % 1.0)) * np.sin(np.pi * (inside * 2.0 % 1.0)) ** 0.7
    return blend(rgb("#4c4a47"), rgb("#ffffff"), 0.30 + 0.6 * loop + 0.08 * noise(rng, slope=0.5))


def pile(rng: np.random.Generator) -> Picture:
    """Nearly white carpet pile, to be tinted."""
    tuft = noise(rng, slope=0.25, coarsest=90.0)
    return blend(rgb("#56534f"), rgb("#ffffff"), 0.62 + 0.13 * tuft + 0.07 * noise(rng, slope=1.3))


def wallpaper(rng: np.random.Generator, ground: str, motif: str, kind: str) -> Picture:
    """Printed paper: `stripes`, `scales` (overlapping arcs), `lattice` (diamonds) or `leaves`."""
    u, v = grid_px()
    if kind == "stripes":
        bands = u * 8.0 % 1.0
        share = np.where(bands < 0.5, 0.85, 0.0) + np.where(np.abs(bands - 0.75) < 0.03, 0.9, 0.0)
    elif kind == "scales":
        share = np.zeros_like(u)
        for row in range(-1, 17):  # later rows lie over earlier ones
            center_u = (u * 8.0 + 0.5 * (row % 2)) % 1.0 - 0.5
            center_v = v * 16.0 - row
            radius = np.hypot(center_u, (center_v - 1.0) / 2.0)
            arc = 0.5 + 0.5 * np.cos(2.0 * np.pi * 5.0 * radius)
            share = np.where(
                (radius < 0.5) & (center_v < 1.0), np.where(radius > 0.46, 1.0, 0.75 * arc), share
            )
    elif kind == "lattice":
        a, b = (u + v) * 6.0 % 1.0 - 0.5, (u - v) * 6.0 % 1.0 - 0.5
        line = np.minimum(np.abs(a), np.abs(b))
        share = np.where(line < 0.05, 0.95, np.where(np.abs(a) + np.abs(b) < 0.62, 0.0, 0.45))
        share = np.where(np.hypot(np.abs(a) - 0.5, np.abs(b) - 0.5) < 0.13, 0.95, share)
    else:
        share = _scattered_leaves(rng)
    ink = np.asarray(share, np.float32) * (0.93 + 0.05 * noise(rng, slope=0.5))
    paper = 1.0 + 0.022 * noise(rng, slope=0.5) + 0.018 * noise(rng, slope=1.5)
    return np.asarray(blend(rgb(ground), rgb(motif), ink) * paper[..., None], np.float32)


def _scattered_leaves(rng: np.random.Generator) -> Field:
    """Leaves in all directions with ribs and veins, 0 between them."""
    share = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    reach = SIZE_PX // 10
    window = np.arange(-reach, reach + 1)
    dv, du = np.meshgrid(window / np.float32(SIZE_PX), window / np.float32(SIZE_PX), indexing="ij")
    places = (np.stack(np.meshgrid(np.arange(10), np.arange(10)), axis=-1).reshape(-1, 2) + 0.5) / 10.0
    for place in places + rng.uniform(-0.03, 0.03, places.shape):
        angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 0.095)
        s = (du * np.cos(angle) + dv * np.sin(angle)) / length
        t = (dv * np.cos(angle) - du * np.sin(angle)) / length
        vein = np.abs((s + 1.6 * np.abs(t)) * 4.0 % 1.0 - 0.5) * 0.4
        tone = rng.uniform(0.55, 1.0) - np.where(np.minimum(np.abs(t), vein) < 0.04, 0.25, 0.0)
        rows, columns = np.ix_(
            *((np.floor(at * SIZE_PX).astype(np.int64) + window) % SIZE_PX for at in place)
        )
        blade = (np.abs(s) < 1.0) & (np.abs(t) < 0.36 * (1.0 - s * s))
        share[rows, columns] = np.where(blade, tone, share[rows, columns])
    return share


def metal(rng: np.random.Generator) -> Picture:
    """Brushed steel along u."""
    return blend(rgb("#8f9193"), rgb("#f4f5f6"), 0.62 + 0.13 * noise(rng, slope=0.7, stretch=40.0))


def concrete(rng: np.random.Generator) -> Picture:
    """Cast concrete: clouds, pits and fine sand."""
    pits = np.clip(noise(rng, slope=1.2, coarsest=40.0) - 2.1, 0.0, 1.0)
    return blend(
        rgb("#6f6c68"),
        rgb("#d8d5d0"),
        0.62 + 0.13 * noise(rng, slope=1.7) + 0.07 * noise(rng, slope=0.4) - pits,
    )


def leaf(rng: np.random.Generator) -> Picture:
    """A leaf along u, its rib in the middle of v."""
    u, v = grid_px(128)
    side = np.abs(v - 0.5)
    veins = np.abs((u - 0.8 * side) * 12.0 % 1.0 - 0.5)
    share = 0.5 + 0.35 * np.clip(1.0 - side * 30.0, 0.0, 1.0) + 0.22 * np.clip(1.0 - veins * 7.0, 0.0, 1.0)
    return blend(rgb("#2f4a24"), rgb("#b9cf86"), share - 0.5 * side + 0.07 * noise(rng, slope=1.0, size=128))
