# mypy: disable-error-code="index,attr-defined,operator,arg-type,no-untyped-def,return-value,empty-body"
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""The ray caster: one kernel factory, specialised on the requested outputs and the terms of the scene.

One traversal per ray answers everything. A specialisation contains only the code that it needs. On a CPU with
Embree a thread is a packet of pixels, and with candidate lists a tile (`raycast_packets.py`); else it is a
pixel of one instant, or, with candidate lists, of a few. Blocks of 64 threads are tiles of 8 x 8 pixels, so
that their rays traverse the same nodes of the tree. With candidate lists (`candidate_lists.py`) the threads
of a block share the set-up of triangles.

On CUDA four threads side by side cast four of several rays of a pixel (`_quad_program`). The 32 rays of a
warp then belong to eight pixels of one instant, or four of two, in place of 32 pixels: they traverse fewer
nodes and shade fewer faces, and wait less for each other. Light is summed in the order of the rays, so
pictures have the same bits as those of a thread a pixel.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from collections.abc import Collection
from functools import cache

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.candidate_lists import candidate_intersector
from neurosim_core.render.kernel_data import (
    FAR_M,
    UNRESOLVED,
    BodyData,
    CandidateListData,
    Hit,
    RenderOutputs,
    RenderTerms,
    SceneData,
    ViewData,
)
from neurosim_core.render.outputs import (
    FACE,
    OUTPUTS,
    geometry_writer,
    radiance_writer,
    requested_outputs,
    widened_outputs,
)
from neurosim_core.render.ray_intersection import (
    UNFUSED,
    intersect_bodies,
    intersect_candidate,
    intersect_scene,
)
from neurosim_core.render.raycast_packets import packet_kernel
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.tiles import pose_finder, tile_finder, tile_locator

PIXEL_BOUNDS = (64, 14)
"""Threads of a block and, on CUDA, blocks of a multiprocessor: registers are limited to fit; fastest on an
H200."""
QUAD_BOUNDS = (64, 16)
"""The same where four threads cast the rays of a pixel: 4 % faster than with 14."""
_CANDIDATE_BOUNDS = (64, 10)
"""The same with candidate lists: a few registers are spilled, and it is still 1 to 3 % faster."""
_FACE_BOUNDS = (64, 12)
"""The same where faces are all that is asked for."""


def raycast_kernel(outputs: Collection[str], terms: RenderTerms) -> wp.Kernel:
    """Return the kernel that casts rays for `outputs` in a scene with `terms`; made once per combination.

    Its parameters: the index of the first thread; `SceneData`, `ViewData` and `BodyData`, of which it reads
    what the terms say. It writes `RenderOutputs`.

    Raises:
        ValueError: An output is unknown, none is requested, or worlds with different scenes or lenses are to
            use candidate lists.
    """
    if terms.candidate_group and (terms.world_scenes or terms.world_lenses):
        raise ValueError("candidate lists need worlds with one scene and one lens")
    if not terms.candidate_group:
        terms = terms._replace(by_tile=False)
    unknown = sorted(set(outputs) - {*OUTPUTS, FACE})
    if unknown or not outputs:
        raise ValueError(f"outputs must be some of {list(OUTPUTS)}, got {sorted(outputs)}")
    if not requested_outputs(outputs).radiance and "returns" not in outputs:  # materials do not matter
        terms = terms._replace(
            textured=False, emissive=False, baked=False, finest_level=False, nearest_texel=False
        )
    if terms.embree or terms.by_tile:
        outputs, terms = widened_outputs(outputs), terms._replace(supersampled=False)
    return _kernel(tuple(name for name in (*OUTPUTS, FACE) if name in outputs), terms)


def fallback_kernel(outputs: Collection[str], terms: RenderTerms) -> wp.Kernel | None:
    """Return the kernel that renders the unresolved pixels of `raycast_kernel`; None: there are none.

    It is launched after `raycast_kernel`, with the same arguments and `CandidateListData.fallback_threads`
    threads.
    """
    if not terms.candidate_group or terms.by_tile:
        return None
    return raycast_kernel(outputs, terms._replace(candidate_group=0, fallback=True))


