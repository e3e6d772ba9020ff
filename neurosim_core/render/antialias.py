# mypy: disable-error-code="index,attr-defined,no-any-return,operator,arg-type,no-untyped-def,assignment"
# mypy: disable-error-code="return-value,call-overload,empty-body,untyped-decorator,misc"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning in kernels)
"""Adaptive antialiasing: more rays where the picture varies, so that a pixel integrates light over its area.

1. The first pass casts one ray per pixel. The rays of neighbouring pixels go through different points of
   their pixels: a bar as thin as a quarter of a pixel is hit in one of four adjacent rows or columns.
2. A quad of 2 x 2 pixels is marked where log radiance differs by more than QUAD_CONTRAST from that of a pixel
   up to REACH_PX away in a row or a column. Each of its pixels becomes the mean of COARSE_COUNT rays.
3. A pixel is marked where the log radiance of its rays differs by more than PIXEL_CONTRAST. It becomes the
   mean of SAMPLE_COUNT rays.

Means are taken in linear light. The points are fixed in the pixel: a still camera gives the same picture at
every instant. They form a Hammersley set, which is stratified in 4 x 4 cells, in 16 rows and in 16 columns;
the first COARSE_COUNT of them are 5/16 of a pixel apart in columns and in rows.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from collections.abc import Collection
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.native_code import read_native
from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.camera import Lens
from neurosim_core.render.embree import packet_caster
from neurosim_core.render.launch import launch_split
from neurosim_core.render.lighting import spread_order
from neurosim_core.render.outputs import RADIANCE, RenderOutputs, radiance_writer
from neurosim_core.render.packet_shading import packet_shader
from neurosim_core.render.ray_intersection import FAR_M, UNFUSED, Hit, intersect_bodies, intersect_scene
from neurosim_core.render.raycast_pixels import PIXEL_BOUNDS, mark_pixel, turn_count
from neurosim_core.render.render_terms import RenderTerms
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.view_data import ViewData, WorldData, tile_finder

SAMPLE_COUNT = 16
"""Rays of a marked pixel."""
COARSE_COUNT = 4
"""Rays of each pixel of a marked quad, of which there are as many."""
QUAD_CONTRAST = 0.05
"""Difference of log radiance between pixels that marks a quad."""
PIXEL_CONTRAST = 0.05
"""Difference of log radiance between the rays of a pixel that marks it."""
REACH_PX = 2
"""Distance of the pixels that are compared [px]."""
_CELLS = 4
_COARSE = (0, 5, 10, 15)
_BLOCKS_PER_MULTIPROCESSOR = 32
_BLOCK = 64


def hammersley_points() -> NDArray[np.float64]:
    """Return SAMPLE_COUNT points (column, row) of the unit square, shape [SAMPLE_COUNT, 2]."""
    rest = [k for k in range(SAMPLE_COUNT) if k not in _COARSE]
    index = np.array([*_COARSE, *rest])
    reversed_bits = sum(((index >> bit) & 1) << (3 - bit) for bit in range(4))
    return (np.stack([index, reversed_bits], axis=-1) + 0.5) / SAMPLE_COUNT


def _rays_through(lens: Lens, point: Any, sample_count: int, fill_factor: float) -> NDArray[np.float32]:
    """Return rays through a point of the sensitive area of each pixel, shape [H * W, 4]."""
    column, row = 0.5 + np.sqrt(fill_factor) * (np.asarray(point) - 0.5)
    spread = lens.ray_spread()[..., None] * np.float32(np.sqrt(fill_factor / sample_count))
    return np.concatenate([lens.ray_table((column, row)), spread], axis=-1).reshape(-1, 4)


def ray_layers(lens: Lens, sample_count: int, fill_factor: float = 1.0) -> NDArray[np.float32]:
    """Return rays through the centres of pixels and, for several samples, through points spread over them.

    The points are a lattice: along rows and along columns each n-th of a pixel has one of the n.

    Args:
        lens: Rays of the pixels.
        sample_count: n.
        fill_factor: Share of the pixel's area, around its centre, that the points are spread over.

    Returns:
        Direction in C and spread [rad], shape [1 or 1 + n, H * W, 4].
    """
    points = [(0.5, 0.5)]
    if sample_count > 1:
        columns, rows = np.arange(sample_count), spread_order(sample_count)
        points += list(zip((columns + 0.5) / sample_count, (rows + 0.5) / sample_count, strict=True))
    return np.stack([_rays_through(lens, point, sample_count, fill_factor) for point in points])


def sample_rays(lens: Lens, fill_factor: float = 1.0) -> NDArray[np.float32]:
    """Return the rays of marked pixels: direction in C and spread [rad], shape [H * W, SAMPLE_COUNT, 4]."""
    points = hammersley_points()
    return np.stack([_rays_through(lens, point, SAMPLE_COUNT, fill_factor) for point in points], axis=1)


def first_rays(lens: Lens, fill_factor: float = 1.0) -> NDArray[np.float32]:
    """Return the rays of the first pass, shape [H * W, 4].

    They go through the centres of 4 x 4 cells of the pixels. Four adjacent rows of a column use all columns
    of cells, and four adjacent columns of a row use all rows of cells.
    """
    row, col = np.indices((lens.height, lens.width)).reshape(2, -1)
    cell_column = (row + 2 * (col & 1) + ((col >> 1) & 1)) % _CELLS
    cell_row = (col + 2 * (row & 1) + ((row >> 1) & 1)) % _CELLS
    centres = (np.arange(_CELLS) + 0.5) / _CELLS
    rays = np.stack([_rays_through(lens, (x, y), 1, fill_factor) for x in centres for y in centres])
    return rays[_CELLS * cell_column + cell_row, np.arange(len(row))]


@wp.struct
class SampleData:
    """The queues of a launch, and the rays of their pixels."""

    rays: wp.array2d[wp.vec4]
    """Direction in C and spread [rad], shape [H * W, SAMPLE_COUNT]; of several lenses one after the other."""
    quads: wp.array[int]
    """Indices of marked quads, in any order: 16 of a tile and instant, then its instants, then tiles."""
    quad_count: wp.array[int]
    """Number of marked quads, shape [1]."""
    pixels: wp.array[int]
    """Indices of marked pixels, in any order: 64 of a tile and instant, then its instants, then tiles."""
    pixel_count: wp.array[int]
    """Number of marked pixels, shape [1]."""


@cache
def _pixel_finder(terms: RenderTerms) -> wp.Function:
    """Return the Warp function that locates a pixel of a launch by its index; row -1: it is not rendered.

    It returns instant, row, column and world.
    """
    find_tile = tile_finder(terms)

    @wp.func
    def find_pixel(index: int, view: ViewData, worlds: WorldData):
        in_tile = index % 64
        block = index // 64
        instant = block % view.instant_count
        world, _tile, left, top = find_tile(block // view.instant_count, view.width, view.height)
        col = left + in_tile % 8
        row = top + in_tile // 8
        if wp.static(terms.worlds):
            instant += world * worlds.stride
            if worlds.active[world] == 0:
                row = -1
        if col >= view.width or row >= view.height:
            row = -1
        return instant, row, col, world

    return find_pixel


@wp.func
def _pixel_of_quad(quad: int, member: int) -> int:
    """Return the index of a pixel of a quad."""
    in_tile = quad % 16
    row = 2 * (in_tile // 4) + member // 2
    return (quad // 16) * 64 + 8 * row + 2 * (in_tile % 4) + member % 2


@cache
def _quad_kernel(terms: RenderTerms) -> wp.Kernel:
    """Return the kernel that marks quads."""
    find_pixel = _pixel_finder(terms)

    @wp.kernel(module="unique", enable_backward=False)
    def mark_quads(
        first: int,
        # In:
        view: ViewData,
        worlds: WorldData,
        log_radiance: wp.array3d[float],
        # Out:
        samples: SampleData,
    ) -> None:
        quad = first + wp.tid()
        contrast = float(0.0)
        for member in range(4):
            instant, row, col, _world = find_pixel(_pixel_of_quad(quad, member), view, worlds)
            if row >= 0:
                own = log_radiance[instant, row, col]
                for reach in range(1, wp.static(REACH_PX + 1)):
                    left = log_radiance[instant, row, wp.max(col - reach, 0)]
                    right = log_radiance[instant, row, wp.min(col + reach, view.width - 1)]
                    above = log_radiance[instant, wp.max(row - reach, 0), col]
                    below = log_radiance[instant, wp.min(row + reach, view.height - 1), col]
                    low = wp.min(wp.min(left, right), wp.min(above, below))
                    high = wp.max(wp.max(left, right), wp.max(above, below))
                    contrast = wp.max(contrast, wp.max(high - own, own - low))
        marked = contrast > wp.static(QUAD_CONTRAST)
        mark_pixel(marked, quad, samples.quads, samples.quad_count)

    return mark_quads


@wp.func
def _log_of(radiance: wp.vec3, dark_floor: float) -> float:
    return wp.log(0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2] + dark_floor)


@cache
def _lane_functions(group: int) -> tuple[wp.Function, wp.Function]:
    """Return functions that give the sum and the largest of the values of `group` threads side by side."""

    @wp.func_native(read_native(__file__, "sum_lanes", LANES=group))
    def sum_lanes(value: wp.vec3) -> wp.vec3: ...

    @wp.func_native(read_native(__file__, "max_lanes", LANES=group))
    def max_lanes(value: float) -> float: ...

    return sum_lanes, max_lanes


@cache
def _sample_tracer(terms: RenderTerms, *, coarse: bool) -> wp.Function:
    """Return the Warp function that gives the radiance of a ray of a pixel; rays traverse the tree."""
    radiance_of = pixel_shader(terms)

    @wp.func
    def trace(
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        samples: SampleData,
        world: int,
        instant: int,
        row: int,
        col: int,
        sample: int,
    ) -> wp.vec3:
        if wp.static(terms.world_scenes):
            scene = worlds.scenes[worlds.scene[world]]
        pixel = row * view.width + col
        if wp.static(terms.world_lenses):
            pixel += worlds.lens[world] * view.width * view.height
        ray_C = samples.rays[pixel, sample]
        direction_C = wp.vec3(ray_C[0], ray_C[1], ray_C[2])
        spread_rad = ray_C[3]
        if wp.static(coarse):
            spread_rad *= wp.static(float(np.sqrt(SAMPLE_COUNT / COARSE_COUNT)))
        q = view.q_WC[instant]
        origin = view.p_WC[instant]
        ray = wp.quat_rotate(q, direction_C)
        hit = intersect_scene(scene, origin, ray)
        body = int(-1)
        if wp.static(terms.bodies):
            hit, body = intersect_bodies(bodies, instant, direction_C, q, hit)
        return radiance_of(scene, bodies, instant, body, q, ray, origin, spread_rad, hit)

    return trace


@cache
def _block_kernel(outputs: tuple[str, ...], terms: RenderTerms, *, coarse: bool) -> wp.Kernel:
    """Return the kernel of a CUDA device that renders queued quads (`coarse`) or pixels, 16 threads each."""
    find_pixel = _pixel_finder(terms)
    trace = _sample_tracer(terms, coarse=coarse)
    group = COARSE_COUNT if coarse else SAMPLE_COUNT
    sum_lanes, max_lanes = _lane_functions(group)
    write_radiance = radiance_writer(outputs, supersampled=True)

    @wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED, launch_bounds=PIXEL_BOUNDS)
    def render_queue(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        thread_count: int,
        # In/out:
        samples: SampleData,
        # Out:
        out: RenderOutputs,
    ) -> None:
        thread = first + wp.tid()
        lane = thread % SAMPLE_COUNT
        # all threads of a block take as many turns, and come together to what warps do together
        begin = thread // _BLOCK * wp.static(_BLOCK // SAMPLE_COUNT)
        step = thread_count // SAMPLE_COUNT
        count = samples.pixel_count[0]
        if wp.static(coarse):
            count = samples.quad_count[0]
        for turn in range(turn_count(begin, count, step)):
            entry = begin + turn * step + (thread % _BLOCK) // SAMPLE_COUNT
            index = int(0)
            row = int(-1)
            col = int(0)
            world = int(0)
            instant = int(0)
            if entry < count:
                if wp.static(coarse):
                    index = _pixel_of_quad(samples.quads[entry], lane // group)
                else:
                    index = samples.pixels[entry]
                instant, row, col, world = find_pixel(index, view, worlds)
            radiance = wp.vec3(0.0)
            if row >= 0:
                radiance = trace(scene, view, bodies, worlds, samples, world, instant, row, col, lane % group)
            total = sum_lanes(radiance)
            leads = row >= 0 and lane % group == 0
            if wp.static(coarse):
                own = _log_of(radiance, scene.dark_floor)
                highest = max_lanes(own)
                lowest = -max_lanes(-own)
                if leads:
                    before = out.log_radiance[instant, row, col]
                    highest = wp.max(highest, before)
                    lowest = wp.min(lowest, before)
                varies = leads and highest - lowest > wp.static(PIXEL_CONTRAST)
                mark_pixel(varies, index, samples.pixels, samples.pixel_count)
            if leads:
                slot = int(-1)
                if wp.static(len(outputs) > 1):
                    slot = view.image_slot[instant]
                write_radiance(scene, total, group + 1, instant, slot, row, col, out)

    return render_queue


@cache
def _packet_kernel(outputs: tuple[str, ...], terms: RenderTerms, *, coarse: bool) -> wp.Kernel:
    """Return the kernel of a CPU that renders queued quads (`coarse`) or pixels, a packet of 16 rays each."""
    find_pixel = _pixel_finder(terms)
    trace = _sample_tracer(terms, coarse=coarse)
    radiance_of = pixel_shader(terms)
    group = COARSE_COUNT if coarse else SAMPLE_COUNT
    widening = float(np.sqrt(SAMPLE_COUNT / group))
    write_radiance = radiance_writer(outputs, supersampled=True)
    cast_packet = packet_caster(terms.embree) if terms.embree else None
    packed = bool(terms.embree) and terms.baked and not terms.bodies and not terms.finest_level
    shade_packet = packet_shader(
        SAMPLE_COUNT, textured=terms.textured, emissive=terms.emissive, unit_normals=False
    )

    @wp.kernel(module="unique", enable_backward=False, module_options={} if terms.embree else UNFUSED)
    def render_queue_packets(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        # In/out:
        samples: SampleData,
        # Out:
        out: RenderOutputs,
    ) -> None:
        entry = first + wp.tid()
        lanes = int(SAMPLE_COUNT)  # a variable: loops stay loops
        radiance = wp.zeros(shape=(SAMPLE_COUNT,), dtype=wp.vec3)
        if wp.static(bool(terms.embree)):
            ray = wp.zeros(shape=(SAMPLE_COUNT,), dtype=wp.vec3)
            face = wp.zeros(shape=(SAMPLE_COUNT,), dtype=int)
            t = wp.zeros(shape=(SAMPLE_COUNT,), dtype=float)
            u = wp.zeros(shape=(SAMPLE_COUNT,), dtype=float)
            v = wp.zeros(shape=(SAMPLE_COUNT,), dtype=float)
            normal = wp.zeros(shape=(SAMPLE_COUNT,), dtype=wp.vec3)
            spread_rad = wp.zeros(shape=(SAMPLE_COUNT,), dtype=float)
        for lane in range(lanes):
            index = int(0)
            if wp.static(coarse):
                index = _pixel_of_quad(samples.quads[entry], lane // group)
            else:
                index = samples.pixels[entry]
            instant, row, col, world = find_pixel(index, view, worlds)
            if row >= 0:
                if wp.static(bool(terms.embree)):
                    pixel = row * view.width + col
                    if wp.static(terms.world_lenses):
                        pixel += worlds.lens[world] * view.width * view.height
                    ray_C = samples.rays[pixel, lane % group]
                    direction_C = wp.vec3(ray_C[0], ray_C[1], ray_C[2])
                    ray[lane] = wp.quat_rotate(view.q_WC[instant], direction_C)
                    spread_rad[lane] = widening * ray_C[3]
                else:
                    radiance[lane] = trace(
                        scene, view, bodies, worlds, samples, world, instant, row, col, lane % group
                    )
        # the packet has one origin: its pixels are of one instant
        index = int(0)
        if wp.static(coarse):
            index = _pixel_of_quad(samples.quads[entry], 0)
        else:
            index = samples.pixels[entry]
        instant, row, col, world = find_pixel(index, view, worlds)
        slot = int(-1)
        if wp.static(len(outputs) > 1):
            slot = view.image_slot[instant]
        if wp.static(bool(terms.embree)):
            if wp.static(terms.world_scenes):
                scene = worlds.scenes[worlds.scene[world]]
            origin = view.p_WC[instant]
            cast_packet(scene.embree_intersect, scene.embree_scene, origin, ray, FAR_M, face, t, u, v, normal)
            if wp.static(packed):
                shade_packet(scene, ray, spread_rad, face, t, u, v, normal, radiance)
            else:
                q = view.q_WC[instant]
                for lane in range(lanes):
                    if wp.length_sq(ray[lane]) > 0.0:
                        hit = Hit()
                        hit.face = face[lane]
                        hit.t = t[lane]
                        hit.u = u[lane]
                        hit.v = v[lane]
                        hit.normal = wp.normalize(normal[lane])
                        body = int(-1)
                        if wp.static(terms.bodies):
                            direction_C = wp.quat_rotate_inv(q, ray[lane])
                            hit, body = intersect_bodies(bodies, instant, direction_C, q, hit)
                        radiance[lane] = radiance_of(
                            scene, bodies, instant, body, q, ray[lane], origin, spread_rad[lane], hit
                        )
        members = int(SAMPLE_COUNT // group)
        for member in range(members):
            if wp.static(coarse):
                index = _pixel_of_quad(samples.quads[entry], member)
                _instant, row, col, _world = find_pixel(index, view, worlds)
            if row >= 0:
                total = wp.vec3(0.0)
                highest = out.log_radiance[instant, row, col]
                lowest = highest
                for lane in range(member * group, (member + 1) * group):
                    total += radiance[lane]
                    if wp.static(coarse):
                        own = _log_of(radiance[lane], scene.dark_floor)
                        highest = wp.max(highest, own)
                        lowest = wp.min(lowest, own)
                if wp.static(coarse):
                    varies = highest - lowest > wp.static(PIXEL_CONTRAST)
                    mark_pixel(varies, index, samples.pixels, samples.pixel_count)
                write_radiance(scene, total, group + 1, instant, slot, row, col, out)

    return render_queue_packets


def sampling_kernels(
    outputs: Collection[str], terms: RenderTerms, *, is_cpu: bool
) -> tuple[wp.Kernel, wp.Kernel, wp.Kernel]:
    """Return the kernels that mark quads, render quads, and render pixels.

    Args:
        outputs: Outputs of the renderer; log radiance is always written, RGB if it is one of them.
        terms: Terms of the first pass.
        is_cpu: Whether the device is a CPU.
    """
    written = tuple(name for name in RADIANCE if name in ("log_radiance", *outputs))
    plain = terms._replace(candidate_group=0, by_tile=False, fallback=False, supersampled=True)
    make_kernel = _packet_kernel if is_cpu else _block_kernel
    coarse, fine = (make_kernel(written, plain, coarse=coarse) for coarse in (True, False))
    return _quad_kernel(plain), coarse, fine


class AdaptiveSampling:
    """The second and the third step for one renderer."""

    def __init__(
        self,
        rays: NDArray[np.float32],
        *,
        outputs: Collection[str],
        terms: RenderTerms,
        pixel_count: int,
        device: str,
        thread_count: int | None,
    ) -> None:
        """Allocate queues that hold all pixels.

        Args:
            rays: `sample_rays`, of several lenses one after the other, shape [H * W, SAMPLE_COUNT, 4].
            outputs: Outputs of the renderer.
            terms: Terms of the first pass.
            pixel_count: The most pixels of a launch: those of all tiles, instants and worlds.
            device: Where to render.
            thread_count: Threads on a CPU device; all cores if None.
        """
        self._device, self._thread_count = device, thread_count
        self._is_cpu = wp.get_device(device).is_cpu
        self._mark, self._coarse, self._fine = sampling_kernels(outputs, terms, is_cpu=self._is_cpu)
        data = self._data = SampleData()
        data.rays = wp.array(rays, dtype=wp.vec4, device=device)
        data.quads = wp.zeros(pixel_count // 4, dtype=int, device=device)
        data.pixels = wp.zeros(pixel_count, dtype=int, device=device)
        self._counts = wp.zeros(2, dtype=int, device=device)
        data.quad_count, data.pixel_count = self._counts[:1], self._counts[1:]
        processors = 0 if self._is_cpu else wp.get_device(device).sm_count
        self._threads = processors * _BLOCKS_PER_MULTIPROCESSOR * _BLOCK

    def launch(
        self,
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        out: RenderOutputs,
        *,
        pixel_count: int,
    ) -> None:
        """Mark quads of the first pass, and render them again.

        Args:
            scene: As for the first pass, as the next three.
            view: Rays and poses.
            bodies: Bodies that move.
            worlds: Worlds that are rendered together.
            out: Outputs of the first pass; log radiance and RGB of marked pixels are overwritten.
            pixel_count: Pixels of the first pass: those of all tiles, instants and worlds.
        """
        data = self._data
        self._counts.zero_()
        self._launch(self._mark, pixel_count // 4, [view, worlds, out.log_radiance], [data])
        inputs = [scene, view, bodies, worlds]
        for kernel, count in ((self._coarse, data.quad_count), (self._fine, data.pixel_count)):
            if self._is_cpu:
                self._launch(kernel, int(count.numpy()[0]), inputs, [data, out])
            else:
                self._launch(kernel, self._threads, [*inputs, self._threads], [data, out])

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        if dim > 0:
            launch_split(
                kernel,
                dim=dim,
                inputs=inputs,
                outputs=outputs,
                device=self._device,
                thread_count=self._thread_count,
            )
