# mypy: disable-error-code="index,attr-defined,operator,arg-type,no-untyped-def,assignment,return-value"
# mypy: disable-error-code="call-overload,empty-body,misc,valid-type"
# ruff: noqa: UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning in kernels)
"""Antialiasing on CUDA: what `antialias.py` describes, in three kernels.

1. A thread is a pixel. Blocks of 4 x 4 pixels that show one plane surface, or the sky, are shaded; the others
   are listed.
2. A warp is a listed block in two instants, which see nearly the same; a thread is a pixel. The threads
   prepare the faces, look at the edges that cross pixels, and shade the surfaces that pixels show together.
   Instants that show many faces are taken one by one. Pixels that have to be rendered by rays are listed.
3. A thread is a ray of such a pixel.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from typing import Any

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.kernel_data import BodyData, Hit, RenderOutputs, RenderTerms, SceneData, ViewData
from neurosim_core.render.outputs import radiance_writer, requested_outputs
from neurosim_core.render.ray_intersection import UNFUSED, intersect_bodies, intersect_scene
from neurosim_core.render.raycast import PIXEL_BOUNDS, turn_count
from neurosim_core.render.shading import APART, pixel_shader, surface_shader
from neurosim_core.render.tiles import pose_finder, tile_locator

SAMPLE_COUNT = 32
"""Points of a pixel."""
RAY_COUNT = 8
"""Rays of a pixel that is rendered by rays."""
RAY_WIDTH = wp.constant(RAY_COUNT**-0.5)
"""Width of the footprint of one of them [px]."""
FACE_COUNT_MAX = 48
"""Most faces of a block of 4 x 4 pixels and the ring around it."""
SHARPNESS = wp.constant(0.64)
"""Width of the footprint that a texture is averaged over where a surface fills a pixel [px].

