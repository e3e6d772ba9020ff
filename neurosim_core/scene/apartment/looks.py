"""Colours and materials of a flat: one scheme for all of it, a finish and a look for each room."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.apartment import pictures, textures
from neurosim_core.scene.apartment.draws import stream
from neurosim_core.scene.apartment.floorplan import Role
from neurosim_core.scene.scene import LinearRgb
from neurosim_core.settings_file import read_table


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A material and the size of its texture."""

    name: str
    color: LinearRgb = (1.0, 1.0, 1.0)
    """Albedo, or what the texture is multiplied with."""
    texture: str | None = None
    """Key of the texture; see `Palette.paint`."""
    tile_m: tuple[float, ...] = (1.0, 1.0)
    """Size of one repetition of the texture along u and v [m]."""
    emission: LinearRgb = (0.0, 0.0, 0.0)
    exact: bool = False
    """Whether the texture must lie as the part says (a picture, a pattern across parts), not at random."""

    def fitted(self, width_m: float, height_m: float) -> Surface:
        """Return the surface with its texture exactly once on a part of this size."""
        return replace(self, tile_m=(width_m, height_m))


class Finish(NamedTuple):
    """The materials of a room's walls, floor and ceiling."""

    floor: Surface
    walls: tuple[Surface, ...]
    """Of `Room.walls`."""
    splash: Surface
    """Behind the counter of a kitchen."""


def _surface(
    name: str, *, color: str = "#ffffff", texture: str | None = None, tile: float = 1.0, **more: Any
) -> Surface:
    """Return a surface of an sRGB colour over a nearly white texture."""
    more = {key: tuple(value) if isinstance(value, list) else value for key, value in more.items()}
    code = textures.rgb(color).astype(np.float64)
    light = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    r, g, b = light.tolist()
    return Surface(name=name, color=(r, g, b), texture=texture, tile_m=(tile, tile), **more)


class Palette:
    """All surfaces of one flat, and how their textures are painted."""

    def __init__(self, seed: int) -> None:
        """Choose a scheme of colours."""
        self._seed = seed
        self._table = read_table(__file__, "looks")
        schemes = list(self._table["schemes"].values())
        self._scheme: dict[str, list[str]] = schemes[int(stream(seed, "scheme").integers(len(schemes)))]
        self.common = {name: _surface(name, **data) for name, data in self._table["surfaces"].items()}
        """Surfaces that do not differ between rooms, by name."""
        self._formulas: dict[str, tuple[str, dict[str, Any]]] = {
            key: (formula, {}) for key, formula in self._table["textures"].items()
        }

    def paint(self, key: str) -> NDArray[np.uint8]:
        """Return the texture of a surface's key, 8-bit sRGB."""
        rng = stream(self._seed, "texture", key)
        formula, variables = self._formulas[key]
        u, v = textures.texel_grid()
        painters = {painter.__name__: functools.partial(painter, rng) for painter in _PAINTERS}
        scope = {**_FUNCTIONS, **painters, "u": u, "v": v, "scheme": self._scheme, **variables}
        return np.asarray(np.clip(eval(formula, scope) * 255.0 + 0.5, 0.0, 255.0), np.uint8)

    def _painted(self, key: str, formula: str, tile_m: tuple[float, ...], **variables: Any) -> Surface:
        self._formulas[key] = formula, variables
        return Surface(name=key, texture=key, tile_m=tile_m, exact=True)

    def rug(self, index: int, *size_m: float) -> Surface:
        """Return the pattern of a rug, fitted to its width and depth."""
        return self._painted(f"rug {index}", 'rug(scheme["prints"])', size_m)

    def poster(self, index: int, *size_m: float) -> Surface:
        """Return a print of its own for each index, fitted to its width and height."""
        kind = index + int(stream(self._seed, "posters").integers(5))
        return self._painted(f"poster {index}", 'poster(scheme["prints"], kind)', size_m, kind=kind)

    def finish(self, name: str, role: Role, index: int) -> Finish:
        """Return what a room is lined with."""
        rng, number = stream(self._seed, "finish", name), index + 1
        color = {kind: str(rng.choice(self._scheme[kind])) for kind in ("walls", "accents")}
        wall = _surface(f"wall paint {number}", color=color["walls"], texture="plaster", tile=1.5)
        accent = _surface(f"accent paint {number}", color=color["accents"], texture="plaster", tile=1.5)
        floor = _surface("floor boards", texture="planks", tile=2.0, exact=True)
        if role in ("living", "studio", "dining") and stream(self._seed, "chevron").uniform() < 0.4:
            floor = _surface("parquet", texture="chevron", tile=1.4, exact=True)
        if role in ("bedroom", "dining", "living") and rng.uniform() < 0.75:
            kind = str(rng.choice(list(self._table["wallpapers"])))
            ground, motif = (rng.choice(self._scheme[part]) for part in ("walls", "accents"))
            tile, formula = (self._table["wallpapers"][kind][part] for part in ("tile", "texture"))
            colors = {"ground": ground, "motif": motif}
            accent = self._painted(f"wallpaper {kind} {number}", formula, (tile, tile), **colors)
        if role == "bedroom" and rng.uniform() < 0.4:
            color["carpet"] = str(rng.choice(self._table["carpets"]))
            floor = _surface(f"carpet {number}", color=color["carpet"], texture="pile", tile=1.2)
        if role in ("kitchen", "bathroom"):
            floor, accent = self._tiled(role, rng, number)
            return Finish(floor, (accent if role == "bathroom" else wall,) * 4, accent)
        feature = int(rng.integers(4))
        return Finish(floor, tuple(accent if side == feature else wall for side in range(4)), accent)

    def _tiled(self, role: Role, rng: np.random.Generator, number: int) -> tuple[Surface, Surface]:
        """Return floor and wall of a wet room."""
        color, pale = str(rng.choice(self._scheme["accents"])), str(rng.choice(self._scheme["walls"]))
        floors = self._table["wet_floors"]
        kind, data = list(floors.items())[int(rng.integers(len(floors)))]
        size = (data["tile"], data["tile"])
        floor = self._painted(f"{kind} floor {number}", data["texture"], size, color=color, pale=pale)
        colors = (color,) if role == "kitchen" else ("#e8e6df", "#dfdfd9", pale)
        formula = 'tiles(colors, "#cfcbc3", grid=(4, 8), bond=True)'
        return floor, self._painted(f"wall tiles {number}", formula, (0.9, 0.9), colors=colors)

    def look(self, name: str) -> dict[str, Surface]:
        """Return what the furniture of a room is made of, by name."""
        rng = stream(self._seed, "look", name)
        fabric, accent, knit = (str(color) for color in rng.permutation(self._scheme["fabrics"])[:3])
        pot = str(rng.choice(self._table["pots"]))
        front = str(rng.choice([*self._scheme["accents"], "#e9e6df", "#e9e6df"]))
        return self.common | {
            "front": _surface(f"front {name}", color=front, texture="plaster", tile=1.5),
            "fabric": _surface(f"fabric {fabric}", color=fabric, texture="weave", tile=0.6),
            "accent": _surface(f"fabric {accent}", color=accent, texture="weave", tile=0.5),
            "knit": _surface(f"knit {knit}", color=knit, texture="knit", tile=0.6),
            "pot": _surface(f"pot {pot}", color=pot, texture="plaster", tile=0.8),
        }


_PAINTERS = (*textures.PAINTERS, *pictures.PAINTERS)
_FUNCTIONS: dict[str, Any] = {
    "__builtins__": {},
    "blend": textures.blend,
    **{name: getattr(np, name) for name in ("sin", "abs", "clip", "where", "pi")},
}
