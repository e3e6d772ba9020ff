# mypy: disable-error-code="no-untyped-def,return-value"
# mypy: allow-untyped-calls, allow-untyped-decorators
# ruff: noqa: UP018, RUF046  (typed literals have a meaning in kernels)
"""Who looks: the rays and poses of a launch, its worlds, and where its tiles of 8 x 8 pixels are."""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

from functools import cache
from typing import Any

import warp as wp

from neurosim_core.render.cast_terms import Terms
from neurosim_core.render.scene_data import SceneData


@wp.struct
class ViewData:
    """What a launch looks at: along the rays of a lens, from the poses of its instants."""

    rays: wp.array2d[wp.vec4]
    """Direction in C and spread [rad], shape [layer, H * W]: one layer, or that of the centres and then the
    samples whose mean is the radiance."""
    width: int
    """Columns of a picture [px]."""
    height: int
    """Rows of a picture [px]."""
    instant_count: int
    """How many of the K instants are rendered, of each world."""
    p_WC: wp.array[wp.vec3]
    """Position of the camera [m], shape [K]."""
    q_WC: wp.array[wp.quat]
    """Orientation of the camera's optical frame, xyzw, shape [K]."""
    image_slot: wp.array[int]
    """Where the images of an instant go, shape [K]; -1: nowhere."""


def make_view(rays: Any, width: int, height: int) -> ViewData:
    """Return a view along rays, vec4, shape [layer, H * W]; without instants."""
    view = ViewData()
    view.rays, view.width, view.height = rays, width, height
    return view


@wp.struct
class WorldData:
    """Who looks, where worlds are rendered together; instants are [world, K], in this order in all arrays."""

    stride: int
    """K: room for instants of each world."""
    active: wp.array[int]
    """1: this world is rendered, 0: its pictures stay as they are, shape [world]."""
    scenes: wp.array[SceneData]
    """`Terms.world_scenes`: all scenes there are."""
    scene: wp.array[int]
    """`Terms.world_scenes`: which of them a world is in, shape [world]."""
    lens: wp.array[int]
    """`Terms.world_lenses`: rays of which lens, of those that follow each other in a layer, shape [world]."""


@cache
def tile_finder(terms: Terms) -> wp.Function:
    """Return the function that says where a tile is: all tiles of a world, row by row, then the next world.

    Its parameters: the tile; width and height of the picture [px]. It returns the world; the tile among those
    of this world; the column and the row of its first pixel.
    """

    @wp.func
    def find_tile(tile: int, width: int, height: int):
        tile_columns = (width + 7) // 8
        world = int(0)
        if wp.static(terms.worlds):
            tile_count = tile_columns * ((height + 7) // 8)
            world = tile // tile_count
            tile -= world * tile_count
        return world, tile, (tile % tile_columns) * 8, (tile // tile_columns) * 8

    return find_tile
