"""What a scene, its settings and its lens need of the ray caster: nothing else is in its code."""

from __future__ import annotations

import math
from typing import NamedTuple

from neurosim_core.render.config import WalkConfig


class Terms(NamedTuple):
    """What a scene and its settings need in the kernel."""

    textured: bool
    """Some material has a texture."""
    emissive: bool
    """Some material emits light."""
    baked: bool
    """Light is interpolated between corners instead of evaluated for each pixel."""
    supersampled: bool
    """Radiance is the mean over several rays per pixel."""
    embree: int = 0
    """Embree finds what rays hit, so many at once (`embree.packet_width`), on the CPU only; 0: Warp does."""
    finest_level: bool = False
    """Textures are read at their finest level, however large the footprint of a ray is."""
    nearest_texel: bool = False
    """With `finest_level`: as they are stored, not interpolated."""
    bodies: bool = False
    """Bodies move through the scene."""
    worlds: bool = False
    """Instants are those of many worlds, which may look or not (`WorldData`)."""
    world_scenes: bool = False
    """Worlds are in different scenes."""
    world_lenses: bool = False
    """Worlds look through different lenses."""
    walked: int = 0
    """Rays of a tile share a walk through the tree (`tile_walk`): a block of 64 threads looks at so many
    instants together. Pixels of which the lists do not tell are left to the kernel with `asking`."""
    asking: bool = False
    """Of the pixels that `walked` left, and no others: each ray walks by itself."""
    by_tile: bool = False
    """`walked` means a thread for each tile, which leaves nothing: on a CPU."""


def with_walks(terms: Terms, walk: WalkConfig | None, *, group: int | None = None) -> Terms:
    """Return terms for rays that share walks, or do not; a group of instants divides those of a walk."""
    if walk is None:
        return terms._replace(walked=0, by_tile=False)
    return terms._replace(walked=group or _group_size(walk.instants))


def group_of(terms: Terms) -> int:
    """Return how many instants a thread of `raycast_kernel` looks at; 1 where threads are tiles or packets.

    Samples of a pixel are added up one instant at a time.
    """
    return terms.walked if terms.walked and not (terms.by_tile or terms.supersampled) else 1


def _group_size(instants: int) -> int:
    """Return how many of the instants that share a walk a block looks at together: 4, 2 or 1, a divisor."""
    return math.gcd(instants, 4)
