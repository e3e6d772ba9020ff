"""Mesh files as scenes: glTF, GLB, OBJ, PLY, STL and whatever else trimesh reads."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.registry import register
from neurosim_core.scene.config import SceneConfig
from neurosim_core.scene.gltf import read_gltf
from neurosim_core.scene.lamps import lights_of
from neurosim_core.scene.scene import Ambient, LinearRgb, Material, Scene, Texture, extent
from neurosim_core.scene.source import (
    Axis,
    Part,
    SceneError,
    Source,
    rgb,
)
from neurosim_core.scene.srgb import linear_to_srgb8
from neurosim_core.scene.topology import smooth_normals
from neurosim_core.scene.triangles import corner_columns, cross, dot, face_vectors

__all__ = ["MeshSceneConfig", "SceneError", "load_mesh_scene"]

_GLTF = frozenset({"gltf", "glb"})
_EXTENT_MAX_M = 20_000.0
_FAR_M = 100.0
"""From here on the origin of a scene is moved [m]: float32 rounds to 8 um."""
_STOREY_M = (1.8, 15.0)
"""Heights that a building is taken to have, from one low room to a hall [m]."""
_LEVEL_RAD = math.radians(2.0)
"""How far a level or upright surface of a building may lean."""
_COLOR_WIDTH = 4096
"""Widest texture that vertex colours are packed into [px]."""


@register("scene", "mesh")
class MeshSceneConfig(SceneConfig):
    """A scene that is read from a mesh file."""

    kind: Literal["mesh"] = "mesh"
    """Kind of scene: a mesh file."""
    file: Path
    """glTF, GLB, OBJ, PLY, STL or another format that trimesh reads."""
    unit_m: float | None = Field(default=None, gt=0.0)
    """Length of one unit of the file [m], 0.001 for millimetres. null: what the file or its format says."""
    up_axis: Axis | None = None
    """Axis of the file that points up: x, y or z. null: what the file says, else y or z where the scene looks
    like a building that stands upright along it, else the default of its format."""
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset of every point, after units and axes [m]. A scene that then lies more than 100 m from the origin
    along an axis is moved there, by whole metres, and a note says by how much."""
    inside_m: tuple[float, float, float] | None = None
    """A point in the space to fly in, such as a room of the loaded scene [m]. null: unknown."""
    light_scale: float | None = Field(default=None, gt=0.0)
    """Radiance reflected at 1 m per candela of the lights in the file; refused where the file has no lights.
    null: a factor that lights the rooms well."""
    missing_texture: Literal["error", "ignore"] = "error"
    """Response to a missing texture file. error: stop; ignore: use the base colour alone."""
    ambient_up: LinearRgb = (0.35, 0.35, 0.36)
    """Linear RGB radiance of a white surface that faces up, from ambient light alone."""
    ambient_down: LinearRgb = (0.22, 0.21, 0.20)
    """Linear RGB radiance of a white surface that faces down, from ambient light alone."""

    def load(self, *, pictures: bool = True) -> Scene:
        """Read the mesh file; see `load_mesh_scene`."""
        return load_mesh_scene(self, pictures=pictures)


DEFAULT_KIND = "apartment"
"""Kind of a scene whose settings neither say it nor have keys of a mesh."""


def scene_kind(settings: Mapping[str, Any]) -> str:
    """Return the kind of a scene as its settings say it, or show it by their keys."""
    only_mesh = MeshSceneConfig.model_fields.keys() - {"kind"} | {"path"}
    return str(settings.get("kind", DEFAULT_KIND if only_mesh.isdisjoint(settings) else "mesh"))


