"""Collects pieces and turns them into a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.apartment.geometry import Part, merge
from neurosim_core.scene.apartment.looks import Surface
from neurosim_core.scene.apartment.pieces import Piece
from neurosim_core.scene.scene import Ambient, Light, Material, Scene, Texture


class Assembly:
    """A scene under construction."""

    def __init__(self, paint: Callable[[str], NDArray[np.uint8]]) -> None:
        """Take what paints the texture of a key."""
        self._paint = paint
        self._textures: dict[str, Texture] = {}
        self._surfaces: dict[Surface, int] = {}
        self._counts: dict[str, int] = {}
        self._instances: list[str] = []
        self._parts: list[Part] = []
        self._face_material: list[NDArray[np.int32]] = []
        self._face_instance: list[NDArray[np.int32]] = []
        self._lights: list[Light] = []

    def add(self, kind: str, parts: Sequence[tuple[Part, Surface]]) -> None:
        """Add an object; objects are named `kind_1`, `kind_2` and so on."""
        self._counts[kind] = self._counts.get(kind, 0) + 1
        for part, surface in parts:
            # Shifts of textures differ from part to part (additive recurrence of the plastic number).
            shift = np.array([0.7548776662, 0.5698402910]) * len(self._parts) % 1.0
            uv = part.uv / surface.tile_m + (0.0 if surface.exact else shift)
            self._parts.append(replace(part, uv=uv))
            material = self._surfaces.setdefault(surface, len(self._surfaces))
            self._face_material.append(np.full(len(part.faces), material, np.int32))
            self._face_instance.append(np.full(len(part.faces), len(self._instances), np.int32))
        self._instances.append(f"{kind}_{self._counts[kind]}")

    def place(self, piece: Piece) -> None:
        """Add a piece that stands where it shall stand, as one object, with its lights."""
        self.add(piece.kind, piece.parts)
        self._lights.extend(piece.lights)

    def _material(self, surface: Surface) -> Material:
        key, texture = surface.texture, None
        if key is not None:
            texture = self._textures.setdefault(key, Texture(name=key, srgb=partial(self._paint, key)))
        return Material(
            name=surface.name, base_color=surface.color, texture=texture, emission=surface.emission
        )

    def finish(self, name: str, *, ambient: Ambient, inside_m: tuple[float, float, float]) -> Scene:
        """Return the scene."""
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
            materials=tuple(self._material(surface) for surface in self._surfaces),
            lights=tuple(self._lights),
            ambient=ambient,
            inside_m=inside_m,
        )
