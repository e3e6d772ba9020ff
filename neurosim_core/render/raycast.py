"""The ray caster: one kernel factory, specialised on the requested outputs and the terms of the scene.

One traversal per ray answers everything. A thread is a pixel (`raycast_pixels.py`), or on a CPU a packet of
pixels with Embree and a tile with candidate lists (`raycast_packets.py`). A specialisation contains only the
code that it needs.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache

import warp as wp

from neurosim_core.render.outputs import FACE, OUTPUTS, requested_outputs, widened_outputs
from neurosim_core.render.raycast_packets import packet_kernel
from neurosim_core.render.raycast_pixels import pixel_kernel
from neurosim_core.render.render_terms import RenderTerms


def raycast_kernel(outputs: Collection[str], terms: RenderTerms) -> wp.Kernel:
    """Return the kernel that casts rays for `outputs` in a scene with `terms`; made once per combination.

    Its parameters: the index of the first thread; `SceneData`, `ViewData`, `BodyData`, `WorldData` and
    `CandidateListData`, of which it reads what the terms say. It writes `RenderOutputs`.

    Raises:
        ValueError: An output is unknown, none is requested, or worlds with different scenes or lenses are to
            use candidate lists.
    """
    if terms.candidate_group and (terms.world_scenes or terms.world_lenses):
        raise ValueError("candidate lists need worlds with one scene and one lens")
    if not terms.candidate_group:
        terms = terms._replace(by_tile=False)
    unknown = sorted(set(outputs) - {*OUTPUTS, FACE})
    if unknown or not outputs:
        raise ValueError(f"outputs must be some of {list(OUTPUTS)}, got {sorted(outputs)}")
    if not requested_outputs(outputs).radiance and "returns" not in outputs:  # materials do not matter
        terms = terms._replace(
            textured=False, emissive=False, baked=False, finest_level=False, nearest_texel=False
        )
    if terms.embree or terms.by_tile:
        outputs, terms = widened_outputs(outputs), terms._replace(supersampled=False)
    return _kernel(tuple(name for name in (*OUTPUTS, FACE) if name in outputs), terms)


def fallback_kernel(outputs: Collection[str], terms: RenderTerms) -> wp.Kernel | None:
    """Return the kernel that renders the unresolved pixels of `raycast_kernel`; None: there are none.

    It is launched after `raycast_kernel`, with the same arguments and `CandidateListData.fallback_threads`
    threads.
    """
    if not terms.candidate_group or terms.by_tile:
        return None
    return raycast_kernel(outputs, terms._replace(candidate_group=0, fallback=True))


@cache
def _kernel(outputs: tuple[str, ...], terms: RenderTerms) -> wp.Kernel:
    return (packet_kernel if terms.embree or terms.by_tile else pixel_kernel)(outputs, terms)