A lookup blurs more than a mean does.
"""
INSTANTS = wp.constant(4)
"""Instants of a pixel in a block that shows one surface, of a thread."""
COVER_BOUNDS = (64, 12)
"""Threads of a block, and blocks of a multiprocessor."""
_RAY_THREADS = 5120
"""Threads of a multiprocessor: far more than run at a time, since some take longer than others."""
_SEVERAL, _SKY, _BODY = (wp.constant(kind) for kind in (1, 2, 3))
_RAYS = wp.constant(16 * RAY_COUNT)
_FAST = {"fast_math": True}
"""Quotients, roots and logarithms are off by a few units in the last place."""
Coverage = wp.types.vector(length=6, dtype=int)
PlaneHit = wp.types.vector(length=8, dtype=float)
PairSample = wp.types.vector(length=9, dtype=float)


@wp.func_native(read_native(__file__, "sample_point", SAMPLES=RAY_COUNT))
def ray_point(ray: int) -> wp.vec2:
    """Return the point of a pixel that a ray goes through, from its centre [px]."""
    ...


@wp.func
def footprint_width(point_count: float) -> float:
    """Return the width of the footprint that a texture is averaged over where so many points show it [px]."""
    return SHARPNESS * wp.sqrt(point_count / float(SAMPLE_COUNT))


@wp.struct
class BlockLists:
    """Blocks of 4 x 4 pixels that a kernel leaves to another one; threads 16 n to 16 n + 15 are block n."""

    uneven: wp.array[wp.vec3i]
    """Those that show several surfaces in one of two consecutive instants: four times the tile, and which of
    its blocks; the first instant; a bit for each of the two."""
    unresolved: wp.array[wp.vec2i]
    """Those with pixels that have to be rendered by rays, and a bit for each of these."""
    count: wp.array[int]  # Length of the two lists, and how many entries of the first are taken
    threads: int  # Threads of the kernel that goes through the second one


def make_lists(block_count: int, device: Any) -> BlockLists:
    """Return empty lists for at most so many blocks."""
    lists = BlockLists()
    lists.uneven = wp.zeros(block_count, dtype=wp.vec3i, device=device)
    lists.unresolved = wp.zeros(block_count, dtype=wp.vec2i, device=device)
    lists.count = wp.zeros(3, dtype=int, device=device)
    lists.threads = _RAY_THREADS * max(1, wp.get_device(device).sm_count)
    return lists


def thread_counts(lists: BlockLists, pixel_count: int, instant_count: int) -> tuple[int, int, int]:
    """Return the threads of the three kernels, for so many pixels of all instants of all worlds."""
    even = pixel_count // instant_count * -(-instant_count // INSTANTS)
    cover = lists.threads // _RAY_THREADS * COVER_BOUNDS[0] * COVER_BOUNDS[1]
    return even, cover, lists.threads


@wp.func_native(read_native(__file__, "next_entry"))
def next_entry(count: wp.array[int], counter: int) -> int:
    """Return the next number that a counter gives to a warp."""
    ...


@wp.func_native(read_native(__file__, "leaves_room", BLOCKS=COVER_BOUNDS[1]))
def leaves_room() -> wp.bool:
    """Return whether a block of the kernel of uneven blocks ends before all is done.

    So a multiprocessor is left to what comes and goes: the flight is ahead of the renderer, and a kernel of a
    vehicle needs more registers than full multiprocessors have.
    """
    ...


@wp.struct
class PixelPlace:
    """A pixel of a block in one instant; for the rest see `tiles.TilePlace`."""

    rendered: wp.bool
    world: int
    instant: int
    slot: int
    left: int  # Column of the first pixel of the block
    top: int  # Row of the first pixel of the block
    row: int
    col: int
    outside: wp.bool  # The pixel is not in the picture
    ray: int  # Index of its ray in a layer


@wp.struct
class PixelRays:
    """Where a pixel is seen from, and the direction to its centre and its change across and down, in W."""

    position: wp.vec3
    center: wp.vec3
    across: wp.vec3
    down: wp.vec3


@wp.func_native(read_native(__file__, "classify_block"))
def _classify_block(scene: SceneData, view: ViewData, faces: wp.array3d[int], at: PixelPlace) -> int:
    """Tell what the first rays show in and around a block: 0: one surface; others: see the file."""
    ...


@wp.func_native(read_native(__file__, "intersect_face_plane"))
def _intersect_face_plane(scene: SceneData, part: int, origin: wp.vec3, toward: wp.vec3) -> PlaneHit:
    """Return where a direction intersects the plane of a face."""
    ...


def _block_coverer(timed: bool) -> Any:
    """Return the Warp function that finds what the points of the pixels of a block show; see the file."""
    code = read_native(__file__, "cover_block", SAMPLES=SAMPLE_COUNT, MOST=FACE_COUNT_MAX, TIMED=timed)

    @wp.func_native(code)
    def cover_block(
        scene: SceneData,
        view: ViewData,
        faces: wp.array3d[int],
        at: PixelPlace,
        alone: wp.bool,
        outside: wp.bool,
        rays: PixelRays,
    ) -> Coverage: ...

    return cover_block


@wp.func_native(read_native(__file__, "pair_sample", SAMPLES=SAMPLE_COUNT, MOST=FACE_COUNT_MAX))
def _pair_sample(
    scene: SceneData,
    place: int,
    alone: wp.bool,
    pair: int,
    own_part: int,
    spread_rad: float,
    rays: PixelRays,
) -> PairSample:
    """Return what a pixel sees of a surface; see the file."""
    ...


@wp.func_native(read_native(__file__, "store_pair", SAMPLES=SAMPLE_COUNT, MOST=FACE_COUNT_MAX))
def _store_pair(place: int, pair: int, light: wp.vec3):
    """Keep the light of a pair."""
    ...


@wp.func_native(read_native(__file__, "sum_pairs", SAMPLES=SAMPLE_COUNT, MOST=FACE_COUNT_MAX))
def _sum_pairs(place: int, first: int, count: int, step: int, total: wp.vec3) -> wp.vec3:
    """Return `total` and the light of those of consecutive pairs that are among the 32 of a step."""
    ...


@wp.func_native(read_native(__file__, "ray_sum"))
def _ray_sum(value: wp.vec3) -> wp.vec3:
    """Return the sum over the threads of a pixel's rays."""
    ...


