# mypy: disable-error-code="index,attr-defined,misc,return-value,assignment,operator"
"""Textures for the ray caster: decoded to linear light, averaged into mip levels, packed, sampled.

A texel is 32 bits: the square roots of linear red, green and blue in 11, 11 and 10 bits. The root spreads the
codes like sRGB does, but is decoded with one multiplication and no table, and with 8 times (blue: 4 times)
the levels of an 8-bit file, so the error is far below that of the file itself; and it is one load of 32 bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.scene.scene import Material, Texture
from neurosim_core.scene.srgb import LINEAR

wp.set_module_options({"enable_backward": False})

_LEVELS_RG = 2047
_LEVELS_B = 1023
_TEXEL_UNIT = wp.constant(wp.vec3(1.0 / _LEVELS_RG**2, 1.0 / _LEVELS_RG**2, 1.0 / _LEVELS_B**2))
"""Linear light of a texel whose roots are coded by 1."""


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
    red = np.rint(root[..., 0] * _LEVELS_RG).astype(np.uint32)
    green = np.rint(root[..., 1] * _LEVELS_RG).astype(np.uint32)
    blue = np.rint(root[..., 2] * _LEVELS_B).astype(np.uint32)
    return np.asarray(red | (green << np.uint32(11)) | (blue << np.uint32(22)), dtype=np.uint32)


@dataclass(frozen=True, kw_only=True, eq=False)
class PackedTextures:
    """All mip levels of all textures of a scene, one after another."""

    texels: NDArray[np.uint32]
    """Packed texels, shape [T]; row 0 of a level is the top."""
    levels: NDArray[np.int32]
    """First texel, width, height of each level of each texture, shape [L, 3]."""
    material_texture: NDArray[np.int32]
    """First row in `levels` and number of levels of each material, shape [M, 2]; 0 levels: no texture."""

    def size_px(self, material: int) -> tuple[int, int]:
        """Return width and height of a material's texture [px]; (0, 0): it has none."""
        first, count = self.material_texture[material]
        return (int(self.levels[first, 1]), int(self.levels[first, 2])) if count else (0, 0)


def pack_textures(materials: Sequence[Material]) -> PackedTextures:
    """Decode textures, build their mip chains and pack them; one that materials share is packed once.

    Threads share the textures: NumPy releases the interpreter lock.
    """
    textures = list({id(m.texture): m.texture for m in materials if m.texture is not None}.values())
    with ThreadPoolExecutor() as pool:
        chains = dict(zip(map(id, textures), pool.map(_packed_levels, textures), strict=True))
    chunks: list[NDArray[np.uint32]] = []
    levels: list[tuple[int, int, int]] = []
    rows: dict[int, tuple[int, int]] = {}
    texel_count = 0
    for key, chain in chains.items():
        rows[key] = (len(levels), len(chain))
        for level in chain:
            levels.append((texel_count, level.shape[1], level.shape[0]))
            chunks.append(level.reshape(-1))
            texel_count += level.size
    return PackedTextures(
        texels=np.concatenate(chunks) if chunks else np.zeros(0, dtype=np.uint32),
        levels=np.array(levels, dtype=np.int32).reshape(-1, 3),
        material_texture=np.array([rows.get(id(m.texture), (0, 0)) for m in materials], np.int32).reshape(
            -1, 2
        ),
    )


def _packed_levels(texture: Texture) -> list[NDArray[np.uint32]]:
    """Return the packed texels of all levels of a texture, shape [H, W] each."""
    codes = encode_texels(np.repeat(LINEAR[:, None], 3, axis=1))  # each channel alone, as a table
    masks = np.array([_LEVELS_RG, _LEVELS_RG << 11, _LEVELS_B << 22], np.uint32)
    red, green, blue = (codes & mask for mask in masks)
    srgb = texture.srgb
    finest = red[srgb[..., 0]] | green[srgb[..., 1]] | blue[srgb[..., 2]]
    return [finest, *(encode_texels(level) for level in mip_chain(LINEAR[srgb])[1:])]


