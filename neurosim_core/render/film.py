# mypy: disable-error-code="index,attr-defined,misc,no-any-return,operator,arg-type,assignment"
# mypy: disable-error-code="call-overload,no-untyped-def,return-value"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""What is kept of a pixel: the outputs of a cast, and how they are written."""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

from functools import cache

import warp as wp

from neurosim_core.render.ray_hit import Hit
from neurosim_core.render.scene_data import SceneData

OUTPUTS = ("log_radiance", "rgb", "depth", "normal", "instance")
"""Everything that a cast can answer."""


@wp.func
def _to_srgb(linear: float) -> wp.uint8:
    # IEC 61966-2-1
    x = wp.clamp(linear, 0.0, 1.0)
    code = wp.where(x <= 0.0031308, 12.92 * x, 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055)
    return wp.uint8(int(255.0 * code + 0.5))


@cache
def geometry_writer(outputs: tuple[str, ...]) -> wp.Function:
    """Return the function that writes depth, normal and instance of a pixel, those of them in `outputs`."""

    @wp.func
    def write_geometry(
        scene: SceneData,
        ray: wp.vec3,
        cosine: float,
        hit: Hit,
        slot: int,
        row: int,
        col: int,
        depth_out: wp.array3d[float],
        normal_out: wp.array3d[wp.vec3],
        instance_out: wp.array3d[int],
    ) -> None:
        if wp.static("depth" in outputs):
            depth_out[slot, row, col] = wp.where(hit.face >= 0, hit.t * cosine, wp.inf)
        if wp.static("normal" in outputs):
            normal = wp.vec3(0.0)
            if hit.face >= 0:
                normal = wp.where(wp.dot(hit.normal, ray) > 0.0, -hit.normal, hit.normal)
            normal_out[slot, row, col] = normal
        if wp.static("instance" in outputs):
            name = int(-1)
            if hit.face >= 0:
                name = scene.face_instance[hit.face]
            instance_out[slot, row, col] = name

    return write_geometry


@cache
def radiance_writer(outputs: tuple[str, ...], *, supersampled: bool) -> wp.Function:
    """Return the function that writes log radiance and RGB of a pixel, those of them in `outputs`.

    It takes the radiance of all samples of the pixel together, if it is `supersampled`.
    """

    @wp.func
    def write_radiance(
        scene: SceneData,
        total: wp.vec3,
        layer_count: int,
        instant: int,
        slot: int,
        row: int,
        col: int,
        log_radiance_out: wp.array3d[float],
        rgb_out: wp.array4d[wp.uint8],
    ) -> None:
        radiance = total
        if wp.static(supersampled):
            radiance = (1.0 / float(layer_count - 1)) * radiance
        if wp.static("log_radiance" in outputs):
            luma = 0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2]
            log_radiance_out[instant, row, col] = wp.log(luma + scene.dark_floor)
        if wp.static("rgb" in outputs):
            if slot >= 0:
                rgb_out[slot, row, col, 0] = _to_srgb(scene.exposure * radiance[0])
                rgb_out[slot, row, col, 1] = _to_srgb(scene.exposure * radiance[1])
                rgb_out[slot, row, col, 2] = _to_srgb(scene.exposure * radiance[2])

    return write_radiance
