"""Solids that furniture, walls and bodies are made of: boxes, cushions, lathed bodies, tubes and sheets.

Every part has unit normals, faces that wind counter-clockwise seen from outside, and texture coordinates in
metres, so that one material has one texel density wherever it is used.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A piece of surface of one material."""

    vertices: Array
    """Positions [m], shape [V, 3]."""
    normals: Array
    """Unit normals, shape [V, 3]."""
    uv: Array
    """Position on the surface [m], shape [V, 2]; u runs along the grain."""
    faces: NDArray[np.int64]
    """Vertex indices, shape [F, 3]."""

    def moved(self, offset: ArrayLike = (0.0, 0.0, 0.0), *, yaw_rad: float = 0.0) -> Part:
        """The part turned about the z axis by `yaw_rad`, then shifted by `offset` [m]."""
        part = self.turned(yaw_rad, axis=2) if yaw_rad else self
        vertices = part.vertices + np.asarray(offset, float)
        return Part(vertices=vertices, normals=part.normals, uv=part.uv, faces=part.faces)

    def turned(self, angle_rad: float, *, axis: int) -> Part:
        """The part turned about a coordinate axis through the origin, right-handed."""
        vertices, normals = (turned(each, angle_rad, axis=axis) for each in (self.vertices, self.normals))
        return Part(vertices=vertices, normals=normals, uv=self.uv, faces=self.faces)


def turned(points: Array, angle_rad: float, *, axis: int) -> Array:
    """Vectors turned about a coordinate axis, right-handed, shape [..., 3]; right angles are exact."""
    quarter = angle_rad / (0.5 * np.pi)
    c, s = float(np.cos(angle_rad)), float(np.sin(angle_rad))
    if abs(quarter - round(quarter)) < 1e-9:  # walls stay exactly axis-aligned
        c, s = float(round(c)), float(round(s))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    result: Array = points.copy()
    result[..., first] = c * points[..., first] - s * points[..., second]
    result[..., second] = s * points[..., first] + c * points[..., second]
    return result


def merge(parts: Sequence[Part]) -> Part:
    """Several parts as one."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Part(
        vertices=np.concatenate([part.vertices for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        uv=np.concatenate([part.uv for part in parts]),
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
    )


def unit(vectors: Array) -> Array:
    """Vectors of length 1 with the same direction; zero stays zero. Shape [..., 3]."""
    length = np.sqrt(np.einsum("...i,...i", vectors, vectors))[..., None]
    return np.asarray(vectors / (length + (length == 0.0)))


def cross(a: Array, b: Array) -> Array:
    """Vector product, shape [..., 3]; of few vectors much faster than `np.cross`."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., ahead] * b[..., behind] - a[..., behind] * b[..., ahead])


def _facet(corners: Array, uv: Array) -> Part:
    """A planar quadrilateral; its corners run counter-clockwise, shape [4, 3]."""
    normal = unit(cross(corners[1] - corners[0], corners[2] - corners[0]))
    return Part(
        vertices=corners, normals=np.tile(normal, (4, 1)), uv=uv, faces=np.array([[0, 1, 2], [0, 2, 3]])
    )


def quad(corner: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike) -> Part:
    """A rectangle; its front is on the side of `edge_u x edge_v`, its uv starts at the world's origin."""
    corner, edge_u, edge_v = (np.asarray(value, float) for value in (corner, edge_u, edge_v))
    vertices = np.stack([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v])
    return _facet(vertices, vertices @ np.stack([unit(edge_u), unit(edge_v)], axis=1))


def picture_quad(corner: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike) -> Part:
    """A rectangle whose uv runs from 0 to its size [m], for a picture that fits it exactly."""
    part = quad(corner, edge_u, edge_v)
    return replace(part, uv=part.uv - part.uv[0])


def frame(size: ArrayLike, *, profile: ArrayLike) -> Part:
    """A mitred moulding around a rectangle, of width and height, in the plane y = 0 that faces -y.

    The profile is distance outwards from the rectangle and y [m], from outside to inside, shape [N, 2].
    """
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    rings = []
    for out, y in np.asarray(profile, float):
        x, z = (corners * (0.5 * np.asarray(size, float) + out)).T
        rings.append(np.stack([x, np.full(4, y), z], axis=1))
    parts = []
    for outer, inner in itertools.pairwise(rings):
        for k, after in ((0, 1), (1, 2), (2, 3), (3, 0)):
            points = np.stack([outer[k], outer[after], inner[after], inner[k]])
            along, across = (0, 2) if k % 2 == 0 else (2, 0)
            parts.append(_facet(points, np.stack([points[:, along], points[:, 1] + points[:, across]], 1)))
    return merge(parts)


def grid_surface(points: Array, uv: Array, *, normals: Array | None = None) -> Part:
    """A smooth surface through a grid of points [m], [M, N, 3], with texture coordinates [m], [M, N, 2].

    The front is on the side of d/dN x d/dM reversed, that is of (rightwards along N) x (forwards along M).
    Normals come from the grid itself when not given.
    """
    rows, columns = points.shape[:2]
    if normals is None:
        normals = unit(cross(np.gradient(points, axis=1), np.gradient(points, axis=0)))
    return Part(
        vertices=points.reshape(-1, 3),
        normals=normals.reshape(-1, 3),
        uv=uv.reshape(-1, 2),
        faces=_grid_faces(rows, columns),
    )


