# mypy: disable-error-code="index,attr-defined,operator,arg-type,assignment,empty-body,union-attr"
# mypy: disable-error-code="no-untyped-def,valid-type"
# ruff: noqa: UP018  (typed literals have a meaning in kernels)
"""Candidate lists: one search of the tree for all rays of a tile of pixels in several instants; exact.

The rays of 8 x 8 pixels in M consecutive instants lie in a narrow frustum: that of the tile, swept by the
motion of the camera. One search lists the triangles in it, and each ray is intersected with the list alone.

1. A few probe rays are traced. The furthest hit, and a little more, is the reach of the list: triangles
   behind the walls of a room are not listed.
2. The tree is traversed with the swept frustum, cut off at the reach. On CUDA the threads of a block take
   nodes from one stack. The list holds every triangle that one of the rays can hit within the reach.
3. Each ray is intersected with the list. Where one triangle is first by more than rounding, the tree's own
   intersection computes the point. Other rays are unresolved and traverse the tree, as do all rays of a tile
   whose list is too long.

Nothing is approximated: the results are those of rays that traverse the tree (`ray_tree.py`) to the last bit,
as far as a compiler makes the same code of the same intersection in two places. They depend neither on the
number of instants per launch or per list nor on the order in which threads find triangles.

The test of step 3 (`candidate_intersector`) evaluates three edge functions, normalised such that their sum is
one over the distance. The ray hits a triangle first if the triangle is nearer than all others by more than
rounding, the ray passes inside its edges by more than rounding, and the hit is within the reach of the list.
`ray_intersection.intersect_face` then computes the exact point, with the tree's own arithmetic. Otherwise the
answer is UNRESOLVED.

Error bounds. Corners relative to the camera are rounded the same way in both tests, so they count as exact.
The edge function d . (b x (c - b)) is off by at most 6e-7 |b| |c - b|, that of Woop's test by 1.4e-6 max|a,
b, c| |c - b|. Rays keep their direction in C, and the functions are turned there: that adds 1.2e-6. A ray is
within rounding of an edge if the function is below EDGE = 5e-6 of the same product. The distance of a
triangle is off by less than TIE / 2 of it, unless the triangle is seen nearly from the side or is a sliver
(SIDE): rays within rounding of such a triangle are unresolved.

Margins. Frustums and the sides of tiles hold all rays of a tile by an angle of 1e-5 rad to spare. What that
has to cover is the rounding of rays and of the camera's axes when they are rotated (5e-7 rad each), and of a
triangle's corners along the sides (1e-6 of the distance): 2e-6 rad together, wherever in the picture,
because all of it is measured as angles. Bounds are kept as slopes x / z, and a slope is an angle only
short of 90 degrees from the axis: lenses are taken up to a slope of 100 (89.4 degrees), where the 1e-5
rad move a bound by two thousandths of itself at most, and are refused beyond. A triangle whose plane
contains the ray to within rounding is the one exception: Woop's test can hit it outside of its edges, and
where that is outside of the frustum, too, the tree finds it and a list does not.

References: Reshetov, Soupikov, Hurley (2005), Multi-Level Ray Tracing Algorithm; Woop, Benthin, Wald (2013),
Watertight Ray/Triangle Intersection.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import math
from functools import cache
from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.native_code import read_native
from neurosim_core.render.config import CandidateListConfig
from neurosim_core.render.kernel_data import (
    BLOCK,
    FAR_M,
    TILE,
    UNRESOLVED,
    CandidateListData,
    RayTree,
    SceneData,
    ViewData,
)
from neurosim_core.render.launch import launch_split
from neurosim_core.render.ray_tree import intersect_tree

_INDEX_MAX = 2**31 - 1
"""Kernels count in 32 bits."""
_AUTO = ((8, 1.5e-3), (16, 2.5e-3), (32, 6.0e-3))
"""Least number of instants, and largest pixel [rad] for which lists pay: with fewer instants, or with fewer
tiles of larger pixels, the search takes as long as it saves."""
_AUTO_FACES_MAX = 7.0
"""Largest product of the number of triangles, as cut for the light, and the solid angle of a pixel [sr] for
which lists pay."""
_UNRESOLVED_SHARE = 8
"""One in so many pixels may be unresolved; if there are more, the fallback kernel renders all pixels."""
_THREADS_PER_MULTIPROCESSOR = 1280
"""Threads of the fallback kernel: more than run at a time, since some take longer than others."""
_BORDER_RAD = 1.0e-5
"""By how much the rays of a tile are taken to reach beyond their border [rad]."""
_SLOPE_MAX = 100.0
"""Largest |x / z| and |y / z| of a ray: 89.4 degrees from the axis."""
_ROUNDING = wp.constant(4.0e-6)
"""Of the coordinates of a scene: what frustums are widened by."""
_REACH = wp.constant(1.01)
_REACH_M = wp.constant(0.01)
"""A list reaches further than the furthest probe ray: by this factor, and by this length [m]."""
_COSINE_MIN = wp.constant(0.2)
"""Least cosine between the axis of a frustum and its rays; a tile that turns further has no list."""


def choose_candidate_lists(
    requested: CandidateListConfig | Literal["auto"] | None,
    rays: NDArray[np.float32],
    *,
    instant_count: int,
    face_count: int,
    is_cuda: bool,
    embree: bool = False,
) -> CandidateListConfig | None:
    """Return the settings of candidate lists for a renderer; None: rays traverse the tree.

    Args:
        requested: `RenderConfig.candidate_lists`.
        rays: Those of `ray_layers`.
        instant_count: The most instants of one world in a launch.
        face_count: Triangles of the scene, as cut for baked light.
        is_cuda: The device is one of CUDA, else a CPU.
        embree: Embree casts rays; on a CPU without it lists are always sooner, or as soon.
    """
    if requested != "auto":
        return requested
    widest = max((pixel_rad for least, pixel_rad in _AUTO if instant_count >= least), default=0.0)
    sample_count = max(1, len(rays) - 1)  # each of which has its share of the pixel
    spreads_rad = rays[..., 3].ravel()
    middle = [(len(spreads_rad) - 1) // 2, len(spreads_rad) // 2]
    median_rad = np.partition(spreads_rad, middle)[middle].mean()  # np.median imports numpy.ma
    pixel_rad = float(median_rad) * math.sqrt(sample_count)
    small = pixel_rad <= widest and face_count * pixel_rad**2 <= _AUTO_FACES_MAX
    pays = small if is_cuda else not embree
    return CandidateListConfig() if pays and looks_forward(rays) else None


def _check_counts(config: CandidateListConfig, *, groups: int, tiles: int) -> None:
    """Refuse what kernels, which count in 32 bits, cannot address: threads, and entries of the lists."""
    longest = _INDEX_MAX // (groups * tiles)
    if max(config.face_count_max, BLOCK) > longest:
        allowed = f"at most {longest}" if longest >= BLOCK else "no value is small enough"
        raise ValueError(
            f"{groups} groups of instants of {tiles} tiles with render.candidate_lists.face_count_max = "
            f"{config.face_count_max} are more than 2^31 - 1 entries: {allowed} here; or take fewer worlds "
            "or pixels, or share a list between more instants (render.candidate_lists.instants)"
        )


def looks_forward(rays: NDArray[np.float32]) -> bool:
    """Return whether `tile_bounds` takes the rays of a lens."""
    x, y, z = np.moveaxis(rays[..., :3].astype(np.float64), -1, 0)
    return bool((z > 0.0).all() and (np.maximum(np.abs(x), np.abs(y)) <= _SLOPE_MAX * z).all())


def tile_bounds(rays: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return the least and largest x / z and y / z of the rays of each tile, shape [tile, 4], row by row.

    They are widened by 1e-5 rad, more than rounding. A ray that reaches z = 1 after the length L, and a plane
    x = (s + ds) z where it has the slope s, are ds / (L sqrt(1 + s^2)) apart [rad]. Rays are in C, shape
    [layer, H * W, 3 or more].

    Raises:
        ValueError: A ray does not look forward (z <= 0), or is too close to 90 degrees from the axis: |x / z|
            or |y / z| is above 100.
    """
    directions = rays[..., :3].astype(np.float64).reshape(-1, height, width, 3)
    if not (directions[..., 2] > 0.0).all():
        raise ValueError("candidate lists need rays that look forward, and some of this lens do not (z <= 0)")
    slopes = directions[..., :2] / directions[..., 2:]
    steepest = float(np.abs(slopes).max())
    if steepest > _SLOPE_MAX:
        raise ValueError(
            f"candidate lists need rays with |x / z| and |y / z| up to {_SLOPE_MAX:g} "
            f"({math.degrees(math.atan(_SLOPE_MAX)):.1f} deg from the axis), and this lens has "
            f"{steepest:.4g}: take a narrower lens, or set render.candidate_lists to null"
        )
    length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
    widened = _BORDER_RAD * length * np.sqrt(1.0 + slopes**2)
    lowest, highest = slopes - widened, slopes + widened
    bounds = []
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            part = np.s_[:, top : top + TILE, left : left + TILE]
            low, high = lowest[part].min(axis=(0, 1, 2)), highest[part].max(axis=(0, 1, 2))
            bounds.append((low[0], high[0], low[1], high[1]))
    return np.array(bounds, dtype=np.float32)