def mean_albedo(materials: Sequence[Material], packed: PackedTextures) -> NDArray[np.float32]:
    """Return the albedo of each material averaged over its texture, linear, shape [M, 3]."""
    albedo = np.array([m.base_color for m in materials], dtype=np.float32).reshape(-1, 3)
    for index, (first, count) in enumerate(packed.material_texture):
        if count:
            code = int(packed.texels[packed.levels[first + count - 1, 0]])
            root = np.array([code & 2047, (code >> 11) & 2047, code >> 22]) / (
                _LEVELS_RG,
                _LEVELS_RG,
                _LEVELS_B,
            )
            albedo[index] *= (root**2).astype(np.float32)
    return albedo


@wp.func
def _decode_texel(code: wp.uint32) -> wp.vec3:
    """Return the linear light of a packed texel in `_TEXEL_UNIT`, which is a whole number."""
    red = float(int(code & wp.uint32(2047)))
    green = float(int((code >> wp.uint32(11)) & wp.uint32(2047)))
    blue = float(int(code >> wp.uint32(22)))
    return wp.vec3(red * red, green * green, blue * blue)


@wp.func
def _sample_level(texels: wp.array[wp.uint32], level: wp.vec3i, u: float, v: float) -> wp.vec3:
    """Return the linear light in `_TEXEL_UNIT`."""
    width = level[1]
    height = level[2]
    x = u * float(width) - 0.5
    y = v * float(height) - 0.5
    x_floor = wp.floor(x)
    y_floor = wp.floor(y)
    blend_x = x - x_floor
    blend_y = y - y_floor
    left = int(x_floor)
    top = int(y_floor)
    right = wp.where(left + 1 < width, left + 1, 0)
    bottom = wp.where(top + 1 < height, top + 1, 0)
    left = wp.where(left < 0, width - 1, left)
    top = wp.where(top < 0, height - 1, top)
    upper = level[0] + top * width
    lower = level[0] + bottom * width
    above = wp.lerp(_decode_texel(texels[upper + left]), _decode_texel(texels[upper + right]), blend_x)
    below = wp.lerp(_decode_texel(texels[lower + left]), _decode_texel(texels[lower + right]), blend_x)
    return wp.lerp(above, below, blend_y)


@wp.func
def sample_finest(
    texels: wp.array[wp.uint32], levels: wp.array[wp.vec3i], texture: wp.vec2i, uv: wp.vec2
) -> wp.vec3:
    """Return the linear light of a texture's finest level, bilinear between texels; see `sample_texture`.

    It aliases where texels are smaller than pixels.
    """
    u = uv[0] - wp.floor(uv[0])
    v = 1.0 - (uv[1] - wp.floor(uv[1]))
    return wp.cw_mul(_TEXEL_UNIT, _sample_level(texels, levels[texture[0]], u, v))


@wp.func
def sample_nearest(
    texels: wp.array[wp.uint32], levels: wp.array[wp.vec3i], texture: wp.vec2i, uv: wp.vec2
) -> wp.vec3:
    """Return the linear light of the nearest texel of a texture's finest level; see `sample_texture`.

    It aliases where texels are smaller than pixels, and has steps where they are larger.
    """
    level = levels[texture[0]]
    u = uv[0] - wp.floor(uv[0])
    v = 1.0 - (uv[1] - wp.floor(uv[1]))
    col = wp.min(int(u * float(level[1])), level[1] - 1)
    row = wp.min(int(v * float(level[2])), level[2] - 1)
    return wp.cw_mul(_TEXEL_UNIT, _decode_texel(texels[level[0] + row * level[1] + col]))


@wp.func
def sample_texture(
    texels: wp.array[wp.uint32],
    levels: wp.array[wp.vec3i],
    texture: wp.vec2i,
    uv: wp.vec2,
    lod: float,
) -> wp.vec3:
    """Return the trilinearly filtered linear light of a texture that repeats in both directions.

    Texels and levels are those of `PackedTextures`, `texture` a row of its `material_texture` with at least
    one level. v = 1 is the top; `lod` is log2 of the width of the footprint in texels of level 0.
    """
    u = uv[0] - wp.floor(uv[0])
    v = 1.0 - (uv[1] - wp.floor(uv[1]))
    clamped = wp.clamp(lod, 0.0, float(texture[1] - 1))
    finer = int(clamped)
    blend = clamped - float(finer)
    color = _sample_level(texels, levels[texture[0] + finer], u, v)
    if blend > 0.0:
        color = wp.lerp(color, _sample_level(texels, levels[texture[0] + finer + 1], u, v), blend)
    return wp.cw_mul(_TEXEL_UNIT, color)
