# mypy: disable-error-code="index,attr-defined,operator,arg-type,no-untyped-def,assignment,return-value"
# mypy: disable-error-code="call-overload,empty-body,misc,valid-type"
# ruff: noqa: UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning in kernels)
"""Antialiasing: a pixel is the mean of the faces that it shows, weighed by how much of it each covers.

1. The first pass casts one ray per pixel and notes the face that it hits. The rays of neighbouring pixels go
   through different points of their pixels: a bar as thin as a quarter of a pixel is hit in one of four
   adjacent rows or columns.
2. A block of 4 x 4 pixels may show the faces that the first rays hit in it and in a ring of one pixel around
   it, and, step by step, those beyond their edges that cross the block. Each of SAMPLE_COUNT points of a
   pixel shows the nearest of them. That takes products and sums: no ray is cast. A plane surface is shaded
   once per pixel, at the middle of the points that show it.
3. Blocks with more than FACE_COUNT_MAX faces or with moving bodies, and pixels that show for the most part
   none of the faces, are the mean of RAY_COUNT rays.

Faces are those of the scene before they are cut for baked light, which makes many of one.

Means are taken in linear light. The points are fixed in the pixel: a still camera gives the same picture at
every instant. They form a Hammersley set.

Reference: Akeley (1993), RealityEngine graphics (multisampling); Aila, Laine (2004), Alias-free shadow maps.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from collections.abc import Collection, Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.native_code import read_native
from neurosim_core.render.antialias_groups import (
    FACE_COUNT_MAX,
    RAY_COUNT,
    RAY_WIDTH,
    SAMPLE_COUNT,
    SHARPNESS,
    footprint_width,
    group_kernels,
    make_lists,
    ray_point,
    thread_counts,
)
from neurosim_core.render.embree import packet_caster
from neurosim_core.render.kernel_data import (
    FAR_M,
    TILE,
    BodyData,
    Hit,
    RenderOutputs,
    RenderTerms,
    SceneData,
    ViewData,
)
from neurosim_core.render.launch import launch_split
from neurosim_core.render.outputs import RADIANCE, radiance_writer
from neurosim_core.render.ray_intersection import UNFUSED, intersect_bodies, intersect_scene
from neurosim_core.render.raycast_packets import PACKET_TERMS, PixelBlock
from neurosim_core.render.shading import APART, pixel_shader, surface_shader
from neurosim_core.render.tiles import TilePlace, pose_finder, tile_locator

_SIDE = 4
_LANES = _SIDE * _SIDE
_INSTANTS = 4
"""Instants of a tile that a thread of a CPU renders, in blocks of 4 x 4 pixels."""
_BLOCK_COUNT = 4 * _INSTANTS
_LIGHT_COUNT = 3 * _LANES * _BLOCK_COUNT


@wp.func_native(read_native(__file__, "cover_pixel", SAMPLES=SAMPLE_COUNT, MOST=FACE_COUNT_MAX))
def _cover_pixel(
    scene: SceneData,
    view: ViewData,
    faces: wp.array3d[int],
    instant: int,
    row: int,
    col: int,
    origin: wp.vec3,
    center: wp.vec3,
    across: wp.vec3,
    down: wp.vec3,
    hit_out: wp.array[Hit],
    number_out: wp.array[float],
    ray_out: wp.array[wp.vec3],
    slope_out: wp.array[wp.vec2],
) -> int:
    """Find the faces that a pixel shows, -1: the sky; how many points show each; where to shade it.

    Returns:
        Number of faces; -1: the pixel has to be rendered by rays.
    """
    ...


def _pixel_kernel(terms: RenderTerms) -> wp.Kernel:
    """Return the kernel of a CPU whose threads are pixels, for all terms."""
    radiance_of = pixel_shader(terms)
    shade = surface_shader(terms, beyond=True)
    locate_tile = tile_locator(terms, images=True, instants=True)
    write_radiance = radiance_writer(RADIANCE, supersampled=False, allocated=True)
    cast_packet = packet_caster(terms.embree) if terms.embree else None
    find_pose = pose_finder(terms)

    @wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED)
    def average_pixels(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        rays: wp.array2d[wp.vec4],
        # Out:
        out: RenderOutputs,
    ) -> None:
        index = first + wp.tid()
        # 64 indices are a tile of 8 x 8 pixels, and 16 side by side a block of 4 x 4
        in_tile = index % 64
        place = locate_tile(index // 64 // view.instant_count, index // 64 % view.instant_count, view)
        if wp.static(terms.world_scenes):
            scene = view.worlds.scenes[view.worlds.scene[place.world]]
        col = place.left + 4 * (in_tile // 16 % 2) + in_tile % 4
        row = place.top + 4 * (in_tile // 32) + in_tile // 4 % 4
        if not place.rendered or col >= view.width or row >= view.height:
            return
        if place.slot < 0 and out.log_radiance.shape[0] == 0:
            return
        instant = place.instant
        pose = find_pose(instant, 0, row * view.width + col, view)
        origin = view.p_WC[pose]
        q = view.q_WC[pose]
        pixel = place.first_ray + row * view.width + col
        center = wp.vec3(rays[0, pixel][0], rays[0, pixel][1], rays[0, pixel][2])
        across = wp.vec3(rays[1, pixel][0], rays[1, pixel][1], rays[1, pixel][2])
        down = wp.vec3(rays[2, pixel][0], rays[2, pixel][1], rays[2, pixel][2])
        spread_rad = rays[0, pixel][3]
        hits = wp.zeros(shape=(wp.static(FACE_COUNT_MAX + 1),), dtype=Hit)
        number = wp.zeros(shape=(wp.static(FACE_COUNT_MAX + 1),), dtype=float)
        ray = wp.zeros(shape=(wp.static(FACE_COUNT_MAX + 1),), dtype=wp.vec3)
        slope = wp.zeros(shape=(wp.static(FACE_COUNT_MAX + 1),), dtype=wp.vec2)
        count = _cover_pixel(
            scene,
            view,
            out.face,
            instant,
            row,
            col,
            origin,
            wp.quat_rotate(q, center),
            wp.quat_rotate(q, across),
            wp.quat_rotate(q, down),
            hits,
            number,
            ray,
            slope,
        )
        total = wp.vec3(0.0)
        whole = float(0.0)
        for entry in range(count):
            width_rad = footprint_width(number[entry]) * spread_rad
            total += number[entry] * shade(scene, ray[entry], origin, width_rad, hits[entry], slope[entry])
            whole += number[entry]
        if count < 0:
            whole = float(RAY_COUNT)
            if wp.static(bool(terms.embree)):
                toward = wp.zeros(shape=(_LANES,), dtype=wp.vec3)
                origins = wp.zeros(shape=(_LANES,), dtype=wp.vec3)
                for sample in range(RAY_COUNT):
                    point = ray_point(sample)
                    origins[sample] = origin
                    toward[sample] = wp.quat_rotate(
                        q, wp.normalize(center + point[0] * across + point[1] * down)
                    )
                cast_packet(scene.embree_intersect, scene.embree_quick, origins, toward, FAR_M, hits)
            for sample in range(RAY_COUNT):
                point = ray_point(sample)
                direction_C = wp.normalize(center + point[0] * across + point[1] * down)
                direction = wp.quat_rotate(q, direction_C)
                hit = Hit()
                if wp.static(bool(terms.embree)):
                    hit = hits[sample]
                    hit.normal = wp.normalize(hit.normal)
                else:
                    hit = intersect_scene(scene, origin, direction)
                body = int(-1)
                if wp.static(terms.bodies):
                    hit, body = intersect_bodies(bodies, pose, direction_C, q, hit)
                total += radiance_of(
                    scene, bodies, pose, body, q, direction, origin, RAY_WIDTH * spread_rad, hit
                )
        write_radiance(scene, total / whole, 1, instant, place.slot, row, col, out)

    return average_pixels


@cache
def _tile_shader(*, timed: bool) -> Any:
    """Return the Warp function, for CPU kernels only, that renders a tile from the faces in and around it.

    It does so at a few instants, those whose bit is `wanted`. Its last output has bits for the pixels of each
    block that have to be rendered by rays.
    """
    points = {"SAMPLES": SAMPLE_COUNT, "MOST": FACE_COUNT_MAX, "SHARPNESS": round(100 * SHARPNESS)}
    lookup = {**PACKET_TERMS, "LIGHT_WITHIN": True, "APART": round(100 * APART)}
    terms = {"INSTANTS": _INSTANTS, "TIMED": timed, "UNIT": True}

    @wp.func_native(read_native(__file__, "shade_tile", **terms, **points, **lookup))
    def shade_tile(
        scene: SceneData,
        view: ViewData,
        faces: wp.array3d[int],
        rays: wp.array2d[wp.vec4],
        tile: TilePlace,
        wanted: int,
        radiance_out: wp.array[float],
        unresolved_out: wp.array[int],
    ): ...

    return shade_tile


@cache
def _pixel_caster(width: int, *, timed: bool) -> Any:
    """Return the Warp function, for CPU kernels only, that renders those of 4 x 4 pixels that have a bit."""
    packet = {"SAMPLES": RAY_COUNT, "N": _LANES, "SIDE": _SIDE, "WIDTH": width, "INSTANTS": _INSTANTS}

    @wp.func_native(read_native(__file__, "cast_pixels", TIMED=timed, UNIT=False, **packet, **PACKET_TERMS))
    def cast_pixels(
        scene: SceneData,
        view: ViewData,
        rays: wp.array2d[wp.vec4],
        pixels: PixelBlock,
        far_m: float,
        unresolved: int,
        block: int,
        radiance_out: wp.array[float],
    ): ...

    return cast_pixels


@wp.func_native(read_native(__file__, "write_log", INSTANTS=_INSTANTS))
def _write_log(
    dark_floor: float,
    radiance: wp.array[float],
    tile: TilePlace,
    wanted: int,
    log_radiance_out: wp.array3d[float],
):
    """Write the log radiance of a tile at a few instants; on a CPU only."""
    ...


def _tile_kernel(terms: RenderTerms) -> wp.Kernel:
    """Return the kernel of a CPU whose threads are tiles at a few instants, with rays cast by Embree."""
    locate_tile = tile_locator(terms, images=True, instants=True)
    write_images = radiance_writer(RADIANCE[1:], supersampled=False, allocated=True)
    shade_tile = _tile_shader(timed=terms.timed)
    cast_pixels = _pixel_caster(terms.embree, timed=terms.timed)

    @wp.kernel(module="unique", enable_backward=False)
    def average_tiles(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        rays: wp.array2d[wp.vec4],
        # Out:
        out: RenderOutputs,
    ) -> None:
        index = first + wp.tid()
        group_count = (view.instant_count + _INSTANTS - 1) // _INSTANTS
        tile = index // group_count
        begin = index % group_count * _INSTANTS
        place = locate_tile(tile, begin, view)
        if not place.rendered:
            return
        if wp.static(terms.world_scenes):
            scene = view.worlds.scenes[view.worlds.scene[place.world]]
        count = wp.min(_INSTANTS, view.instant_count - begin)
        wanted = int(0)
        for later in range(count):
            if out.log_radiance.shape[0] > 0 or view.image_slot[place.instant + later] >= 0:
                wanted = wanted | (1 << later)
        light = wp.zeros(shape=(_LIGHT_COUNT,), dtype=float)
        unresolved = wp.zeros(shape=(_BLOCK_COUNT,), dtype=int)
        shade_tile(scene, view, out.face, rays, place, wanted, light, unresolved)
        block = int(0)
        while block < _BLOCK_COUNT:  # not `range`, which would be unrolled
            if unresolved[block] != 0:
                pixels = PixelBlock()
                pixels.instant = place.instant + block // 4
                pixels.top = place.top + block % 4 // 2 * _SIDE
                pixels.left = place.left + block % 2 * _SIDE
                pixels.first_ray = place.first_ray + pixels.top * view.width + pixels.left
                pixels.rows = wp.min(view.height - pixels.top, _SIDE)
                pixels.columns = wp.min(view.width - pixels.left, _SIDE)
                cast_pixels(scene, view, rays, pixels, FAR_M, unresolved[block], block, light)
            block += 1
        if out.log_radiance.shape[0] > 0:
            _write_log(scene.dark_floor, light, place, wanted, out.log_radiance)
        if out.rgb.shape[0] > 0 or out.radiance.shape[0] > 0:
            for later in range(count):
                slot = view.image_slot[place.instant + later]
                if slot >= 0:
                    for y in range(wp.min(view.height - place.top, 2 * _SIDE)):
                        for x in range(wp.min(view.width - place.left, 2 * _SIDE)):
                            block = 4 * later + y // _SIDE * 2 + x // _SIDE
                            red = _LANES * block + _SIDE * (y % _SIDE) + x % _SIDE
                            green = red + _LANES * _BLOCK_COUNT
                            blue = green + _LANES * _BLOCK_COUNT
                            radiance = wp.vec3(light[red], light[green], light[blue])
                            row = place.top + y
                            write_images(
                                scene, radiance, 1, place.instant + later, slot, row, place.left + x, out
                            )

    return average_tiles


@cache
def antialiasing_kernels(
    outputs: tuple[str, ...], terms: RenderTerms, *, is_cuda: bool
) -> tuple[wp.Kernel, ...]:
    """Return the kernels of the second pass: one on a CPU, three on CUDA (`antialias_groups.py`).

    Their parameters: the index of the first thread; what `Antialiasing.launch` takes. Of the outputs those in
    `RADIANCE` are written; terms are those of the first pass.
    """
    plain = terms._replace(candidate_group=0, by_tile=False, fallback=False, supersampled=False)
    if is_cuda:
        return group_kernels(tuple(name for name in RADIANCE if name in outputs), plain)
    return (_cpu_kernel(plain),)


@cache
def _cpu_kernel(terms: RenderTerms) -> wp.Kernel:
    """Return one kernel for all outputs: checking which are allocated takes less than to compile each set."""
    return (_tile_kernel if _by_tile(terms) else _pixel_kernel)(terms)


def _by_tile(terms: RenderTerms) -> bool:
    return bool(terms.embree) and terms.baked and not terms.bodies and not terms.finest_level


class Antialiasing:
    """The second pass of one renderer."""

    def __init__(
        self,
        rays: NDArray[np.float32],
        *,
        outputs: Collection[str],
        terms: RenderTerms,
        device: str,
        pixel_count: int,
    ) -> None:
        """Choose the kernels and allocate what they share, for launches of at most `pixel_count` pixels.

        Rays are `pixel_rays`, of several lenses one after the other, shape [3, H * W, 4]; terms are those of
        the first pass.
        """
        self._device = device
        is_cuda = wp.get_device(device).is_cuda
        self._kernels = antialiasing_kernels(tuple(sorted(outputs)), terms, is_cuda=is_cuda)
        self._lists = make_lists(pixel_count // _LANES, device) if is_cuda else None
        self._by_tile = _by_tile(terms)
        self._rays: Any = wp.array(rays, dtype=wp.vec4, device=device)

    def launch(
        self, inputs: Sequence[Any], outputs: Sequence[Any], *, pixel_count: int, instant_count: int
    ) -> None:
        """Write the light of the pixels of all tiles, instants and worlds; outputs have the faces.

        Inputs are scene, view and bodies, and outputs the `RenderOutputs`, as of the first pass.
        """
        inputs = [*inputs, self._rays]
        if self._lists is None:
            dim, multiple = pixel_count, TILE * TILE
            if self._by_tile:
                dim = pixel_count // (TILE * TILE * instant_count) * -(-instant_count // _INSTANTS)
                multiple = 1
            kernel, device = self._kernels[0], self._device
            launch_split(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, multiple=multiple)
            return
        self._lists.count.zero_()
        dims = thread_counts(self._lists, pixel_count, instant_count)
        for kernel, dim in zip(self._kernels, dims, strict=True):
            launch_split(kernel, dim=dim, inputs=inputs, outputs=[*outputs, self._lists], device=self._device)
