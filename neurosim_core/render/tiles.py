# mypy: disable-error-code="assignment,index,no-untyped-def,return-value"
# ruff: noqa: UP018, RUF046  (typed literals have a meaning in kernels)
"""The layout of tiles of 8 x 8 pixels, and where rays begin: functions for kernels."""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

from functools import cache

import warp as wp

from neurosim_core.render.kernel_data import RenderTerms, ViewData


@cache
def pose_finder(terms: RenderTerms) -> wp.Function:
    """Return the Warp function that finds the pose of a ray.

    Its parameters: the row of the arrays of instants; the layer; the pixel of a lens; view.
    """

    @wp.func
    def find_pose(instant: int, layer: int, pixel: int, view: ViewData) -> int:
        pose = instant
        if wp.static(terms.timed):
            pose = instant * view.pose_count + view.pose[layer, pixel]
        return pose

    return find_pose


@cache
def tile_finder(terms: RenderTerms) -> wp.Function:
    """Return the Warp function that locates a tile; tiles are numbered row by row, then world by world.

    Its parameters: the tile; width and height of the picture [px]. It returns the world; the index of the
    tile in that world; the column and the row of its first pixel.
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


@wp.struct
class TilePlace:
    """A tile in one instant."""

    rendered: wp.bool  # False: its world is inactive, or none of the outputs is wanted of the instant
    world: int
    tile: int  # Its index in the world
    instant: int  # Row of the arrays of instants
    left: int  # Column of its first pixel
    top: int  # Row of its first pixel
    first_ray: int  # Index of the first ray of the world's lens in a layer
    slot: int  # Where images go, -1: nowhere


@cache
def tile_locator(terms: RenderTerms, *, images: bool, instants: bool) -> wp.Function:
    """Return the Warp function that locates a tile in one instant.

    Its parameters: the tile, as `tile_finder` counts; the instant, of a world; view. Outputs are
    written that have image slots (`images`), or that all instants have (`instants`).
    """
    find_tile = tile_finder(terms)

    @wp.func
    def locate_tile(tile: int, instant: int, view: ViewData) -> TilePlace:
        place = TilePlace()
        world, in_world, left, top = find_tile(tile, view.width, view.height)
        place.world = world
        place.tile = in_world
        place.left = left
        place.top = top
        place.rendered = True
        if wp.static(terms.worlds):
            instant += world * view.worlds.stride
            place.rendered = view.worlds.active[world] != 0
        if wp.static(terms.world_lenses):
            place.first_ray = view.worlds.lens[world] * view.width * view.height
        place.instant = instant
        place.slot = -1
        if wp.static(images):
            place.slot = view.image_slot[instant]
            if wp.static(not instants):
                place.rendered = place.rendered and place.slot >= 0
        return place

    return locate_tile
