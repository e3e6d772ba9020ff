# mypy: disable-error-code="no-untyped-def,empty-body,valid-type"
"""Shading of a packet of rays on a CPU, in loops over its lanes that become vector instructions.

The arithmetic and its order are those of `shading.py` for baked light and mip-mapped textures, so the bytes
are the same. Each quantity of the lanes is an array, and each loop does one thing for all lanes without a
branch, except for loads from tables and the library's logarithm of the footprint. Where all lanes hit one
triangle, its tables are read once. Shading ray by ray takes three times as long as Embree's intersection.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

from functools import cache
from typing import Any

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.kernel_data import Hit, SceneData, ViewData

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
