"""The generated apartment: the scene that is used when the user names none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from pydantic import Field

from neurosim_core.registry import register
from neurosim_core.scene.apartment.floorplan import make_floor_plan
from neurosim_core.scene.apartment.looks import Palette, Surface
from neurosim_core.scene.apartment.pieces import Piece
from neurosim_core.scene.apartment.rooms import Furnisher
from neurosim_core.scene.apartment.shell import make_shell
from neurosim_core.scene.config import SceneConfig
from neurosim_core.scene.scene import Ambient, Material, Scene, Texture
from neurosim_core.scene.solids import Part, merge

_FLIGHT_HEIGHT_M = 1.4


@register("scene", "apartment")
class ApartmentConfig(SceneConfig):
    """A furnished flat that is generated from a seed."""

    kind: Literal["apartment"] = "apartment"
    """A generated apartment."""
    seed: int = Field(default=7, ge=0)
    """Seed of plan, colours and furniture. The same seed gives the same bytes."""
    rooms: int = Field(default=4, ge=1, le=8)
    """Number of rooms, all connected by doors."""
    ceiling_m: float = Field(default=2.7, ge=2.4, le=4.0)
    """Height of the rooms [m]."""
    door_width_m: float = Field(default=1.05, ge=0.95, le=1.6)
    """Clear width of the doorways [m]; those between living room, kitchen and dining room may be wider."""
    door_height_m: float = Field(default=2.1, ge=1.9, le=2.3)
    """Clear height of the doorways [m]."""
    furniture: float = Field(default=1.0, ge=0.0, le=1.0)
    """Amount of optional furniture, from 0 to 1; 0 leaves what each kind of room must have."""

    def load(self, *, pictures: bool = True) -> Scene:
        """Generate the flat; pictures are painted when they are looked at."""
        return make_apartment(self)


def make_apartment(config: ApartmentConfig) -> Scene:
    """Generate a furnished flat.

    World frame: the middle of the flat is the origin, its floor is z = 0. Objects are named `sofa_1`,
    `floor_2` and so on; without `ceiling_*` and `roof_1` one looks into the flat from above.
    """
    plan, palette = make_floor_plan(config), Palette(config.seed)
    finishes = [palette.finish(room.name, room.role, index) for index, room in enumerate(plan.rooms)]
    pieces = make_shell(plan, finishes, palette.common, config)
    points = []
    for index, (room, finish) in enumerate(zip(plan.rooms, finishes, strict=True)):
        space = Furnisher(room, index, palette, finish, config).furnish()
        pieces.extend(space.pieces)
        points.append(space.roomiest(_FLIGHT_HEIGHT_M))
    name = f"apartment with {config.rooms} room{'s' * (config.rooms > 1)}, seed {config.seed}"
    return assemble(name, pieces, palette, inside_m=max(points)[1])


def assemble(
    name: str, pieces: Sequence[Piece], palette: Palette, *, inside_m: tuple[float, float, float] | None
) -> Scene:
    """Return a scene in which every piece is an object; objects are named `kind_1`, `kind_2` and so on."""
    counts: dict[str, int] = {}
    instances: list[str] = []
    surfaces: dict[Surface, int] = {}
    parts: list[Part] = []
    face_material: list[int] = []
    face_instance: list[int] = []
    for piece in pieces:
        counts[piece.kind] = counts.get(piece.kind, 0) + 1
        for part, surface in piece.parts:
            # Shifts of textures differ from part to part (additive recurrence of the plastic number).
            shift = np.array([0.7548776662, 0.5698402910]) * len(parts) % 1.0
            parts.append(replace(part, uv=part.uv / surface.tile_m + (0.0 if surface.exact else shift)))
            face_material += [surfaces.setdefault(surface, len(surfaces))] * len(part.faces)
            face_instance += [len(instances)] * len(part.faces)
        instances.append(f"{piece.kind}_{counts[piece.kind]}")
    keys = {surface.texture for surface in surfaces if surface.texture is not None}
    textures = {key: Texture(name=key, srgb=partial(palette.paint, key)) for key in keys}
    whole = merge(parts)
    return Scene(
        name=name,
        vertices=whole.vertices.astype(np.float32),
        faces=whole.faces.astype(np.int32),
        normals=whole.normals.astype(np.float32),
        uv=whole.uv.astype(np.float32),
        face_material=np.array(face_material, np.int32),
        face_instance=np.array(face_instance, np.int32),
        instance_names=tuple(instances),
        materials=tuple(
            Material(
                name=surface.name,
                base_color=surface.color,
                texture=textures.get(surface.texture or ""),
                emission=surface.emission,
            )
            for surface in surfaces
        ),
        lights=tuple(light for piece in pieces for light in piece.lights),
        ambient=Ambient(up=(0.3, 0.3, 0.31), down=(0.23, 0.22, 0.21)),
        inside_m=inside_m,
        closed=True,
    )