def load_mesh_scene(config: MeshSceneConfig, *, pictures: bool = True, decode: bool = True) -> Scene:
    """Read a mesh file: every instance in metres, z up, with materials, textures and lights.

    Every assumption that was made is a sentence in the scene's `notes`. Transparent and metallic materials
    become opaque Lambertian ones. Vertex and face colours become a texture in which each face has its own two
    by two texels: bilinear lookup between three texel centres gives the linear blend of its corners. Lights
    come from KHR_lights_punctual; where there is none, lamps are hung under the ceilings. Without `pictures`
    textures of glTF are decoded when they are first looked at, if ever: until then no library is imported for
    them, and an emissive texture counts as white. Without `decode` none but emissive ones are decoded now.

    Raises:
        SceneError: If the file is missing, of an unknown format, truncated or malformed; if a texture is
            missing or cannot be decoded; if a vertex in use is not finite; if no face is left; if the scene
            reaches farther than 20 km from its origin; if there are no lights to scale by `light_scale`.
    """
    path = config.file.expanduser()
    source = _read(path, config, pictures)
    notes = list(source.notes)
    unit_m, sentence = _unit(config, source)
    notes.insert(0, sentence)
    if not any(len(part.faces) for part in source.parts):
        raise SceneError(f"{path}: empty, there are no triangles in it")
    parts = source.parts
    thin = [_place(part, path) for part in parts]
    axis, sentence = _up_axis(config, source, parts, unit_m)
    notes.insert(1, sentence)
    turn = unit_m * _TURN[axis]
    for part in parts:
        part.positions = part.positions @ turn.T + config.position_m
        if part.normals is not None:
            part.normals = part.normals @ _TURN[axis].T
    boxes = np.stack([extent(part.positions.take(part.faces, axis=0)) for part in parts if len(part.faces)])
    origin = _origin(boxes)
    for part in parts:
        part.positions = part.positions - origin
    if origin.any():
        notes.append(
            f"The scene lies far from the origin: {origin.tolist()} m was subtracted from its coordinates; "
            "all places in settings and recordings count from there."
        )
    _check_extent(boxes - origin, path)

    positions, faces, keep = _joined(parts, thin, notes, path)
    corners = corner_columns(positions, faces)
    with ThreadPoolExecutor(max_workers=1) as aside:
        shift_m, told = np.array(config.position_m) - origin, list[str]()
        lighting = aside.submit(
            lights_of, source, config.light_scale, corners, told, turn=turn, shift_m=shift_m, path=path
        )
        arrays = _assembled(parts, positions, faces, keep, source, notes)
        lights = lighting.result()
    notes += told
    size = np.ptp(corners, axis=(1, 2))
    if config.unit_m is None and not 0.02 <= size.max() <= 500.0:
        across = f"{size.max():,.0f}" if size.max() > 1.0 else f"{size.max():.3g}"
        notes.insert(0, f"It is {across} m across; if that is wrong, declare unit_m (0.001 for millimetres).")
    scene = Scene(
        name=path.stem,
        lights=lights,
        ambient=Ambient(up=config.ambient_up, down=config.ambient_down),
        instance_names=tuple(source.instance_names),
        instance_labels=source.instance_labels,
        notes=tuple(notes),
        inside_m=config.inside_m,
        origin_m=(float(origin[0]), float(origin[1]), float(origin[2])),
        **arrays,
    )
    if pictures and decode:  # at the end: what threads do of it in Python would hold up the rest
        textures = dict.fromkeys(m.texture for m in scene.materials if m.texture is not None)
        with ThreadPoolExecutor() as threads:  # Pillow releases the interpreter lock
            list(threads.map(Texture.decode, textures))
    return scene


def _read(path: Path, config: MeshSceneConfig, pictures: bool) -> Source:
    if path.is_dir():
        raise SceneError(f"{path}: a directory; name a mesh file in it ({_formats()})")
    if not path.exists():
        raise SceneError(f"{path}: no such file (looked from {Path.cwd()})")
    suffix = path.suffix.lower().lstrip(".")
    required = config.missing_texture == "error"
    if suffix in _GLTF:
        _check_size(path)
        return read_gltf(path, textures_required=required, pictures=pictures)

    from neurosim_core.scene.trimesh_reader import formats, read_with_trimesh  # takes a second

    if suffix not in formats():
        raise SceneError(f"{path}: unknown format {path.suffix!r}, known: {_formats()}")
    _check_size(path)
    return read_with_trimesh(path, suffix, textures_required=required)


def _check_size(path: Path) -> None:
    if path.stat().st_size == 0:
        raise SceneError(f"{path}: empty, the file has no bytes")


def _formats() -> str:
    """Return the suffixes of the files that can be read."""
    from neurosim_core.scene.trimesh_reader import formats

    return ", ".join(sorted(formats() | _GLTF))


_TURN: dict[str, NDArray[np.float64]] = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
}
"""Rotation that turns the axis up."""


def _unit(config: MeshSceneConfig, source: Source) -> tuple[float, str]:
    if config.unit_m is not None:
        return config.unit_m, f"Unit: {config.unit_m:g} m, as declared."
    return source.unit_m, f"Unit: {source.unit_m:g} m; {source.unit_reason}."


