# mypy: disable-error-code="index,attr-defined,operator,arg-type,no-untyped-def,return-value"
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""The ray caster whose threads are pixels: of one instant, or, with candidate lists, of a few.

Blocks of 64 threads are tiles of 8 x 8 pixels, so that their rays traverse the same nodes of the tree; four
of several rays a pixel are cast side by side (`raycast_quads.py`). With candidate lists
(`candidate_lists.py`) the threads of a block share the set-up of triangles.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.candidate_data import UNRESOLVED, CandidateListData
from neurosim_core.render.candidate_intersection import candidate_intersector
from neurosim_core.render.outputs import (
    FACE,
    RenderOutputs,
    geometry_writer,
    radiance_writer,
    requested_outputs,
)
from neurosim_core.render.ray_intersection import (
    FAR_M,
    UNFUSED,
    Hit,
    intersect_bodies,
    intersect_candidate,
    intersect_scene,
)
from neurosim_core.render.raycast_quads import casts_quads, quad_program
from neurosim_core.render.render_terms import RenderTerms, instants_per_thread
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.view_data import ViewData, WorldData, tile_finder, tile_locator

PIXEL_BOUNDS = (64, 14)
"""Threads of a block and, on CUDA, blocks of a multiprocessor: registers are limited to fit; fastest on an
H200."""
QUAD_BOUNDS = (64, 16)
"""The same where four threads cast the rays of a pixel: 4 % faster than with 14."""
_CANDIDATE_BOUNDS = (64, 10)
"""The same with candidate lists: a few registers are spilled, and it is still 1 to 3 % faster."""
_FACE_BOUNDS = (64, 12)
"""The same where faces are all that is asked for."""


def _bounds_of(outputs: tuple[str, ...], terms: RenderTerms) -> tuple[int, int] | None:
    if terms.candidate_group == 0:
        return QUAD_BOUNDS if casts_quads(outputs, terms) else PIXEL_BOUNDS
    simple = len(outputs) == 1 and not (terms.worlds or terms.bodies or terms.supersampled)
    if not simple:
        return None
    return _FACE_BOUNDS if outputs == (FACE,) else _CANDIDATE_BOUNDS


def pixel_kernel(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Kernel:
    """Build the kernel; see `raycast.raycast_kernel`."""
    if terms.candidate_group:
        render_thread = _group_program(outputs, terms)
    elif casts_quads(outputs, terms):
        render_thread = quad_program(outputs, terms)
    else:
        render_thread = _pixel_program(outputs, terms)

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
        candidates: CandidateListData,
        # Out:
        out: RenderOutputs,
    ) -> None:
        begin = first + wp.tid()
        if wp.static(terms.fallback):
            count = candidates.unresolved_count[0]
            listed = count <= candidates.unresolved.shape[0]
            if not listed:  # all pixels
                count = view.instant_count * candidates.bounds.shape[0] * 64
                if wp.static(terms.worlds):
                    count *= worlds.active.shape[0]
            for turn in range(turn_count(begin, count, candidates.fallback_threads)):
                index = begin + turn * candidates.fallback_threads
                if listed:
                    index = candidates.unresolved[index]
                render_thread(index, scene, view, bodies, worlds, candidates, out)
        else:
            render_thread(begin, scene, view, bodies, worlds, candidates, out)

    return raycast


