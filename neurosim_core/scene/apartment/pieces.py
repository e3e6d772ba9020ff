"""Pieces of furniture, built from the table in `furniture.yaml`.

An entry of the table is a solid (`box`, `cushion`, `lathe`, ...; `solids.py` has their options) or another
piece with the variables it is given. Strings are expressions of NumPy functions, variables, the surfaces of
the room and random numbers (`uniform(low, high)`, `jitter(reach)`, `chance(probability)`, `pick(...)`).
The other keys of an entry are:

    of                surface; entries below inherit it
    let, for          variables; variables that run over values, one copy of the entry for each combination
    if, else          a condition; the entries that stand in when it is false
    parts             entries that are turned and shifted as one
    scale, turn, at   factor, angles about axes in order [rad], offset [m]
    shift_uv          shift of the texture [m]
    light             a point light of this strength
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import CodeType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim_core.scene import solids
from neurosim_core.scene.apartment.draws import Draws
from neurosim_core.scene.apartment.looks import Surface
from neurosim_core.scene.apartment.pictures import SPINE_COLUMNS, SPINE_ROWS
from neurosim_core.scene.scene import Light
from neurosim_core.scene.solids import Array, Part, turned
from neurosim_core.settings_file import read_table

_WARM = np.array([1.5, 1.35, 1.14])
"""Intensity of a lamp of strength 1: walls and floors of furnished rooms get a radiance of 0.2 to 0.6."""


@dataclass
class Piece:
    """A piece of furniture, standing on z = 0 with its back to y = 0 and its front towards -y."""

    kind: str
    parts: list[tuple[Part, Surface]] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)

    def include(self, other: Piece) -> None:
        """Add all of another piece."""
        self.parts.extend(other.parts)
        self.lights.extend(other.lights)

    def moved(self, offset: ArrayLike, yaw_rad: float = 0.0) -> Piece:
        """Return the piece turned about its z axis, then shifted [m]."""
        lights = []
        for light in self.lights:
            at = turned(np.array(light.position_m), yaw_rad, axis=2) + np.asarray(offset, float)
            lights.append(replace(light, position_m=tuple(at.tolist())))
        parts = [(part.moved(offset, yaw_rad=yaw_rad), surface) for part, surface in self.parts]
        return Piece(self.kind, parts, lights)

    @functools.cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m], shape [2, 3]."""
        points = np.concatenate([part.vertices for part, _ in self.parts])
        return np.stack([points.min(axis=0), points.max(axis=0)])


def make_piece(kind: str, surfaces: Mapping[str, Surface], draws: Draws, **given: Any) -> Piece:
    """Build a piece of the table; what is `given` replaces variables of its `let`, or is what it asks for.

    Raises:
        NameError: It asks for a variable that is not given.
    """
    scope = {**FUNCTIONS, **surfaces, **given}
    return replace(_build(read_table(__file__, "furniture")[kind], scope, draws, given), kind=kind)


def _build(node: Mapping[str, Any], scope: dict[str, Any], draws: Draws, given: Mapping[str, Any]) -> Piece:
    """Build an entry; variables in `given` keep their value."""
    if "if" in node and not evaluate(node["if"], scope, draws, "if"):
        return _build({"parts": node.get("else", [])}, scope, draws.under("else"), {})
    whole = Piece("")
    for inner, own in _copies(list(node.get("for", {}).items()), scope, draws):
        for name, data in node.get("let", {}).items():
            if name not in given:
                inner[name] = evaluate(data, inner, own, name)
        if "of" in node:
            inner["of"] = evaluate(node["of"], inner, own, "of")
        piece = _solid(node, inner, own)
        for index, entry in enumerate(node.get("parts", ())):
            piece.include(_build(entry, dict(inner), own.under(index), {}))
        placing = {key: evaluate(node[key], inner, own, key) for key in _PLACING if key in node}
        whole.include(_placed(piece, placing) if placing else piece)
    return whole


def _copies(
    loops: Sequence[tuple[str, Any]], scope: dict[str, Any], draws: Draws
) -> Iterator[tuple[dict[str, Any], Draws]]:
    """Yield variables and random numbers of each copy that `for` asks for."""
    if not loops:
        yield dict(scope), draws
        return
    (name, data), *rest = loops
    for index, value in enumerate(evaluate(data, scope, draws, name)):
        yield from _copies(rest, {**scope, name: value}, draws.under(name, index))