@functools.cache
def _grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None, :]).reshape(-1)
    return np.concatenate(
        [
            np.stack([corner, corner + 1, corner + columns + 1], axis=1),
            np.stack([corner, corner + columns + 1, corner + columns], axis=1),
        ]
    )


def without_slivers(part: Part) -> Part:
    """Drop the faces that a pole or a repeated point folds to nothing."""
    a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
    area = 0.5 * np.linalg.norm(cross(b - a, c - a), axis=1)
    return replace(part, faces=part.faces[area > 1e-10])


@dataclass(frozen=True, eq=False)
class _Cube:
    """The surface of a cube as a grid that can be stretched into boxes and cushions."""

    corner: Array
    """Signs of the corner that each vertex belongs to, shape [V, 3]."""
    normals: Array
    """Unit normals of the rounded edge there, shape [V, 3]."""
    points: Array
    """Positions on the cube from -1 to 1, evenly spaced as seen from its middle, shape [V, 3]."""
    side: NDArray[np.int64]
    """Axis of the side that each vertex belongs to, shape [V]."""
    faces: NDArray[np.int64]


@functools.cache
def _cube(lines: int, *, sharp: bool = False) -> _Cube:
    """A cube of `lines` grid lines along each edge; half of them round each corner, unless it is `sharp`."""
    half = lines // 2
    spread = np.linspace(-1.0, 1.0, lines)
    # In a rounded corner the first line is where the flat part ends, the last one is the middle of the edge.
    bend = np.tan(0.25 * np.pi * np.arange(half) / max(1, half - 1))
    offset = np.concatenate([-bend[::-1], bend]) if 2 * half == lines and not sharp else np.zeros(lines)
    across, along = (grid.reshape(-1) for grid in np.meshgrid(*[np.arange(lines)] * 2, indexing="ij"))
    lined = [np.sign(spread), offset, np.tan(0.25 * np.pi * spread)]
    sheets: list[list[Array]] = [[], [], []]
    for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
        first, second = (along, across) if sign > 0.0 else (across, along)
        for sheet, line in zip(sheets, lined, strict=True):
            columns = (np.full(lines * lines, sign), line[first], line[second])
            sheet.append(np.roll(np.stack(columns, axis=1), axis, axis=1))
    corner, normals, points = (np.concatenate(sheet) for sheet in sheets)
    return _Cube(
        corner=corner,
        normals=unit(normals),
        points=points,
        side=np.repeat(np.arange(3), 2 * lines * lines),
        faces=np.concatenate([_grid_faces(lines, lines) + k * lines * lines for k in range(6)]),
    )


def _planar_uv(positions: Array, side: NDArray[np.int64], grain: int) -> Array:
    """Project each vertex along the axis of its side; u follows the grain where that lies in the side."""
    along = np.where(side == grain, (side + 1) % 3, grain)
    index = np.arange(len(positions))
    return np.stack([positions[index, along], positions[index, 3 - side - along]], axis=1)


def box(size: ArrayLike, *, edge: float = 0.0, segments: int = 1, grain: int = 0) -> Part:
    """A box about the origin, sharp or rounded.

    `edge` is the radius of edges and corners [m]; at most nearly half the shortest edge is used. 1 segment
    per half edge makes 108 triangles, 2 make 300, a sharp box has 12. u follows the axis `grain`.
    """
    half = 0.5 * np.asarray(size, float)
    radius = min(edge, 0.98 * float(half.min()))
    cube = _cube(2 * (segments + 1)) if edge else _cube(2, sharp=True)
    vertices = cube.corner * (half - radius) + radius * cube.normals
    uv = _planar_uv(vertices, cube.side, grain)
    return Part(vertices=vertices, normals=cube.normals, uv=uv, faces=cube.faces)


def cushion(
    size: ArrayLike, *, power: ArrayLike = (2.0, 2.0, 2.0), segments: int = 7, folds: Sequence[float] = ()
) -> Part:
    """A soft body |x/a|^p + |y/b|^q + |z/c|^r = 1 about the origin: from an egg (2) to nearly a box (8).

    It has 12 * segments^2 triangles. `folds` are the phases of two waves of 6 mm that crease its top, as of a
    blanket; none leave it smooth.
    """
    half = 0.5 * np.asarray(size, float)
    exponent = np.asarray(power, float)
    cube = _cube(segments + 1)
    scale = np.ones(len(cube.points))
    for _ in range(10):  # Newton on sum |s x|^p = 1, convex and rising in s: converges from above
        value = np.abs(cube.points * scale[:, None]) ** exponent
        scale -= (value.sum(axis=1) - 1.0) * scale / (exponent * value).sum(axis=1)
    surface = cube.points * scale[:, None]
    normals = unit(np.sign(surface) * exponent * np.abs(surface) ** (exponent - 1.0) / half)
    vertices = surface * half
    for phase, height, wave in zip(folds, (0.006, 0.0042), ((9.0, 3.0), (5.0, -8.0)), strict=False):
        angle = vertices[:, :2] @ wave + phase
        vertices[:, 2] += height * np.sin(angle) * np.clip(2.0 * surface[:, 2], 0.0, 1.0)
        slope = height * np.cos(angle) * np.clip(normals[:, 2], 0.0, 1.0)
        normals = normals - np.append(slope[:, None] * wave, np.zeros((len(slope), 1)), axis=1)
    uv = _planar_uv(cube.points * half, cube.side, 0)
    return Part(vertices=vertices, normals=unit(normals), uv=uv, faces=cube.faces)


