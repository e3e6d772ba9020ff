"""The candidate lists of a launch, as kernels read them (`candidate_lists.py`)."""

# No `from __future__ import annotations`: Warp needs the annotations of structures as objects.

import warp as wp

TILE = 8
"""Width and height of a tile [px]."""
BLOCK = TILE * TILE
"""Threads of a CUDA block that process a tile together; on a CPU one thread processes it."""
UNRESOLVED = -2
"""In place of a face index: the candidate list does not decide what the ray hits; the tree does."""


@wp.struct
class CandidateListData:
    """Candidate lists: for each tile and each group of instants, the triangles that its rays may hit.

    The structure is empty in kernels that do not use lists.
    """

    instants: int  # M: consecutive instants that share a list
    limit: int  # Capacity of a list
    faces: wp.array[int]
    """The lists, shape [group, tile, limit], flattened; group g holds the instants from M g on."""
    count: wp.array2d[int]
    """Length of each list, shape [group, tile]; -1: there is none, rays traverse the tree."""
    reach: wp.array2d[float]  # Distance up to which a list is complete [m], shape [group, tile]
    bounds: wp.array[wp.vec4]
    """Least and largest x / z, least and largest y / z of the rays of a tile in C, shape [tile]."""
    unresolved: wp.array[int]  # Pixels for the fallback kernel, in any order; empty on a CPU
    unresolved_count: wp.array[int]
    """Number of unresolved pixels, including those that the array has no room for, shape [1]."""
    fallback_threads: int  # Number of threads of the fallback kernel
