"""The ray caster: one kernel factory, specialised on the outputs asked for and the terms of the scene.

One traversal per ray answers everything. A thread is a pixel (`raycast_pixels.py`), or on a CPU a packet of
pixels with Embree and a tile with shared walks (`raycast_packets.py`). What a specialisation does not need is
not in its code.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache

import warp as wp

from neurosim_core.render.cast_terms import Terms
from neurosim_core.render.film import OUTPUTS
from neurosim_core.render.raycast_packets import packet_kernel
from neurosim_core.render.raycast_pixels import pixel_kernel


def raycast_kernel(outputs: Collection[str], terms: Terms) -> wp.Kernel:
    """Return the kernel that casts rays for `outputs` in a scene with `terms`; made once per combination.

    Its parameters: the index of the first thread; `SceneData`, `ViewData`, `BodyData`, `WorldData` and
    `WalkData`, of which it reads what the terms say. It writes `FilmData`.

    Raises:
        ValueError: If an output is unknown or none is asked for, or unlike worlds are to share walks.
    """
    if terms.walked and (terms.world_scenes or terms.world_lenses):
        raise ValueError("rays share walks where worlds have one scene and one lens")
    if not terms.walked:
        terms = terms._replace(by_tile=False)
    unknown = sorted(set(outputs) - set(OUTPUTS))
    if unknown or not outputs:
        raise ValueError(f"outputs must be some of {list(OUTPUTS)}, got {sorted(outputs)}")
    return _kernel(tuple(name for name in OUTPUTS if name in outputs), terms)


def asking_kernel(outputs: Collection[str], terms: Terms) -> wp.Kernel | None:
    """Return the kernel that renders the pixels that `raycast_kernel` leaves; None: it leaves none.

    It is launched after the other, with the same arguments and `WalkData.left_threads` threads.
    """
    if not terms.walked or terms.by_tile:
        return None
    return raycast_kernel(outputs, terms._replace(walked=0, asking=True))


@cache
def _kernel(outputs: tuple[str, ...], terms: Terms) -> wp.Kernel:
    return (packet_kernel if terms.embree or terms.by_tile else pixel_kernel)(outputs, terms)
