# mypy: disable-error-code="index,attr-defined,assignment,return-value,empty-body"
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""Render outputs: their arrays, and the functions that write a pixel of them."""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

from collections.abc import Collection
from functools import cache
from typing import NamedTuple

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.ray_intersection import Hit
from neurosim_core.render.render_terms import RenderTerms
from neurosim_core.render.scene_data import SceneData
from neurosim_core.render.shading import albedo_reader

OUTPUTS = ("log_radiance", "rgb", "radiance", "depth", "range", "normal", "instance", "returns")
"""The outputs of the ray caster."""

INSTANT_OUTPUTS = frozenset({"log_radiance"})
"""Those that all instants have, whether they have an image slot or not."""
RADIANCE = ("log_radiance", "rgb", "radiance")
"""Those of the light of a pixel."""
_PLAIN_GEOMETRY = ("depth", "range", "normal", "instance")
_GEOMETRY = (*_PLAIN_GEOMETRY, "returns")
FACE = "face"
"""The output of a first pass (`antialias.py`), which all instants have."""


class RequestedOutputs(NamedTuple):
    """What a set of outputs requires."""

    log: bool
    """Log radiance, which all instants have, is requested."""
    faces: bool
    """Faces, which all instants have, are requested."""
    images: bool
    """Another output, which instants with an image slot have, is requested."""
    radiance: bool
    """Log radiance, RGB or radiance is requested."""
    geometry: bool
    """Depth, range, normal, instance or returns are requested."""


def widened_outputs(outputs: Collection[str]) -> frozenset[str]:
    """Return outputs and those that the writers for allocated outputs write by the same code.

    Kernels of a CPU check which are allocated, which takes less than to compile a kernel for each set.
    """
    alike = (RADIANCE[1:], _PLAIN_GEOMETRY)
    return frozenset(outputs).union(*(names for names in alike if not set(names).isdisjoint(outputs)))


def requested_outputs(outputs: Collection[str]) -> RequestedOutputs:
    """Return what `outputs` require of a kernel."""
    return RequestedOutputs(
        log="log_radiance" in outputs,
        faces=FACE in outputs,
        images=any(name not in ("log_radiance", FACE) for name in outputs),
        radiance=any(name in outputs for name in RADIANCE),
        geometry=any(name in outputs for name in _GEOMETRY),
    )


@wp.struct
class RenderOutputs:
    """The arrays of outputs; those not requested are empty. All but the first two have image slots."""

    log_radiance: wp.array3d[float]  # log(Rec. 709 luma + dark floor) of each instant, shape [K, H, W]
    face: wp.array3d[int]  # Index of the face that the last ray of a pixel hits, -1: none, shape [K, H, W]
    rgb: wp.array4d[wp.uint8]  # sRGB of exposure times radiance, shape [M, H, W, 3]
    radiance: wp.array3d[wp.vec3]  # Exposure times linear radiance, of which 1 is white, shape [M, H, W]
    depth: wp.array3d[float]  # Planar z [m], inf where nothing is hit, shape [M, H, W]
    range: wp.array3d[float]  # Length of the ray [m], inf where nothing is hit, shape [M, H, W]
    normal: wp.array3d[wp.vec3]
    """Of the triangle, in W, towards the camera, zero where nothing is hit, shape [M, H, W]."""
    instance: wp.array3d[int]  # -1 where nothing is hit, shape [M, H, W]
    returns: wp.array3d[wp.vec3]
    """Length of the ray [m], inf where nothing is hit; |cosine| of incidence; luma of the albedo; shape
    [M, H, W]."""


@wp.func
def _to_srgb(linear: float) -> wp.uint8:
    # IEC 61966-2-1
    x = wp.clamp(linear, 0.0, 1.0)
    code = wp.where(x <= 0.0031308, 12.92 * x, 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055)
    return wp.uint8(int(255.0 * code + 0.5))


@cache
def geometry_writer(outputs: tuple[str, ...], terms: RenderTerms, *, allocated: bool = False) -> wp.Function:
    """Return the function that writes those of a pixel's `outputs` that are geometry.

    Of `widened_outputs` it writes, if `allocated`, those whose arrays are.
    """
    surface_albedo = albedo_reader(terms)

    @wp.func
    def write_geometry(
        scene: SceneData,
        ray: wp.vec3,
        cosine: float,
        spread_rad: float,
        hit: Hit,
        slot: int,
        row: int,
        col: int,
        out: RenderOutputs,
    ) -> None:
        if wp.static("depth" in outputs):
            if wp.static(not allocated) or out.depth.shape[0] > 0:
                out.depth[slot, row, col] = wp.where(hit.face >= 0, hit.t * cosine, wp.inf)
        if wp.static("range" in outputs):
            if wp.static(not allocated) or out.range.shape[0] > 0:
                out.range[slot, row, col] = wp.where(hit.face >= 0, hit.t, wp.inf)
        if wp.static("normal" in outputs):
            if wp.static(not allocated) or out.normal.shape[0] > 0:
                normal = wp.vec3(0.0)
                if hit.face >= 0:
                    normal = wp.where(wp.dot(hit.normal, ray) > 0.0, -hit.normal, hit.normal)
                out.normal[slot, row, col] = normal
        if wp.static("instance" in outputs):
            if wp.static(not allocated) or out.instance.shape[0] > 0:
                name = int(-1)
                if hit.face >= 0:
                    name = scene.face_instance[hit.face]
                out.instance[slot, row, col] = name
        if wp.static("returns" in outputs):
            found = wp.vec3(wp.inf, 0.0, 0.0)
            if hit.face >= 0:
                facing = wp.dot(ray, hit.normal)
                albedo = surface_albedo(scene, spread_rad, facing, hit, wp.vec2(0.0))
                luma = 0.2126 * albedo[0] + 0.7152 * albedo[1] + 0.0722 * albedo[2]
                found = wp.vec3(hit.t, wp.abs(facing), luma)
            out.returns[slot, row, col] = found

    return write_geometry


@wp.func_native(read_native(__file__, "log_of", BINARY=False))
def _natural_log(x: float) -> float: ...


@cache
def radiance_writer(outputs: tuple[str, ...], *, supersampled: bool, allocated: bool = False) -> wp.Function:
    """Return the function that writes those of a pixel's `outputs` that are light.

    It takes the radiance of all samples of the pixel together, if it is `supersampled`; if `allocated`, it
    writes the outputs whose arrays are.
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
        out: RenderOutputs,
    ) -> None:
        radiance = total
        if wp.static(supersampled):
            radiance = (1.0 / float(layer_count - 1)) * radiance
        if wp.static("log_radiance" in outputs):
            if wp.static(not allocated) or out.log_radiance.shape[0] > 0:
                luma = 0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2]
                out.log_radiance[instant, row, col] = _natural_log(luma + scene.dark_floor)
        if wp.static("radiance" in outputs):
            if slot >= 0 and (wp.static(not allocated) or out.radiance.shape[0] > 0):
                out.radiance[slot, row, col] = scene.exposure * radiance
        if wp.static("rgb" in outputs):
            if slot >= 0 and (wp.static(not allocated) or out.rgb.shape[0] > 0):
                out.rgb[slot, row, col, 0] = _to_srgb(scene.exposure * radiance[0])
                out.rgb[slot, row, col, 1] = _to_srgb(scene.exposure * radiance[1])
                out.rgb[slot, row, col, 2] = _to_srgb(scene.exposure * radiance[2])

    return write_radiance
