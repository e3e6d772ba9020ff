"""Texels as the ray caster reads them: pictures in linear light, averaged into mip levels, packed.

A texel is 32 bits: the square roots of linear red, green and blue in 11, 11 and 10 bits. The root spreads the
codes like sRGB does, but is decoded with one multiplication and no table, and with 8 times (blue: 4 times)
the levels of an 8-bit file, so the error is far below that of the file itself; and it is one load of 32 bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.srgb import LINEAR

LEVELS_RG = 2047
LEVELS_B = 1023
"""Greatest codes of red and green, and of blue."""


def mip_chain(linear: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Return a linear picture [H, W, C] and its averages at half, a quarter, … of the resolution.

    Each level is the exact box average of the one before (odd sizes too), so all levels have the same mean.
    """
    levels = [linear]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halve(_halve(levels[-1], axis=0), axis=1))
    return levels


def _halve(picture: NDArray[np.float32], *, axis: int) -> NDArray[np.float32]:
    rows = np.moveaxis(picture, axis, 0)
    size = rows.shape[0]
    if size == 1:
        return picture
    half = size // 2
    if size % 2 == 0:
        result = 0.5 * (rows[0::2] + rows[1::2])
    else:  # each of the `half` results covers 2 + 1 / half texels
        k = np.arange(half, dtype=np.float32).reshape(-1, *[1] * (rows.ndim - 1))
        result = ((half - k) * rows[0:-1:2] + half * rows[1::2] + (k + 1.0) * rows[2::2]) / size
    return np.moveaxis(result.astype(np.float32), 0, axis)


def encode_texels(linear: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Return packed texels of linear light [..., 3] in [0, 1] (values outside are clipped)."""
    root = np.sqrt(np.clip(linear, 0.0, 1.0))
    red = np.rint(root[..., 0] * LEVELS_RG).astype(np.uint32)
    green = np.rint(root[..., 1] * LEVELS_RG).astype(np.uint32)
    blue = np.rint(root[..., 2] * LEVELS_B).astype(np.uint32)
    return np.asarray(red | (green << np.uint32(11)) | (blue << np.uint32(22)), dtype=np.uint32)


def packed_levels(srgb: NDArray[np.uint8]) -> list[NDArray[np.uint32]]:
    """Return the packed texels of all levels of a picture, shape [H, W] each."""
    codes = encode_texels(np.repeat(LINEAR[:, None], 3, axis=1))  # each channel alone, as a table
    masks = np.array([LEVELS_RG, LEVELS_RG << 11, LEVELS_B << 22], np.uint32)
    red, green, blue = (codes & mask for mask in masks)
    finest = red[srgb[..., 0]] | green[srgb[..., 1]] | blue[srgb[..., 2]]
    return [finest, *(encode_texels(level) for level in mip_chain(LINEAR[srgb])[1:])]