def lathe(
    profile: ArrayLike,
    *,
    sides: int = 24,
    crease: float = 0.6,
    stretch: tuple[float, float] = (1.0, 1.0),
    power: float = 2.0,
) -> Part:
    """A body turned about the z axis, of so many sides.

    The profile is radius and height [m] of the outline, shape [N, 2], counter-clockwise seen with the axis on
    the left: from the bottom outwards and up; an edge is sharp from a bend of `crease` on [rad]. Seen from
    above it is |x|^p + |y|^p = 1, stretched along x and y: 2 is a circle, 8 nearly a square.
    """
    outline = np.asarray(profile, float)
    segment = np.diff(outline, axis=0)
    heading = np.arctan2(segment[:, 1], segment[:, 0])
    bend = np.abs((np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi)
    cuts = [0, *(np.nonzero(bend > crease)[0] + 1), len(outline) - 1]
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outward = np.sign(around) * np.abs(around) ** (power - 1.0) / stretch  # normal of the outline from above
    around /= (np.abs(around) ** power).sum(axis=1, keepdims=True) ** (1.0 / power)
    around, outward = around * stretch, outward / (np.abs(around * outward).sum(axis=1, keepdims=True))
    around[-1], outward[-1] = around[0], outward[0]
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(segment, axis=1))])
    girth = 2.0 * np.pi * float(outline[:, 0].max()) * max(stretch)
    parts = []
    for first, last in itertools.pairwise(cuts):
        run = outline[first : last + 1]
        tangent = np.gradient(run, axis=0) if len(run) > 2 else np.tile(run[1] - run[0], (2, 1))
        points, normals = np.empty((2, len(run), sides + 1, 3))
        points[..., :2], points[..., 2] = run[:, :1, None] * around, run[:, 1:]
        normals[..., :2], normals[..., 2] = tangent[:, 1:, None] * outward, -tangent[:, :1]
        wound = np.broadcast_arrays((angle / (2.0 * np.pi) * girth)[None], length[first : last + 1, None])
        flat = np.all(np.abs(run[:, 1] - run[0, 1]) < 1e-9)  # the texture of a disc must not wind around
        uv = points[..., :2].copy() if flat else np.stack(wound, axis=-1)
        parts.append(grid_surface(points, uv, normals=unit(normals)))
    return without_slivers(merge(parts))


def cylinder(size: tuple[float, float, float], *, sides: int = 24, edge: float = 0.0) -> Part:
    """An upright cylinder of a radius, from a bottom to a top [m], with a chamfer of `edge` at both ends."""
    radius, bottom, top = size
    if edge == 0.0:
        return lathe([(0.0, bottom), (radius, bottom), (radius, top), (0.0, top)], sides=sides)
    side = [(radius - edge, bottom), (radius, bottom + edge), (radius, top - edge), (radius - edge, top)]
    return lathe([(0.0, bottom), *side, (0.0, top)], sides=sides)


def tube(path: ArrayLike, *, radius: ArrayLike, sides: int = 8) -> Part:
    """A round bar along points [m], shape [N, 3], closed at both ends; one radius, or one per point."""
    spine = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radius, float), (len(spine),))
    tangent = unit(np.gradient(spine, axis=0))
    side = np.empty_like(spine)
    guide = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    for index, direction in enumerate(tangent):  # carry one frame along, so that the tube does not twist
        guide = side[index] = unit(guide - direction * float(guide @ direction))
    other = cross(tangent, side)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)[None, :, None]
    normals = np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]
    normals[:, -1] = normals[:, 0]
    points = spine[:, None] + radii[:, None, None] * normals
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spine, axis=0), axis=1))])
    # The grain runs along the bar.
    uv = np.stack(np.broadcast_arrays(length[:, None], angle[..., 0] * float(radii.max())), axis=-1)
    parts = [grid_surface(points, uv, normals=normals)]
    fan = np.arange(1, sides - 1)
    for end, outward, ring in ((0, -tangent[0], points[0, -2::-1]), (-1, tangent[-1], points[-1, :-1])):
        flat = (ring - spine[end]) @ np.stack([side[end], other[end]], axis=1)
        faces = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
        parts.append(Part(vertices=ring, normals=np.tile(outward, (sides, 1)), uv=flat, faces=faces))
    return merge(parts)
