"""Solids that furniture and walls are made of: boxes, rounded boxes, lathed and swept bodies, sheets.

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
        return self.turned(yaw_rad, axis=2).shifted(offset) if yaw_rad else self.shifted(offset)

    def shifted(self, offset: ArrayLike) -> Part:
        """The part shifted by `offset` [m]."""
        return replace(self, vertices=self.vertices + np.asarray(offset, float))

    def turned(self, angle_rad: float, *, axis: int) -> Part:
        """The part turned about a coordinate axis through the origin, right-handed."""
        return replace(
            self,
            vertices=turned(self.vertices, angle_rad, axis=axis),
            normals=turned(self.normals, angle_rad, axis=axis),
        )


def turned(points: Array, angle_rad: float, *, axis: int) -> Array:
    """Vectors turned about a coordinate axis, right-handed, shape [..., 3]."""
    c, s = _cos_sin(angle_rad)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    result: Array = points.copy()
    result[..., first] = c * points[..., first] - s * points[..., second]
    result[..., second] = s * points[..., first] + c * points[..., second]
    return result


def _cos_sin(angle_rad: float) -> tuple[float, float]:
    """Cosine and sine, exact for multiples of a right angle, so that walls stay exactly axis-aligned."""
    quarter = angle_rad / (0.5 * np.pi)
    if abs(quarter - round(quarter)) < 1e-9:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarter) % 4]
    return float(np.cos(angle_rad)), float(np.sin(angle_rad))


def merge(parts: Sequence[Part]) -> Part:
    """Several parts as one."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Part(
        vertices=np.concatenate([part.vertices for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        uv=np.concatenate([part.uv for part in parts]),
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
    )


def quad(corner: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike) -> Part:
    """A rectangle; its front is on the side of `edge_u x edge_v`, its uv starts at the world's origin."""
    corner, edge_u, edge_v = (np.asarray(value, float) for value in (corner, edge_u, edge_v))
    vertices = np.stack([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v])
    normal = np.cross(edge_u, edge_v)
    along = np.stack([edge_u / np.linalg.norm(edge_u), edge_v / np.linalg.norm(edge_v)], axis=1)
    return Part(
        vertices=vertices,
        normals=np.tile(normal / np.linalg.norm(normal), (4, 1)),
        uv=vertices @ along,
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
    )


def picture_quad(corner: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike) -> Part:
    """A rectangle whose uv runs from 0 to its size [m], for a picture that fits it exactly."""
    part = quad(corner, edge_u, edge_v)
    return replace(part, uv=part.uv - part.uv[0])


def grid_surface(points: Array, uv: Array, *, normals: Array | None = None, closed_u: bool = False) -> Part:
    """A smooth surface through a grid of points.

    Args:
        points: Positions [m], shape [M, N, 3]; the front is on the side of d/dN x d/dM reversed, that is of
            (rightwards along N) x (forwards along M).
        uv: Texture coordinates [m], shape [M, N, 2].
        normals: Unit normals, shape [M, N, 3]; from the grid itself when not given.
        closed_u: The last column lies on the first one (a tube): normals there are averaged.
    """
    rows, columns = points.shape[:2]
    if normals is None:
        along_n = np.gradient(points, axis=1)
        if closed_u:
            along_n[:, 0] = along_n[:, -1] = (points[:, 1] - points[:, -2]) / 2.0
        normal = np.cross(along_n, np.gradient(points, axis=0))
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        normals = normal / np.where(length > 0.0, length, 1.0)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None, :]).reshape(-1)
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + columns + 1], axis=1),
            np.stack([corner, corner + columns + 1, corner + columns], axis=1),
        ]
    )
    return Part(
        vertices=points.reshape(-1, 3), normals=normals.reshape(-1, 3), uv=uv.reshape(-1, 2), faces=faces
    )


def without_slivers(part: Part) -> Part:
    """Drop the faces that a pole or a repeated point folds to nothing."""
    a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return replace(part, faces=part.faces[area > 1e-10])


@dataclass(frozen=True, eq=False)
class _Cube:
    """The surface of a cube as a grid that can be stretched into boxes."""

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
    offset = np.concatenate([-bend[::-1], bend]) if 2 * half == lines else np.zeros(lines)
    rows, columns = (
        grid.reshape(-1) for grid in np.meshgrid(np.arange(lines), np.arange(lines), indexing="ij")
    )
    cell = (np.arange(lines - 1)[:, None] * lines + np.arange(lines - 1)[None, :]).reshape(-1)
    quads = np.stack(
        [cell, cell + 1, cell + lines + 1, cell, cell + lines + 1, cell + lines], axis=1
    ).reshape(-1, 3)
    corner: list[Array] = []
    normals: list[Array] = []
    points: list[Array] = []
    side: list[NDArray[np.int64]] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            right, up = (axis + 1) % 3, (axis + 2) % 3
            if sign < 0.0:
                right, up = up, right
            at, bent, spot = (
                np.empty((lines * lines, 3)),
                np.empty((lines * lines, 3)),
                np.empty((lines * lines, 3)),
            )
            at[:, right], at[:, up], at[:, axis] = np.sign(spread[columns]), np.sign(spread[rows]), sign
            bent[:, right], bent[:, up], bent[:, axis] = offset[columns], offset[rows], sign
            if sharp:
                bent[:, [right, up]] = 0.0
            tangent = np.tan(0.25 * np.pi * spread)
            spot[:, right], spot[:, up], spot[:, axis] = tangent[columns], tangent[rows], sign
            faces.append(quads + len(faces) * lines * lines)
            corner.append(at)
            normals.append(bent / np.linalg.norm(bent, axis=1, keepdims=True))
            points.append(spot)
            side.append(np.full(lines * lines, axis))
    return _Cube(
        corner=np.concatenate(corner),
        normals=np.concatenate(normals),
        points=np.concatenate(points),
        side=np.concatenate(side),
        faces=np.concatenate(faces),
    )


