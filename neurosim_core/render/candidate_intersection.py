# mypy: disable-error-code="valid-type,no-untyped-def"
"""Intersection of rays with the candidate list of their tile.

The test evaluates three edge functions, normalised such that their sum is one over the distance. The ray hits
a triangle first if the triangle is nearer than all others by more than rounding, the ray passes inside its
edges by more than rounding, and the hit is within the reach of the list. `ray_intersection.intersect_face`
then computes the exact point, with the tree's own arithmetic. Otherwise the answer is UNRESOLVED.

Error bounds. Corners relative to the camera are rounded the same way in both tests, so they count as exact.
The edge function d . (b x (c - b)) is off by at most 6e-7 |b| |c - b|, that of Woop's test by 1.4e-6 max|a,
b, c| |c - b|. Rays keep their direction in C, and the functions are turned there: that adds 1.2e-6. A ray is
within rounding of an edge if the function is below EDGE = 5e-6 of the same product. The distance of a
triangle is off by less than TIE / 2 of it, unless the triangle is seen nearly from the side or is a sliver
(SIDE): rays within rounding of such a triangle are unresolved.

Reference: Woop, Benthin, Wald (2013), Watertight Ray/Triangle Intersection.
"""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

from functools import cache

import warp as wp

from neurosim_core.native_code import read_native
from neurosim_core.render.candidate_data import UNRESOLVED


@cache
def candidate_intersector(group: int) -> wp.Function:
    """Return the Warp function that intersects the ray of a pixel with a candidate list at several instants.

    It returns a vector of `group` integers, a divisor of 64: for each instant the face that the ray hits
    first; -1: none; UNRESOLVED. On CUDA the 64 threads of a block, the pixels of a tile, call it together and
    share the set-up of triangles.

    Its parameters: the mesh; the lists; begin and length of the tile's list (length -1: no list); the
    distance up to which the list is complete, and the distance that counts as infinite [m];
    `CandidateListData.bounds` of the tile; positions [m] and orientations of the camera in W; the first
    instant and the number of instants; the direction of the pixel's ray in C, of unit length.
    """
    found = wp.types.vector(length=group, dtype=int)

    @wp.func_native(read_native(__file__, "intersect_candidates", GROUP=group, UNRESOLVED=UNRESOLVED))
    def intersect_candidates(
        id: wp.uint64,
        faces: wp.array[int],
        begin: int,
        count: int,
        reach: float,
        far_m: float,
        bounds: wp.vec4,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        first: int,
        instants: int,
        ray_C: wp.vec3,
    ) -> found: ...

    return intersect_candidates


@wp.func_native(read_native(__file__, "intersect_tile", UNRESOLVED=UNRESOLVED))
def intersect_tile(
    id: wp.uint64,
    faces: wp.array[int],
    begin: int,
    count: int,
    reach: float,
    far_m: float,
    bounds: wp.vec4,
    q: wp.quat,
    origin: wp.vec3,
    rays: wp.array[wp.vec3],
    face_out: wp.array[int],
):
    """Intersect all 64 rays of a tile at one instant with its list; for CPU kernels, vectorised over rays.

    See `candidate_intersector`; rays are in W. It writes the face that each ray hits first; -1: none;
    UNRESOLVED.
    """
    ...
