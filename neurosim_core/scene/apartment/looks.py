"""Colours and materials of a flat: one scheme for all of it, one finish and one look for each room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.apartment import pictures, surfaces
from neurosim_core.scene.apartment.assembly import Surface, linear
from neurosim_core.scene.apartment.floorplan import Role, stream
from neurosim_core.scene.apartment.shell import RoomFinish

Painter = Callable[[np.random.Generator], surfaces.Picture]


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """The colours of a flat (sRGB)."""

    name: str
    wood: tuple[str, str]
    """Dark and light of the furniture's grain."""
    dark_wood: tuple[str, str]
    floor: tuple[str, str]
    walls: tuple[str, ...]
    accents: tuple[str, ...]
    """Painted walls, wallpaper, tiles."""
    fabrics: tuple[str, ...]
    prints: tuple[str, ...]
    """Rugs and posters; the first is the ground of rugs."""


SCHEMES = (
    Scheme(
        name="nordic",
        wood=("#a77d52", "#e2c196"),
        dark_wood=("#4f3624", "#8d6443"),
        floor=("#8a6843", "#d9b587"),
        walls=("#e9e4da", "#dfe3e0", "#ece6dc", "#e3dfd8"),
        accents=("#4f6d68", "#c58a5e", "#38506b", "#8a9a7b"),
        fabrics=("#7d8a8c", "#c98f58", "#3f5e6b", "#d8cdb8", "#a5523c"),
        prints=("#e9dfca", "#b5482e", "#2f4a5e", "#d3a13c", "#5f7d6a"),
    ),
    Scheme(
        name="walnut",
        wood=("#5a3c26", "#a2714a"),
        dark_wood=("#2f2019", "#5e4230"),
        floor=("#4d3321", "#946844"),
        walls=("#e6ddcd", "#dcd6cb", "#e8e2d4", "#d7d9d2"),
        accents=("#2f4f4a", "#a4553a", "#8c6d3f", "#4a5a76"),
        fabrics=("#3d5a4c", "#b9722f", "#8b3f36", "#cbbfa7", "#2f3f55"),
        prints=("#7b2d26", "#e8dcc4", "#23395b", "#c9a227", "#3d5a45"),
    ),
    Scheme(
        name="coastal",
        wood=("#8d7a62", "#d6c6a9"),
        dark_wood=("#3b4650", "#6b7884"),
        floor=("#857763", "#cfc0a5"),
        walls=("#edece6", "#dce5e8", "#efe9dd", "#e2e8e2"),
        accents=("#3c6e8f", "#78a5a3", "#e1a95f", "#2b4162"),
        fabrics=("#4a7090", "#d9d2c3", "#e0a458", "#78a5a3", "#c95d4b"),
        prints=("#23415f", "#efe6d5", "#78a5a3", "#e1a95f", "#c95d4b"),
    ),
    Scheme(
        name="loft",
        wood=("#6e4b2f", "#b98a5c"),
        dark_wood=("#242322", "#4a4644"),
        floor=("#6d543b", "#b8966b"),
        walls=("#dcd8d1", "#e4e0d9", "#d3d3d0", "#e0d8cc"),
        accents=("#8f4a35", "#3a3f45", "#b0843a", "#56694c"),
        fabrics=("#8a4f32", "#56585a", "#b0843a", "#c7bba6", "#3f4f46"),
        prints=("#2b2b2b", "#d9cfbd", "#a3402c", "#b0843a", "#54707a"),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Look:
    """What the furniture of one room is made of."""

    wood: Surface
    dark_wood: Surface
    front: Surface
    """Painted fronts of cupboards."""
    fabric: Surface
    accent: Surface
    """A second fabric that stands out."""
    knit: Surface
    linen: Surface
    leather: Surface
    metal: Surface
    steel: Surface
    """Brushed, bright."""
    white: Surface
    ceramic: Surface
    stone: Surface
    glow: Surface
    """Lit lampshades."""
    bulb: Surface
    leaf: Surface
    soil: Surface
    pot: Surface
    spines: Surface
    screen: Surface
    glass: Surface
    prints: tuple[str, ...]


def plain(name: str, color: str, texture: str | None = None, tile_m: float = 1.0) -> Surface:
    """A surface of one sRGB colour, over a nearly white texture if one is named."""
    return Surface(name=name, color=linear(color), texture=texture, tile_m=(tile_m, tile_m))


class Palette:
    """All surfaces of one flat, and how their textures are painted."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self.scheme = SCHEMES[int(stream(seed, "scheme").integers(len(SCHEMES)))]
        scheme = self.scheme
        self._painters: dict[str, Painter] = {
            "plaster": surfaces.plaster,
            "wood": lambda rng: surfaces.wood(rng, *scheme.wood),
            "dark wood": lambda rng: surfaces.wood(rng, *scheme.dark_wood),
            "planks": lambda rng: surfaces.planks(rng, *scheme.floor),
            "chevron": lambda rng: surfaces.chevron(rng, *scheme.floor),
            "weave": surfaces.weave,
            "knit": surfaces.knit,
            "pile": surfaces.pile,
            "metal": surfaces.metal,
            "concrete": surfaces.concrete,
            "marble": lambda rng: surfaces.marble(rng, "#ece9e4", "#66646a"),
            "leaf": surfaces.leaf,
            "spines": pictures.spines,
            "screen": pictures.screen,
            "view": pictures.view,
        }

    def paint(self, key: str) -> NDArray[np.uint8]:
        """The texture of a surface's key."""
        return surfaces.quantize(self._painters[key](stream(self._seed, "texture", key)))

    def _painted(
        self,
        key: str,
        painter: Painter,
        tile_m: tuple[float, float],
        *,
        exact: bool = True,
        glow: float = 0.0,
    ) -> Surface:
        self._painters[key] = painter
        return Surface(name=key, texture=key, tile_m=tile_m, exact=exact, emission=(glow, glow, glow))

    def view(self, width_m: float, height_m: float) -> Surface:
        """The outside, as bright as a day seen from indoors, fitted to a window."""
        return Surface(
            name="view",
            texture="view",
            tile_m=(width_m, height_m),
            color=(1.0, 1.0, 1.0),
            emission=(0.2, 0.235, 0.285),
            exact=True,
        )

    def rug(self, index: int, width_m: float, depth_m: float) -> Surface:
        """A rug's pattern, fitted to its size."""
        prints = self.scheme.prints
        return self._painted(f"rug {index}", lambda rng: pictures.rug(rng, prints), (width_m, depth_m))

    def poster(self, index: int, width_m: float, height_m: float) -> Surface:
        """A print of its own for each index."""
        prints = self.scheme.prints
        paint = pictures.POSTERS[
            (index + int(stream(self._seed, "posters").integers(5))) % len(pictures.POSTERS)
        ]
        return self._painted(f"poster {index}", lambda rng: paint(rng, prints), (width_m, height_m))

    def finish(self, name: str, role: Role, index: int) -> RoomFinish:
        """What a room is lined with."""
        scheme, rng = self.scheme, stream(self._seed, "finish", name)
        wall = plain(f"wall paint {index + 1}", str(rng.choice(scheme.walls)), "plaster", 1.5)
        floor = Surface(name="floor boards", texture="planks", tile_m=(2.0, 2.0), exact=True)
        accent = plain(f"accent paint {index + 1}", str(rng.choice(scheme.accents)), "plaster", 1.5)
        if role in ("living", "studio", "dining") and stream(self._seed, "chevron").uniform() < 0.4:
            floor = Surface(name="parquet", texture="chevron", tile_m=(1.4, 1.4), exact=True)
        if role in ("bedroom", "dining", "living") and rng.uniform() < 0.75:
            kind = str(rng.choice(["stripes", "scales", "lattice", "leaves"]))
            ground, motif = str(rng.choice(scheme.walls)), str(rng.choice(scheme.accents))
            size = {"stripes": 1.2, "scales": 0.9, "lattice": 1.1, "leaves": 1.3}[kind]
            accent = self._painted(
                f"wallpaper {kind} {index + 1}",
                lambda rng: surfaces.wallpaper(rng, ground, motif, kind),
                (size, size),
            )
        if role == "bedroom" and rng.uniform() < 0.4:
            floor = plain(
                f"carpet {index + 1}", str(rng.choice(["#b9ab96", "#8f979c", "#a39382"])), "pile", 1.2
            )
        if role in ("kitchen", "bathroom"):
            floor, accent = self._tiled(role, rng, index)
        return RoomFinish(
            floor=floor,
            wall=accent if role == "bathroom" else wall,
            accent=accent,
            accent_wall=int(rng.integers(4)) if role not in ("kitchen", "bathroom") else -1,
            view=self.view,
            ceiling=plain("ceiling paint", "#efeeea", "plaster", 1.5),
            trim=plain("trim paint", "#f4f3ef", "plaster", 1.0),
            sill=Surface(name="wood", texture="wood", tile_m=(1.2, 1.2)),
        )

    def _tiled(self, role: Role, rng: np.random.Generator, index: int) -> tuple[Surface, Surface]:
        """Floor and wall of a wet room."""
        color = str(rng.choice(self.scheme.accents))
        pale = str(rng.choice(self.scheme.walls))
        floors: Sequence[tuple[str, Painter, float]] = (
            (
                "checker",
                lambda rng: surfaces.tiles(rng, ("#ddd8cd", "#4a4d52"), "#8f8b84", checker=True),
                1.3,
            ),
            ("terrazzo", lambda rng: surfaces.terrazzo(rng, "#d9d3c8", self.scheme.prints[1:]), 1.3),
            ("slate", lambda rng: surfaces.tiles(rng, ("#8b8d8c", "#7c7f80", "#999894"), "#c9c5bd"), 1.8),
            (
                "two tone",
                lambda rng: surfaces.tiles(rng, (pale, color), "#b9b4aa", columns=6, rows=6, checker=True),
                1.2,
            ),
        )
        kind, painter, size = floors[int(rng.integers(len(floors)))]
        floor = self._painted(f"{kind} floor {index + 1}", painter, (size, size))
        colors = (color,) if role == "kitchen" else ("#e8e6df", "#dfdfd9", pale)
        wall = self._painted(
            f"wall tiles {index + 1}",
            lambda rng: surfaces.tiles(rng, colors, "#cfcbc3", columns=4, rows=8, bond=True),
            (0.9, 0.9),
        )
        return floor, wall

    def look(self, name: str) -> Look:
        """What the furniture of a room is made of."""
        scheme, rng = self.scheme, stream(self._seed, "look", name)
        fabric, accent, knit = (str(color) for color in rng.permutation(scheme.fabrics)[:3])
        pot = str(rng.choice(["#b5653f", "#e4ddd0", "#39444b", "#8f9a86"]))
        return Look(
            wood=Surface(name="wood", texture="wood", tile_m=(1.2, 1.2)),
            dark_wood=Surface(name="dark wood", texture="dark wood", tile_m=(1.2, 1.2)),
            front=plain(
                f"front {name}", str(rng.choice([*scheme.accents, "#e9e6df", "#e9e6df"])), "plaster", 1.5
            ),
            fabric=plain(f"fabric {fabric}", fabric, "weave", 0.6),
            accent=plain(f"fabric {accent}", accent, "weave", 0.5),
            knit=plain(f"knit {knit}", knit, "knit", 0.6),
            linen=plain("linen", "#efebe2", "weave", 0.6),
            leather=plain("leather", "#3a3633", "concrete", 0.7),
            metal=plain("black metal", "#33343a", "metal", 0.8),
            steel=Surface(name="steel", texture="metal", tile_m=(0.8, 0.8)),
            white=plain("white lacquer", "#eceae5", "plaster", 1.5),
            ceramic=plain("ceramic", "#f1f0ee"),
            stone=Surface(name="stone", texture="marble", tile_m=(1.3, 1.3)),
            glow=Surface(
                name="lampshade",
                color=linear("#f3e6cc"),
                texture="weave",
                tile_m=(0.5, 0.5),
                emission=(0.62, 0.5, 0.34),
            ),
            bulb=Surface(name="bulb", color=linear("#fff4e0"), emission=(2.2, 1.9, 1.45)),
            leaf=Surface(name="leaf", color=linear("#c8e0b0"), texture="leaf", exact=True),
            soil=plain("soil", "#5b4636", "concrete", 0.4),
            pot=plain(f"pot {pot}", pot, "plaster", 0.8),
            spines=Surface(name="book spines", texture="spines", exact=True),
            screen=Surface(name="screen", texture="screen", exact=True, emission=(0.03, 0.035, 0.045)),
            glass=plain("dark glass", "#16181b"),
            prints=scheme.prints,
        )
