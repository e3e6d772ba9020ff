# mypy: disable-error-code="index,attr-defined,misc,operator,assignment,arg-type"
"""Pixels that no light reaches, such as those outside the image circle of a fisheye lens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.render.camera import Lens
from neurosim_core.render.launch import launch_split
from neurosim_core.render.outputs import RenderOutputs

wp.set_module_options({"enable_backward": False})


@wp.kernel
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
    """The pixels that see nothing, of one lens or of several."""

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
