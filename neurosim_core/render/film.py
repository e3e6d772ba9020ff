# mypy: disable-error-code="index,assignment,return-value"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""What is kept of a pixel: the outputs of a cast, and how they are written."""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

from collections.abc import Collection
from functools import cache
from typing import Any, NamedTuple

import warp as wp

from neurosim_core.render.ray_hit import Hit
from neurosim_core.render.scene_data import SceneData

OUTPUTS = ("log_radiance", "rgb", "depth", "normal", "instance")
"""Everything that a cast can answer."""


class Asked(NamedTuple):
    """What some outputs have in common."""

    log: bool
    """Log radiance is asked for, which all instants have."""
    images: bool
    """Something else is asked for, which instants with an image slot have."""
    radiance: bool
    """Light is needed: for log radiance or for RGB."""
    geometry: bool
    """Depth, normal or instance is asked for."""


def asked_for(outputs: Collection[str]) -> Asked:
    """Return what kernels have to do for `outputs`."""
    return Asked(
        log="log_radiance" in outputs,
        images=any(name != "log_radiance" for name in outputs),
        radiance="log_radiance" in outputs or "rgb" in outputs,
        geometry=any(name in outputs for name in ("depth", "normal", "instance")),
    )


@wp.struct
class FilmData:
    """The outputs of a cast; what is not asked for is empty. All but the first are of image slots."""

    log_radiance: wp.array3d[float]
    """log(Rec. 709 luma + dark floor) of each instant, shape [K, H, W]."""
    rgb: wp.array4d[wp.uint8]
    """sRGB of exposure times radiance, shape [M, H, W, 3]."""
    depth: wp.array3d[float]
    """Planar z [m], inf where nothing is hit, shape [M, H, W]."""
    normal: wp.array3d[wp.vec3]
    """Of the triangle, in W, towards the camera, zero where nothing is hit, shape [M, H, W]."""
    instance: wp.array3d[int]
    """-1 where nothing is hit, shape [M, H, W]."""


def make_film(**outputs: Any) -> FilmData:
    """Return the arrays of outputs, by name, as kernels take them; None: it is not asked for."""
    film = FilmData()
    for name, array in outputs.items():
        setattr(film, name, array)
    return film


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
        film: FilmData,
    ) -> None:
        if wp.static("depth" in outputs):
            film.depth[slot, row, col] = wp.where(hit.face >= 0, hit.t * cosine, wp.inf)
        if wp.static("normal" in outputs):
            normal = wp.vec3(0.0)
            if hit.face >= 0:
                normal = wp.where(wp.dot(hit.normal, ray) > 0.0, -hit.normal, hit.normal)
            film.normal[slot, row, col] = normal
        if wp.static("instance" in outputs):
            name = int(-1)
            if hit.face >= 0:
                name = scene.face_instance[hit.face]
            film.instance[slot, row, col] = name

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
        film: FilmData,
    ) -> None:
        radiance = total
        if wp.static(supersampled):
            radiance = (1.0 / float(layer_count - 1)) * radiance
        if wp.static("log_radiance" in outputs):
            luma = 0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2]
            film.log_radiance[instant, row, col] = wp.log(luma + scene.dark_floor)
        if wp.static("rgb" in outputs):
            if slot >= 0:
                film.rgb[slot, row, col, 0] = _to_srgb(scene.exposure * radiance[0])
                film.rgb[slot, row, col, 1] = _to_srgb(scene.exposure * radiance[1])
                film.rgb[slot, row, col, 2] = _to_srgb(scene.exposure * radiance[2])

    return write_radiance
