# mypy: disable-error-code="index,attr-defined,no-any-return,operator,arg-type,no-untyped-def"
# mypy: disable-error-code="return-value"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""The ray caster whose threads are pixels: of an instant, or, where walks are shared, of a few.

Blocks of 64 threads are tiles of 8 x 8 pixels, so that their rays walk the same nodes of the tree. With
shared walks (`tile_walk.py`) a block finds together what its rays hit.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import warp as wp

from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.cast_terms import Terms, group_of
from neurosim_core.render.film import FilmData, asked_for, geometry_writer, radiance_writer
from neurosim_core.render.list_search import together_finder
from neurosim_core.render.ray_hit import FAR_M, UNFUSED, meet_bodies, meet_listed, meet_scene
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.view_data import ViewData, WorldData, tile_finder
from neurosim_core.render.walk_data import ASK, WalkData

_BOUNDS = (64, 14)
"""Threads and, on CUDA, blocks of a multiprocessor that registers must do for: as measured on an H200."""
_TOGETHER_BOUNDS = (64, 10)
"""The same for shared walks: a few registers are spilled, and it is still 1 to 3 % faster."""


def _bounds_of(outputs: tuple[str, ...], terms: Terms) -> tuple[int, int] | None:
    if terms.walked == 0:
        return _BOUNDS
    simple = len(outputs) == 1 and not (terms.worlds or terms.bodies or terms.supersampled)
    return _TOGETHER_BOUNDS if simple else None


def pixel_kernel(outputs: tuple[str, ...], terms: Terms) -> wp.Kernel:
    """Return the kernel, made anew; see `raycast.raycast_kernel`."""
    leaving = terms.walked > 0
    look = _together_eye(outputs, terms) if leaving else _eye(outputs, terms)

    @wp.kernel(
        module="unique",
        enable_backward=False,
        module_options=UNFUSED,
        launch_bounds=_bounds_of(outputs, terms),
    )
    def raycast(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        walks: WalkData,
        # Out:
        film: FilmData,
    ) -> None:
        begin = first + wp.tid()
        if wp.static(terms.asking):
            count = walks.left_count[0]
            listed = count <= walks.left.shape[0]
            if not listed:  # all pixels
                count = view.instant_count * walks.bounds.shape[0] * 64
                if wp.static(terms.worlds):
                    count *= worlds.active.shape[0]
            for turn in range(turn_count(begin, count, walks.left_threads)):
                index = begin + turn * walks.left_threads
                if listed:
                    index = walks.left[index]
                look(index, scene, view, bodies, worlds, walks, film)
        else:
            look(begin, scene, view, bodies, worlds, walks, film)

    return raycast