@wp.struct
class _Frustum:
    """The rays of a tile in several instants: z along the axis, all of them between four planes."""

    origin: wp.vec3  # In W [m], as the axes; what follows is relative to it
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    slope_low: wp.vec2  # Least x / z and y / z of the rays
    slope_high: wp.vec2
    foot_low: wp.vec2  # Where the lower planes cross z = 0: x >= foot_low[0] + slope_low[0] z
    foot_high: wp.vec2
    near: float  # Least z [m]
    far: float  # Largest z [m]


@wp.func_native(read_native(__file__, "block_max"))
def _block_max(value: float) -> float:
    """Return the largest value of the threads of a block; on a CPU, of the one."""
    ...


@wp.func_native(read_native(__file__, "list_frustum_faces"))
def _list_frustum_faces(
    tree: RayTree, frustum: _Frustum, limit: int, begin: int, faces_out: wp.array[int]
) -> int:
    """Write the faces that reach into a frustum from `begin` on, in any order; return their number.

    It returns -1 if there are more than `limit`. On CUDA the 64 threads of a block call it together.
    A thread takes a node: it lists the faces of a leaf, or puts the children on the stack.
    """
    ...


@wp.func
def _corner_ray(bounds: wp.vec4, corner: int) -> wp.vec3:
    return wp.vec3(bounds[corner % 2], bounds[2 + corner // 2], 1.0)


@cache
def frustum_search_kernel(lanes: int) -> wp.Kernel:
    """Return the kernel that fills candidate lists; `lanes` threads share a tile: 64 on CUDA, else 1."""

    @wp.kernel(module="unique", enable_backward=False)
    def search_frustums(
        first: int,
        # Model:
        tree: RayTree,
        rays: wp.array2d[wp.vec4],
        width: int,
        height: int,
        extent_m: float,
        # In:
        instant_count: int,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        # In/out:
        data: CandidateListData,
    ) -> None:
        index = first + wp.tid()
        lane = index % lanes
        tile = (index // lanes) % data.bounds.shape[0]
        group = index // lanes // data.bounds.shape[0]
        begin = group * data.instants
        instants = wp.min(data.instants, instant_count - begin)
        tile_columns = (width + 7) // 8
        left = (tile % tile_columns) * 8
        top = (tile // tile_columns) * 8
        bounds = data.bounds[tile]
        # A probe is one of 4 x 4 pixels spread over the tile, at one of up to four instants.
        times = wp.min(instants, 4)
        reach = float(0.0)
        for probe in range(lane, 16 * times, lanes):
            instant = begin + (probe // 16) * (instants - 1) // wp.max(times - 1, 1)
            col = wp.min(left + (7 * (probe % 4) + 1) // 3, width - 1)
            row = wp.min(top + (7 * ((probe // 4) % 4) + 1) // 3, height - 1)
            ray_C = rays[0, row * width + col]
            ray = wp.quat_rotate(q_WC[instant], wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
            reach = wp.max(reach, intersect_tree(tree, p_WC[instant], ray, FAR_M)[0])
        reach = wp.min(_block_max(reach) * _REACH + _REACH_M, FAR_M)

        frustum = _Frustum()
        middle = begin + instants // 2
        q = q_WC[middle]
        axis_C = wp.vec3(0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[2] + bounds[3]), 1.0)
        frustum.origin = p_WC[middle]
        frustum.z = wp.normalize(wp.quat_rotate(q, axis_C))
        frustum.x = wp.normalize(wp.cross(wp.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0)), frustum.z))
        frustum.y = wp.cross(frustum.z, frustum.x)
        low = wp.vec2(FAR_M)
        high = wp.vec2(-FAR_M)
        cosine = float(1.0)
        for corner in range(lane, 4 * instants, lanes):
            ray = wp.normalize(wp.quat_rotate(q_WC[begin + corner // 4], _corner_ray(bounds, corner % 4)))
            cosine = wp.min(cosine, wp.dot(ray, frustum.z))
            slope = wp.vec2(wp.dot(ray, frustum.x), wp.dot(ray, frustum.y)) / wp.dot(ray, frustum.z)
            low = wp.min(low, slope)
            high = wp.max(high, slope)
        cosine = -_block_max(-cosine)
        frustum.slope_low = wp.vec2(-_block_max(-low[0]), -_block_max(-low[1]))
        frustum.slope_high = wp.vec2(_block_max(high[0]), _block_max(high[1]))
        low = wp.vec2(FAR_M)
        high = wp.vec2(-FAR_M)
        near = float(FAR_M)
        far = float(-FAR_M)
        for instant in range(begin + lane, begin + instants, lanes):
            moved = p_WC[instant] - frustum.origin
            place = wp.vec2(wp.dot(moved, frustum.x), wp.dot(moved, frustum.y))
            along = wp.dot(moved, frustum.z)
            low = wp.min(low, place - along * frustum.slope_low)
            high = wp.max(high, place - along * frustum.slope_high)
            near = wp.min(near, along)
            far = wp.max(far, along)
        margin = _ROUNDING * (extent_m + wp.length(frustum.origin))
        frustum.foot_low = wp.vec2(-_block_max(-low[0]) - margin, -_block_max(-low[1]) - margin)
        frustum.foot_high = wp.vec2(_block_max(high[0]) + margin, _block_max(high[1]) + margin)
        frustum.near = -_block_max(-near) - margin
        frustum.far = _block_max(far) + reach + margin
        count = -1
        if cosine > _COSINE_MIN:  # of all lanes or of none
            begin_of_list = (group * data.bounds.shape[0] + tile) * data.limit
            count = _list_frustum_faces(tree, frustum, data.limit, begin_of_list, data.faces)
        if lane == 0:
            data.count[group, tile] = count
            data.reach[group, tile] = reach

    return search_frustums


@cache
def candidate_intersector(group: int) -> wp.Function:
    """Return the Warp function that intersects the ray of a pixel with a candidate list at several instants.

    It returns a vector of `group` integers, a divisor of 64: for each instant the face that the ray hits
    first; -1: none; UNRESOLVED. On CUDA the 64 threads of a block, the pixels of a tile, call it together and
    share the set-up of triangles.

    Its parameters: the scene and the view; the tile; the first instant and the number of instants; the
    distance that counts as infinite [m]; the direction of the pixel's ray in C, of unit length.
    """
    found = wp.types.vector(length=group, dtype=int)

    @wp.func_native(read_native(__file__, "intersect_candidates", GROUP=group, UNRESOLVED=UNRESOLVED))
    def intersect_candidates(
        scene: SceneData, view: ViewData, tile: int, first: int, instants: int, far_m: float, ray_C: wp.vec3
    ) -> found: ...

    return intersect_candidates


@wp.func_native(read_native(__file__, "intersect_tile", UNRESOLVED=UNRESOLVED))
def intersect_tile(
    scene: SceneData,
    view: ViewData,
    tile: int,
    first: int,
    far_m: float,
    rays: wp.array[wp.vec3],
    face_out: wp.array[int],
):
    """Intersect all 64 rays of a tile at one instant with its list; for CPU kernels, vectorised over rays.

    See `candidate_intersector`; rays are in W. It writes the face that each ray hits first; -1: none;
    UNRESOLVED.
    """
    ...


class CandidateLists:
    """The candidate lists of one renderer.

    Attributes:
        data: For kernels; overwritten by `update`.
    """

    def __init__(
        self,
        tree: RayTree,
        rays: NDArray[np.float32],
        *,
        width: int,
        height: int,
        extent_m: float,
        config: CandidateListConfig,
        instant_count: int,
        has_fallback: bool,
    ) -> None:
        """Allocate the lists, for at most `instant_count` instants per launch.

        Rays are those of `ray_layers`; `extent_m` is the largest coordinate of the mesh. With a fallback,
        unresolved pixels are left to another kernel (`raycast.fallback_kernel`).

        Raises:
            ValueError: A ray does not look forward enough (`tile_bounds`), or there are more than 2^31 - 1
                threads or entries of the lists.
        """
        groups = -(-instant_count // config.instants)
        _check_counts(config, groups=groups, tiles=-(-width // TILE) * -(-height // TILE))
        bounds = tile_bounds(rays, width, height)
        self._tree, self._width, self._height, self._extent_m = tree, width, height, extent_m
        self._device = str(tree.nodes.device)
        self._lanes = 1 if tree.nodes.device.is_cpu else BLOCK
        self.data = CandidateListData()
        self.data.instants = config.instants
        self.data.limit = config.face_count_max
        size = groups * len(bounds) * config.face_count_max
        self.data.faces = wp.zeros(size, dtype=int, device=self._device)
        self.data.count = wp.zeros((groups, len(bounds)), dtype=int, device=self._device)
        self.data.reach = wp.zeros((groups, len(bounds)), dtype=float, device=self._device)
        self.data.bounds = wp.array(bounds, dtype=wp.vec4, device=self._device)
        self.data.unresolved_count = wp.zeros(1, dtype=int, device=self._device)
        capacity = instant_count * len(bounds) * BLOCK // _UNRESOLVED_SHARE if has_fallback else 0
        self.data.unresolved = wp.zeros(capacity, dtype=int, device=self._device)
        processors = tree.nodes.device.sm_count if tree.nodes.device.is_cuda else 0
        self.data.fallback_threads = max(1, processors * _THREADS_PER_MULTIPROCESSOR)

    def update(
        self,
        rays: wp.array2d[wp.vec4],
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        *,
        instant_count: int,
    ) -> None:
        """Fill the lists with the triangles that rays may hit at the first `instant_count` poses."""
        groups = -(-instant_count // self.data.instants)
        self.data.unresolved_count.zero_()
        launch_split(
            frustum_search_kernel(self._lanes),
            dim=groups * self.data.bounds.shape[0] * self._lanes,
            inputs=[self._tree, rays, self._width, self._height, self._extent_m, instant_count, p_WC, q_WC],
            outputs=[self.data],
            device=self._device,
        )