def _solid(node: Mapping[str, Any], scope: dict[str, Any], draws: Draws) -> Piece:
    """Build the solid, the piece or the light that an entry names; nothing where it has `parts` only."""
    kind = next((key for key in node if key not in _KEYS), None)
    if kind is None:
        return Piece("")
    if kind in read_table(__file__, "furniture"):
        given = {name: evaluate(data, scope, draws, name) for name, data in node[kind].items()}
        surfaces = {name: value for name, value in scope.items() if isinstance(value, Surface)}
        return make_piece(kind, surfaces, draws.under(kind), **given)
    if kind == "light":
        intensity = tuple((evaluate(node[kind], scope, draws, kind) * _WARM).tolist())
        return Piece("", lights=[Light(position_m=(0.0, 0.0, 0.0), intensity=intensity)])
    if kind == "sheet":
        steps = evaluate(node["steps"], scope, draws, "steps")
        scope["u"], scope["v"] = np.meshgrid(*(np.linspace(0.0, 1.0, count + 1) for count in steps))
    options = {key: evaluate(data, scope, draws, key) for key, data in node.items() if key not in _KEYS}
    return Piece("", parts=[(_SOLIDS[kind](options.pop(kind), **options), scope["of"])])


def _placed(piece: Piece, where: Mapping[str, Any]) -> Piece:
    """Scale, turn and shift what an entry made."""
    offset = np.asarray(where.get("at", (0.0, 0.0, 0.0)), float)
    parts = []
    for part, surface in piece.parts:
        if "scale" in where or "shift_uv" in where:
            uv = part.uv + where.get("shift_uv", (0.0, 0.0))
            part = replace(part, vertices=part.vertices * where.get("scale", 1.0), uv=uv)
        for axis, angle in where.get("turn", {}).items():
            part = part.turned(angle, axis="xyz".index(axis))
        parts.append((part.moved(offset), surface))
    return Piece("", parts, Piece("", [], piece.lights).moved(offset).lights)


def evaluate(data: Any, scope: dict[str, Any], draws: Draws, name: str) -> Any:
    """Return the value of what a table has for a variable or an option called `name`."""
    if isinstance(data, str):
        code, draws_numbers = _compiled(data)
        return eval(code, scope | draws.functions(name) if draws_numbers else scope)
    if isinstance(data, list):
        return [
            evaluate(item, scope, draws, f"{name}.{index}") if isinstance(item, str | list) else item
            for index, item in enumerate(data)
        ]
    if isinstance(data, dict):
        return {key: evaluate(item, scope, draws, f"{name}.{key}") for key, item in data.items()}
    return data


@functools.cache
def _compiled(text: str) -> tuple[CodeType, bool]:
    return compile(text, text, "eval"), re.search(r"\b(uniform|jitter|chance|pick)\(", text) is not None


def _book(size: Sequence[float], *, cell: int) -> Part:
    """A standing book (thickness, depth, height), its spine at y = 0; `cell` of the picture of spines."""
    part = solids.box(size).moved((0.0, 0.5 * size[1], 0.5 * size[2]))
    low = np.array([cell % SPINE_COLUMNS, SPINE_ROWS - 1 - cell // SPINE_COLUMNS])
    paper = np.array([SPINE_COLUMNS - 1, 0])
    corners = np.array([[0.06, 0.02], [0.94, 0.02], [0.06, 0.98], [0.94, 0.98]])
    cover = np.array([[0.4, 0.02], [0.6, 0.02], [0.4, 0.98], [0.6, 0.98]])
    faces = (low + cover, low + cover, low + corners, low + corners, paper + corners, paper + corners)
    return replace(part, uv=np.concatenate(faces) / np.array([SPINE_COLUMNS, SPINE_ROWS]))


def _sheet(points: Sequence[ArrayLike], *, steps: Sequence[int], uv: Sequence[ArrayLike]) -> Part:
    """A smooth sheet: x, y, z and uv as functions of u and v in [0, 1], in `steps` along u and v."""
    shape = steps[1] + 1, steps[0] + 1

    def stacked(values: Sequence[ArrayLike]) -> Array:
        return np.stack([np.broadcast_to(np.asarray(value, float), shape) for value in values], axis=-1)

    return solids.grid_surface(stacked(points), stacked(uv))


_PLACING = ("scale", "turn", "at", "shift_uv")
_KEYS = {"of", "let", "for", "if", "else", "parts", *_PLACING}
_SOLIDS: dict[str, Any] = {
    "box": solids.box,
    "cushion": solids.cushion,
    "lathe": solids.lathe,
    "cylinder": solids.cylinder,
    "tube": solids.tube,
    "frame": solids.frame,
    "quad": lambda edges: solids.quad(*edges),
    "canvas": lambda edges: solids.picture_quad(*edges),
    "sheet": _sheet,
    "book": _book,
}
FUNCTIONS: dict[str, Any] = {
    "__builtins__": {},
    **{name: getattr(np, name) for name in ("sin", "cos", "pi", "clip", "abs", "linspace", "cumsum")},
    **{function.__name__: function for function in (min, max, sum, len, int, range, round)},
    "fitted": Surface.fitted,
    "untextured": lambda surface: replace(surface, texture=None, exact=False),
}