def _up_axis(config: MeshSceneConfig, source: Source, parts: list[Part], unit_m: float) -> tuple[Axis, str]:
    if config.up_axis is not None:
        return config.up_axis, f"Up axis: {config.up_axis}, as declared."
    looks = _looks_up(parts, unit_m)
    if source.up_axis is not None:
        doubt = ""
        if looks not in (None, source.up_axis):
            doubt = f" Its geometry looks {looks} up; declare up_axis if it lies on its side."
        return source.up_axis, f"Up axis: {source.up_axis}; {source.up_reason}.{doubt}"
    if looks is not None:
        return looks, (
            f"Up axis: {looks}, from the geometry (a building: floors at several heights, walls around "
            f"them); {source.up_reason}. Declare up_axis to be sure."
        )
    return source.up_default, (
        f"Up axis: {source.up_default}, by default; {source.up_reason}, and the geometry shows no building. "
        "Declare up_axis to be sure."
    )


def _looks_up(parts: list[Part], unit_m: float) -> Axis | None:
    """Return the axis, y or z, along which a building stands in the file; None if no building is seen.

    A building is flatter along its up axis than 0.6 of both other extents and as high as `_STOREY_M`. More
    surface is level in it (floors, ceilings, table tops) than faces any other axis, and that at three heights
    or more, which a lone box has not. Upright surface faces both other axes, at least half of one full wall
    each, which a stage set, a hill or a ball on a plane has not.
    """
    corners = unit_m * np.concatenate([corner_columns(part.positions, part.faces) for part in parts], axis=2)
    size = np.ptp(corners, axis=(1, 2))
    axis = int(np.argmin(size))
    first, second = (other for other in range(3) if other != axis)
    low, high = _STOREY_M
    if axis == 0 or not low <= size[axis] <= min(high, 0.6 * size[first], 0.6 * size[second]):
        return None
    normal = 0.5 * face_vectors(corners)
    area = np.sqrt(dot(normal, normal))
    facing = np.abs(normal) > math.cos(_LEVEL_RAD) * area
    amount = facing @ area
    upright = np.abs(normal[axis]) < math.sin(_LEVEL_RAD) * area
    walls = (normal[:, upright] ** 2 / area[upright]).sum(axis=1)  # area times the squared cosine
    if (
        int(np.argmax(amount)) != axis
        or walls[first] < 0.5 * size[axis] * size[second]
        or walls[second] < 0.5 * size[axis] * size[first]
    ):
        return None
    level = facing[axis]
    height = corners[axis][:, level].mean(axis=0)
    order = np.argsort(height)
    floor = np.cumsum(np.diff(height[order], prepend=height[order[0]]) > 0.05)  # 5 cm apart: another one
    floors = np.bincount(floor, weights=area[level][order])
    return ("x", "y", "z")[axis] if (floors > 0.002 * amount[axis]).sum() >= 3 else None


