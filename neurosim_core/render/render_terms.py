"""The terms that a scene, its settings and its lens compile into the ray caster."""

from __future__ import annotations

import math
from typing import NamedTuple

from neurosim_core.render.config import CandidateListConfig


class RenderTerms(NamedTuple):
    """The terms of a kernel."""

    textured: bool
    """Some material has a texture; always on a CPU, where to look takes less than to compile both."""
    emissive: bool
    """Some material emits light; always on a CPU, likewise."""
    baked: bool
    """Light is baked: interpolated between corners instead of evaluated for each pixel."""
    supersampled: bool
    """Radiance is the mean over several rays per pixel; `raycast_packets.py` counts them itself."""
    embree: int = 0
    """Rays per packet of Embree (`embree.packet_width`), on the CPU only; 0: Warp intersects rays."""
    finest_level: bool = False
    """Textures are read at their finest level, whatever the footprint of a ray."""
    nearest_texel: bool = False
    """With `finest_level`: texels are not interpolated."""
    bodies: bool = False
    """Bodies move through the scene."""
    worlds: bool = False
    """Instants belong to many worlds, each of which may be inactive (`WorldData`)."""
    world_scenes: bool = False
    """Worlds have different scenes."""
    world_lenses: bool = False
    """Worlds have different lenses."""
    candidate_group: int = 0
    """Rays are intersected with candidate lists (`candidate_lists`), by a block of 64 threads for this many
    instants together; 0: rays traverse the tree. Unresolved pixels go to the kernel with `fallback`."""
    fallback: bool = False
    """The kernel renders the unresolved pixels of one with `candidate_group`; each ray traverses the tree."""
    by_tile: bool = False
    """With `candidate_group`: a thread renders a tile and resolves all of its pixels, on a CPU."""
    timed: bool = False
    """Each ray has an instant of its own (`ray_times`); rays traverse the tree."""
    quads: bool = False
    """Four threads side by side cast the rays of a pixel, a multiple of four, on CUDA (`raycast_quads`)."""


def with_candidate_lists(
    terms: RenderTerms, config: CandidateListConfig | None, *, group: int | None = None
) -> RenderTerms:
    """Return terms for rays with or without candidate lists; `group` divides the instants of a list."""
    if config is None:
        return terms._replace(candidate_group=0, by_tile=False)
    return terms._replace(candidate_group=group or _group_size(config.instants))


def instants_per_thread(terms: RenderTerms) -> int:
    """Return how many instants a thread of `raycast_kernel` renders; 1 where threads are tiles or packets.

    Samples of a pixel are summed for one instant at a time.
    """
    return terms.candidate_group if terms.candidate_group and not (terms.by_tile or terms.supersampled) else 1


def _group_size(instants: int) -> int:
    """Return how many instants of a list a block renders together: 4, 2 or 1, a divisor."""
    return math.gcd(instants, 4)
