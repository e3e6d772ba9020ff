# mypy: disable-error-code="assignment,union-attr,no-untyped-call"
"""One walk through the tree for all rays of a tile of pixels in several consecutive instants; exact.

The rays of 8 x 8 pixels in M instants lie in a narrow frustum: that of the tile, swept by the motion of the
camera. One walk lists the triangles that reach into it, and each ray is tested against the list alone.

1. A few of the rays are cast one by one. The furthest hit, and a little more, is the reach of the list: what
   lies behind the walls of a room is not in it.
2. The tree is walked with the swept frustum, cut off at the reach. On CUDA the threads of a block take nodes
   from one stack. What is listed is every triangle that one of the rays can hit within the reach.
3. A ray is tested against the list. Where by more than rounding one triangle is what it hits first, the
   tree's own intersection says where exactly. A ray of which that is not sure asks the tree, as do all of a
   tile with too long a list.

So nothing is approximated: the answers are those of rays that walk by themselves (`ray_tree.py`) to the last
bit, as far as a compiler makes the same code of the same intersection in two places. Neither the number of
instants per launch, nor how many share a walk, nor the order in which threads find triangles, changes them.

The walk of 1 and 2 is in `frustum_walk.py`; the test of 3 and its rounding in `list_search.py`; what the
sides of tiles have to spare in `tile_bounds.py`.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.config import WalkConfig
from neurosim_core.render.frustum_walk import walk_kernel
from neurosim_core.render.launch import launch_split
from neurosim_core.render.ray_tree import RayTree
from neurosim_core.render.tile_bounds import looks_forward, tile_bounds
from neurosim_core.render.walk_data import BLOCK, TILE, WalkData

_INDEX_MAX = 2**31 - 1
"""Kernels count in 32 bits."""
_AUTO = ((8, 1.5e-3), (16, 2.5e-3), (32, 3.2e-3))
"""From so many instants on, tiles of pixels up to so wide [rad] share walks: with fewer instants a walk takes
as long as it saves, and so it does with fewer tiles, of larger pixels. As measured on an H200, 240x180 to
1280x720, in a house of 145,844 triangles and in halls of 20,000 to 2 million."""
_AUTO_FACES_MAX = 2.2
"""Nor do they with more triangles, as cut for the light, times the solid angle of a pixel [sr]: lists have
about 50 then."""
_LEFT_SHARE = 8
"""There is room for one in so many pixels to be left; if there are more, the launch is done again by rays
that walk by themselves."""
_THREADS_PER_MULTIPROCESSOR = 1280
"""Of those that render what is left: more than run at a time, since some take longer than others."""


def shared_walk(
    asked: WalkConfig | Literal["auto"] | None,
    rays: NDArray[np.float32],
    *,
    instant_count: int,
    face_count: int,
    is_cuda: bool,
) -> WalkConfig | None:
    """Return how rays share walks; None: each walks by itself.

    Args:
        asked: `RenderConfig.shared_walk`.
        rays: Rays of the pixels in C, shape [layer, H * W, 4], as `warp_renderer.ray_layers` gives them.
        instant_count: The most instants of a launch, of one world.
        face_count: Triangles that rays may hit.
        is_cuda: Where they are rendered.
    """
    if asked != "auto":
        return asked
    widest = max((pixel_rad for least, pixel_rad in _AUTO if instant_count >= least), default=0.0)
    sample_count = max(1, len(rays) - 1)  # each of which has its share of the pixel
    pixel_rad = float(np.median(rays[..., 3])) * math.sqrt(sample_count)
    small = pixel_rad <= widest and face_count * pixel_rad**2 <= _AUTO_FACES_MAX
    return WalkConfig() if is_cuda and small and looks_forward(rays) else None


def _check_counts(config: WalkConfig, *, walks: int, tiles: int) -> None:
    """Refuse what kernels, which count in 32 bits, cannot address: threads, and entries of the lists."""
    longest = _INDEX_MAX // (walks * tiles)
    if max(config.face_count_max, BLOCK) > longest:
        allowed = f"at most {longest}" if longest >= BLOCK else "no value is small enough"
        raise ValueError(
            f"{walks} shared walks of {tiles} tiles with render.shared_walk.face_count_max = "
            f"{config.face_count_max} are more than 2^31 - 1 entries: {allowed} here; or take fewer worlds "
            "or pixels, or share a walk between more instants (render.shared_walk.instants)"
        )


class TileWalk:
    """The lists of one renderer, and the launch that fills them.

    Attributes:
        data: For kernels; overwritten by `launch`.
    """

    def __init__(
        self,
        tree: RayTree,
        rays: NDArray[np.float32],
        *,
        width: int,
        height: int,
        extent_m: float,
        config: WalkConfig,
        instant_count: int,
        leaves: bool,
        thread_count: int | None = None,
    ) -> None:
        """Allocate the lists.

        Args:
            tree: What rays hit.
            rays: Rays of the pixels in C, shape [layer, H * W, 4].
            width: Columns of the picture [px].
            height: Rows of the picture [px].
            extent_m: Largest coordinate of the mesh [m].
            config: How walks are shared.
            instant_count: K, the most instants per launch.
            leaves: Pixels are left to another kernel (`raycast.asking_kernel`).
            thread_count: Threads on a CPU device; all cores if None.

        Raises:
            ValueError: A ray does not look forward enough (`tile_bounds`), or there are more than 2^31 - 1
                threads or entries of the lists.
        """
        walks = -(-instant_count // config.instants)
        _check_counts(config, walks=walks, tiles=-(-width // TILE) * -(-height // TILE))
        bounds = tile_bounds(rays, width, height)
        self._tree, self._width, self._height, self._extent_m = tree, width, height, extent_m
        self._device = str(tree.nodes.device)
        self._thread_count = thread_count
        self._lanes = 1 if tree.nodes.device.is_cpu else BLOCK
        self.data = WalkData()
        self.data.instants = config.instants
        self.data.limit = config.face_count_max
        size = walks * len(bounds) * config.face_count_max
        self.data.faces = wp.zeros(size, dtype=int, device=self._device)
        self.data.count = wp.zeros((walks, len(bounds)), dtype=int, device=self._device)
        self.data.reach = wp.zeros((walks, len(bounds)), dtype=float, device=self._device)
        self.data.bounds = wp.array(bounds, dtype=wp.vec4, device=self._device)
        self.data.left_count = wp.zeros(1, dtype=int, device=self._device)
        room = instant_count * len(bounds) * BLOCK // _LEFT_SHARE if leaves else 0
        self.data.left = wp.zeros(room, dtype=int, device=self._device)
        processors = tree.nodes.device.sm_count if tree.nodes.device.is_cuda else 0
        self.data.left_threads = max(1, processors * _THREADS_PER_MULTIPROCESSOR)

    def launch(
        self,
        rays: wp.array2d[wp.vec4],
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        *,
        instant_count: int,
    ) -> None:
        """List the triangles that rays may hit at the first `instant_count` poses.

        Args:
            rays: Rays of the pixels in C, shape [layer, H * W].
            p_WC: Position of the camera [m], shape [K].
            q_WC: Orientation of the camera's optical frame, xyzw, shape [K].
            instant_count: How many of the K instants are rendered.
        """
        walks = -(-instant_count // self.data.instants)
        self.data.left_count.zero_()
        launch_split(
            walk_kernel(self._lanes),
            dim=walks * self.data.bounds.shape[0] * self._lanes,
            inputs=[
                self._tree,
                rays,
                self._width,
                self._height,
                self._extent_m,
                instant_count,
                p_WC,
                q_WC,
            ],
            outputs=[self.data],
            device=self._device,
            thread_count=self._thread_count,
        )
