# mypy: disable-error-code="index,attr-defined,operator,arg-type,no-untyped-def,empty-body,return-value"
# ruff: noqa: UP018, RUF046  (typed literals: they have a meaning)
"""The program of the ray caster where four threads side by side cast the rays of a pixel, on CUDA.

The 32 rays of a warp then belong to eight pixels of one instant, or four of two, in place of 32 pixels: they
traverse fewer nodes and shade fewer faces, and wait less for each other. Light is summed in the order of the
rays, so pictures have the same bits as those of a thread a pixel.
"""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.candidate_data import CandidateListData
from neurosim_core.render.outputs import RenderOutputs, radiance_writer, requested_outputs
from neurosim_core.render.ray_intersection import intersect_bodies, intersect_scene
from neurosim_core.render.render_terms import RenderTerms
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.view_data import ViewData, WorldData, pose_finder, tile_locator


def casts_quads(outputs: tuple[str, ...], terms: RenderTerms) -> bool:
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


def quad_program(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Function:
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
        worlds: WorldData,
        candidates: CandidateListData,
        out: RenderOutputs,
    ):
        # Counted as by `raycast_pixels`. Two blocks of two instants are the halves of a tile at both.
        in_tile = index % 64
        block = index // 64
        instant = block % view.instant_count
        tile = block // view.instant_count
        half = instant % 2
        paired = instant < view.instant_count // 2 * 2
        if paired:
            instant += (in_tile // 16) % 2 - half
        place = locate_tile(tile, instant, view, worlds)
        if wp.static(terms.world_scenes):
            scene = worlds.scenes[worlds.scene[place.world]]
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
