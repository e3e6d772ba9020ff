# mypy: disable-error-code="assignment,union-attr"
"""Candidate lists: one search of the tree for all rays of a tile of pixels in several instants; exact.

The rays of 8 x 8 pixels in M consecutive instants lie in a narrow frustum: that of the tile, swept by the
motion of the camera. One search lists the triangles in it, and each ray is intersected with the list alone.

1. A few probe rays are traced. The furthest hit, and a little more, is the reach of the list: triangles
   behind the walls of a room are not listed.
2. The tree is traversed with the swept frustum, cut off at the reach. On CUDA the threads of a block take
   nodes from one stack. The list holds every triangle that one of the rays can hit within the reach.
3. Each ray is intersected with the list. Where one triangle is first by more than rounding, the tree's own
   intersection computes the point. Other rays are unresolved and traverse the tree, as do all rays of a tile
   whose list is too long.

Nothing is approximated: the results are those of rays that traverse the tree (`ray_tree.py`) to the last bit,
as far as a compiler makes the same code of the same intersection in two places. They depend neither on the
number of instants per launch or per list nor on the order in which threads find triangles.

Steps 1 and 2 are in `frustum_search.py`; the test of step 3 and its rounding are in
`candidate_intersection.py`; the margins of tiles are in `tile_bounds.py`.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.candidate_data import BLOCK, TILE, CandidateListData
from neurosim_core.render.config import CandidateListConfig
from neurosim_core.render.frustum_search import frustum_search_kernel
from neurosim_core.render.launch import launch_split
from neurosim_core.render.ray_tree import RayTree
from neurosim_core.render.tile_bounds import looks_forward, tile_bounds

_INDEX_MAX = 2**31 - 1
"""Kernels count in 32 bits."""
_AUTO = ((8, 1.5e-3), (16, 2.5e-3), (32, 6.0e-3))
"""Least number of instants, and largest pixel [rad] for which lists pay: with fewer instants, or with fewer
tiles of larger pixels, the search takes as long as it saves."""
_AUTO_FACES_MAX = 7.0
"""Largest product of the number of triangles, as cut for the light, and the solid angle of a pixel [sr] for
which lists pay."""
_UNRESOLVED_SHARE = 8
"""One in so many pixels may be unresolved; if there are more, the fallback kernel renders all pixels."""
_THREADS_PER_MULTIPROCESSOR = 1280
"""Threads of the fallback kernel: more than run at a time, since some take longer than others."""


def choose_candidate_lists(
    requested: CandidateListConfig | Literal["auto"] | None,
    rays: NDArray[np.float32],
    *,
    instant_count: int,
    face_count: int,
    is_cuda: bool,
    embree: bool = False,
) -> CandidateListConfig | None:
    """Return the settings of candidate lists for a renderer; None: rays traverse the tree.

    Args:
        requested: `RenderConfig.candidate_lists`.
        rays: Those of `ray_layers`.
        instant_count: The most instants of one world in a launch.
        face_count: Triangles of the scene, as cut for baked light.
        is_cuda: The device is one of CUDA, else a CPU.
        embree: Embree casts rays; on a CPU without it lists are always sooner, or as soon.
    """
    if requested != "auto":
        return requested
    widest = max((pixel_rad for least, pixel_rad in _AUTO if instant_count >= least), default=0.0)
    sample_count = max(1, len(rays) - 1)  # each of which has its share of the pixel
    pixel_rad = float(np.median(rays[..., 3])) * math.sqrt(sample_count)
    small = pixel_rad <= widest and face_count * pixel_rad**2 <= _AUTO_FACES_MAX
    pays = small if is_cuda else not embree
    return CandidateListConfig() if pays and looks_forward(rays) else None


def _check_counts(config: CandidateListConfig, *, groups: int, tiles: int) -> None:
    """Refuse what kernels, which count in 32 bits, cannot address: threads, and entries of the lists."""
    longest = _INDEX_MAX // (groups * tiles)
    if max(config.face_count_max, BLOCK) > longest:
        allowed = f"at most {longest}" if longest >= BLOCK else "no value is small enough"
        raise ValueError(
            f"{groups} groups of instants of {tiles} tiles with render.candidate_lists.face_count_max = "
            f"{config.face_count_max} are more than 2^31 - 1 entries: {allowed} here; or take fewer worlds "
            "or pixels, or share a list between more instants (render.candidate_lists.instants)"
        )


class CandidateLists:
    """The candidate lists of one renderer.

    Attributes:
        data: For kernels; overwritten by `update`.
    """

    def __init__(
        self,
        tree: RayTree,
        rays: NDArray[np.float32],
        *,
        width: int,
        height: int,
        extent_m: float,
        config: CandidateListConfig,
        instant_count: int,
        has_fallback: bool,
    ) -> None:
        """Allocate the lists, for at most `instant_count` instants per launch.

        Rays are those of `ray_layers`; `extent_m` is the largest coordinate of the mesh. With a fallback,
        unresolved pixels are left to another kernel (`raycast.fallback_kernel`).

        Raises:
            ValueError: A ray does not look forward enough (`tile_bounds`), or there are more than 2^31 - 1
                threads or entries of the lists.
        """
        groups = -(-instant_count // config.instants)
        _check_counts(config, groups=groups, tiles=-(-width // TILE) * -(-height // TILE))
        bounds = tile_bounds(rays, width, height)
        self._tree, self._width, self._height, self._extent_m = tree, width, height, extent_m
        self._device = str(tree.nodes.device)
        self._lanes = 1 if tree.nodes.device.is_cpu else BLOCK
        self.data = CandidateListData()
        self.data.instants = config.instants
        self.data.limit = config.face_count_max
        size = groups * len(bounds) * config.face_count_max
        self.data.faces = wp.zeros(size, dtype=int, device=self._device)
        self.data.count = wp.zeros((groups, len(bounds)), dtype=int, device=self._device)
        self.data.reach = wp.zeros((groups, len(bounds)), dtype=float, device=self._device)
        self.data.bounds = wp.array(bounds, dtype=wp.vec4, device=self._device)
        self.data.unresolved_count = wp.zeros(1, dtype=int, device=self._device)
        capacity = instant_count * len(bounds) * BLOCK // _UNRESOLVED_SHARE if has_fallback else 0
        self.data.unresolved = wp.zeros(capacity, dtype=int, device=self._device)
        processors = tree.nodes.device.sm_count if tree.nodes.device.is_cuda else 0
        self.data.fallback_threads = max(1, processors * _THREADS_PER_MULTIPROCESSOR)

    def update(
        self,
        rays: wp.array2d[wp.vec4],
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        *,
        instant_count: int,
    ) -> None:
        """Fill the lists with the triangles that rays may hit at the first `instant_count` poses."""
        groups = -(-instant_count // self.data.instants)
        self.data.unresolved_count.zero_()
        launch_split(
            frustum_search_kernel(self._lanes),
            dim=groups * self.data.bounds.shape[0] * self._lanes,
            inputs=[self._tree, rays, self._width, self._height, self._extent_m, instant_count, p_WC, q_WC],
            outputs=[self.data],
            device=self._device,
        )
