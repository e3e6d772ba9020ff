"""Colours and materials of a flat: one scheme for all of it, a finish and a look for each room."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from neurosim_core.scene.apartment import pictures, textures
from neurosim_core.scene.apartment.draws import stream
from neurosim_core.scene.apartment.floorplan import Role
from neurosim_core.scene.scene import LinearRgb

Painter = Callable[[np.random.Generator], textures.Picture]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A material and the size of its texture."""

    name: str
    color: LinearRgb = (1.0, 1.0, 1.0)
    """Albedo, or what the texture is multiplied with."""
    texture: str | None = None
    """Key of the texture; see `Palette.paint`."""
    tile_m: tuple[float, float] = (1.0, 1.0)
    """Size of one repetition of the texture along u and v [m]."""
    emission: LinearRgb = (0.0, 0.0, 0.0)
    exact: bool = False
    """Whether the texture must lie as the part says (a picture, a pattern across parts), not at random."""

    def fitted(self, width_m: float, height_m: float) -> Surface:
        """Return the surface with its texture exactly once on a part of this size."""
        return replace(self, tile_m=(width_m, height_m))


@dataclass(frozen=True, kw_only=True)
class Finish:
    """What a room is lined with."""

    floor: Surface
    walls: tuple[Surface, ...]
    """Of `Room.walls`."""
    splash: Surface
    """Behind the counter of a kitchen."""


@functools.cache
def _table() -> dict[str, Any]:
    table: dict[str, Any] = yaml.load(Path(__file__).with_name("looks.yaml").read_bytes(), yaml.CSafeLoader)
    return table


def _surface(
    name: str, *, color: str = "#ffffff", texture: str | None = None, tile: float = 1.0, **more: Any
) -> Surface:
    """Return a surface of an sRGB colour over a nearly white texture."""
    code = textures.rgb(color).astype(np.float64)
    light = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    more = {key: tuple(value) if isinstance(value, list) else value for key, value in more.items()}
    r, g, b = (float(value) for value in light)
    return Surface(name=name, color=(r, g, b), texture=texture, tile_m=(tile, tile), **more)