def _planar_uv(positions: Array, side: NDArray[np.int64], grain: int) -> Array:
    """Project each vertex along the axis of its side; u follows the grain where that lies in the side."""
    along = np.where(side == grain, (side + 1) % 3, grain)
    index = np.arange(len(positions))
    return np.stack([positions[index, along], positions[index, 3 - side - along]], axis=1)


def box(size: ArrayLike, *, center: ArrayLike = (0.0, 0.0, 0.0), grain: int = 0) -> Part:
    """A sharp box.

    Args:
        size: Edge lengths [m].
        center: Where its middle is [m].
        grain: Axis that u follows.
    """
    cube = _cube(2, sharp=True)
    vertices = cube.corner * (0.5 * np.asarray(size, float))
    uv = _planar_uv(vertices, cube.side, grain)
    return Part(vertices=vertices + np.asarray(center, float), normals=cube.normals, uv=uv, faces=cube.faces)


def rounded_box(
    size: ArrayLike,
    radius_m: float,
    *,
    center: ArrayLike = (0.0, 0.0, 0.0),
    grain: int = 0,
    segments: int = 1,
) -> Part:
    """A box whose edges and corners are rounded.

    Args:
        size: Outer edge lengths [m].
        radius_m: Radius of the edges [m]; at most nearly half the shortest edge is used.
        center: Where its middle is [m].
        grain: Axis that u follows.
        segments: Facets per half edge; 1 makes 108 triangles, 2 make 300.
    """
    cube = _cube(2 * (segments + 1))
    half = 0.5 * np.asarray(size, float)
    radius = min(radius_m, 0.98 * float(half.min()))
    vertices = cube.corner * (half - radius) + radius * cube.normals
    uv = _planar_uv(vertices, cube.side, grain)
    return Part(vertices=vertices + np.asarray(center, float), normals=cube.normals, uv=uv, faces=cube.faces)


def cushion(
    size: ArrayLike,
    *,
    center: ArrayLike = (0.0, 0.0, 0.0),
    power: ArrayLike = (4.0, 4.0, 2.4),
    grain: int = 0,
    segments: int = 7,
) -> Part:
    """A soft body |x/a|^p + |y/b|^q + |z/c|^r = 1: from an egg (2) to nearly a box (8).

    Args:
        size: Outer edge lengths [m].
        center: Where its middle is [m].
        power: Exponents per axis.
        grain: Axis that u follows.
        segments: Facets along each edge; 12 * segments^2 triangles.
    """
    half = 0.5 * np.asarray(size, float)
    exponent = np.asarray(power, float)
    cube = _cube(segments + 1)
    scale = np.ones(len(cube.points))
    for _ in range(10):  # Newton on sum |s x|^p = 1, convex and rising in s: converges from above
        value = np.abs(cube.points * scale[:, None]) ** exponent
        scale -= (value.sum(axis=1) - 1.0) * scale / (exponent * value).sum(axis=1)
    surface = cube.points * scale[:, None]
    normals = np.sign(surface) * exponent * np.abs(surface) ** (exponent - 1.0) / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = _planar_uv(cube.points * half, cube.side, grain)
    return Part(vertices=surface * half + np.asarray(center, float), normals=normals, uv=uv, faces=cube.faces)


def lathe(
    profile: ArrayLike, *, sides: int = 24, crease_rad: float = 0.6, center: ArrayLike = (0.0, 0.0, 0.0)
) -> Part:
    """A body turned about the z axis.

    Args:
        profile: Radius and height [m] of the outline, shape [N, 2], counter-clockwise seen with the axis on
            the left: from the bottom outwards and up. A point is a sharp edge where the outline bends by more
            than `crease_rad`.
        sides: Facets around.
        crease_rad: Bend from which on an edge is sharp [rad].
        center: Added to all positions [m].
    """
    outline = np.asarray(profile, float)
    segment = np.diff(outline, axis=0)
    heading = np.arctan2(segment[:, 1], segment[:, 0])
    bend = np.abs((np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi)
    cuts = [0, *(np.nonzero(bend > crease_rad)[0] + 1), len(outline) - 1]
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around[-1] = around[0]
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(segment, axis=1))])
    girth = 2.0 * np.pi * float(outline[:, 0].max())
    parts = []
    for first, last in itertools.pairwise(cuts):
        run = outline[first : last + 1]
        tangent = np.gradient(run, axis=0) if len(run) > 2 else np.tile(run[1] - run[0], (2, 1))
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        points = np.empty((len(run), sides + 1, 3))
        points[..., :2] = run[:, :1, None] * around[None]
        points[..., 2] = run[:, 1:]
        normals = np.empty_like(points)
        normals[..., :2] = tangent[:, 1:, None] * around[None]
        normals[..., 2] = -tangent[:, :1]
        flat = np.all(np.abs(run[:, 1] - run[0, 1]) < 1e-9)
        if flat:  # a disc: its texture must not wind around
            uv = points[..., :2].copy()
        else:
            uv = np.stack(
                np.broadcast_arrays((angle / (2.0 * np.pi) * girth)[None], length[first : last + 1, None]), -1
            )
        parts.append(grid_surface(points, uv, normals=normals))
    return without_slivers(merge(parts)).shifted(center)


