"""A scene of any number of triangles: a hall of pillars, the same shapes however finely they are cut."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.scene import Ambient, Light, Material, Scene, Texture

_LENGTH_M, _WIDTH_M, _HEIGHT_M = 20.0, 12.0, 4.0
_PILLAR_ROWS, _PILLAR_COLUMNS = 3, 5
_RADIUS_M = 0.35
_RIPPLE_M = 0.03
_TILE_M = 1.0
"""Side of the square that the texture covers [m]."""
_TEXTURE_PX = 512


@dataclass(frozen=True, kw_only=True)
class _Patch:
    """A grid of points with a normal and texture coordinates each."""

    points: NDArray[np.float64]
    """Shape [rows, columns, 3]; faces are counter-clockwise seen from where normals point."""
    normals: NDArray[np.float64]
    uv: NDArray[np.float64]
    name: str
    material: int


def hall(triangle_count: int) -> Scene:
    """Return a hall with rippled pillars and textured walls, the same on every call.

    Args:
        triangle_count: About how many triangles; the shapes are cut evenly into so many.

    Raises:
        ValueError: Too few for the shapes.
    """
    if triangle_count < 1_000:
        raise ValueError(f"triangle_count must be at least 1000, got {triangle_count}")
    low, high = 1e-3, 10.0  # a cell's side: fewer triangles with a larger one
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _face_count(middle) > triangle_count else (low, middle)
    return _join(_patches(high), name=f"hall cut into {_face_count(high):,} triangles")


def _face_count(cell_m: float) -> int:
    return sum(2 * rows * columns for rows, columns in (*_wall_cells(cell_m), *_pillar_cells(cell_m)))


def _cells(length_m: float, cell_m: float, *, least: int) -> int:
    return max(least, round(length_m / cell_m))


def _wall_cells(cell_m: float) -> list[tuple[int, int]]:
    long, wide, high = (_cells(side, cell_m, least=1) for side in (_LENGTH_M, _WIDTH_M, _HEIGHT_M))
    return [(wide, long)] * 2 + [(high, long)] * 2 + [(high, wide)] * 2


def _pillar_cells(cell_m: float) -> list[tuple[int, int]]:
    around = _cells(2.0 * math.pi * _RADIUS_M, cell_m, least=8)
    return [(_cells(_HEIGHT_M, cell_m, least=1), around)] * (_PILLAR_ROWS * _PILLAR_COLUMNS)


def _patches(cell_m: float) -> list[_Patch]:
    half_x, half_y = 0.5 * _LENGTH_M, 0.5 * _WIDTH_M
    x, y, z = np.array([_LENGTH_M, 0, 0]), np.array([0, _WIDTH_M, 0]), np.array([0, 0, _HEIGHT_M])
    corner = np.array([-half_x, -half_y, 0.0])
    sides = (  # corner, direction of columns, direction of rows: their cross product points inwards
        ("floor", corner, x, y),
        ("ceiling", corner + y + z, x, -y),
        ("front wall", corner + x, -x, z),
        ("back wall", corner + y, x, z),
        ("left wall", corner, y, z),
        ("right wall", corner + x + y, -y, z),
    )
    cells = _wall_cells(cell_m)
    walls = [
        _wall(name, start, along, up, shape, material=index)
        for index, ((name, start, along, up), shape) in enumerate(zip(sides, cells, strict=True))
    ]
    pillars = []
    for index, shape in enumerate(_pillar_cells(cell_m)):
        row, column = divmod(index, _PILLAR_COLUMNS)
        place = (
            -half_x + _LENGTH_M * (column + 0.5) / _PILLAR_COLUMNS,
            -half_y + _WIDTH_M * (row + 0.5) / _PILLAR_ROWS,
        )
        pillars.append(_pillar(f"pillar {index + 1}", place, shape, material=index % 6))
    return [*walls, *pillars]


def _wall(
    name: str,
    corner: NDArray[np.float64],
    along: NDArray[np.float64],
    up: NDArray[np.float64],
    shape: tuple[int, int],
    *,
    material: int,
) -> _Patch:
    v, u = np.meshgrid(*(np.linspace(0.0, 1.0, n + 1) for n in shape), indexing="ij")
    normal = np.cross(along, up)
    points = corner + u[..., None] * along + v[..., None] * up
    return _Patch(
        points=points,
        normals=np.broadcast_to(normal / np.linalg.norm(normal), points.shape),
        uv=np.stack([u * np.linalg.norm(along), v * np.linalg.norm(up)], axis=-1) / _TILE_M,
        name=name,
        material=material,
    )


def _pillar(name: str, place: tuple[float, float], shape: tuple[int, int], *, material: int) -> _Patch:
    """Return a pillar whose radius ripples with height and around it."""
    v, u = np.meshgrid(*(np.linspace(0.0, 1.0, n + 1) for n in shape), indexing="ij")
    angle = 2.0 * math.pi * u
    radius = _RADIUS_M + _RIPPLE_M * np.cos(8.0 * angle) * np.sin(6.0 * math.pi * v)
    outwards = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(u)], axis=-1)
    points = radius[..., None] * outwards
    points[..., :2] += place
    points[..., 2] = _HEIGHT_M * v
    turns = max(1, round(2.0 * math.pi * _RADIUS_M / _TILE_M))  # whole tiles: no seam
    return _Patch(
        points=points,
        normals=outwards,
        uv=np.stack([turns * u, _HEIGHT_M * v / _TILE_M], axis=-1),
        name=name,
        material=material,
    )


def _join(patches: Sequence[_Patch], *, name: str) -> Scene:
    vertices: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    uv: list[NDArray[np.float64]] = []
    faces, materials, instances = [], [], []
    first = 0
    for instance, patch in enumerate(patches):
        rows, columns = patch.points.shape[:2]
        index = first + np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        grid = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2).reshape(-1, 3)
        faces.append(grid)
        materials.append(np.full(len(grid), patch.material))
        instances.append(np.full(len(grid), instance))
        for parts, values in ((vertices, patch.points), (normals, patch.normals), (uv, patch.uv)):
            parts.append(values.reshape(rows * columns, -1))
        first += rows * columns
    lamps = [(x, y, 0.9 * _HEIGHT_M) for x in (-0.3 * _LENGTH_M, 0.0, 0.3 * _LENGTH_M) for y in (-2.0, 2.0)]
    return Scene(
        name=name,
        vertices=np.concatenate(vertices).astype(np.float32),
        faces=np.concatenate(faces).astype(np.int32),
        normals=np.concatenate(normals).astype(np.float32),
        uv=np.concatenate(uv).astype(np.float32),
        face_material=np.concatenate(materials).astype(np.int32),
        face_instance=np.concatenate(instances).astype(np.int32),
        instance_names=tuple(patch.name for patch in patches),
        materials=tuple(_material(index) for index in range(6)),
        lights=tuple(Light(position_m=lamp, intensity=(2.0, 2.0, 1.8)) for lamp in lamps),
        ambient=Ambient(up=(0.3, 0.3, 0.3), down=(0.2, 0.2, 0.2)),
        inside_m=(0.0, 0.25 * _WIDTH_M * 0.67, 0.5 * _HEIGHT_M),
    )


def _material(index: int) -> Material:
    """Return plaster of blotches of many sizes, which wraps around without a seam."""
    rng = np.random.default_rng(index)
    picture = np.zeros((_TEXTURE_PX, _TEXTURE_PX))
    for size in (8, 16, 32, 64, 128, 256):
        coarse = rng.random((size, size))
        picture += np.kron(coarse, np.ones((_TEXTURE_PX // size,) * 2)) / math.log2(size)
    picture = (picture - picture.min()) / (picture.max() - picture.min())
    tint = np.array([1.0, 0.95 - 0.05 * (index % 3), 0.9 - 0.1 * (index % 2)])
    srgb = np.rint(60.0 + 180.0 * picture[..., None] * tint).astype(np.uint8)
    return Material(name=f"plaster {index + 1}", texture=Texture(name=f"plaster {index + 1}", srgb=srgb))
