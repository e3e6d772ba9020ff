"""The generated apartment: the scene that is used when the user names none."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.scene.apartment.assembly import Assembly, Lamp, Piece, Surface
from neurosim_core.scene.apartment.floorplan import FloorPlan, make_floor_plan, stream
from neurosim_core.scene.apartment.geometry import cylinder, rounded_box
from neurosim_core.scene.apartment.shell import RoomFinish, add_shell
from neurosim_core.scene.apartment.surfaces import TEXTURES, quantize
from neurosim_core.scene.scene import Ambient, Scene
from neurosim_core.settings import Settings


class ApartmentConfig(Settings):
    """A furnished flat that is generated from a seed."""

    kind: Literal["apartment"] = "apartment"
    """A generated apartment."""
    seed: int = Field(default=7, ge=0)
    """Chooses the flat: plan, colours, furniture. The same seed gives the same bytes."""
    rooms: int = Field(default=4, ge=1, le=8)
    """Number of rooms; all of them can be reached through doors."""
    ceiling_m: float = Field(default=2.7, ge=2.4, le=4.0)
    """Height of the rooms [m]."""
    door_width_m: float = Field(default=1.05, ge=0.95, le=1.6)
    """Clear width of the doorways [m]; those between living room, kitchen and dining room may be wider."""
    door_height_m: float = Field(default=2.1, ge=1.9, le=2.3)
    """Clear height of the doorways [m]."""
    furniture: float = Field(default=1.0, ge=0.0, le=1.0)
    """How much of the optional furniture is there; 0 leaves what each kind of room must have."""


def make_apartment(config: ApartmentConfig) -> Scene:
    """Generate a furnished flat.

    World frame: the middle of the flat is the origin, its floor is z = 0. Objects are named `sofa_1`, `floor_2`, …
    """
    plan = make_floor_plan(
        seed=config.seed,
        rooms=config.rooms,
        door_width_m=config.door_width_m,
        door_height_m=config.door_height_m,
        ceiling_m=config.ceiling_m,
    )

    def paint(key: str) -> NDArray[np.uint8]:
        return quantize(TEXTURES[key](stream(config.seed, "texture", key)))

    assembly = Assembly(paint)
    wall = Surface(name="wall", texture="plaster", color=(0.8, 0.75, 0.68), tile_m=(1.6, 1.6))
    white = Surface(name="white paint", texture="plaster", color=(0.85, 0.85, 0.83), tile_m=(1.6, 1.6))
    floor = Surface(name="oak floor", texture="oak planks", tile_m=(1.8, 1.8), exact=True)
    view = Surface(name="sky", emission=(0.6, 0.75, 0.95), color=(0.0, 0.0, 0.0))
    finish = RoomFinish(
        floor=floor, wall=wall, accent=wall, accent_wall=-1, ceiling=white, trim=white, sill=floor, view=view
    )
    add_shell(assembly, plan, {room.name: finish for room in plan.rooms}, ceiling_m=config.ceiling_m)
    for room in plan.rooms:
        x, y = room.rect.center
        table = Piece("table")
        table.add(floor, rounded_box((1.2, 0.7, 0.4), 0.02, center=(0.0, 0.0, 0.202)))
        assembly.place(table.moved((x, y, 0.0)))
        lamp = Piece("pendant", lamps=[Lamp(position=(x, y, 2.1), intensity=(0.9, 0.85, 0.75))])
        lamp.add(
            Surface(name="lamp", emission=(2.0, 1.8, 1.5)),
            cylinder(0.2, 2.15, config.ceiling_m - 0.05, x=x, y=y, edge_m=0.03),
        )
        assembly.place(lamp)
    return assembly.finish(
        f"apartment {config.seed} with {config.rooms} rooms", ambient=Ambient(), inside_m=_inside(plan)
    )


def _inside(plan: FloorPlan) -> tuple[float, float, float]:
    x, y = plan.rooms[0].rect.center
    return x, y, 1.4