@wp.func_native(read_native(__file__, "warp_votes"))
def _warp_votes(vote: wp.bool) -> int:
    """Return a bit for each thread of a warp."""
    ...


@wp.func
def _xyz(ray: wp.vec4) -> wp.vec3:
    return wp.vec3(ray[0], ray[1], ray[2])


def _pixel_locator(terms: RenderTerms, *, images: bool, instants: bool) -> wp.Function:
    """Return the Warp function that locates a pixel of a block.

    Its parameters: the tile, as `tile_finder` counts; the instant, of a world; which of the four blocks of
    the tile; which of the 16 pixels of the block; view.
    """
    locate_tile = tile_locator(terms, images=images, instants=instants)

    @wp.func
    def locate_pixel(tile: int, instant: int, quarter: int, lane: int, view: ViewData):
        place = locate_tile(tile, instant, view)
        at = PixelPlace()
        at.rendered = place.rendered
        at.world = place.world
        at.instant = place.instant
        at.slot = place.slot
        at.left = place.left + 4 * (quarter % 2)
        at.top = place.top + 4 * (quarter // 2)
        at.row = at.top + lane // 4
        at.col = at.left + lane % 4
        at.outside = at.col >= view.width or at.row >= view.height
        at.ray = place.first_ray + at.row * view.width + at.col
        return at

    return locate_pixel


def _part_shader(terms: RenderTerms) -> wp.Function:
    """Return the Warp function that finds the light of a face where a direction intersects its plane.

    Its parameters: the scene; the face; origin and direction; the width of the footprint [rad]. For baked
    light and filtered textures it is the program of packets on a CPU (`raycast_packets.py`), for one ray.
    """
    if terms.baked and not terms.finest_level:
        code = read_native(
            __file__,
            "shade_part",
            TEXTURED=terms.textured,
            EMISSIVE=terms.emissive,
            UNIT=True,
            LIGHT_WITHIN=True,
            APART=round(100 * APART),
        )

        @wp.func_native(code)
        def shade_part(
            scene: SceneData, part: int, origin: wp.vec3, toward: wp.vec3, width_rad: float
        ) -> wp.vec3: ...

        return shade_part
    shade = surface_shader(terms, beyond=True)

    @wp.func
    def light_of(scene: SceneData, part: int, origin: wp.vec3, toward: wp.vec3, width_rad: float) -> wp.vec3:
        found = _intersect_face_plane(scene, part, origin, toward)
        hit = Hit()
        hit.face = part
        hit.t = found[0]
        hit.u = found[1]
        hit.v = found[2]
        hit.normal = wp.vec3(found[3], found[4], found[5])
        return shade(scene, wp.normalize(toward), origin, width_rad, hit, wp.vec2(found[6], found[7]))

    return light_of


def group_kernels(outputs: tuple[str, ...], terms: RenderTerms) -> tuple[wp.Kernel, wp.Kernel, wp.Kernel]:
    """Return the three kernels; parameters: those of `antialias.antialiasing_kernels`, then `BlockLists`."""
    requested = requested_outputs(outputs)
    locate_pixel = _pixel_locator(terms, images=requested.images, instants=requested.log)
    find_pose = pose_finder(terms)
    cover_block = _block_coverer(terms.timed)
    radiance_of = pixel_shader(terms)
    shade_part = _part_shader(terms)
    write_radiance = radiance_writer(outputs, supersampled=False)

    @wp.kernel(module="unique", enable_backward=False, module_options=_FAST, launch_bounds=PIXEL_BOUNDS)
    def shade_even_blocks(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        rays: wp.array2d[wp.vec4],
        # Out:
        out: RenderOutputs,
        lists: BlockLists,
    ) -> None:
        # The threads of a warp reach the functions that they call together: 64 are a tile in a few instants.
        group = (first + wp.tid()) // 64
        quarter = (first + wp.tid()) % 64 // 16
        lane = (first + wp.tid()) % 16
        group_count = (view.instant_count + INSTANTS - 1) // INSTANTS
        tile = group // group_count
        begin = group % group_count * INSTANTS
        end = wp.min(begin + INSTANTS, view.instant_count)
        at = locate_pixel(tile, begin, quarter, lane, view)
        if wp.static(terms.world_scenes):
            scene = view.worlds.scenes[view.worlds.scene[at.world]]
        in_picture = at.left < view.width and at.top < view.height
        first_instant = at.instant - begin
        uneven = int(0)
        for instant in range(begin, end):
            if wp.static(requested.images):
                at = locate_pixel(tile, instant, quarter, lane, view)
            at.instant = first_instant + instant
            if not at.rendered:
                continue
            kind = _classify_block(scene, view, out.face, at)
            if lane == 0 and in_picture and kind == _BODY:
                columns = (1 << wp.min(view.width - at.left, 4)) - 1
                pixels = int(0)
                for row in range(wp.min(view.height - at.top, 4)):
                    pixels = pixels | (columns << (4 * row))
                lists.unresolved[wp.atomic_add(lists.count, 1, 1)] = wp.vec2i(
                    4 * (tile * view.instant_count + instant) + quarter, pixels
                )
            if kind == _SEVERAL:
                uneven = uneven | (1 << (instant - begin))
            even = kind != _SEVERAL and kind != _BODY
            if at.outside or not even:
                continue
            radiance = scene.sky
            if kind != _SKY:
                ray_C = rays[0, at.ray]
                pose = find_pose(at.instant, 0, at.row * view.width + at.col, view)
                toward = wp.quat_rotate(view.q_WC[pose], _xyz(ray_C))
                radiance = shade_part(
                    scene, out.face[at.instant, at.row, at.col], view.p_WC[pose], toward, SHARPNESS * ray_C[3]
                )
            write_radiance(scene, radiance, 1, at.instant, at.slot, at.row, at.col, out)
        for pair in range(INSTANTS // 2):
            bits = (uneven >> (2 * pair)) & 3
            if lane == 0 and in_picture and bits != 0:
                lists.uneven[wp.atomic_add(lists.count, 0, 1)] = wp.vec3i(
                    4 * tile + quarter, begin + 2 * pair, bits
                )

    @wp.kernel(module="unique", enable_backward=False, module_options=_FAST, launch_bounds=COVER_BOUNDS)
    def cover_uneven_blocks(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        rays: wp.array2d[wp.vec4],
        # Out:
        out: RenderOutputs,
        lists: BlockLists,
    ) -> None:
        # The threads of a warp reach the functions that they call together.
        lane = (first + wp.tid()) % 32
        entry = next_entry(lists.count, 2)
        waiting = int(0)  # bits of the instants of an entry that are taken one by one
        while entry < lists.count[0]:
            listed = lists.uneven[entry]
            bits = wp.where(waiting != 0, waiting & -waiting, listed[2])
            alone = bits != 3
            instant = listed[1] + wp.where(alone, bits // 2, lane // 16)
            at = locate_pixel(listed[0] // 4, instant, listed[0] % 4, lane % 16, view)
            if wp.static(terms.world_scenes):
                scene = view.worlds.scenes[view.worlds.scene[at.world]]
            unwanted = at.outside or (alone and lane >= 16)
            back = wp.where(at.outside, (at.row - at.top) * view.width + at.col - at.left, 0)
            pixel = at.ray - back
            part = int(-1)
            if not at.outside:
                part = out.face[at.instant, at.row, at.col]
            pose = find_pose(at.instant, 0, at.row * view.width + at.col - back, view)
            q = view.q_WC[pose]
            own = PixelRays()
            own.position = view.p_WC[pose]
            own.center = wp.quat_rotate(q, _xyz(rays[0, pixel]))
            own.across = wp.quat_rotate(q, _xyz(rays[1, pixel]))
            own.down = wp.quat_rotate(q, _xyz(rays[2, pixel]))
            covered = cover_block(scene, view, out.face, at, alone, unwanted, own)
            if covered[0] < 0:
                waiting = int(3)
                continue
            total = wp.vec3(0.0)
            for step in range((covered[0] + 31) // 32):
                pair = 32 * step + lane
                known = wp.min(pair, covered[0] - 1)
                sample = _pair_sample(scene, covered[5], alone, known, part, rays[0, pixel][3], own)
                if pair < covered[0]:
                    light = shade_part(
                        scene,
                        wp.cast(sample[2], int),
                        wp.vec3(sample[6], sample[7], sample[8]),
                        wp.vec3(sample[3], sample[4], sample[5]),
                        footprint_width(sample[0]) * sample[1],
                    )
                    _store_pair(covered[5], pair, sample[0] * light)
                total = _sum_pairs(covered[5], covered[1], covered[2], step, total)
            whole = float(SAMPLE_COUNT)
            if covered[4] != 0:
                total += float(covered[3]) * scene.sky
            else:
                whole -= float(covered[3])
            if not unwanted and covered[3] >= 0:
                write_radiance(scene, total / whole, 1, at.instant, at.slot, at.row, at.col, out)
            unresolved = _warp_votes(not unwanted and covered[3] < 0) >> (lane // 16 * 16) & 0xFFFF
            if unresolved != 0 and lane % 16 == 0:
                block = 4 * (listed[0] // 4 * view.instant_count + instant) + listed[0] % 4
                lists.unresolved[wp.atomic_add(lists.count, 1, 1)] = wp.vec2i(block, unresolved)
            waiting = waiting & ~bits
            if waiting == 0:
                if wp.static(not terms.worlds) and leaves_room():
                    break
                entry = next_entry(lists.count, 2)

    @wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED, launch_bounds=PIXEL_BOUNDS)
    def cast_unresolved_pixels(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        rays: wp.array2d[wp.vec4],
        # Out:
        out: RenderOutputs,
        lists: BlockLists,
    ) -> None:
        begin = (first + wp.tid()) // _RAYS
        index = (first + wp.tid()) % _RAYS
        for turn in range(turn_count(begin, lists.count[1], lists.threads // _RAYS)):
            listed = lists.unresolved[begin + turn * (lists.threads // _RAYS)]
            block = listed[0]
            lane = index // RAY_COUNT
            group = block // 4
            at = locate_pixel(group // view.instant_count, group % view.instant_count, block % 4, lane, view)
            if wp.static(terms.world_scenes):
                scene = view.worlds.scenes[view.worlds.scene[at.world]]
            wanted = (listed[1] >> lane) & 1
            light = wp.vec3(0.0)
            if wanted != 0:
                point = ray_point(index % RAY_COUNT)
                pose = find_pose(at.instant, 0, at.row * view.width + at.col, view)
                origin = view.p_WC[pose]
                q = view.q_WC[pose]
                toward_C = _xyz(rays[0, at.ray] + point[0] * rays[1, at.ray] + point[1] * rays[2, at.ray])
                direction_C = wp.normalize(toward_C)
                direction = wp.quat_rotate(q, direction_C)
                hit = intersect_scene(scene, origin, direction)
                body = int(-1)
                if wp.static(terms.bodies):
                    hit, body = intersect_bodies(bodies, pose, direction_C, q, hit)
                light = radiance_of(
                    scene, bodies, pose, body, q, direction, origin, RAY_WIDTH * rays[0, at.ray][3], hit
                )
            light = _ray_sum(light)
            if wanted != 0 and index % RAY_COUNT == 0:
                write_radiance(scene, light / float(RAY_COUNT), 1, at.instant, at.slot, at.row, at.col, out)

    return shade_even_blocks, cover_uneven_blocks, cast_unresolved_pixels
