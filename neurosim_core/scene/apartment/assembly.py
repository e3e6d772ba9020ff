"""Collects parts, surfaces, lamps and objects, and turns them into a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.apartment.geometry import Part, merge, turned
from neurosim_core.scene.scene import Ambient, Light, LinearRgb, Material, Scene, Texture


def linear(color: str) -> LinearRgb:
    """Linear light of an sRGB colour such as "#c8a27a" (IEC 61966-2-1)."""
    code = np.array([int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    light = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return float(light[0]), float(light[1]), float(light[2])


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A material and the size of its texture."""

    name: str
    color: LinearRgb = (1.0, 1.0, 1.0)
    """Albedo, or what the texture is multiplied with."""
    texture: str | None = None
    """Key of the texture; see `surfaces.TEXTURES`."""
    tile_m: tuple[float, float] = (1.0, 1.0)
    """Size of one repetition of the texture along u and v [m]."""
    emission: LinearRgb = (0.0, 0.0, 0.0)
    exact: bool = False
    """Whether the texture must lie as the part says (a picture, a pattern across parts), not at random."""


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """A point light of a piece of furniture, in its frame."""

    position: tuple[float, float, float]
    intensity: LinearRgb


@dataclass
class Piece:
    """A piece of furniture, standing on z = 0 with its back to y = 0 and its front towards -y."""

    kind: str
    parts: list[tuple[Part, Surface]] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)

    def add(self, surface: Surface, *parts: Part) -> None:
        """Add parts of one surface."""
        self.parts.extend((part, surface) for part in parts)

    def include(self, other: Piece, offset: tuple[float, float, float], yaw_rad: float = 0.0) -> None:
        """Add all of another piece, turned and shifted."""
        moved = other.moved(offset, yaw_rad)
        self.parts.extend(moved.parts)
        self.lamps.extend(moved.lamps)

    def moved(self, offset: tuple[float, float, float], yaw_rad: float = 0.0) -> Piece:
        """The piece turned about its z axis, then shifted [m]."""
        lamps = []
        for lamp in self.lamps:
            at = turned(np.array(lamp.position), yaw_rad, axis=2) + np.asarray(offset)
            lamps.append(replace(lamp, position=(float(at[0]), float(at[1]), float(at[2]))))
        parts = [(part.moved(offset, yaw_rad=yaw_rad), surface) for part, surface in self.parts]
        return Piece(kind=self.kind, parts=parts, lamps=lamps)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m], shape [2, 3]."""
        points = np.concatenate([part.vertices for part, _ in self.parts])
        return np.stack([points.min(axis=0), points.max(axis=0)])


class Assembly:
    """A scene under construction."""

    def __init__(self, paint: Callable[[str], NDArray[np.uint8]]) -> None:
        self._paint = paint
        self._textures: dict[str, Texture] = {}
        self._materials: dict[Surface, int] = {}
        self._material_list: list[Material] = []
        self._instances: list[str] = []
        self._counts: dict[str, int] = {}
        self._parts: list[Part] = []
        self._face_material: list[NDArray[np.int32]] = []
        self._face_instance: list[NDArray[np.int32]] = []
        self._lights: list[Light] = []

    def instance(self, kind: str) -> int:
        """A new object; objects are named `kind_1`, `kind_2` and so on."""
        self._counts[kind] = self._counts.get(kind, 0) + 1
        self._instances.append(f"{kind}_{self._counts[kind]}")
        return len(self._instances) - 1

    def add(self, instance: int, surface: Surface, *parts: Part) -> None:
        """Add parts of one surface to an object."""
        for part in parts:
            shift = np.zeros(2) if surface.exact else _scatter(len(self._parts))
            self._parts.append(replace(part, uv=part.uv / np.array(surface.tile_m) + shift))
            self._face_material.append(np.full(len(part.faces), self._material(surface), np.int32))
            self._face_instance.append(np.full(len(part.faces), instance, np.int32))

    def place(self, piece: Piece) -> None:
        """Add a piece that stands where it shall stand, as one object, with its lamps."""
        instance = self.instance(piece.kind)
        for part, surface in piece.parts:
            self.add(instance, surface, part)
        self._lights.extend(Light(position_m=lamp.position, intensity=lamp.intensity) for lamp in piece.lamps)

    def _material(self, surface: Surface) -> int:
        if surface not in self._materials:
            key = surface.texture
            if key is not None and key not in self._textures:
                self._textures[key] = Texture(name=key, srgb=partial(self._paint, key))
            self._materials[surface] = len(self._material_list)
            self._material_list.append(
                Material(
                    name=surface.name,
                    base_color=surface.color,
                    texture=None if key is None else self._textures[key],
                    emission=surface.emission,
                )
            )
        return self._materials[surface]

    def finish(
        self, name: str, *, ambient: Ambient, inside_m: tuple[float, float, float], notes: Iterable[str] = ()
    ) -> Scene:
        """The scene."""
        whole = merge(self._parts)
        return Scene(
            name=name,
            vertices=whole.vertices.astype(np.float32),
            faces=whole.faces.astype(np.int32),
            normals=whole.normals.astype(np.float32),
            uv=whole.uv.astype(np.float32),
            face_material=np.concatenate(self._face_material),
            face_instance=np.concatenate(self._face_instance),
            instance_names=tuple(self._instances),
            materials=tuple(self._material_list),
            lights=tuple(self._lights),
            ambient=ambient,
            notes=tuple(notes),
            inside_m=inside_m,
        )


def _scatter(count: int) -> NDArray[np.float64]:
    """A shift of the texture that differs from part to part (additive recurrence of the plastic number)."""
    return np.array([0.7548776662, 0.5698402910]) * count % 1.0