@wp.func
def turn_count(begin: int, end: int, step: int) -> int:
    """Return how many numbers `range(begin, end, step)` has.

    Counted, since the one after the last may be more than 32 bits hold.
    """
    return wp.where(begin < end, (end - 1 - begin) // step + 1, 0)


def _pixel_program(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Function:
    """Return the function that renders a pixel of one instant by rays that traverse the tree."""
    requested = requested_outputs(outputs)
    every_instant = requested.log or requested.faces
    locate_tile = tile_locator(terms, images=requested.images, instants=every_instant)
    radiance_of = pixel_shader(terms)
    write_geometry = geometry_writer(outputs, terms)
    write_radiance = radiance_writer(outputs, supersampled=terms.supersampled)

    @wp.func
    def render_pixel(
        index: int,
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        candidates: CandidateListData,
        out: RenderOutputs,
    ):
        # `index` counts the pixels of a tile in one instant, then the instants of a tile, then tiles.
        # Adjacent threads should traverse the same nodes: a block is a quarter of a tile at four instants,
        # half of it at two that remain, and at the last instant the whole tile.
        in_tile = index % 64
        block = index // 64
        instant = block % view.instant_count
        tile = block // view.instant_count
        if wp.static(not terms.fallback):
            if instant < view.instant_count // 4 * 4:
                quarter = instant % 4
                instant += in_tile // 16 - quarter
                in_tile = 32 * (quarter // 2) + 4 * (quarter % 2) + 8 * ((in_tile % 16) // 4) + in_tile % 4
            elif instant < view.instant_count // 2 * 2:
                half = instant % 2
                instant += (in_tile // 16) % 2 - half
                in_tile = 32 * half + 4 * (in_tile // 32) + 8 * ((in_tile % 16) // 4) + in_tile % 4
        place = locate_tile(tile, instant, view, worlds)
        if wp.static(terms.world_scenes):
            scene = worlds.scenes[worlds.scene[place.world]]
        col = place.left + in_tile % 8
        row = place.top + in_tile // 8
        if not place.rendered or col >= view.width or row >= view.height:
            return
        instant = place.instant
        slot = place.slot
        origin = view.p_WC[instant]
        q = view.q_WC[instant]
        pixel = place.first_ray + row * view.width + col
        radiance = wp.vec3(0.0)
        for layer in range(view.rays.shape[0]):
            if wp.static(terms.supersampled):
                # Layer 0 goes through the centre and is for geometry, the others are for radiance.
                if layer == 0 and (slot < 0 or wp.static(not requested.geometry)):
                    continue
            pose = instant
            if wp.static(terms.timed):
                pose = instant * view.pose_count + view.pose[layer, pixel - place.first_ray]
                origin = view.p_WC[pose]
                q = view.q_WC[pose]
            ray_C = view.rays[layer, pixel]
            ray = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
            hit = intersect_scene(scene, origin, ray)
            body = int(-1)
            if wp.static(terms.bodies):
                hit, body = intersect_bodies(bodies, pose, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit)
            if wp.static(requested.faces):
                if layer == view.rays.shape[0] - 1:
                    out.face[instant, row, col] = hit.face
            if wp.static(requested.radiance):
                if wp.static(not terms.supersampled) or layer > 0:
                    radiance += radiance_of(scene, bodies, pose, body, q, ray, origin, ray_C[3], hit)
            if wp.static(requested.geometry):
                if slot >= 0 and layer == 0:
                    write_geometry(scene, ray, ray_C[2], ray_C[3], hit, slot, row, col, out)
        if wp.static(requested.radiance):
            write_radiance(scene, radiance, view.rays.shape[0], instant, slot, row, col, out)

    return render_pixel


def _group_program(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Function:
    """Return the function that renders a pixel of a group of instants by candidate lists."""
    requested = requested_outputs(outputs)
    group = instants_per_thread(terms)
    find_tile = tile_finder(terms)
    intersect_candidates = candidate_intersector(group)
    radiance_of = pixel_shader(terms)
    write_geometry = geometry_writer(outputs, terms)
    write_radiance = radiance_writer(outputs, supersampled=terms.supersampled)

    @wp.func
    def render_pixel_of_group(
        index: int,
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        candidates: CandidateListData,
        out: RenderOutputs,
    ):
        # All threads of a block reach the functions that they call together, also those outside the picture.
        in_tile = index % 64
        block = index // 64
        group_count = (view.instant_count + group - 1) // group
        first = (block % group_count) * group
        tile = block // group_count
        instants = wp.min(view.instant_count - first, group)
        block = tile * view.instant_count + first  # of the first instant, as `render_pixel` counts
        world, tile, left_col, top = find_tile(tile, view.width, view.height)
        if wp.static(terms.worlds):
            first += world * worlds.stride
            if worlds.active[world] == 0:
                return
        col = left_col + in_tile % 8
        row = top + in_tile // 8
        outside = col >= view.width or row >= view.height
        pixel = wp.min(row, view.height - 1) * view.width + wp.min(col, view.width - 1)
        candidate_group = first // candidates.instants
        layer_count = view.rays.shape[0]
        radiance = wp.vec3(0.0)
        unresolved = bool(False)
        for layer in range(layer_count):
            ray_C = view.rays[layer, pixel]
            faces = intersect_candidates(
                scene.mesh,
                candidates.faces,
                (candidate_group * candidates.bounds.shape[0] + tile) * candidates.limit,
                candidates.count[candidate_group, tile],
                candidates.reach[candidate_group, tile],
                FAR_M,
                candidates.bounds[tile],
                view.p_WC,
                view.q_WC,
                first,
                instants,
                wp.vec3(ray_C[0], ray_C[1], ray_C[2]),
            )
            for member in range(instants):
                instant = first + member
                slot = int(-1)
                if wp.static(requested.images):
                    slot = view.image_slot[instant]
                rendered = not outside and not unresolved
                if wp.static(requested.images and not (requested.log or requested.faces)):
                    rendered = rendered and slot >= 0
                if wp.static(terms.supersampled):
                    rendered = rendered and (layer > 0 or (slot >= 0 and wp.static(requested.geometry)))
                if rendered:
                    origin = view.p_WC[instant]
                    q = view.q_WC[instant]
                    ray = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
                    hit = Hit()
                    hit.face = faces[member]
                    if wp.static(requested.radiance or requested.geometry or terms.bodies):
                        hit = intersect_candidate(scene, origin, ray, faces[member])
                    unresolved = hit.face == UNRESOLVED
                    if not unresolved:
                        body = int(-1)
                        if wp.static(terms.bodies):
                            hit, body = intersect_bodies(
                                bodies, instant, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit
                            )
                        if wp.static(requested.faces):
                            if layer == layer_count - 1:
                                out.face[instant, row, col] = hit.face
                        if wp.static(requested.radiance):
                            if wp.static(not terms.supersampled) or layer > 0:
                                radiance += radiance_of(
                                    scene, bodies, instant, body, q, ray, origin, ray_C[3], hit
                                )
                        if wp.static(requested.geometry):
                            if slot >= 0 and layer == 0:
                                write_geometry(scene, ray, ray_C[2], ray_C[3], hit, slot, row, col, out)
                if layer == layer_count - 1:
                    mark_pixel(
                        unresolved,
                        (block + member) * 64 + in_tile,
                        candidates.unresolved,
                        candidates.unresolved_count,
                    )
                    if wp.static(requested.radiance):
                        if rendered and not unresolved:
                            write_radiance(scene, radiance, layer_count, instant, slot, row, col, out)
                    radiance = wp.vec3(0.0)
                    unresolved = bool(False)

    return render_pixel_of_group


@wp.func_native(read_native(__file__, "mark_pixel"))
def mark_pixel(marked: wp.bool, index: int, pixels: wp.array[int], count: wp.array[int]):
    """Append the pixel of a thread to an array if it is marked; count it also where the array is full.

    All threads of a block call it together.
    """
    ...
