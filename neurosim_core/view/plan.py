"""The plan of a scene: what an architect draws, cut at one height and seen from above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.scene import Scene
from neurosim_core.scene.srgb import linear_to_srgb8, srgb_to_linear
from neurosim_core.scene.texels import mip_chain

_SAMPLES = np.array([[i + 1 / 3, j + 1 / 3, 3 - i - j + 1 / 3] for i in range(4) for j in range(4 - i)]) / 4
"""Barycentric coordinates at which a face's texture is averaged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """A scene cut at a height. Coordinates are those of the world."""

    outlines: NDArray[np.float64]
    """Cuts of the plane through surfaces [m], shape [n, 2, 2]: segments of two points (x, y)."""
    low_outlines: NDArray[np.float64]
    """The same, cut at 0.3 of the height above the lowest point of the scene: tables, beds, sofas."""
    triangles: NDArray[np.float64]
    """What is seen from above below the plane [m], shape [n, 3, 2], lowest first."""
    colors: NDArray[np.float64]
    """sRGB colour of each triangle in [0, 1], shape [n, 3]."""
    bounds: NDArray[np.float64]
    """Lowest and highest (x, y) of what is shown [m], shape [2, 2]."""


def cut_plan(scene: Scene, *, height_m: float) -> Plan:
    """Cut a scene at a height.

    What lies above the cut is left out. Triangles below it are ordered by their highest point, so that
    drawing them one after the other shows what is on top (exact where objects do not interlock).
    """
    corners = scene.vertices[scene.faces].astype(np.float64)
    floor_m = float(corners[:, :, 2].min())
    outlines = _slice(scene, height_m)
    normal_z = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    below = (corners[:, :, 2].max(axis=1) < height_m) & (np.abs(normal_z) > 1e-9)
    faces = np.flatnonzero(below)
    faces = faces[np.argsort(corners[faces, :, 2].max(axis=1), kind="stable")]
    triangles = corners[faces, :, :2]
    shown = np.concatenate([outlines.reshape(-1, 2), triangles.reshape(-1, 2)])
    if not len(shown):
        shown = scene.bounds_m[:, :2]
    return Plan(
        outlines=outlines,
        low_outlines=_slice(scene, floor_m + 0.3 * (height_m - floor_m)),
        triangles=triangles,
        colors=face_colors(scene, faces),
        bounds=np.stack([shown.min(axis=0), shown.max(axis=0)]),
    )


def _slice(scene: Scene, height_m: float) -> NDArray[np.float64]:
    """Return where the plane z = height_m cuts a scene: segments of two points (x, y), shape [n, 2, 2]."""
    corners = scene.vertices[scene.faces].astype(np.float64)
    above = corners[..., 2] > height_m
    cut = above.any(axis=1) & ~above.all(axis=1)
    begin, end = corners[cut], np.roll(corners[cut], -1, axis=1)
    crosses = above[cut] != np.roll(above[cut], -1, axis=1)  # two edges of each triangle
    begin, end = begin[crosses], end[crosses]
    share = (height_m - begin[:, 2:]) / (end[:, 2:] - begin[:, 2:])
    points: NDArray[np.float64] = begin + share * (end - begin)
    return points[:, :2].reshape(-1, 2, 2)


def face_colors(scene: Scene, faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean albedo of faces as sRGB in [0, 1], shape [n, 3]."""
    linear = np.empty((len(faces), 3))
    for index, material in enumerate(scene.materials):
        mine = np.flatnonzero(scene.face_material[faces] == index)
        linear[mine] = np.array(material.base_color) + np.array(material.emission)
        if material.texture is None or not len(mine):
            continue
        uv = np.einsum("sk,fkc->fsc", _SAMPLES, scene.uv[scene.faces[faces[mine]]])
        linear[mine] *= _mean_texels(material.texture.srgb, uv)
    return linear_to_srgb8(np.clip(linear, 0.0, 1.0)) / 255.0


def _mean_texels(srgb: NDArray[np.uint8], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Average a texture over faces, in linear light; returns shape [F, 3].

    Each face reads the mip level whose texels are as far apart as its samples `uv`, shape [F, samples, 2].
    """
    levels = mip_chain(srgb_to_linear(srgb))
    spacing = np.ptp(uv, axis=1) / 3.0 * [srgb.shape[1], srgb.shape[0]]  # texels; four samples along a side
    level = np.log2(np.maximum(spacing.max(axis=1), 1.0)).astype(np.int64).clip(0, len(levels) - 1)
    mean = np.empty((len(uv), 3))
    for index in np.unique(level):
        faces = np.flatnonzero(level == index)
        height, width = levels[index].shape[:2]
        column = np.floor(uv[faces, :, 0] * width).astype(np.int64) % width
        row = np.floor((1.0 - uv[faces, :, 1]) * height).astype(np.int64) % height
        mean[faces] = levels[index][row, column].mean(axis=1)
    return mean
