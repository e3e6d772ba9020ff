"""Solids that move: their shapes and surfaces as settings, and as triangles in the frame of the body."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from neurosim_core.scene.scene import LinearRgb, Material, Scene, Texture
from neurosim_core.scene.solids import Part, grid_surface, merge, picture_quad, without_slivers
from neurosim_core.scene.source import Axis, SceneError
from neurosim_core.scene.srgb import linear_to_srgb8
from neurosim_core.settings import BaseConfig

_SIDES = 128
"""Facets around a sphere or a cylinder: the surface is inside the true one by at most 3e-4 of the radius."""
_CHECKER_PX = 512
"""Width of the texture of two by two squares; the edge between two is sharp to 1/256 of a square."""

Length = Annotated[float, Field(gt=0.0, le=1000.0)]
Albedo = Annotated[float, Field(ge=0.0, le=1.0)]
Color = tuple[Albedo, Albedo, Albedo]


class BoxShape(BaseConfig):
    """A box about the origin of the body."""

    kind: Literal["box"] = "box"
    size_m: tuple[Length, Length, Length] = (0.4, 0.4, 0.4)
    """Lengths of the edges along x, y and z of the body [m]."""


class SphereShape(BaseConfig):
    """A sphere about the origin of the body."""

    kind: Literal["sphere"] = "sphere"
    radius_m: Length = 0.2
    """Radius [m]."""


class CylinderShape(BaseConfig):
    """A closed cylinder about the z axis of the body, its middle in the origin."""

    kind: Literal["cylinder"] = "cylinder"
    radius_m: Length = 0.2
    """Radius [m]."""
    length_m: Length = 0.4
    """Length along the axis [m]."""


class MeshShape(BaseConfig):
    """A mesh file; its origin is that of the body."""

    kind: Literal["mesh"] = "mesh"
    file: Path
    """glTF, GLB, OBJ, PLY, STL or another format that trimesh reads."""
    unit_m: float | None = Field(default=None, gt=0.0)
    """Length of one unit of the file [m], 0.001 for millimetres. null: what the file or its format says."""
    up_axis: Axis | None = None
    """Axis of the file that becomes z of the body. null: as for scenes (`MeshSceneConfig.up_axis`)."""
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset of every point, after units and axes [m]: moves the centre of rotation to the origin."""


class PlainSurface(BaseConfig):
    """One colour."""

    kind: Literal["plain"] = "plain"
    color: Color = (0.6, 0.6, 0.6)
    """Albedo, linear red, green, blue in [0, 1]."""


class CheckerSurface(BaseConfig):
    """Squares of two colours, aligned with the edges of a face; whole squares around round shapes."""

    kind: Literal["checker"] = "checker"
    square_m: Length = 0.1
    """Width of a square [m]; around a sphere or cylinder, the nearest that fits a whole number of times."""
    color: Color = (0.8, 0.8, 0.8)
    """Albedo of the square in the corner of a face, linear red, green, blue in [0, 1]."""
    other_color: Color = (0.05, 0.05, 0.05)
    """Albedo of its neighbours, likewise."""


class PictureSurface(BaseConfig):
    """A picture that repeats, upright on a face; a whole number of times around round shapes."""

    kind: Literal["picture"] = "picture"
    file: Path
    """PNG, JPEG or the like, 8-bit sRGB."""
    width_m: Length = 0.4
    """Width of the picture on the body [m]; around a sphere or cylinder, the nearest that fits."""


ShapeConfig = Annotated[
    BoxShape | SphereShape | CylinderShape | MeshShape,
    Field(discriminator="kind"),
]
SurfaceConfig = Annotated[
    PlainSurface | CheckerSurface | PictureSurface,
    Field(discriminator="kind"),
]


def make_solid(shape: ShapeConfig, surface: SurfaceConfig | None, *, name: str) -> Scene:
    """Return a shape as one instance in the frame O of its body, without lights.

    Without a surface it is grey, and a mesh as its file says.

    Raises:
        SceneError: A file cannot be used, or a mesh is asked to wear a pattern.
    """
    if isinstance(shape, MeshShape):
        return _mesh(shape, surface, name)
    material, period_m = _material(surface or PlainSurface(), name)
    part = _part(shape, period_m)
    return Scene(
        name=name,
        vertices=part.vertices.astype(np.float32),
        normals=part.normals.astype(np.float32),
        uv=part.uv.astype(np.float32),
        faces=part.faces.astype(np.int32),
        face_material=np.zeros(len(part.faces), dtype=np.int32),
        face_instance=np.zeros(len(part.faces), dtype=np.int32),
        instance_names=(name,),
        materials=(material,),
    )


