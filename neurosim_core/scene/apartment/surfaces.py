"""Procedural textures: 8-bit sRGB pictures that repeat without a seam and have contrast at every scale."""

from __future__ import annotations

from collections.abc import Callable

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
        coarsest: Frequencies below this many periods per tile are flattened.
        size: Edge of the square [px].
    """
    spectrum = scipy.fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    across = np.fft.fftfreq(size, 1.0 / size).astype(np.float32)[:, None]
    along = np.arange(size // 2 + 1, dtype=np.float32)[None, :] * np.float32(stretch)
    spectrum *= np.maximum(np.hypot(across, along), np.float32(coarsest)) ** np.float32(-slope)
    spectrum[0, 0] = 0.0
    field = scipy.fft.irfft2(spectrum, s=(size, size))
    return np.asarray(field / field.std(), np.float32)


def blend(low: NDArray[np.float32], high: NDArray[np.float32], share: Field) -> Picture:
    """From colour (or picture) `low` to `high` by a share that is clipped to [0, 1]."""
    weight = np.clip(share, 0.0, 1.0)[..., None]
    return np.asarray(low + (high - low) * weight, np.float32)


def quantize(picture: Picture) -> NDArray[np.uint8]:
    """8-bit sRGB."""
    return np.asarray(np.clip(picture * 255.0 + 0.5, 0.0, 255.0), np.uint8)


def grid_px(size: int = SIZE_PX) -> tuple[Field, Field]:
    """Column u and row v of each texel centre, in [0, 1)."""
    line = (np.arange(size, dtype=np.float32) + 0.5) / size
    return np.broadcast_to(line[None, :], (size, size)), np.broadcast_to(line[:, None], (size, size))


def plaster(rng: np.random.Generator) -> Picture:
    """Rolled wall paint: nearly white, with the roller's grain and faint clouds."""
    grain = 0.55 * noise(rng, slope=0.9, coarsest=24.0) + 0.45 * noise(rng, slope=1.8)
    return blend(rgb("#d2d2d0"), rgb("#ffffff"), 0.62 + 0.17 * grain)


def planks(rng: np.random.Generator, dark: str, light: str, *, rows: int = 12) -> Picture:
    """Floor boards along u with grain, a tone of their own each, and dark joints."""
    u, v = grid_px()
    row = np.floor(v * rows).astype(int)
    offset = rng.permutation(rows)[row] / rows + 0.0
    column = np.floor((u + offset) * 2.0).astype(int) % 2
    tone = rng.uniform(-1.0, 1.0, (rows, 2)).astype(np.float32)[row, column]
    shift = rng.integers(0, SIZE_PX, (rows, 2))[row, column]
    grain = noise(rng, slope=1.15, stretch=14.0, coarsest=6.0)
    grain = grain[
        (np.arange(SIZE_PX)[:, None] + shift) % SIZE_PX, (np.arange(SIZE_PX)[None, :] + 3 * shift) % SIZE_PX
    ]
    picture = blend(rgb(dark), rgb(light), 0.5 + 0.2 * tone + 0.2 * grain)
    to_edge = np.minimum(v * rows % 1.0, 1.0 - v * rows % 1.0) * SIZE_PX / rows
    along = (u + offset) * 2.0 % 1.0
    to_end = np.minimum(along, 1.0 - along) * SIZE_PX / 2.0
    joint = np.clip(np.minimum(to_edge, to_end) / 1.3, 0.0, 1.0)
    return np.asarray(picture * (0.35 + 0.65 * joint[..., None]), np.float32)


TEXTURES: dict[str, Callable[[np.random.Generator], Picture]] = {
    "plaster": plaster,
    "oak planks": lambda rng: planks(rng, "#8a6440", "#cfa878"),
}
