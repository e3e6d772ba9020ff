# mypy: disable-error-code="empty-body"
"""The points of a pixel that antialiasing tests; see `antialias.py`."""

import warp as wp

from neurosim_core.native_code import read_native

SAMPLE_COUNT = 32
"""Points of a pixel."""
RAY_COUNT = 8
"""Rays of a pixel that is rendered by rays."""
RAY_WIDTH = wp.constant(RAY_COUNT**-0.5)
"""Width of the footprint of one of them [px]."""
FACE_COUNT_MAX = 48
"""Most faces of a block of 4 x 4 pixels and the ring around it."""
SHARPNESS = wp.constant(0.64)
"""Width of the footprint that a texture is averaged over where a surface fills a pixel [px].

A lookup blurs more than a mean does.
"""
APART = wp.constant(0.42)
"""How far from the middle of a long footprint the two lookups are whose mean is taken, of its length."""


@wp.func_native(read_native(__file__, "sample_point", SAMPLES=RAY_COUNT))
def ray_point(ray: int) -> wp.vec2:
    """Return the point of a pixel that a ray goes through, from its centre [px]."""
    ...


@wp.func
def footprint_width(point_count: float) -> float:
    """Return the width of the footprint that a texture is averaged over where so many points show it [px]."""
    return SHARPNESS * wp.sqrt(point_count / float(SAMPLE_COUNT))
