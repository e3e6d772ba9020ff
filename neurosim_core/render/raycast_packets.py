# mypy: disable-error-code="index,attr-defined,misc,operator,no-untyped-def,empty-body,valid-type"
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""The ray caster of a CPU: a thread is a packet of pixels, of which four are a tile, or a tile.

With Embree a thread is a packet of 4 x 4 pixels, with candidate lists (`candidate_lists.py`) a whole tile.

Packets are shaded in loops over their lanes that become vector instructions. The arithmetic and its order are
those of `shading.py` for baked light and mip-mapped textures, so the bytes are the same. Each quantity of the
lanes is an array, and each loop does one thing for all lanes without a branch, except for loads from tables
and the library's logarithm of the footprint. Where all lanes hit one triangle, its tables are read once.
Shading ray by ray takes three times as long as Embree's intersection.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from functools import cache
from typing import Any

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.candidate_lists import intersect_tile
from neurosim_core.render.embree import packet_caster
from neurosim_core.render.kernel_data import (
    FAR_M,
    TILE,
    UNRESOLVED,
    BodyData,
    Hit,
    RenderOutputs,
    RenderTerms,
    SceneData,
    ViewData,
)
from neurosim_core.render.outputs import RADIANCE, geometry_writer, radiance_writer, requested_outputs
from neurosim_core.render.ray_intersection import (
    UNFUSED,
    intersect_bodies,
    intersect_candidate,
    intersect_scene,
)
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.tiles import pose_finder, tile_locator

PACKET_TERMS = {"TEXTURED": True, "EMISSIVE": True, "LIGHT_WITHIN": False, "APART": 0}
"""Constants of `shade_lanes.cuh`: on a CPU to look for textures takes less than to compile both kernels."""


@wp.struct
class PixelBlock:
    """4 x 4 pixels in one instant, or as many of them as are in the picture."""

    first_ray: int  # Index of the first ray in a layer
    instant: int  # Row of the arrays of instants
    top: int  # Row of the first pixel
    left: int  # Column of the first pixel
    rows: int
    columns: int


@cache
def packet_shader(lanes: int, *, unit_normals: bool) -> Any:
    """Return the Warp function, for CPU kernels only, that adds the radiance of a packet's hits to a total.

    Its parameters are the scene; then of each lane: ray, of unit length; spread [rad]; hit, whose normal is
    of unit length if so said. The last is the radiance of each lane so far, to add to.
    """
    code = read_native(__file__, "shade_packet", N=lanes, UNIT=unit_normals, **PACKET_TERMS)

    @wp.func_native(code)
    def shade_packet(
        scene: SceneData,
        rays: wp.array[wp.vec3],
        spreads: wp.array[float],
        hits: wp.array[Hit],
        total: wp.array[wp.vec3],
    ): ...

    return shade_packet


@cache
def packet_program(width: int) -> Any:
    """Return the Warp function, for CPU kernels only, that casts and shades 4 x 4 pixels, and takes the log.

    The bits are those of `packet_caster`, `packet_shader` and the writer of each pixel; the hits are passed
    on in arrays by quantity, which are neither cleared nor transposed. Of several layers of rays the first is
    left out, and the radiance is the mean of the others; four layers of 2 x 2 pixels are a packet if their
    number is a multiple of four, so the last bits may differ from those of packets of one layer.

    Its parameters: the scene; the view, whose rays are contiguous; the pixels; the distance beyond which hits
    do not count [m]. The last is the log radiance, of which these pixels are written.
    """
    code = read_native(__file__, "render_packet", N=16, SIDE=4, WIDTH=width, UNIT=False, **PACKET_TERMS)

    @wp.func_native(code)
    def render_packet(
        scene: SceneData,
        view: ViewData,
        pixels: PixelBlock,
        far_m: float,
        log_radiance_out: wp.array3d[float],
    ): ...

    return render_packet


@cache
def face_caster(width: int, *, timed: bool) -> Any:
    """Return the Warp function, for CPU kernels only, that writes the faces that 4 x 4 pixels see, -1: none.

    It casts the rays of the last layer. Its parameters are those of `packet_program`, but for the last, of
    which these pixels are written.
    """

    @wp.func_native(read_native(__file__, "cast_faces", N=16, SIDE=4, WIDTH=width, TIMED=timed))
    def cast_faces(
        scene: SceneData, view: ViewData, pixels: PixelBlock, far_m: float, face_out: wp.array3d[int]
    ): ...

    return cast_faces


