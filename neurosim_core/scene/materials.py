# mypy: disable-error-code="index,attr-defined,misc,return-value,assignment,operator"
"""Textures for the ray caster: decoded to linear light, averaged into mip levels, packed, sampled."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.scene.scene import Material, Texture
from neurosim_core.scene.texels import LEVELS_B, LEVELS_RG

wp.set_module_options({"enable_backward": False})

_TEXEL_UNIT = wp.constant(wp.vec3(1.0 / LEVELS_RG**2, 1.0 / LEVELS_RG**2, 1.0 / LEVELS_B**2))
"""Linear light of a texel whose roots are coded by 1."""


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
        chains = dict(zip(map(id, textures), pool.map(Texture.pack_levels, textures), strict=True))
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


def mean_albedo(materials: Sequence[Material], packed: PackedTextures) -> NDArray[np.float32]:
    """Return the albedo of each material averaged over its texture, linear, shape [M, 3]."""
    albedo = np.array([m.base_color for m in materials], dtype=np.float32).reshape(-1, 3)
    for index, (first, count) in enumerate(packed.material_texture):
        if count:
            code = int(packed.texels[packed.levels[first + count - 1, 0]])
            root = np.array([code & 2047, (code >> 11) & 2047, code >> 22]) / (
                LEVELS_RG,
                LEVELS_RG,
                LEVELS_B,
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
