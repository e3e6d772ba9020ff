"""A hall with boxes: pillars, shelves or the bars of gates, wherever the settings say."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from neurosim_core.frames import Vector3
from neurosim_core.registry import register
from neurosim_core.scene.apartment.apartment import assemble
from neurosim_core.scene.apartment.looks import Palette, Surface
from neurosim_core.scene.apartment.pieces import Piece
from neurosim_core.scene.config import SceneConfig
from neurosim_core.scene.scene import Light, Scene
from neurosim_core.scene.solids import box, quad
from neurosim_core.settings import BaseConfig

_LAMPS_APART_M = 8.0
_POSTER_M = 2.0
_LOOKS = 6
"""Prints and fabrics that boxes take turns in."""

Length = Annotated[float, Field(gt=0.0)]


class BoxConfig(BaseConfig):
    """A box in a hall."""

    position_m: Vector3
    """Centre in the world [m]."""
    size_m: tuple[Length, Length, Length]
    """Edge lengths along its own x, y and z [m]."""
    yaw_rad: float = 0.0
    """Rotation about z [rad]."""


@register("scene", "hall")
class HallConfig(SceneConfig):
    """A hall with boxes in it; the middle of its floor is the origin."""

    kind: Literal["hall"] = "hall"
    """A hall with boxes."""
    size_m: tuple[Length, Length, Length] = (20.0, 12.0, 4.0)
    """Edge lengths along x, y and z [m]."""
    boxes: tuple[BoxConfig, ...] = ()
    """Boxes that stand or hang in it; they may intersect each other."""
    seed: int = Field(default=0, ge=0)
    """Seed of colours and patterns."""
    inside_m: Vector3 | None = None
    """A point in free space [m]; null: a search finds one."""

    def load(self, *, pictures: bool = True) -> Scene:
        """Build the hall; pictures are painted when they are looked at."""
        return make_hall(self)


def make_hall(config: HallConfig) -> Scene:
    """Build a hall: lamps under the ceiling, walls and boxes with prints that an event camera sees well."""
    palette = Palette(config.seed)
    x, y, z = config.size_m
    finish = palette.finish("hall", "living", 0)
    prints = [palette.poster(index, _POSTER_M, _POSTER_M) for index in range(_LOOKS)]
    looks = [palette.look(f"box {index}") for index in range(_LOOKS)]
    fabrics = [look[name] for look in looks for name in ("front", "fabric", "knit")]

    def panel(kind: str, corner: Vector3, u: Vector3, v: Vector3, surface: Surface) -> Piece:
        return Piece(kind, [(quad(corner, u, v), surface)])

    a, b = 0.5 * x, 0.5 * y
    pieces = [
        panel("floor", (-a, -b, 0.0), (x, 0.0, 0.0), (0.0, y, 0.0), finish.floor),
        panel("ceiling", (-a, b, z), (x, 0.0, 0.0), (0.0, -y, 0.0), palette.common["ceiling"]),
        panel("wall", (-a, b, 0.0), (x, 0.0, 0.0), (0.0, 0.0, z), prints[0]),
        panel("wall", (a, -b, 0.0), (-x, 0.0, 0.0), (0.0, 0.0, z), prints[1]),
        panel("wall", (a, b, 0.0), (0.0, -y, 0.0), (0.0, 0.0, z), prints[2]),
        panel("wall", (-a, -b, 0.0), (0.0, y, 0.0), (0.0, 0.0, z), prints[3]),
    ]
    rng = np.random.default_rng(config.seed)
    for each in config.boxes:
        chosen = prints if rng.random() < 0.5 else fabrics
        surface = chosen[int(rng.integers(len(chosen)))]
        part = box(each.size_m).moved(each.position_m, yaw_rad=each.yaw_rad)
        pieces.append(Piece("box", [(part, surface)]))
    counts = [max(round(side / _LAMPS_APART_M), 1) for side in (x, y)]
    strength = 0.35 * z * z
    for i, j in itertools.product(*map(range, counts)):
        place = (x * ((i + 0.5) / counts[0] - 0.5), y * ((j + 0.5) / counts[1] - 0.5), z - 0.1)
        lamp = Light(position_m=place, intensity=(strength, strength, 0.95 * strength))
        pieces.append(Piece("lamp", [(box((0.3, 0.3, 0.06)).moved(place), palette.common["bulb"])], [lamp]))
    return assemble(f"hall, seed {config.seed}", pieces, palette, inside_m=config.inside_m)
