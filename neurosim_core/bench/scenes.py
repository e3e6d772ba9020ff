"""Scenes that the benchmarks make: a fine checkerboard, and thin structures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.engine import Ambient, Material, Scene, Texture
from neurosim_core.scene.solids import box

_EVEN = Ambient(up=(1.0, 1.0, 1.0), down=(1.0, 1.0, 1.0))
_COLOURS = {
    "wall": (0.75, 0.73, 0.7),
    "slat": (0.2, 0.2, 0.22),
    "bar": (0.05, 0.05, 0.05),
    "leaf": (0.1, 0.3, 0.08),
}


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
    boxes = [(box((8.0, 8.0, 3.0)), 0)]  # and material
    for side, angle in enumerate(np.arange(4) * np.pi / 2):
        along, ahead = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        if side % 2 == 0:  # blinds
            slat = box((0.02, 2.5, 0.025))
            places = [(*(3.0 * ahead), z) for z in np.arange(-1.2, 1.2, 0.05)]
        else:  # railings
            slat = box((0.012, 0.012, 1.6))
            places = [(*(2.0 * ahead + shift * along), -0.5) for shift in np.arange(-2.0, 2.0, 0.1)]
        boxes += [(slat.moved(place, yaw_rad=float(angle)), 1 + side % 2) for place in places]
    triangles = [part.vertices[part.faces] for part, _ in boxes]
    materials = [np.full(len(part.faces), material) for part, material in boxes]
    for angle in np.pi / 4 * np.array([1, 3, 5, 7]):  # plants
        base = np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), -0.3])
        tips = base + rng.normal(0.0, 0.25, (150, 1, 3))
        triangles.append(tips + rng.normal(0.0, 0.02, (150, 3, 3)))
        materials.append(np.full(150, 3))
    painted = [Material(name=name, base_color=colour) for name, colour in _COLOURS.items()]
    return _scene("thin structures", np.concatenate(triangles), np.concatenate(materials), painted)


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