class Palette:
    """All surfaces of one flat, and how their textures are painted."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        schemes = list(_table()["schemes"].values())
        self.scheme = scheme = schemes[int(stream(seed, "scheme").integers(len(schemes)))]
        self.common = {name: _surface(name, **data) for name, data in _table()["surfaces"].items()}
        """Surfaces that do not differ between rooms, by name."""
        self._painters: dict[str, Painter] = {
            "wood": lambda rng: textures.wood(rng, *scheme["wood"]),
            "dark_wood": lambda rng: textures.wood(rng, *scheme["dark_wood"]),
            "planks": lambda rng: textures.planks(rng, *scheme["floor"]),
            "chevron": lambda rng: textures.chevron(rng, *scheme["floor"]),
            "marble": lambda rng: textures.marble(rng, "#ece9e4", "#66646a"),
            "spines": pictures.spines,
            "screen": pictures.screen,
            "view": pictures.view,
        }

    def paint(self, key: str) -> NDArray[np.uint8]:
        """Return the texture of a surface's key."""
        painter = self._painters.get(key) or functools.partial(
            _paint_formula, formula=_table()["textures"][key]
        )
        return textures.quantize(painter(stream(self._seed, "texture", key)))

    def _painted(self, key: str, painter: Painter, tile_m: tuple[float, float]) -> Surface:
        self._painters[key] = painter
        return Surface(name=key, texture=key, tile_m=tile_m, exact=True)

    def rug(self, index: int, width_m: float, depth_m: float) -> Surface:
        """Return the pattern of a rug, fitted to its size."""
        prints = self.scheme["prints"]
        return self._painted(f"rug {index}", lambda rng: pictures.rug(rng, prints), (width_m, depth_m))

    def poster(self, index: int, width_m: float, height_m: float) -> Surface:
        """Return a print of its own for each index."""
        prints = self.scheme["prints"]
        count = len(pictures.POSTERS)
        paint = pictures.POSTERS[(index + int(stream(self._seed, "posters").integers(count))) % count]
        return self._painted(f"poster {index}", lambda rng: paint(rng, prints), (width_m, height_m))

    def finish(self, name: str, role: Role, index: int) -> Finish:
        """Return what a room is lined with."""
        scheme, rng = self.scheme, stream(self._seed, "finish", name)
        wall = _surface(
            f"wall paint {index + 1}", color=rng.choice(scheme["walls"]), texture="plaster", tile=1.5
        )
        floor = Surface(name="floor boards", texture="planks", tile_m=(2.0, 2.0), exact=True)
        accent = _surface(
            f"accent paint {index + 1}", color=rng.choice(scheme["accents"]), texture="plaster", tile=1.5
        )
        if role in ("living", "studio", "dining") and stream(self._seed, "chevron").uniform() < 0.4:
            floor = Surface(name="parquet", texture="chevron", tile_m=(1.4, 1.4), exact=True)
        if role in ("bedroom", "dining", "living") and rng.uniform() < 0.75:
            kind = str(rng.choice(["stripes", "scales", "lattice", "leaves"]))
            ground, motif = str(rng.choice(scheme["walls"])), str(rng.choice(scheme["accents"]))
            size = {"stripes": 1.2, "scales": 0.9, "lattice": 1.1, "leaves": 1.3}[kind]
            accent = self._painted(
                f"wallpaper {kind} {index + 1}",
                lambda rng: textures.wallpaper(rng, ground, motif, kind),
                (size, size),
            )
        if role == "bedroom" and rng.uniform() < 0.4:
            color = rng.choice(_table()["carpets"])
            floor = _surface(f"carpet {index + 1}", color=color, texture="pile", tile=1.2)
        if role in ("kitchen", "bathroom"):
            floor, accent = self._tiled(role, rng, index)
            lined = (accent,) * 4 if role == "bathroom" else (wall,) * 4
        else:
            feature = int(rng.integers(4))
            lined = tuple(accent if side == feature else wall for side in range(4))
        return Finish(floor=floor, walls=lined, splash=accent)

    def _tiled(self, role: Role, rng: np.random.Generator, index: int) -> tuple[Surface, Surface]:
        """Return floor and wall of a wet room."""
        color, pale = str(rng.choice(self.scheme["accents"])), str(rng.choice(self.scheme["walls"]))
        floors: dict[str, tuple[float, Painter]] = {
            "checker": (
                1.3,
                lambda rng: textures.tiles(rng, ("#ddd8cd", "#4a4d52"), "#8f8b84", checker=True),
            ),
            "terrazzo": (1.3, lambda rng: textures.terrazzo(rng, "#d9d3c8", self.scheme["prints"][1:])),
            "slate": (1.8, lambda rng: textures.tiles(rng, ("#8b8d8c", "#7c7f80", "#999894"), "#c9c5bd")),
            "two tone": (
                1.2,
                lambda rng: textures.tiles(rng, (pale, color), "#b9b4aa", grid=(6, 6), checker=True),
            ),
        }
        kind = list(floors)[int(rng.integers(len(floors)))]
        size, painter = floors[kind]
        colors = (color,) if role == "kitchen" else ("#e8e6df", "#dfdfd9", pale)
        wall = self._painted(
            f"wall tiles {index + 1}",
            lambda rng: textures.tiles(rng, colors, "#cfcbc3", grid=(4, 8), bond=True),
            (0.9, 0.9),
        )
        return self._painted(f"{kind} floor {index + 1}", painter, (size, size)), wall

    def look(self, name: str) -> dict[str, Surface]:
        """Return what the furniture of a room is made of, by name."""
        scheme, rng = self.scheme, stream(self._seed, "look", name)
        fabric, accent, knit = (str(color) for color in rng.permutation(scheme["fabrics"])[:3])
        pot = str(rng.choice(_table()["pots"]))
        front = str(rng.choice([*scheme["accents"], "#e9e6df", "#e9e6df"]))
        return self.common | {
            "front": _surface(f"front {name}", color=front, texture="plaster", tile=1.5),
            "fabric": _surface(f"fabric {fabric}", color=fabric, texture="weave", tile=0.6),
            "accent": _surface(f"fabric {accent}", color=accent, texture="weave", tile=0.5),
            "knit": _surface(f"knit {knit}", color=knit, texture="knit", tile=0.6),
            "pot": _surface(f"pot {pot}", color=pot, texture="plaster", tile=0.8),
        }


def _paint_formula(rng: np.random.Generator, formula: tuple[str, str, str]) -> textures.Picture:
    """Return the picture of an entry of `textures` in the table."""
    low, high, share = formula
    u, v = textures.texel_grid()
    functions = {name: getattr(np, name) for name in ("sin", "abs", "clip", "where", "pi")}
    scope = {"__builtins__": {}, **functions, "u": u, "v": v, "noise": functools.partial(textures.noise, rng)}
    return textures.blend(textures.rgb(low), textures.rgb(high), eval(share, scope))
