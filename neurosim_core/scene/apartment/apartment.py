"""The generated apartment: the scene that is used when the user names none."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neurosim_core.scene.apartment.assembly import Assembly
from neurosim_core.scene.apartment.floorplan import make_floor_plan
from neurosim_core.scene.apartment.looks import Palette
from neurosim_core.scene.apartment.rooms import furnish
from neurosim_core.scene.apartment.shell import add_shell
from neurosim_core.scene.scene import Ambient, Scene
from neurosim_core.settings import Settings

_FLIGHT_HEIGHT_M = 1.4


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

    World frame: the middle of the flat is the origin, its floor is z = 0. Objects are named `sofa_1`,
    `floor_2` and so on; without `ceiling_*` and `roof_1` one looks into the flat from above.
    """
    plan = make_floor_plan(
        seed=config.seed,
        rooms=config.rooms,
        door_width_m=config.door_width_m,
        door_height_m=config.door_height_m,
        ceiling_m=config.ceiling_m,
    )

    palette = Palette(config.seed)
    assembly = Assembly(palette.paint)
    finishes = {
        room.name: palette.finish(room.name, room.role, index) for index, room in enumerate(plan.rooms)
    }
    add_shell(assembly, plan, finishes, palette.common, ceiling_m=config.ceiling_m)
    spaces = [
        furnish(
            room,
            index,
            assembly,
            palette,
            finishes[room.name],
            seed=config.seed,
            density=config.furniture,
            ceiling_m=config.ceiling_m,
        )
        for index, room in enumerate(plan.rooms)
    ]
    return assembly.finish(
        f"apartment with {config.rooms} room{'s' * (config.rooms > 1)}, seed {config.seed}",
        ambient=Ambient(up=(0.3, 0.3, 0.31), down=(0.23, 0.22, 0.21)),
        inside_m=max(space.roomiest(_FLIGHT_HEIGHT_M) for space in spaces)[1],
    )