def packet_kernel(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Kernel:
    """Build the kernel; see `raycast.raycast_kernel`."""
    requested = requested_outputs(outputs)
    every_instant = requested.log or requested.faces
    locate_tile = tile_locator(terms, images=requested.images, instants=every_instant)
    radiance_of = pixel_shader(terms)
    write_geometry = geometry_writer(outputs, terms, allocated=True)
    write_radiance = radiance_writer(RADIANCE, supersampled=False, allocated=True)
    find_pose = pose_finder(terms)
    side = TILE if terms.by_tile else 4
    lanes = side * side
    packets = (TILE // side) ** 2  # of a tile
    listed = terms.candidate_group > 0
    cast_packet = packet_caster(terms.embree) if terms.embree else None

    packed = requested.radiance and terms.baked and not terms.bodies and not terms.finest_level
    each_lane = requested.geometry or listed or not packed
    shade_packet = packet_shader(lanes, unit_normals=listed)
    fused = requested.log and packed and not listed and not terms.timed  # for instants without an image slot
    render_packet = packet_program(terms.embree) if fused else None
    plain = requested.faces and not (requested.radiance or terms.bodies or listed)
    cast_faces = face_caster(terms.embree, timed=terms.timed) if plain else None

    @wp.kernel(module="unique", enable_backward=False, module_options={} if terms.embree else UNFUSED)
    def raycast_packets(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        # Out:
        out: RenderOutputs,
    ) -> None:
        # A packet is the same pixels in every launch: the last bit of a hit may depend on the other rays.
        index = first + wp.tid()
        in_tile = index % packets
        block = index // packets
        instant = block % view.instant_count
        place = locate_tile(block // view.instant_count, instant, view)
        if wp.static(terms.world_scenes):
            scene = view.worlds.scenes[view.worlds.scene[place.world]]
        left = place.left + (in_tile % 2) * side
        top = place.top + (in_tile // 2) * side
        if not place.rendered or left >= view.width or top >= view.height:
            return
        instant = place.instant
        slot = place.slot
        columns = wp.min(view.width - left, side)
        rows = wp.min(view.height - top, side)
        pixels = PixelBlock()
        pixels.first_ray = place.first_ray + top * view.width + left
        pixels.instant = instant
        pixels.top = top
        pixels.left = left
        pixels.rows = rows
        pixels.columns = columns
        if wp.static(fused):
            if slot < 0:
                render_packet(scene, view, pixels, FAR_M, out.log_radiance)
                return
        if wp.static(plain):
            if slot < 0 or wp.static(not requested.geometry):
                cast_faces(scene, view, pixels, FAR_M, out.face)
                return
        ray = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        face = wp.zeros(shape=(lanes if listed else 1,), dtype=int)
        hits = wp.zeros(shape=(lanes,), dtype=Hit)
        radiance = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        origin = wp.zeros(shape=(lanes,), dtype=wp.vec3)
        spread_rad = wp.zeros(shape=(lanes if packed else 1,), dtype=float)
        layers = view.rays.shape[0]
        for layer in range(layers):
            if layers > 1 and layer == 0 and (slot < 0 or wp.static(not requested.geometry)):
                continue
            for y in range(rows):
                for x in range(columns):
                    pixel = (top + y) * view.width + left + x
                    pose = find_pose(instant, layer, pixel, view)
                    ray_C = view.rays[layer, place.first_ray + pixel]
                    direction_C = wp.vec3(ray_C[0], ray_C[1], ray_C[2])
                    ray[side * y + x] = wp.quat_rotate(view.q_WC[pose], direction_C)
                    origin[side * y + x] = view.p_WC[pose]
                    if wp.static(packed):
                        spread_rad[side * y + x] = ray_C[3]
            if wp.static(listed):
                intersect_tile(scene, view, place.tile, instant, FAR_M, ray, face)
            else:
                embree_scene = scene.embree_scene
                if wp.static(requested.faces):
                    if layer == layers - 1:
                        embree_scene = scene.embree_quick
                cast_packet(scene.embree_intersect, embree_scene, origin, ray, FAR_M, hits)
            if wp.static(each_lane):
                for y in range(rows):
                    for x in range(columns):
                        lane = side * y + x
                        pixel = (top + y) * view.width + left + x
                        pose = find_pose(instant, layer, pixel, view)
                        q = view.q_WC[pose]
                        ray_C = view.rays[layer, place.first_ray + pixel]
                        if wp.static(listed):
                            hit = intersect_candidate(scene, origin[lane], ray[lane], face[lane])
                            if hit.face == UNRESOLVED:
                                hit = intersect_scene(scene, origin[lane], ray[lane])
                        else:
                            hit = hits[lane]
                            hit.normal = wp.normalize(hit.normal)
                        body = int(-1)
                        if wp.static(terms.bodies):
                            hit, body = intersect_bodies(
                                bodies, pose, wp.vec3(ray_C[0], ray_C[1], ray_C[2]), q, hit
                            )
                        if wp.static(listed and packed):
                            hits[lane] = hit
                        if wp.static(requested.faces):
                            if layer == layers - 1:
                                out.face[instant, top + y, left + x] = hit.face
                        if wp.static(requested.radiance and not packed):
                            if layers == 1 or layer > 0:
                                radiance[lane] += radiance_of(
                                    scene, bodies, pose, body, q, ray[lane], origin[lane], ray_C[3], hit
                                )
                        if wp.static(requested.geometry):
                            if slot >= 0 and layer == 0:
                                write_geometry(
                                    scene, ray[lane], ray_C[2], ray_C[3], hit, slot, top + y, left + x, out
                                )
            if wp.static(packed):
                if layers == 1 or layer > 0:
                    shade_packet(scene, ray, spread_rad, hits, radiance)
        if wp.static(requested.radiance):
            share = 1.0 / float(wp.max(layers - 1, 1))
            for y in range(rows):
                for x in range(columns):
                    write_radiance(
                        scene, share * radiance[side * y + x], 1, instant, slot, top + y, left + x, out
                    )

    return raycast_packets
