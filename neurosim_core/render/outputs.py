# mypy: disable-error-code="index,attr-defined,assignment,return-value,empty-body,operator"
# ruff: noqa: SIM102, UP018, RUF046  (nested wp.static branches, typed literals: they have a meaning)
"""Render outputs: their names, the functions that write a pixel of them, and pixels that no light reaches."""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

from collections.abc import Collection, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.camera import Lens
from neurosim_core.render.kernel_data import Hit, RenderOutputs, RenderTerms, SceneData
from neurosim_core.render.launch import launch_split
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
    """The requirements of a set of outputs."""

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


@wp.kernel(module="unique", enable_backward=False)
def _darken_pixels(
    first: int,
    # Model:
    pixels: wp.array2d[wp.vec2i],
    lens_of_world: wp.array[int],
    stride: int,
    log_dark: float,
    # In:
    instant_count: int,
    image_slot: wp.array[int],
    # Out:
    out: RenderOutputs,
) -> None:
    index = first + wp.tid()
    place = index % pixels.shape[1]
    instant = index // pixels.shape[1] % instant_count
    world = index // pixels.shape[1] // instant_count
    pixel = pixels[lens_of_world[world], place]
    row = pixel[0]
    col = pixel[1]
    if row < 0:
        return
    instant += world * stride
    if out.log_radiance.shape[0] > 0:
        out.log_radiance[instant, row, col] = log_dark
    slot = image_slot[instant]
    if slot < 0:
        return
    if out.rgb.shape[0] > 0:
        for channel in range(3):
            out.rgb[slot, row, col, channel] = wp.uint8(0)
    if out.radiance.shape[0] > 0:
        out.radiance[slot, row, col] = wp.vec3(0.0)
    if out.depth.shape[0] > 0:
        out.depth[slot, row, col] = wp.inf
    if out.range.shape[0] > 0:
        out.range[slot, row, col] = wp.inf
    if out.normal.shape[0] > 0:
        out.normal[slot, row, col] = wp.vec3(0.0)
    if out.instance.shape[0] > 0:
        out.instance[slot, row, col] = -1


class BlindPixels:
    """The pixels that no light reaches, such as those outside the image circle of a fisheye lens.

    They are those of one lens or of several.
    """

    def __init__(self, lenses: Sequence[Lens], lens_of_world: Any, *, stride: int, dark_floor: float) -> None:
        """Bring them to the device; lenses are of one size, and each world has at most `stride` instants."""
        masks = [lens.blind_pixels() for lens in lenses]
        found = [np.zeros((0, 2), int) if mask is None else np.argwhere(mask) for mask in masks]
        self.count = max(map(len, found))
        """The most of one lens."""
        rows = np.full((len(found), self.count, 2), -1, dtype=np.int32)
        for row, pixels in zip(rows, found, strict=True):
            row[: len(pixels)] = pixels
        self._lens_of_world = lens_of_world
        places: Any = wp.array(rows, dtype=wp.vec2i, device=lens_of_world.device)
        self._model = [places, lens_of_world, stride, float(np.log(dark_floor))]

    def darken(self, image_slot: Any, out: RenderOutputs, *, instant_count: int) -> None:
        """Write what a pixel is that sees nothing: black, infinitely far, no surface."""
        if self.count:
            dim = self._lens_of_world.shape[0] * instant_count * self.count
            inputs = [*self._model, instant_count, image_slot]
            device = self._lens_of_world.device
            launch_split(_darken_pixels, dim=dim, inputs=inputs, outputs=[out], device=device)
