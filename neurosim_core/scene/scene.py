"""A scene that is loaded or generated: triangles, materials and lights.

Metres, z up, linear light.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.texels import packed_levels
from neurosim_core.scene.topology import connect_faces
from neurosim_core.scene.triangles import corner_columns, dot, double_areas, face_vectors

LinearRgb = tuple[float, float, float]
"""Linear-light red, green, blue (Rec. 709 primaries)."""


def extent(points: NDArray[Any]) -> NDArray[Any]:
    """Return the lowest and the highest corner of points, shape [..., 3] -> [2, 3].

    Axis by axis: NumPy takes 25 times as long to reduce rows of three numbers.
    """
    axes = [points[..., axis] for axis in range(3)]
    return np.array([[values.min() for values in axes], [values.max() for values in axes]])


class Texture:
    """A texture; a generated one is painted at its first use."""

    def __init__(
        self,
        *,
        name: str,
        srgb: NDArray[np.uint8] | Callable[[], NDArray[np.uint8]],
        levels: Callable[[], list[NDArray[np.uint32]]] | None = None,
    ) -> None:
        """Take texels as `srgb` has them, or what paints them; `levels`: what packs them elsewhere."""
        self.name = name
        self._source = srgb
        self._levels = levels

    # No `cached_property`: before Python 3.12 it has one lock for all textures, so threads would take turns.
    @property
    def srgb(self) -> NDArray[np.uint8]:
        """8-bit sRGB texels as stored in the file, shape [H, W, 3]; row 0 is v = 1 (top, as in a picture)."""
        source = self._source
        if callable(source):
            source = self._source = source()
        return source

    def decode(self) -> None:
        """Look at the texels now: raises what is wrong with their picture."""
        self.srgb  # noqa: B018

    def pack_levels(self) -> list[NDArray[np.uint32]]:
        """Return the packed texels of all mip levels, shape [H, W] each; they are not kept."""
        return packed_levels(self.srgb) if self._levels is None else self._levels()


@dataclass(frozen=True, kw_only=True, eq=False)
class Material:
    """A Lambertian surface that may also emit light."""

    name: str
    base_color: LinearRgb = (0.8, 0.8, 0.8)
    """Albedo, linear, in [0, 1]; multiplies the texture."""
    texture: Texture | None = None
    emission: LinearRgb = (0.0, 0.0, 0.0)
    """Emitted radiance, linear; seen by cameras, lights nothing (lamps come with a `Light`)."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """A point light: radiance reflected by a white surface at distance d facing it is intensity / d^2."""

    position_m: tuple[float, float, float]
    intensity: LinearRgb
    """Reflected radiance at 1 m, linear."""


@dataclass(frozen=True, kw_only=True)
class Ambient:
    """Hemispheric light: a white surface facing up reflects `up`, one facing down reflects `down`."""

    up: LinearRgb = (0.35, 0.35, 0.36)
    down: LinearRgb = (0.22, 0.21, 0.20)


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedMesh:
    """Triangles of a scene after `render.refine`."""

    vertices: NDArray[np.float32]
    """Positions [m], shape [V, 3]; the first are those of the scene."""
    normals: NDArray[np.float32]
    """Unit shading normals, shape [V, 3]."""
    uv: NDArray[np.float32]
    """Texture coordinates, shape [V, 2]."""
    faces: NDArray[np.int32]
    """Vertex indices, shape [F, 3]."""
    origin: NDArray[np.int32]
    """Face of the scene that each face is a part of, shape [F]."""

    @cached_property
    def areas_m2(self) -> NDArray[np.float64]:
        """Area of each face [m^2], shape [F]."""
        return 0.5 * double_areas(corner_columns(self.vertices.astype(np.float64), self.faces))

    @cached_property
    def corner_normals(self) -> NDArray[np.float32]:
        """Shading normal of each corner, turned to the front of its face, shape [F, 3, 3]."""
        front = face_vectors(corner_columns(self.vertices, self.faces))
        normals = corner_columns(self.normals, self.faces)
        sign = np.where(dot(normals, front[:, None]) < 0.0, np.float32(-1.0), np.float32(1.0))
        return np.ascontiguousarray((normals * sign).T)

    @cached_property
    def corner_groups(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Group number of each corner [3F] and one corner of each group: same place, same normal.

        Places are told apart to 2^-20 of the scene's size, normals to 1/64.
        """
        low, high = extent(self.vertices)
        quantum = max(float((high - low).max()) / (1 << 20), 1e-9)
        place = np.rint((self.vertices - low) / quantum).astype(np.int64)
        _, place_id = np.unique(place[:, 0] << 42 | place[:, 1] << 21 | place[:, 2], return_inverse=True)
        facing = np.rint(self.corner_normals.reshape(-1, 3) * 64.0).astype(np.int64) + 64
        key = place_id[self.faces.reshape(-1)] << 24 | facing[:, 0] << 16 | facing[:, 1] << 8 | facing[:, 2]
        _, example, group = np.unique(key, return_index=True, return_inverse=True)
        order = np.argsort(example)  # in the order of faces: neighbours in space run after each other
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        return rank[group], example[order]


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Triangles with materials and lights. World frame: metres, z up.

    Raises:
        ValueError: There are no triangles.
    """

    name: str
    vertices: NDArray[np.float32]
    """Positions [m], shape [V, 3]. Vertices are split where uv or normals differ."""
    faces: NDArray[np.int32]
    """Vertex indices, shape [F, 3], counter-clockwise seen from the front. Surfaces are two-sided."""
    normals: NDArray[np.float32]
    """Unit shading normal of each vertex, shape [V, 3]."""
    uv: NDArray[np.float32]
    """Texture coordinates of each vertex, shape [V, 2]; v = 1 is the top row of the texture; wraps around."""
    face_material: NDArray[np.int32]
    """Index into `materials`, shape [F]."""
    face_instance: NDArray[np.int32]
    """Index into `instance_names`, shape [F]: which object a face belongs to."""
    instance_names: tuple[str, ...]
    materials: tuple[Material, ...]
    lights: tuple[Light, ...] = ()
    ambient: Ambient = field(default_factory=Ambient)
    sky: LinearRgb = (0.55, 0.7, 0.95)
    """Radiance of rays that hit nothing."""
    notes: tuple[str, ...] = ()
    """Assumptions, losses and repairs of loading, one sentence each; shown to the user."""
    instance_labels: Mapping[str, str] = field(default_factory=dict)
    """Classes of instances, such as "chair", by name, where the file says them."""
    inside_m: tuple[float, float, float] | None = None
    """A point known to be in free space, if the source of the scene knows one [m]."""
    closed: bool = False
    """Whether paths must begin inside: there is nothing to see from outside."""

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What was subtracted from the coordinates of the file, in metres and with z up, as float32 could not
    tell places apart so far from its zero [m]."""

    refine: Callable[[], Mapping[float | None, RefinedMesh]] | None = None
    """Returns meshes that `render.refine` has made of it elsewhere, by their longest edge [m]; None: none."""
    connect: Callable[[], tuple[NDArray[np.int32], NDArray[np.int32]]] | None = None
    """Returns what `connect_faces` has returned elsewhere; None: it is called here."""

    def __post_init__(self) -> None:
        """Refuse what renderers cannot show: a GPU would look for its tree in memory that is not there."""
        if len(self.faces) == 0:
            raise ValueError(f"a scene must have triangles, and {self.name!r} has none")

    @cached_property
    def refined(self) -> Mapping[float | None, RefinedMesh]:
        """The result of `refine`."""
        return {} if self.refine is None else self.refine()

    @cached_property
    def connections(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The result of `connect_faces`."""
        return connect_faces(self) if self.connect is None else self.connect()

    @cached_property
    def bounds_m(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m], shape [2, 3]."""
        return extent(self.vertices.take(self.faces, axis=0)).astype(np.float64)
