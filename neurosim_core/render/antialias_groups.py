# mypy: disable-error-code="index,attr-defined,no-any-return,operator,arg-type,no-untyped-def,assignment"
# mypy: disable-error-code="return-value,call-overload,empty-body,untyped-decorator,misc,valid-type"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning in kernels)
"""The second pass of antialiasing on CUDA: 16 threads share the faces of their block of 4 x 4 pixels.

It computes what `antialias.py` describes. The threads of a block list its faces together, and each of them
prepares some. Each tests the points of its own pixel, and shades what they show. A pixel that has to be
rendered by rays is rendered by 8 of them, a ray each.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.body_arrays import BodyData
from neurosim_core.render.coverage import (
    FACE_COUNT_MAX,
    RAY_COUNT,
    RAY_WIDTH,
    SAMPLE_COUNT,
    SHARPNESS,
    ray_point,
)
from neurosim_core.render.outputs import RenderOutputs, radiance_writer, requested_outputs
from neurosim_core.render.ray_intersection import UNFUSED, Hit, intersect_bodies, intersect_scene
from neurosim_core.render.render_terms import RenderTerms
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.shading import pixel_shader
from neurosim_core.render.view_data import ViewData, WorldData, tile_finder

_NO_LAYER = wp.constant(255.0)
_ALL_POINTS = wp.constant((1 << SAMPLE_COUNT) - 1)
_TOGETHER = 16 // RAY_COUNT
"""Pixels of a block that are rendered by rays together."""
_BOUNDS = (64, 10)
"""Threads of a block, and blocks of a multiprocessor."""
Coverage = wp.types.vector(length=7, dtype=int)
Shown = wp.types.vector(length=5, dtype=float)
Met = wp.types.vector(length=6, dtype=float)


@wp.func_native(read_native(__file__, "cover_group", SAMPLES=SAMPLE_COUNT, MOST=FACE_COUNT_MAX))
def _cover_group(
    scene: SceneData,
    faces: wp.array3d[int],
    instant: int,
    row: int,
    col: int,
    height: int,
    width: int,
    origin: wp.vec3,
    center: wp.vec3,
    across: wp.vec3,
    down: wp.vec3,
) -> Coverage:
    """Find what the points of a pixel show; see the file."""
    ...


@wp.func_native(read_native(__file__, "samples_of_layer", SAMPLES=SAMPLE_COUNT))
def _samples_of_layer(coverage: Coverage, left: int) -> Shown:
    """Return the layer of the first point in `left`, and of its points: bits, number, mean."""
    ...


@wp.func_native(read_native(__file__, "part_of_layer", MOST=FACE_COUNT_MAX))
def _part_of_layer(
    scene: SceneData, coverage: Coverage, layer: int, own: int, origin: wp.vec3, toward: wp.vec3
) -> int:
    """Return the face to shade."""
    ...


@wp.func_native(read_native(__file__, "meet_part"))
def _meet_part(scene: SceneData, part: int, origin: wp.vec3, toward: wp.vec3) -> Met:
    """Return where a direction meets the plane of a face."""
    ...


@wp.func_native(read_native(__file__, "group_sum"))
def _group_sum(value: wp.vec3) -> wp.vec3:
    """Return the sums over threads 0 to 7 and 8 to 15 of a block of pixels, to even and to odd threads."""
    ...


@wp.func_native(read_native(__file__, "group_votes"))
def _group_votes(vote: wp.bool) -> int:
    """Return a bit for each thread of a block of pixels."""
    ...


def group_kernel(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Kernel:
    """Return the kernel, whose threads are pixels; see `antialias.antialiasing_kernel`."""
    find_tile = tile_finder(terms)
    radiance_of = pixel_shader(terms)
    requested = requested_outputs(outputs)
    write_radiance = radiance_writer(outputs, supersampled=False)

    @wp.kernel(module="unique", enable_backward=False, module_options=UNFUSED, launch_bounds=_BOUNDS)
    def average_groups(
        first: int,
        # In:
        scene: SceneData,
        view: ViewData,
        bodies: BodyData,
        worlds: WorldData,
        rays: wp.array2d[wp.vec4],
        # Out:
        out: RenderOutputs,
    ) -> None:
        # All threads of a block of pixels reach the functions that they call together.
        index = first + wp.tid()
        in_tile = index % 64
        block = index // 64
        instant = block % view.instant_count
        world, _tile, left, top = find_tile(block // view.instant_count, view.width, view.height)
        first_ray = int(0)
        if wp.static(terms.worlds):
            instant += world * worlds.stride
            if worlds.active[world] == 0:
                return
        if wp.static(terms.world_scenes):
            scene = worlds.scenes[worlds.scene[world]]
        if wp.static(terms.world_lenses):
            first_ray = worlds.lens[world] * view.width * view.height
        left += 4 * (in_tile // 16 % 2)
        top += 4 * (in_tile // 32)
        if left >= view.width or top >= view.height:
            return
        slot = int(-1)
        if wp.static(requested.images):
            slot = view.image_slot[instant]
            if wp.static(not requested.log):
                if slot < 0:
                    return
        lane = in_tile % 16
        col = left + lane % 4
        row = top + lane // 4
        outside = col >= view.width or row >= view.height
        if outside:
            col = left
            row = top
        origin = view.p_WC[instant]
        q = view.q_WC[instant]
        pixel = first_ray + row * view.width + col
        center_C = rays[0, pixel]
        center = wp.quat_rotate(q, wp.vec3(center_C[0], center_C[1], center_C[2]))
        across_C = rays[1, pixel]
        across = wp.quat_rotate(q, wp.vec3(across_C[0], across_C[1], across_C[2]))
        down_C = rays[2, pixel]
        down = wp.quat_rotate(q, wp.vec3(down_C[0], down_C[1], down_C[2]))
        coverage = _cover_group(
            scene, out.face, instant, row, col, view.height, view.width, origin, center, across, down
        )
        total = wp.vec3(0.0)
        whole = float(0.0)
        remaining = int(0)
        if coverage[0] >= 0:
            remaining = _ALL_POINTS
        while remaining != 0:
            shown = _samples_of_layer(coverage, remaining)
            remaining = remaining & ~int(shown[1])
            if shown[0] == _NO_LAYER:
                if coverage[1] != 0:
                    total += shown[2] * scene.sky
                    whole += shown[2]
            else:
                toward = center + shown[3] * across + shown[4] * down
                part = out.face[instant, row, col]
                if coverage[0] > 0:
                    part = _part_of_layer(scene, coverage, int(shown[0]), part, origin, toward)
                met = _meet_part(scene, part, origin, toward)
                hit = Hit()
                hit.face = part
                hit.t = met[0]
                hit.u = wp.clamp(met[1], 0.0, 1.0)
                hit.v = wp.clamp(met[2], 0.0, 1.0 - hit.u)
                hit.normal = wp.vec3(met[3], met[4], met[5])
                light = radiance_of(
                    scene, bodies, instant, -1, q, wp.normalize(toward), origin, SHARPNESS * center_C[3], hit
                )
                total += shown[2] * light
                whole += shown[2]
        unresolved = _group_votes(coverage[0] < 0 and not outside)
        if unresolved != 0:
            point = ray_point(lane % RAY_COUNT)
            for turn in range(wp.static(16 // _TOGETHER)):
                if (unresolved >> (_TOGETHER * turn)) & 3:
                    member = _TOGETHER * turn + lane // RAY_COUNT
                    if not ((unresolved >> member) & 1):
                        member = member ^ 1
                    pixel = first_ray + (top + member // 4) * view.width + left + member % 4
                    sum_C = rays[0, pixel] + point[0] * rays[1, pixel] + point[1] * rays[2, pixel]
                    direction_C = wp.normalize(wp.vec3(sum_C[0], sum_C[1], sum_C[2]))
                    direction = wp.quat_rotate(q, direction_C)
                    hit = intersect_scene(scene, origin, direction)
                    body = int(-1)
                    if wp.static(terms.bodies):
                        hit, body = intersect_bodies(bodies, instant, direction_C, q, hit)
                    light = radiance_of(
                        scene, bodies, instant, body, q, direction, origin, RAY_WIDTH * rays[0, pixel][3], hit
                    )
                    light = _group_sum(light)
                    if lane // _TOGETHER == turn and coverage[0] < 0:
                        total = light
                        whole = float(RAY_COUNT)
        if not outside:
            write_radiance(scene, total / whole, 1, instant, slot, row, col, out)

    return average_groups