def _origin(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return whole metres to subtract along axes on which parts [P, 2, 3] are far from 0, shape [3]."""
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    away = np.maximum(low, -high)  # negative where 0 is within
    return np.asarray(np.where(away > _FAR_M, np.rint(0.5 * (low + high)), 0.0))


def _check_extent(boxes: NDArray[np.float64], path: Path) -> None:
    far = float(np.abs(boxes).max())
    if far > _EXTENT_MAX_M:
        raise SceneError(
            f"{path}: reaches {far:,.0f} m from the origin, allowed are {_EXTENT_MAX_M:,.0f} m; declare "
            "unit_m (0.001 for millimetres)"
        )


def _place(part: Part, path: Path) -> NDArray[np.bool_]:
    """Apply the transform of a part, for file units and axes; return which of its faces are lines."""
    bad = 0
    if not np.isfinite(part.positions).all():  # those in no face may be anything
        bad = int((~np.isfinite(part.positions[part.faces.reshape(-1)]).all(axis=1)).sum())
    if bad or not np.isfinite(part.matrix).all():
        what = f"{bad} corners of its faces" if bad else "its transform"
        raise SceneError(
            f"{path}: {part.name!r} has NaN or infinite numbers in {what}; finite ones are needed"
        )
    thin, linear = _is_thin(corner_columns(part.positions, part.faces)), part.matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # vertices in no face may be anything
        part.positions = part.positions @ linear.T + part.matrix[:3, 3]
    mirrored = np.linalg.det(linear) < 0.0
    if mirrored:
        part.faces = part.faces[:, ::-1]
        part.corner_color = None if part.corner_color is None else part.corner_color[:, ::-1]
    if part.normals is not None:
        # cofactors turn normals, also where the matrix is singular; a mirror would turn them inside out
        cofactor = np.stack([np.cross(linear[(k + 1) % 3], linear[(k + 2) % 3]) for k in range(3)])
        part.normals = part.normals @ cofactor.T * (-1.0 if mirrored else 1.0)
    return thin


def _is_thin(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which triangles [axis, corner, F] are lower than 1e-7 of their longest edges: float32 lines."""
    edge = np.roll(corners, -1, axis=1) - corners
    longest_squared = dot(edge, edge).max(axis=0)
    normal = cross(edge[:, 0], edge[:, 1])
    return np.asarray(dot(normal, normal) <= (1e-7 * longest_squared) ** 2)


def _joined(
    parts: list[Part], thin_of: list[NDArray[np.bool_]], notes: list[str], path: Path
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the vertices of all parts as a scene rounds them, faces that have an area, and which have."""
    start = np.cumsum([0, *(len(part.positions) for part in parts)])
    positions = np.concatenate([part.positions for part in parts]).astype(np.float32).astype(np.float64)
    faces = np.concatenate([part.faces + first for part, first in zip(parts, start, strict=False)])
    # in the file's numbers, where a line is still exactly one, and as the scene stores them
    thin = np.concatenate(thin_of) | _is_thin(corner_columns(positions, faces))
    if thin.any():
        notes.append(f"{int(thin.sum())} of {len(faces)} faces have no area and are dropped.")
    if thin.all():
        raise SceneError(f"{path}: empty, none of its {len(faces)} faces has an area")
    return positions, faces[~thin], ~thin


def _assembled(
    parts: list[Part],
    positions: NDArray[np.float64],
    faces: NDArray[np.int64],
    keep: NDArray[np.bool_],
    source: Source,
    notes: list[str],
) -> dict[str, Any]:
    """Join parts into the arrays of a scene, without unused vertices; see `_joined`."""
    count = [len(part.faces) for part in parts]
    material = np.repeat([part.material for part in parts], count)[keep]
    instance = np.repeat([part.instance for part in parts], count)[keep]
    owner = np.repeat(np.arange(len(parts)), [len(part.positions) for part in parts])
    uv = np.concatenate([np.zeros((len(p.positions), 2)) if p.uv is None else p.uv for p in parts])
    used_uv = uv[faces.reshape(-1)]
    if not np.isfinite(used_uv).all():
        notes.append("Texture coordinates that are not finite are taken as 0.")
        uv = np.where(np.isfinite(uv), uv, 0.0)
    normals = np.concatenate(
        [np.zeros((len(p.positions), 3)) if p.normals is None else p.normals for p in parts]
    )
    length = np.linalg.norm(normals, axis=1)
    given = np.isfinite(length) & (length > 0.0)
    normals = normals / np.where(given, length, 1.0)[:, None]

    corner_vertex, corner_normal = faces.reshape(-1), np.full(faces.size, -1, dtype=np.int64)
    lacking = ~given.take(faces.T).all(axis=0)
    computed = np.zeros((0, 3))
    if lacking.any():
        computed, label = smooth_normals(positions, faces[lacking], owner)
        corner_normal.reshape(-1, 3)[lacking] = label
        if lacking.any():
            notes.append(
                f"{int(lacking.sum())} faces come without normals; they are computed, sharp at creases."
            )

    colors = [np.ones((len(p.faces), 3, 3)) if p.corner_color is None else p.corner_color for p in parts]
    tinted = np.repeat([p.corner_color is not None for p in parts], count)[keep]
    materials = list(source.materials)
    color_uv: NDArray[np.float64] | None = None
    if tinted.any():
        material, color_uv, tinted = _tint(np.concatenate(colors)[keep], tinted, material, materials, notes)

    # one vertex for each distinct pair of file vertex and normal; corners of tinted faces are never shared
    apart = np.repeat(tinted, 3)
    key = corner_vertex << 33 | (corner_normal + 1) << 1 | apart
    order = np.argsort(key, kind="stable")
    new = np.ones(len(key), dtype=bool)
    new[1:] = (key[order[1:]] != key[order[:-1]]) | apart[order[1:]] | apart[order[:-1]]
    index = np.empty(len(key), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    first = order[new]
    vertex, normal = corner_vertex[first], corner_normal[first]
    final_normals = normals[vertex]
    final_normals[normal >= 0] = computed[normal[normal >= 0]]
    final_uv = uv[vertex]
    if color_uv is not None:
        final_uv = np.where(apart[first][:, None], color_uv[first], final_uv)

    used = np.flatnonzero(np.bincount(material))
    face_material = np.searchsorted(used, material)
    return {
        "vertices": positions[vertex].astype(np.float32),
        "faces": index.reshape(-1, 3).astype(np.int32),
        "normals": final_normals.astype(np.float32),
        "uv": final_uv.astype(np.float32),
        "face_material": face_material.astype(np.int32),
        "face_instance": instance.astype(np.int32),
        "materials": tuple(materials[i] for i in used),
    }


def _tint(
    color: NDArray[np.float64],
    tinted: NDArray[np.bool_],
    material: NDArray[np.int64],
    materials: list[Material],
    notes: list[str],
) -> tuple[NDArray[np.int64], NDArray[np.float64] | None, NDArray[np.bool_]]:
    """Turn corner colours [F, 3, 3] into materials and texture coordinates.

    Returns:
        Material of each face, texture coordinates of each corner [3F, 2] (None: no texture), and which faces
        use them.
    """
    material = material.copy()
    textured = np.array([m.texture is not None for m in materials])[material]
    plain = tinted & ~textured
    if (tinted & textured).any():
        notes.append("Vertex colours of textured faces are left out.")
    color_uv = None
    patched = np.zeros(len(color), dtype=bool)
    for index in np.unique(material[plain]):
        here = plain & (material == index)
        base = materials[index]
        shade = np.clip(color[here], 0.0, 1.0) * base.base_color
        if np.ptp(shade, axis=(0, 1)).max() < 1e-3:
            materials.append(
                Material(name=base.name, base_color=rgb(shade.mean(axis=(0, 1))), emission=base.emission)
            )
        else:
            texture, uv = _patches(shade, base.name)
            materials.append(
                Material(name=base.name, base_color=(1.0, 1.0, 1.0), texture=texture, emission=base.emission)
            )
            color_uv = np.zeros((len(color), 3, 2)) if color_uv is None else color_uv
            color_uv[here] = uv
            patched |= here
        material[here] = len(materials) - 1
    if patched.any():
        notes.append(
            f"Colours of {int(patched.sum())} faces are packed into textures, two by two texels to a face."
        )
    return material, None if color_uv is None else color_uv.reshape(-1, 2), patched


def _patches(color: NDArray[np.float64], name: str) -> tuple[Texture, NDArray[np.float64]]:
    """Pack corner colours [F, 3, 3] into a texture, two by two texels to a face, in the order of the faces.

    Corners sit at three texel centres and the fourth texel continues the plane through them, so the bilinear
    lookup is the linear blend of the corners, up to 8 bits and to clipping of the fourth.
    """
    side = 2 ** math.ceil(math.log2(2.0 * math.sqrt(len(color))))
    width = min(side, _COLOR_WIDTH)
    columns = width // 2
    rows = -(-len(color) // columns)
    height = 2 * rows
    texels = np.zeros((rows * columns, 2, 2, 3))
    texels[: len(color), 0, 0] = color[:, 0]
    texels[: len(color), 0, 1] = color[:, 1]
    texels[: len(color), 1, 0] = color[:, 2]
    texels[: len(color), 1, 1] = color[:, 1] + color[:, 2] - color[:, 0]
    texels[len(color) :] = color.mean(axis=(0, 1))
    image = texels.reshape(rows, columns, 2, 2, 3).transpose(0, 2, 1, 3, 4).reshape(height, width, 3)
    face = np.arange(len(color))
    column, row = 2 * (face % columns), 2 * (face // columns)
    at = np.stack([column, row], axis=1)[:, None] + np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
    uv = at / [width, height]
    uv[:, :, 1] = 1.0 - uv[:, :, 1]
    return Texture(name=f"{name} (vertex colours)", srgb=linear_to_srgb8(image)), uv