@cache
def _kernel(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Kernel:
    return (packet_kernel if terms.embree or terms.by_tile else _pixel_kernel)(outputs, terms)


def _bounds_of(outputs: tuple[str, ...], terms: RenderTerms) -> tuple[int, int] | None:
    if terms.candidate_group == 0:
        return QUAD_BOUNDS if _casts_quads(outputs, terms) else PIXEL_BOUNDS
    simple = len(outputs) == 1 and not (terms.worlds or terms.bodies or terms.supersampled)
    if not simple:
        return None
    return _FACE_BOUNDS if outputs == (FACE,) else _CANDIDATE_BOUNDS


def _pixel_kernel(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Kernel:
    """Build the kernel whose threads are pixels."""
    if terms.candidate_group:
        render_thread = _group_program(outputs, terms)
    elif _casts_quads(outputs, terms):
        render_thread = _quad_program(outputs, terms)
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
        # Out:
        out: RenderOutputs,
    ) -> None:
        begin = first + wp.tid()
        if wp.static(terms.fallback):
            count = view.candidates.unresolved_count[0]
            listed = count <= view.candidates.unresolved.shape[0]
            if not listed:  # all pixels
                count = view.instant_count * view.candidates.bounds.shape[0] * 64
                if wp.static(terms.worlds):
                    count *= view.worlds.active.shape[0]
            for turn in range(turn_count(begin, count, view.candidates.fallback_threads)):
                index = begin + turn * view.candidates.fallback_threads
                if listed:
                    index = view.candidates.unresolved[index]
                render_thread(index, scene, view, bodies, out)
        else:
            render_thread(begin, scene, view, bodies, out)

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
        place = locate_tile(tile, instant, view)
        if wp.static(terms.world_scenes):
            scene = view.worlds.scenes[view.worlds.scene[place.world]]
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
    group = terms.instants_per_thread
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
            first += world * view.worlds.stride
            if view.worlds.active[world] == 0:
                return
        col = left_col + in_tile % 8
        row = top + in_tile // 8
        outside = col >= view.width or row >= view.height
        pixel = wp.min(row, view.height - 1) * view.width + wp.min(col, view.width - 1)
        layer_count = view.rays.shape[0]
        radiance = wp.vec3(0.0)
        unresolved = bool(False)
        for layer in range(layer_count):
            ray_C = view.rays[layer, pixel]
            direction_C = wp.vec3(ray_C[0], ray_C[1], ray_C[2])
            faces = intersect_candidates(scene, view, tile, first, instants, FAR_M, direction_C)
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
                    mark_pixel(unresolved, (block + member) * 64 + in_tile, view.candidates)
                    if wp.static(requested.radiance):
                        if rendered and not unresolved:
                            write_radiance(scene, radiance, layer_count, instant, slot, row, col, out)
                    radiance = wp.vec3(0.0)
                    unresolved = bool(False)

    return render_pixel_of_group


@wp.func_native(read_native(__file__, "mark_pixel"))
def mark_pixel(marked: wp.bool, index: int, candidates: CandidateListData):
    """Append the pixel of a thread to those that are unresolved if it is marked; count it in any case.

    All threads of a block call it together.
    """
    ...


def _casts_quads(outputs: tuple[str, ...], terms: RenderTerms) -> bool:
    """Tell whether the program can render these outputs: light at all instants, and no geometry."""
    requested = requested_outputs(outputs)
    return terms.quads and requested.log and not (requested.geometry or requested.faces or terms.fallback)


@wp.func_native(read_native(__file__, "quad_sum"))
def _quad_sum(before: wp.vec3, value: wp.vec3) -> wp.vec3:
    """Return `before` and the sum of the values of four threads side by side; all of a warp call it."""
    ...


@wp.func
def _locate_pixel(patch: int, in_tile: int, paired: bool, half: int):
    """Return column and row in the tile of what a thread renders in turn: 16 pixels, or 8 of two instants."""
    col = 4 * (patch % 2) + (in_tile // 4) % 2
    row = 2 * (patch // 2) + (in_tile // 8) % 2
    if paired:
        return col + 2 * (in_tile // 32), row + 4 * half
    return col + 2 * ((in_tile // 16) % 2), row + 2 * (patch // 2) + 2 * (in_tile // 32)


def _quad_program(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Function:
    """Return the function that renders the pixels of a tile by rays that traverse the tree."""
    locate_tile = tile_locator(terms, images=requested_outputs(outputs).images, instants=True)
    find_pose = pose_finder(terms)
    radiance_of = pixel_shader(terms)
    write_radiance = radiance_writer(outputs, supersampled=True)

    @wp.func
    def render_quads(
        index: int,
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        out: RenderOutputs,
    ):
        # Counted as by `render_pixel`. Two blocks of two instants are the halves of a tile at both.
        in_tile = index % 64
        block = index // 64
        instant = block % view.instant_count
        tile = block // view.instant_count
        half = instant % 2
        paired = instant < view.instant_count // 2 * 2
        if paired:
            instant += (in_tile // 16) % 2 - half
        place = locate_tile(tile, instant, view)
        if wp.static(terms.world_scenes):
            scene = view.worlds.scenes[view.worlds.scene[place.world]]
        if not place.rendered:  # and so is no other thread of the block
            return
        member = in_tile % 4
        ray_count = view.rays.shape[0] - 1
        total = wp.vec3(0.0)
        own = wp.vec3(0.0)
        for turn in range(ray_count):  # four patches, by four rays of each pixel at a time
            patch = turn // (ray_count // 4)
            layer = 1 + 4 * (turn % (ray_count // 4)) + member
            col, row = _locate_pixel(patch, in_tile, paired, half)
            col += place.left
            row += place.top
            light = wp.vec3(0.0)
            if col < view.width and row < view.height:
                pixel = row * view.width + col
                pose = find_pose(place.instant, layer, pixel, view)
                q = view.q_WC[pose]
                origin = view.p_WC[pose]
                ray_C = view.rays[layer, place.first_ray + pixel]
                ray = wp.quat_rotate(q, wp.vec3(ray_C[0], ray_C[1], ray_C[2]))
                hit = intersect_scene(scene, origin, ray)
                body = int(-1)
                if wp.static(terms.bodies):
                    hit, body = intersect_bodies(bodies, pose, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit)
                light = radiance_of(scene, bodies, pose, body, q, ray, origin, ray_C[3], hit)
            if layer == 1 + member:
                total = wp.vec3(0.0)
            total = _quad_sum(total, light)
            if patch == member:
                own = total
        col, row = _locate_pixel(member, in_tile, paired, half)
        col += place.left
        row += place.top
        if col < view.width and row < view.height:
            write_radiance(scene, own, ray_count + 1, place.instant, place.slot, row, col, out)

    return render_quads
