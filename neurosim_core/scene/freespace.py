# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type"
"""The free space of a scene: distances on a voxel grid, what can be reached, collisions in flight.

The distance is unsigned and exact at voxel centres (nearest point on any triangle). It is 1-Lipschitz, so a
value at one place bounds it at another; every guarantee of this module and of the planner rests on that and
on this identity: if both ends a, b of a segment of length L are at least D from every obstacle point q, then
all of it is at least sqrt(D^2 - L^2 / 4) away, because at x = a + s (b - a)
|x - q|^2 = (1 - s) |a - q|^2 + s |b - q|^2 - s (1 - s) L^2.

An unsigned distance does not know a room from the inside of a sofa. So free space is what a flood fill
reaches from a seed; it cannot pass a surface, and never enters a closed solid.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # which imports its parts when they are used
import warp as wp
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from neurosim_core.frames import Vector3
from neurosim_core.scene.scene import Scene
from neurosim_core.settings import BaseConfig

wp.set_module_options({"enable_backward": False})

Array = NDArray[np.float64]

_ROOM_MIN_M3 = 12.0
"""Smaller regions with walls around them are taken for the insides of things."""
_SIGHT, _SIGHT_MIN_M = 100.0, 1000.0
"""From so many diagonals of a scene, and no fewer metres, nothing of it is seen."""
_CPU_CHUNKS = 8
"""Launches that the columns of a grid are divided into on the CPU, for two or more threads to share."""


_BESIDE_M = 3.0
"""How far free space reaches from a scene that is flat, such as a ground or a poster [m]."""


class FreeSpaceConfig(BaseConfig):
    """A map of the distance to the scene, in which paths are planned."""

    voxel_m: float = Field(default=0.1, ge=1e-6)
    """Edge length of a voxel of the map [m]."""
    voxel_count_max: int = Field(default=8_000_000, ge=1_000)
    """Largest number of voxels, 4 bytes each; a larger scene gets coarser ones, and a note says so."""
    seed_m: Vector3 | None = None
    """A point in the space to fly in [m]; null: the `inside_m` of the scene, else a search finds one."""


@wp.struct
class DistanceField:
    """Distance to the scene, on a device."""

    mesh: wp.uint64  # Triangles of the scene (`wp.Mesh.id`)
    distance: wp.array3d[wp.float32]  # Exact distance at voxel centres [m], shape [nx, ny, nz]
    origin: wp.vec3  # Centre of voxel (0, 0, 0) [m]
    voxel: wp.float32  # Spacing [m]


@wp.func
def mesh_distance(mesh: wp.uint64, point: wp.vec3, distance_max: float) -> float:
    """Return the exact distance to the nearest triangle [m], or `distance_max` if none is nearer."""
    query = wp.mesh_query_point_no_sign(mesh, point, distance_max)
    distance = distance_max
    if query.result:
        distance = wp.length(point - wp.mesh_eval_position(mesh, query.face, query.u, query.v))
    return distance


@wp.func
def sample_distance(field: DistanceField, point: wp.vec3) -> wp.vec2:
    """Return (value, error bound) of the distance at a point, from the grid alone [m].

    The value is trilinear between voxel centres, and |value - distance| <= bound. With weights w_i of centres
    c_i, the bound is sum w_i |c_i - p| <= sqrt(sum w_i |c_i - p|^2) = voxel sqrt(sum u (1 - u)), at most 0.87
    voxel. Outside the outermost centres the value is that at the nearest point of their box; the bound grows
    accordingly.
    """
    nx = field.distance.shape[0]
    ny = field.distance.shape[1]
    nz = field.distance.shape[2]
    place = (point - field.origin) / field.voxel
    inside = wp.vec3(
        wp.clamp(place[0], 0.0, float(nx - 1)),
        wp.clamp(place[1], 0.0, float(ny - 1)),
        wp.clamp(place[2], 0.0, float(nz - 1)),
    )
    x0 = wp.min(int(inside[0]), nx - 2)
    y0 = wp.min(int(inside[1]), ny - 2)
    z0 = wp.min(int(inside[2]), nz - 2)
    u = inside - wp.vec3(float(x0), float(y0), float(z0))
    value = wp.float32(0.0)
    for dx in range(2):
        for dy in range(2):
            for dz in range(2):
                wx = wp.where(dx == 1, u[0], 1.0 - u[0])
                wy = wp.where(dy == 1, u[1], 1.0 - u[1])
                wz = wp.where(dz == 1, u[2], 1.0 - u[2])
                value += wx * wy * wz * field.distance[x0 + dx, y0 + dy, z0 + dz]
    spread = u[0] * (1.0 - u[0]) + u[1] * (1.0 - u[1]) + u[2] * (1.0 - u[2])
    bound = field.voxel * (wp.sqrt(wp.max(spread, 0.0)) + wp.length(place - inside) + 1.0e-4)
    return wp.vec2(value, bound)


@wp.func
def scene_distance(field: DistanceField, point: wp.vec3, exact_below: float) -> float:
    """Return the distance to the scene [m]: exact if it is below `exact_below`, else a lower bound above it.

    The grid answers first; the triangles are asked only where the grid cannot exclude that something is near.
    """
    sample = sample_distance(field, point)
    distance = sample[0] - sample[1]
    if distance <= exact_below:
        distance = mesh_distance(field.mesh, point, sample[0] + sample[1])
    return distance


@wp.kernel
def _fill_distance(
    # Model:
    mesh: wp.uint64,
    origin: wp.vec3,
    voxel: float,
    reach: float,
    first_column: int,
    # Out:
    distance_out: wp.array3d[wp.float32],
) -> None:
    column = first_column + wp.tid()
    x = column // distance_out.shape[1]
    y = column % distance_out.shape[1]
    limit = reach
    for z in range(distance_out.shape[2]):
        point = origin + voxel * wp.vec3(float(x), float(y), float(z))
        distance = mesh_distance(mesh, point, limit)
        distance_out[x, y, z] = distance
        limit = (distance + voxel) * 1.0001  # the next one cannot be farther: short queries are fast


@wp.kernel
def _mesh_distances(
    # Model:
    mesh: wp.uint64,
    reach: float,
    # In:
    points: wp.array[wp.vec3],
    # Out:
    distance_out: wp.array[wp.float32],
) -> None:
    sample = wp.tid()
    distance_out[sample] = mesh_distance(mesh, points[sample], reach)


_GROUND_SLACK_M = 0.01  # how far a floor may be above the plane meant by it


@wp.func
def clearance_around(
    field: DistanceField, radius_m: float, exact_below: float, ground_height_m: wp.float64, p: wp.vec3d
) -> float:
    """Return how much room a sphere has around it [m], negative: it touches.

    Exact (to float32 rounding) below `exact_below` less the radius, and a lower bound elsewhere. A sphere
    that would reach the plane at `ground_height_m`, which may be landed on, is taken as one that ends 1 cm
    above it.
    """
    point = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    radius = wp.min(radius_m, float(p[2] - ground_height_m) - _GROUND_SLACK_M)
    return scene_distance(field, point, exact_below) - radius


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FreeSpace:
    """The map of a scene that paths are planned on."""

    distance: NDArray[np.float32]
    """Distance from voxel centres to the nearest triangle [m], exact, shape [nx, ny, nz]."""
    origin_m: Array
    """Centre of voxel (0, 0, 0) [m], shape [3]."""
    voxel_m: float
    """Spacing [m]."""
    bounds_m: Array
    """Lowest and highest corner of the scene [m], shape [2, 3]; beyond them nothing is free."""
    seed_m: Array
    """A point in the free space that is meant [m], shape [3]."""
    closed: bool
    """Outside there is nothing to fly in (`Scene.closed`), and no `seed_m` of the configuration says else."""
    notes: tuple[str, ...]
    """Assumptions, one sentence each; shown to the user."""
    arrays: DistanceField
    """The map on its device, for kernels."""
    mesh: wp.Mesh
    """Triangles on the device; kept alive with this."""
    device: str
    """Device of `arrays` and `mesh`."""

    def clearance(self, points: ArrayLike) -> Array:
        """Return the exact distance [m] of points [n, 3] to the nearest triangle or bound; < 0 outside."""
        rows = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        on_device: Any = wp.array(rows.astype(np.float32), dtype=wp.vec3, device=self.device)
        out: Any = wp.empty(len(rows), dtype=wp.float32, device=self.device)
        wp.launch(
            _mesh_distances, dim=len(rows), inputs=[self.arrays.mesh, 1e9, on_device, out], device=self.device
        )
        return np.minimum(out.numpy().astype(np.float64), self._to_bounds(rows))

    def interpolated(self, points: ArrayLike) -> Array:
        """Return the clearance [m] as the grid has it, trilinear: within 0.87 voxel of the exact one."""
        rows = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        place = ((rows - self.origin_m) / self.voxel_m).T
        grid = scipy.ndimage.map_coordinates(self.distance, place, order=1, mode="nearest", prefilter=False)
        return np.minimum(grid.astype(np.float64), self._to_bounds(rows))

    def reachable(self, clearance_m: float) -> NDArray[np.bool_]:
        """Return which voxel centres can be reached from the seed at a clearance, shape [nx, ny, nz].

        Neighbours (also diagonal ones) in the result can be connected by straight lines that keep the
        clearance, to triangles and to the bounds of the scene, everywhere. The region is the one that holds
        the seed; where the seed itself has less clearance than asked, it is the largest that can be reached
        from it at any clearance.
        """
        return _reachable(self, clearance_m)

    def check_start(self, point_m: ArrayLike) -> None:
        """Refuse to begin inside a solid, outside of a closed scene, or out of sight of any.

        A solid is a region that is closed on all sides, does not hold the seed, and is smaller than a room
        (12 m^3). Where a surface passes, there is no solid to be inside of. Outside is what is beyond the
        grid or open to that, and does not hold the seed.

        Raises:
            ValueError: The point is inside a solid, outside, or out of sight.
        """
        point = np.asarray(point_m, dtype=np.float64)
        away_m = float(np.linalg.norm(point - np.clip(point, *self.bounds_m)))
        if away_m > max(_SIGHT_MIN_M, _SIGHT * np.linalg.norm(np.ptp(self.bounds_m, axis=0))):
            raise ValueError(
                f"the path begins at {np.round(point, 3).tolist()} m, {away_m:,.0f} m away from the scene, "
                f"which reaches from {np.round(self.bounds_m[0], 1).tolist()} to "
                f"{np.round(self.bounds_m[1], 1).tolist()} m; where `neurosim scene` says that a place was "
                "subtracted from a file's coordinates, subtract it here as well"
            )
        voxel = self.voxel_of(point)
        where = "outside of the rooms"
        if (point >= self.bounds_m[0]).all() and (point <= self.bounds_m[1]).all():
            labels, _ = scipy.ndimage.label(~self.occupied)
            region = labels == labels[voxel]
            if self.occupied[voxel] or region[self.voxel_of(self.seed_m)]:
                return
            ends = [region[side] for side in (0, -1)] + [region[:, side] for side in (0, -1)]
            if not any(face.any() for face in (*ends, region[:, :, 0], region[:, :, -1])):
                volume_m3 = float(region.sum()) * self.voxel_m**3
                if volume_m3 >= _ROOM_MIN_M3:
                    return
                where = f"inside a solid of {volume_m3:.2g} m^3"
        if where.startswith("inside") or self.closed:
            raise ValueError(
                f"the path begins at {np.round(point, 3).tolist()} m, {where}; "
                f"free space is around {np.round(self.seed_m, 3).tolist()} m"
            )

    @functools.cached_property
    def grid_clearance(self) -> NDArray[np.float32]:
        """Clearance at voxel centres: `distance`, or the distance to the bounds where less [m]."""
        axes = [self._axis(a) for a in range(3)]
        walls = [np.minimum(x - self.bounds_m[0, a], self.bounds_m[1, a] - x) for a, x in enumerate(axes)]
        wall = np.minimum(np.minimum(walls[0][:, None, None], walls[1][:, None]), walls[2])
        return np.minimum(self.distance, wall.astype(np.float32))

    @functools.cached_property
    def occupied(self) -> NDArray[np.bool_]:
        """Voxels that a surface passes through: no flood fill crosses a surface between two of the others.

        A surface that lies midway between two layers of centres is half a voxel from both. The slack makes it
        occupy both, although float32 rounds positions and distances at the size of the coordinates.
        """
        rounding = 8.0 * np.spacing(np.float32(np.abs(self.bounds_m).max()))
        return np.asarray(self.distance <= 0.5 * self.voxel_m * (1.0 + 1e-5) + rounding)

    @functools.cached_property
    def height(self) -> NDArray[np.float32]:
        """Height of voxel centres above the surface below them, to a voxel [m]; inf where there is none."""
        layer = np.arange(self.distance.shape[2], dtype=np.float32)
        below = np.maximum.accumulate(np.where(self.occupied, layer, -np.inf), axis=2)
        return np.asarray((layer - below) * self.voxel_m, dtype=np.float32)

    def voxel_of(self, point_m: ArrayLike) -> tuple[int, int, int]:
        """Return the voxel that holds a point; the nearest one for a point outside the grid."""
        place = np.rint((np.asarray(point_m, dtype=np.float64) - self.origin_m) / self.voxel_m).astype(int)
        x, y, z = np.clip(place, 0, np.array(self.distance.shape) - 1).tolist()
        return x, y, z

    def centers(self, voxels: NDArray[np.int64]) -> Array:
        """Return the centres [m] of voxels given by index, shape [n, 3]."""
        return np.asarray(self.origin_m + self.voxel_m * voxels, dtype=np.float64)

    def _axis(self, axis: int) -> Array:
        return np.asarray(self.origin_m[axis] + self.voxel_m * np.arange(self.distance.shape[axis]))

    def _to_bounds(self, rows: Array) -> Array:
        return np.minimum(rows - self.bounds_m[0], self.bounds_m[1] - rows).min(axis=1)


def make_free_space(scene: Scene, config: FreeSpaceConfig, device: str = "cpu") -> FreeSpace:
    """Map the room in a scene.

    The seed is, in this order: `config.seed_m`; the point that the scene knows (`scene.inside_m`); or the
    widest place of the largest connected region, counting only voxels that have a surface below them and in
    each of the four horizontal directions. The inside of a closed solid is such a region too, but a smaller
    one; outside a building some direction is open. Where no such region has 12 m^3 (a terrain with rocks),
    the largest region that has a surface below is taken, and else the largest. A large closed solid in the
    open, such as a block that stands for a building, is taken for a room: say `seed_m` then.

    Raises:
        ValueError: The seed of the configuration is not in free space, or the scene has none.
    """
    return choose_seed(map_distances(scene, config, device), config, inside_m=scene.inside_m)


def map_distances(scene: Scene, config: FreeSpaceConfig, device: str = "cpu") -> FreeSpace:
    """Map the distances to a scene, the first half of `make_free_space`; `choose_seed` is the other one.

    Nearly all of it is outside Python's interpreter lock, and SciPy is not imported.
    """
    bounds = scene.bounds_m
    notes: list[str] = []
    voxel = config.voxel_m
    if (flat := np.ptp(bounds, axis=0) < voxel).any():
        bounds = bounds + np.outer((-_BESIDE_M, _BESIDE_M), flat)
        notes.append(f"The scene is flat: free space is mapped up to {_BESIDE_M:g} m on both sides of it.")
    while (counts := _counts(bounds, voxel)).prod(dtype=float) > config.voxel_count_max:
        voxel *= max(1.01, (counts.prod(dtype=float) / config.voxel_count_max) ** (1.0 / 3.0))
    if voxel != config.voxel_m:
        notes.append(
            f"Free space is mapped in voxels of {voxel:.3g} m instead of {config.voxel_m:g} m: "
            f"the scene measures {' x '.join(f'{s:,.4g}' for s in bounds[1] - bounds[0])} m."
        )
    mesh = wp.Mesh(
        points=wp.array(scene.vertices, dtype=wp.vec3, device=device),
        indices=wp.array(scene.faces.reshape(-1), dtype=wp.int32, device=device),
    )
    origin = bounds[0] + 0.5 * ((bounds[1] - bounds[0]) - (counts - 1) * voxel)
    distance: Any = wp.empty(tuple(counts.tolist()), dtype=wp.float32, device=device)
    _launch_fill(mesh, origin, voxel, distance)

    arrays = DistanceField()
    arrays.mesh = mesh.id
    arrays.distance = distance
    arrays.origin = wp.vec3(*origin.tolist())
    arrays.voxel = wp.float32(voxel)
    return FreeSpace(
        distance=distance.numpy(),
        origin_m=origin,
        voxel_m=voxel,
        bounds_m=bounds,
        seed_m=bounds.mean(axis=0),
        closed=scene.closed and config.seed_m is None,
        notes=tuple(notes),
        arrays=arrays,
        mesh=mesh,
        device=device,
    )


def choose_seed(unseeded: FreeSpace, config: FreeSpaceConfig, *, inside_m: Vector3 | None) -> FreeSpace:
    """Return what `map_distances` has mapped with the seed of its free space; see `make_free_space`.

    `inside_m`: as of the scene.
    """
    bounds, notes = unseeded.bounds_m, list(unseeded.notes)
    known = _Seed(np.array(config.seed_m), "seed_m of the configuration") if config.seed_m else None
    if known is None and inside_m is not None:
        known = _Seed(np.array(inside_m), "the point that the scene names as inside")
    seed = _find_seed(unseeded) if known is None else known
    if known is not None and (room := float(unseeded.clearance(known.point)[0])) <= unseeded.voxel_m:
        if config.seed_m is not None:
            raise ValueError(
                f"seed_m must be in free space, got {config.seed_m}, where the nearest surface or bound "
                f"of the scene is at {room:.3f} m"
            )
        is_outside = bool(((known.point < bounds[0]) | (known.point > bounds[1])).any())
        spans = f"it spans {bounds[0].round(2).tolist()} to {bounds[1].round(2).tolist()} m"
        why = spans if is_outside else f"a surface is {abs(room):.3f} m from there"
        notes.append(f"The scene names {inside_m} as inside, but {why}.")
        seed = _find_seed(unseeded)
    place = np.round(seed.point, 2).tolist()
    return dataclasses.replace(
        unseeded,
        seed_m=seed.point,
        notes=(*notes, f"Free space is what can be reached from {place}: {seed.rule}."),
    )


@dataclass(frozen=True, eq=False)
class _Seed:
    point: Array
    rule: str


def _counts(bounds: Array, voxel: float) -> NDArray[np.int64]:
    """Voxels along each axis, at least 2."""
    return np.maximum(np.ceil((bounds[1] - bounds[0]) / voxel - 1e-6), 2.0).astype(np.int64)


def _launch_fill(mesh: wp.Mesh, origin: Array, voxel: float, distance: Any) -> None:
    """Fill a grid with distances; on the CPU threads share the columns (a launch runs outside the GIL)."""
    columns = distance.shape[0] * distance.shape[1]
    device = distance.device
    chunks = _CPU_CHUNKS if device.is_cpu else 1
    marks = [columns * k // chunks for k in range(chunks + 1)]
    wp.load_module(device=device)

    def launch(chunk: int) -> None:
        first, last = marks[chunk], marks[chunk + 1]
        if last > first:
            wp.launch(
                _fill_distance,
                dim=last - first,
                inputs=[mesh.id, wp.vec3(*origin.tolist()), voxel, 1e9, first, distance],
                device=device,
            )

    if chunks == 1:
        launch(0)
        return
    with ThreadPoolExecutor() as pool:
        list(pool.map(launch, range(chunks)))


def _find_seed(space: FreeSpace) -> _Seed:
    occupied = space.occupied
    labels, count = scipy.ndimage.label(~occupied)
    if count == 0:
        raise ValueError(
            f"the scene has no free space at {space.voxel_m:g} m resolution; it measures "
            f"{' x '.join(f'{s:.3g}' for s in space.bounds_m[1] - space.bounds_m[0])} m"
        )

    def seen(axis: int, *, up: bool) -> NDArray[np.bool_]:
        rays = np.flip(occupied, axis) if up else occupied
        return np.asarray(
            np.flip(np.logical_or.accumulate(rays, axis), axis)
            if up
            else np.logical_or.accumulate(rays, axis)
        )

    below = seen(2, up=False)
    walls = seen(0, up=False) & seen(0, up=True) & seen(1, up=False) & seen(1, up=True)
    widest = "the widest place of the largest region"
    rules = (
        (below & walls, _ROOM_MIN_M3, f"{widest} with a floor below and walls on four sides"),
        (below, 0.0, f"{widest} with a surface below, as no room has walls on four sides"),
        (np.ones_like(below), 0.0, f"{widest}, as nothing has a surface below"),
    )
    for counts, size_min_m3, rule in rules:
        inside = counts & ~occupied
        sizes = np.bincount(labels[inside], minlength=count + 1)
        region = int(sizes.argmax())
        if sizes[region] * space.voxel_m**3 > size_min_m3:
            width = np.where(inside & (labels == region), space.grid_clearance, -np.inf)
            voxel = np.array(np.unravel_index(int(width.argmax()), width.shape))
            return _Seed(space.centers(voxel), rule)
    raise AssertionError("every free voxel counts by the last rule")


def _reachable(space: FreeSpace, clearance_m: float) -> NDArray[np.bool_]:
    room = space.grid_clearance
    seed = space.voxel_of(space.seed_m)
    # D of the identity above for the longest step, a diagonal of length sqrt(3) voxel
    needed = math.sqrt(clearance_m**2 + 0.75 * space.voxel_m**2) * (1.0 + 1e-6)
    free = (room >= needed) & np.isfinite(space.height)
    labels, count = scipy.ndimage.label(free)
    if count == 0:
        return np.zeros_like(free)
    if free[seed]:
        return np.asarray(labels == labels[seed])
    # the seed is too near something: stay in the region that it belongs to at the least clearance
    loose, _ = scipy.ndimage.label(~space.occupied & (room > 0.0))
    if not loose[seed]:
        return np.zeros_like(free)
    sizes = np.bincount(labels[(loose == loose[seed]) & free], minlength=count + 1)
    if sizes.max() == 0:
        return np.zeros_like(free)
    return np.asarray(labels == int(sizes.argmax()))
