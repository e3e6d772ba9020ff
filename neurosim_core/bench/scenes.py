"""Scenes that the benchmarks make: a fine checkerboard, and thin structures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.engine import Ambient, Material, Scene, Texture

_EVEN = Ambient(up=(1.0, 1.0, 1.0), down=(1.0, 1.0, 1.0))
_BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def checkerboard_floor(check_m: float, *, half_m: float = 40.0) -> Scene:
    """Return a floor of small squares [m] around the origin, evenly lit."""
    rows, columns = np.indices((32, 32)) // 16
    grey = np.where((rows + columns) % 2 == 0, 230, 40).astype(np.uint8)
    texture = Texture(name="checkerboard", srgb=np.repeat(grey[..., None], 3, axis=2))
    corners = half_m * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return _scene(
        "checkerboard",
        corners[[[0, 1, 2], [0, 2, 3]]],
        np.zeros(2),
        [Material(name="checkerboard", base_color=(1.0, 1.0, 1.0), texture=texture)],
        uv_per_m=0.5 / check_m,
    )


def thin_structures(*, seed: int = 0) -> Scene:
    """Return a room of 8 m with blinds, railings and plants around the origin, at 1 to 3 m.

    Slats are 25 mm high, bars 12 mm wide, leaves about 40 x 8 mm: at 2 m and 346 pixels over 86 degrees a
    pixel is 11 mm wide.
    """
    rng = np.random.default_rng(seed)
    boxes = [((0.0, 0.0, 0.0), (8.0, 8.0, 3.0), 0.0, 0)]  # centre, size, turn about z, material
    for side, angle in enumerate(np.arange(4) * np.pi / 2):
        along, ahead = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        if side % 2 == 0:  # blinds
            boxes += [((*(3.0 * ahead), z), (0.02, 2.5, 0.025), angle, 1) for z in np.arange(-1.2, 1.2, 0.05)]
        else:  # railings
            places = [2.0 * ahead + shift * along for shift in np.arange(-2.0, 2.0, 0.1)]
            boxes += [((*place, -0.5), (0.012, 0.012, 1.6), angle, 2) for place in places]
    triangles = [_box(np.array(centre), np.array(size), turn) for centre, size, turn, _ in boxes]
    materials = [np.full(12, material) for *_, material in boxes]
    for angle in (np.pi / 4, 3 * np.pi / 4, 5 * np.pi / 4, 7 * np.pi / 4):  # plants
        base = np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), -0.3])
        tips = base + rng.normal(0.0, 0.25, (150, 1, 3))
        triangles.append(tips + rng.normal(0.0, 1.0, (150, 3, 3)) * np.array([0.02, 0.02, 0.02]))
        materials.append(np.full(150, 3))
    colours = {
        "wall": (0.75, 0.73, 0.7),
        "slat": (0.2, 0.2, 0.22),
        "bar": (0.05, 0.05, 0.05),
        "leaf": (0.1, 0.3, 0.08),
    }
    painted = [Material(name=name, base_color=colour) for name, colour in colours.items()]
    return _scene("thin structures", np.concatenate(triangles), np.concatenate(materials), painted)


def _box(centre: NDArray[np.float64], size: NDArray[np.float64], turn_rad: float) -> NDArray[np.float64]:
    """Return the triangles of a box that is turned about z, shape [12, 3, 3]."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    corners = (_BOX * size) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + centre
    return np.array(
        [corners[[a, b, c]] for q in _BOX_QUADS for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    )


def _scene(
    name: str,
    triangles: NDArray[np.float64],
    material: NDArray[np.float64],
    materials: Sequence[Material],
    *,
    uv_per_m: float = 1.0,
) -> Scene:
    """Return a scene of flat triangles, shape [F, 3, 3], evenly lit; texture coordinates are x and y."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    vertices = triangles.reshape(-1, 3)
    return Scene(
        name=name,
        vertices=vertices.astype(np.float32),
        faces=np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
        normals=np.repeat(normal, 3, axis=0).astype(np.float32),
        uv=(vertices[:, :2] * uv_per_m).astype(np.float32),
        face_material=material.astype(np.int32),
        face_instance=np.zeros(len(triangles), dtype=np.int32),
        instance_names=(name,),
        materials=tuple(materials),
        ambient=_EVEN,
    )