@wp.func
def turn_count(begin: int, end: int, step: int) -> int:
    """Return how many numbers `range(begin, end, step)` has.

    Counted, since the one after the last may be more than 32 bits hold.
    """
    return wp.where(begin < end, (end - 1 - begin) // step + 1, 0)


def _eye(outputs: tuple[str, ...], terms: Terms) -> wp.Function:
    """Return the function that looks at a pixel of an instant, by a ray that walks by itself."""
    asked = asked_for(outputs)
    find_tile = tile_finder(terms)
    radiance_of = pixel_shader(terms)
    write_geometry = geometry_writer(outputs)
    write_radiance = radiance_writer(outputs, supersampled=terms.supersampled)

    @wp.func
    def see(
        index: int,
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        walks: WalkData,
        film: FilmData,
    ):
        # A pixel of an instant, of which `index` tells: of a tile all instants, then the next tile. Threads
        # side by side should walk the same nodes: a block is a quarter of a tile at four instants, and
        # what is left over the whole tile at one.
        in_tile = index % 64
        block = index // 64
        instant = block % view.instant_count
        tile = block // view.instant_count
        if wp.static(not terms.asking):
            if instant < view.instant_count // 4 * 4:
                quarter = instant % 4
                instant += in_tile // 16 - quarter
                in_tile = 32 * (quarter // 2) + 4 * (quarter % 2) + 8 * ((in_tile % 16) // 4) + in_tile % 4
        world, tile, left, top = find_tile(tile, view.width, view.height)
        first_ray = int(0)
        if wp.static(terms.worlds):
            instant += world * worlds.stride
            if worlds.active[world] == 0:
                return
        if wp.static(terms.world_scenes):
            scene = worlds.scenes[worlds.scene[world]]
        if wp.static(terms.world_lenses):
            first_ray = worlds.lens[world] * view.width * view.height
        col = left + in_tile % 8
        row = top + in_tile // 8
        if col >= view.width or row >= view.height:
            return
        slot = int(-1)
        if wp.static(asked.images):
            slot = view.image_slot[instant]
            if wp.static(not asked.log):
                if slot < 0:
                    return
        origin = view.p_WC[instant]
        q = view.q_WC[instant]
        pixel = first_ray + row * view.width + col
        radiance = wp.vec3(0.0)
        for layer in range(view.rays.shape[0]):
            if wp.static(terms.supersampled):
                # Layer 0 goes through the centre and is for geometry, the others are for radiance.
                if layer == 0 and (slot < 0 or wp.static(not asked.geometry)):
                    continue
            ray_C = view.rays[layer, pixel]
            ray = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
            hit = meet_scene(scene, origin, ray)
            body = int(-1)
            if wp.static(terms.bodies):
                hit, body = meet_bodies(bodies, instant, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit)
            if wp.static(asked.radiance):
                if wp.static(not terms.supersampled) or layer > 0:
                    radiance += radiance_of(scene, bodies, instant, body, q, ray, origin, ray_C[3], hit)
            if wp.static(asked.geometry):
                if slot >= 0 and layer == 0:
                    write_geometry(scene, ray, ray_C[2], hit, slot, row, col, film)
        if wp.static(asked.radiance):
            write_radiance(scene, radiance, view.rays.shape[0], instant, slot, row, col, film)

    return see


def _together_eye(outputs: tuple[str, ...], terms: Terms) -> wp.Function:
    """Return the function that looks at a pixel of a group of instants, by rays that share a walk."""
    asked = asked_for(outputs)
    group = group_of(terms)
    find_tile = tile_finder(terms)
    find_together = together_finder(group)
    radiance_of = pixel_shader(terms)
    write_geometry = geometry_writer(outputs)
    write_radiance = radiance_writer(outputs, supersampled=terms.supersampled)

    @wp.func
    def see_together(
        index: int,
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        walks: WalkData,
        film: FilmData,
    ):
        # A pixel of a group of instants, of which `index` tells; what blocks do together, all threads do.
        in_tile = index % 64
        block = index // 64
        group_count = (view.instant_count + group - 1) // group
        first = (block % group_count) * group
        tile = block // group_count
        instants = wp.min(view.instant_count - first, group)
        block = tile * view.instant_count + first  # of the first instant, as `see` counts
        world, tile, left_col, top = find_tile(tile, view.width, view.height)
        if wp.static(terms.worlds):
            first += world * worlds.stride
            if worlds.active[world] == 0:
                return
        col = left_col + in_tile % 8
        row = top + in_tile // 8
        outside = col >= view.width or row >= view.height
        pixel = wp.min(row, view.height - 1) * view.width + wp.min(col, view.width - 1)
        walk = first // walks.instants
        layer_count = view.rays.shape[0]
        radiance = wp.vec3(0.0)
        left = bool(False)
        for layer in range(layer_count):
            ray_C = view.rays[layer, pixel]
            faces = find_together(
                scene.mesh,
                walks.faces,
                (walk * walks.bounds.shape[0] + tile) * walks.limit,
                walks.count[walk, tile],
                walks.reach[walk, tile],
                FAR_M,
                walks.bounds[tile],
                view.p_WC,
                view.q_WC,
                first,
                instants,
                wp.vec3(ray_C[0], ray_C[1], ray_C[2]),
            )
            for member in range(instants):
                instant = first + member
                slot = int(-1)
                if wp.static(asked.images):
                    slot = view.image_slot[instant]
                seen = not outside and not left
                if wp.static(asked.images and not asked.log):
                    seen = seen and slot >= 0
                if wp.static(terms.supersampled):
                    seen = seen and (layer > 0 or (slot >= 0 and wp.static(asked.geometry)))
                if seen:
                    origin = view.p_WC[instant]
                    q = view.q_WC[instant]
                    ray = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
                    hit = meet_listed(scene, origin, ray, faces[member])
                    left = hit.face == ASK
                    if not left:
                        body = int(-1)
                        if wp.static(terms.bodies):
                            hit, body = meet_bodies(
                                bodies, instant, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit
                            )
                        if wp.static(asked.radiance):
                            if wp.static(not terms.supersampled) or layer > 0:
                                radiance += radiance_of(
                                    scene, bodies, instant, body, q, ray, origin, ray_C[3], hit
                                )
                        if wp.static(asked.geometry):
                            if slot >= 0 and layer == 0:
                                write_geometry(
                                    scene,
                                    ray,
                                    ray_C[2],
                                    hit,
                                    slot,
                                    row,
                                    col,
                                    film,
                                )
                if layer == layer_count - 1:
                    _leave(left, (block + member) * 64 + in_tile, walks.left, walks.left_count)
                    if wp.static(asked.radiance):
                        if seen and not left:
                            write_radiance(
                                scene,
                                radiance,
                                layer_count,
                                instant,
                                slot,
                                row,
                                col,
                                film,
                            )
                    radiance = wp.vec3(0.0)
                    left = bool(False)

    return see_together


@wp.func_native("""
    using namespace wp;
#ifdef __CUDA_ARCH__
    // one atomic for a warp, whose pixels stay side by side
    const unsigned mask = __ballot_sync(0xffffffffu, is_left), lane = threadIdx.x & 31;
    int place = 0;
    if (mask && lane == 0)
        place = atomicAdd(count.data, __popc(mask));
    place = __shfl_sync(0xffffffffu, place, 0) + __popc(mask & ((1u << lane) - 1));
#else
    const int place = is_left ? __atomic_fetch_add(count.data, 1, __ATOMIC_RELAXED) : 0;
#endif
    if (is_left && place < left.shape[0])
        left.data[place] = index;
""")
def _leave(is_left: wp.bool, index: int, left: wp.array[int], count: wp.array[int]):
    """Note that the pixel of a thread is left, and count it, also where there is no room for it.

    All threads of a block call it together.
    """
    ...
