# mypy: disable-error-code="assignment,index,no-untyped-def,return-value"
# ruff: noqa: UP018, RUF046  (typed literals have a meaning in kernels)
"""The camera of a launch: rays, poses and worlds, and the layout of tiles of 8 x 8 pixels."""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

from functools import cache
from typing import Any

import warp as wp

from neurosim_core.render.render_terms import RenderTerms
from neurosim_core.render.scene_data import SceneData


@wp.struct
class ViewData:
    """The rays of a lens, and the poses of the instants of a launch."""

    rays: wp.array2d[wp.vec4]
    """Direction in C and spread [rad], shape [layer, H * W]: the centres of pixels; further layers are the
    samples whose mean is the radiance."""
    width: int  # Columns of a picture [px]
    height: int  # Rows of a picture [px]
    instant_count: int  # How many of the K instants are rendered, of each world
    p_WC: wp.array[wp.vec3]
    """Position of the camera [m], shape [K]; with `RenderTerms.timed` [K, J], flattened."""
    q_WC: wp.array[wp.quat]  # Orientation of the camera's optical frame, xyzw, likewise
    pose_count: int  # With `RenderTerms.timed`: J, instants of one picture
    pose: wp.array2d[int]  # With `RenderTerms.timed`: which of them each ray has, shape [layer, H * W]
    image_slot: wp.array[int]  # Where the images of an instant go, shape [K]; -1: nowhere


def make_view(rays: Any, width: int, height: int) -> ViewData:
    """Return the view of a lens with rays vec4, shape [layer, H * W]; without instants."""
    view = ViewData()
    view.rays, view.width, view.height = rays, width, height
    return view


@wp.struct
class WorldData:
    """Worlds that are rendered together; arrays of instants have the shape [world, K], flattened."""

    stride: int  # K: capacity for instants of each world
    active: wp.array[int]  # 1: the world is rendered; 0: its outputs are left unchanged, shape [world]
    scenes: wp.array[SceneData]  # With `RenderTerms.world_scenes`: all scenes
    scene: wp.array[int]  # With `RenderTerms.world_scenes`: index of the scene of each world, shape [world]
    lens: wp.array[int]
    """With `RenderTerms.world_lenses`: index of the lens of each world, shape [world]; a layer of rays holds
    the lenses one after another."""


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

    Its parameters: the tile, as `tile_finder` counts; the instant, of a world; view and worlds. Outputs are
    written that have image slots (`images`), or that all instants have (`instants`).
    """
    find_tile = tile_finder(terms)

    @wp.func
    def locate_tile(tile: int, instant: int, view: ViewData, worlds: WorldData) -> TilePlace:
        place = TilePlace()
        world, in_world, left, top = find_tile(tile, view.width, view.height)
        place.world = world
        place.tile = in_world
        place.left = left
        place.top = top
        place.rendered = True
        if wp.static(terms.worlds):
            instant += world * worlds.stride
            place.rendered = worlds.active[world] != 0
        if wp.static(terms.world_lenses):
            place.first_ray = worlds.lens[world] * view.width * view.height
        place.instant = instant
        place.slot = -1
        if wp.static(images):
            place.slot = view.image_slot[instant]
            if wp.static(not instants):
                place.rendered = place.rendered and place.slot >= 0
        return place

    return locate_tile