def cylinder(
    radius_m: float,
    bottom_m: float,
    top_m: float,
    *,
    x: float = 0.0,
    y: float = 0.0,
    sides: int = 24,
    edge_m: float = 0.0,
) -> Part:
    """An upright cylinder with an optional chamfer of `edge_m` at both ends."""
    profile = [(0.0, bottom_m), (radius_m - edge_m, bottom_m), (radius_m, bottom_m + edge_m)]
    profile += [(radius_m, top_m - edge_m), (radius_m - edge_m, top_m), (0.0, top_m)]
    if edge_m == 0.0:
        profile = [profile[0], profile[1], profile[4], profile[5]]
    return lathe(profile, sides=sides, center=(x, y, 0.0))


def tube(path: ArrayLike, radius_m: ArrayLike, *, sides: int = 12) -> Part:
    """A round bar along a path, closed at both ends.

    Args:
        path: Points [m], shape [N, 3].
        radius_m: Radius [m], one or per point.
        sides: Facets around.
    """
    spine = np.asarray(path, float)
    radius = np.broadcast_to(np.asarray(radius_m, float), (len(spine),))
    tangent = np.gradient(spine, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.empty_like(spine)
    guide = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    for index, direction in enumerate(tangent):  # carry one frame along, so that the tube does not twist
        guide = guide - direction * float(guide @ direction)
        guide /= np.linalg.norm(guide)
        side[index] = guide
    other = np.cross(tangent, side)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    normals = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    normals[:, -1] = normals[:, 0]
    points = spine[:, None] + radius[:, None, None] * normals
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spine, axis=0), axis=1))])
    around = angle * float(radius.max())
    # The grain runs along the bar.
    uv = np.stack(np.broadcast_arrays(length[:, None], around[None]), axis=-1)
    parts = [grid_surface(points, uv, normals=normals)]
    for index, direction in ((0, -tangent[0]), (len(spine) - 1, tangent[-1])):
        ring = points[index, :-1] if index else points[index, -2::-1]
        fan = np.arange(1, sides - 1)
        parts.append(
            Part(
                vertices=ring,
                normals=np.tile(direction, (sides, 1)),
                uv=np.stack(
                    [(ring - spine[index]) @ side[index], (ring - spine[index]) @ other[index]], axis=1
                ),
                faces=np.stack([np.zeros_like(fan), fan, fan + 1], axis=1),
            )
        )
    return merge(parts)


def strip(profile: ArrayLike, length_m: float) -> Part:
    """An open moulding along x from 0 to `length_m`.

    Args:
        profile: Points (y, z) [m], shape [N, 2]; the front is on the left of the way along it.
        length_m: Length [m].
    """
    outline = np.asarray(profile, float)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    parts = []
    for index, ((y0, z0), (y1, z1)) in enumerate(itertools.pairwise(outline)):
        part = quad((0.0, y0, z0), (length_m, 0.0, 0.0), (0.0, y1 - y0, z1 - z0))
        uv = np.array(
            [[0.0, run[index]], [length_m, run[index]], [length_m, run[index + 1]], [0.0, run[index + 1]]]
        )
        parts.append(replace(part, uv=uv))
    return merge(parts)


def panel_with_holes(
    width_m: float, height_m: float, holes: Sequence[tuple[float, float, float, float]]
) -> Part:
    """A wall in the plane y = 0 that faces -y, from x = 0 and z = 0 on, with rectangular openings.

    Args:
        width_m: Extent along x [m].
        height_m: Extent along z [m].
        holes: Openings (x0, z0, x1, z1) [m], inside the wall and apart from each other.
    """
    x_lines = sorted({0.0, width_m, *(x for hole in holes for x in (hole[0], hole[2]))})
    parts = []
    for x0, x1 in itertools.pairwise(x_lines):
        over = sorted((z0, z1) for a, z0, b, z1 in holes if a < 0.5 * (x0 + x1) < b)
        ends = [0.0, *(z for span in over for z in span), height_m]
        for z0, z1 in zip(ends[0::2], ends[1::2], strict=True):
            if z1 > z0:
                parts.append(quad((x0, 0.0, z0), (x1 - x0, 0.0, 0.0), (0.0, 0.0, z1 - z0)))
    return merge(parts)