def _material(surface: SurfaceConfig, name: str) -> tuple[Material, tuple[float, float]]:
    """Return the material of a surface, and width and height of what repeats on it [m]."""
    if isinstance(surface, PlainSurface):
        return Material(name=name, base_color=surface.color), (1.0, 1.0)
    if isinstance(surface, CheckerSurface):
        rows, columns = np.indices((_CHECKER_PX, _CHECKER_PX)) * 2 // _CHECKER_PX
        corner = (rows + columns) % 2 == 1  # row 0 is the top: the square at u = v = 0 is in the last row
        colors: list[LinearRgb] = [surface.other_color, surface.color]
        texels = linear_to_srgb8(colors)[corner.astype(np.int64)]
        texture = Texture(name=name, srgb=texels)
        period = 2.0 * surface.square_m
        return Material(name=name, base_color=(1.0, 1.0, 1.0), texture=texture), (period, period)
    from neurosim_core.scene.source import decode_picture  # brings a library for pictures

    path = surface.file.expanduser()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: the picture of {name!r} cannot be read ({error.strerror})") from error
    texels = decode_picture(data, file=str(path), name=name)
    height_m = surface.width_m * texels.shape[0] / texels.shape[1]
    texture = Texture(name=name, srgb=texels)
    return Material(name=name, base_color=(1.0, 1.0, 1.0), texture=texture), (surface.width_m, height_m)


def _repeats(length_m: float, period_m: float) -> int:
    return max(1, round(length_m / period_m))


def _part(shape: BoxShape | SphereShape | CylinderShape, period_m: tuple[float, float]) -> Part:
    if isinstance(shape, BoxShape):
        return _box(shape, period_m)
    return _sphere(shape, period_m) if isinstance(shape, SphereShape) else _cylinder(shape, period_m)


def _box(shape: BoxShape, period_m: tuple[float, float]) -> Part:
    half = 0.5 * np.array(shape.size_m)
    sides = []
    for axis in range(3):
        across, up = ((1, 2), (0, 2), (0, 1))[axis]
        for sign in (-1.0, 1.0):
            edge_u, edge_v, corner = np.zeros(3), np.zeros(3), -half.copy()
            outward = sign * (-1.0 if axis == 1 else 1.0)  # x cross z points along -y
            edge_u[across] = outward * shape.size_m[across]
            corner[across] *= outward
            edge_v[up] = shape.size_m[up]
            corner[axis] = sign * half[axis]
            sides.append(picture_quad(corner, edge_u, edge_v))
    part = merge(sides)
    return replace(part, uv=part.uv / period_m)


def _sphere(shape: SphereShape, period_m: tuple[float, float]) -> Part:
    azimuth = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)[None, :]
    height = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _SIDES // 2 + 1)[:, None]
    azimuth, height = np.broadcast_arrays(azimuth, height)
    around = np.where(np.abs(height) < 0.5 * np.pi, np.cos(height), 0.0)
    points = np.stack([around * np.cos(azimuth), around * np.sin(azimuth), np.sin(height)], axis=-1)
    points[:, -1] = points[:, 0]
    girth_m = 2.0 * math.pi * shape.radius_m
    u = azimuth / (2.0 * np.pi) * _repeats(girth_m, period_m[0])
    v = (height / np.pi + 0.5) * _repeats(0.5 * girth_m, period_m[1])
    part = without_slivers(grid_surface(points, np.stack([u, v], axis=-1), normals=points))
    return replace(part, vertices=shape.radius_m * part.vertices)


def _cylinder(shape: CylinderShape, period_m: tuple[float, float]) -> Part:
    azimuth = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    ring = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    ring[-1] = ring[0]
    axis = np.array([0.0, 0.0, 0.5 * shape.length_m])
    rim = shape.radius_m * ring
    u = azimuth / (2.0 * np.pi) * _repeats(2.0 * math.pi * shape.radius_m, period_m[0])
    v = np.array([0.0, shape.length_m / period_m[1]])
    wall = grid_surface(
        np.stack([rim - axis, rim + axis]),
        np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1),
        normals=np.stack([ring, ring]),
    )
    caps = []
    for sign in (-1.0, 1.0):
        points = np.stack([np.zeros_like(rim), rim] if sign < 0.0 else [rim, np.zeros_like(rim)])
        normals = np.broadcast_to([0.0, 0.0, sign], points.shape)
        uv = points[..., :2] * (sign, 1.0) / period_m
        cap = grid_surface(points + sign * axis, uv, normals=normals)
        first, second = np.swapaxes(cap.vertices[cap.faces[:, 1:]] - cap.vertices[cap.faces[:, :1]], 0, 1)
        caps.append(replace(cap, faces=cap.faces[np.cross(first, second)[:, 2] != 0.0]))
    return merge([wall, *caps])


def _mesh(shape: MeshShape, surface: SurfaceConfig | None, name: str) -> Scene:
    if surface is not None and not isinstance(surface, PlainSurface):
        raise SceneError(
            f"body {name!r}: a mesh wears the surface of its file, or a plain one, not {surface.kind!r}"
        )
    from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene  # brings libraries for meshes

    scene = load_mesh_scene(
        MeshSceneConfig(
            file=shape.file, unit_m=shape.unit_m, up_axis=shape.up_axis, position_m=shape.offset_m
        )
    )
    solid = replace(
        scene,
        name=name,
        face_instance=np.zeros_like(scene.face_instance),
        instance_names=(name,),
        lights=(),
        notes=scene.notes[:-1],  # the last is about lights, which a body does not bring
    )
    if surface is None:
        return solid
    plain = Material(name=name, base_color=surface.color)
    return replace(solid, face_material=np.zeros_like(scene.face_material), materials=(plain,))
