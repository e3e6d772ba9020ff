"""What the ray caster reads of the walks that rays share (`tile_walk.py`)."""

# No `from __future__ import annotations`: Warp needs the annotations of structures as objects.

import warp as wp

TILE = 8
"""Width and height of a tile [px]."""
BLOCK = TILE * TILE
"""Threads that walk together on CUDA; on a CPU one does it all."""
ASK = -2
"""In place of a face: the list does not tell, ask the tree."""


@wp.struct
class WalkData:
    """What the ray caster reads of the walks before it; empty without."""

    instants: int
    """M: instants that share a walk."""
    limit: int
    """The most triangles of a list."""
    faces: wp.array[int]
    """The lists, shape [walk, tile, limit] in one dimension; walk w is of the instants from M w on."""
    count: wp.array2d[int]
    """Length of each list, shape [walk, tile]; -1: too long, ask the tree."""
    reach: wp.array2d[float]
    """Distance up to which a list is complete [m], shape [walk, tile]."""
    bounds: wp.array[wp.vec4]
    """Least and largest x / z, least and largest y / z of the rays of a tile in C, shape [tile]."""
    left: wp.array[int]
    """Pixels that are left for rays that walk by themselves, in any order; empty on a CPU."""
    left_count: wp.array[int]
    """How many there are, also where there is no room for them, shape [1]."""
    left_threads: int
    """How many threads share them."""
