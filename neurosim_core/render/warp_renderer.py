# mypy: disable-error-code="attr-defined,var-annotated,type-arg,call-overload,assignment"
"""The renderer of the simulator: ray casting in Warp, the same source on CPU and CUDA."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.antialias import Antialiasing
from neurosim_core.render.body_arrays import make_body_data, place_camera
from neurosim_core.render.camera import Lens
from neurosim_core.render.candidate_lists import CandidateLists, choose_candidate_lists
from neurosim_core.render.config import CandidateListConfig
from neurosim_core.render.embree import PACKET
from neurosim_core.render.kernel_data import TILE, RenderOutputs, RenderTerms, ViewData
from neurosim_core.render.launch import launch_split
from neurosim_core.render.outputs import FACE, RADIANCE, BlindPixels, requested_outputs
from neurosim_core.render.ray_layers import first_rays, pixel_rays, ray_layers
from neurosim_core.render.ray_times import RayTimes, RayTiming
from neurosim_core.render.raycast import fallback_kernel, raycast_kernel
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.scene.bodies import BodyPoses

EXPOSURE_RAY_COUNT = 16
"""Fewest rays of a pixel whose rays have several times, with adaptive antialiasing."""
_THREAD_COUNT_MAX = 2**31 - 1
"""Kernels count in 32 bits."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderWorlds:
    """The worlds that one launch renders together, and how they differ."""

    count: int = 1
    """Number of worlds N."""
    lenses: Sequence[Lens] = ()
    """The lenses there are, all of one size; empty: every world has the lens of the renderer."""
    lens_of_world: Any = None
    """Index into `lenses` of each world, device array of int32, shape [N]; may change between renders."""
    scenes: Any = None
    """All scenes, device array of `SceneData`; None: every world is in the scene of the renderer."""
    scene_of_world: Any = None
    """Index into `scenes` of each world, device array of int32, shape [N]."""
    terms: RenderTerms | None = None
    """Terms of the kernel that some scene needs; None: as the scene of the renderer says."""


def ray_times_of(timing: RayTiming | None, lens: Lens, arrays: SceneArrays) -> RayTimes | None:
    """Return when the rays of a lens are cast, for `WarpRenderer`; None: all at the stamp.

    Adaptive antialiasing takes one time per pixel. Where a pixel has several, as in an exposure, there are at
    least EXPOSURE_RAY_COUNT rays in its place.
    """
    if timing is None:
        return None
    wanted = arrays.config.samples_per_pixel
    times = timing.times(lens, 1 if wanted == "adaptive" else wanted)
    if wanted == "adaptive" and times is not None and times.sample_count > 1:
        times = timing.times(lens, EXPOSURE_RAY_COUNT)
    return times


ONE_WORLD = RenderWorlds()
"""A single world."""


class WarpRenderer:
    """Renders K instants of one lens in N worlds per launch; `render` does not allocate.

    Instants are [world, K] in this order in all arrays: instant k of world n is row n K + k. On a device they
    are launched in the order world, tile, instant, pixel: the instants of a tile, which see the same
    triangles, run side by side. `render` neither allocates nor waits for a device. Outputs are those of
    `renderer.Renderer`.

    Attributes:
        rays: Rays of the pixels: direction in C and spread [rad], vec4, shape [layer, H * W]; of several
            lenses, one after the other.
        candidates: Candidate lists of tiles; None: rays traverse the tree.
        terms: What its kernels compute because of the scene, the settings, and the lens.
    """

    def __init__(
        self,
        arrays: SceneArrays,
        lens: Lens,
        *,
        outputs: Collection[str],
        instant_count: int,
        image_count: int = 1,
        worlds: RenderWorlds = ONE_WORLD,
        times: RayTimes | None = None,
    ) -> None:
        """Allocate the outputs and choose the kernel; parameters as of `make_renderer`.

        Raises:
            ValueError: An output is unknown, none is requested, the instants have more than 2^31 - 1 rays of
                a layer together, or the lens does not suit candidate lists.
        """
        self._worlds = worlds
        self._tile_count = -(-lens.width // TILE) * -(-lens.height // TILE)
        _check_thread_count(self._tile_count, lens, instant_count, worlds.count)
        self._arrays = arrays
        self._stride = instant_count
        self._times = times
        device = arrays.device
        lenses = worlds.lenses or (lens,)
        adaptive = arrays.config.samples_per_pixel == "adaptive" and requested_outputs(outputs).radiance
        adaptive = adaptive and (times is None or times.sample_count == 1)
        has_geometry = requested_outputs(outputs).geometry
        rays = np.concatenate([self._layers(each, adaptive, has_geometry) for each in lenses], axis=1)
        shared = self._choose_terms(rays, several=worlds.count > 1)
        rendered = {FACE, *outputs}.difference(RADIANCE) if adaptive else set(outputs)
        self._kernel = raycast_kernel(rendered, self.terms)
        self._fallback = fallback_kernel(rendered, self.terms)
        self._group = self.terms.instants_per_thread
        rays_together = TILE * TILE if self.terms.by_tile else PACKET if self.terms.embree else 1
        self._instant_threads = self._tile_count * TILE * TILE // rays_together
        self.rays: wp.array2d[wp.vec4] = wp.array(rays, dtype=wp.vec4, device=device)
        self._view = ViewData()
        self._view.rays, self._view.width, self._view.height = self.rays, lens.width, lens.height
        self._pose_count = 1 if times is None else len(times.offsets_ns)
        if times is not None:
            self._view.pose_count = self._pose_count
            pose = np.broadcast_to(times.instant, (len(rays), times.instant.shape[1]))
            self._view.pose = wp.array(pose, dtype=int, device=device)
        rows = worlds.count * instant_count * self._pose_count
        self._body_data = make_body_data(arrays.bodies, rows, device)
        self._view.worlds.stride = instant_count
        if worlds.scenes is not None:
            self._view.worlds.scenes, self._view.worlds.scene = worlds.scenes, worlds.scene_of_world
        if len(worlds.lenses) > 1:
            self._view.worlds.lens = worlds.lens_of_world
        self.candidates = None if shared is None else self._make_candidates(lens, rays, shared)
        if self.candidates is not None:
            self._view.candidates = self.candidates.data
        self._antialiasing = None
        if adaptive:
            fill_factor = arrays.config.fill_factor
            self._antialiasing = Antialiasing(
                np.concatenate([pixel_rays(each, fill_factor) for each in lenses], axis=1),
                outputs=outputs,
                terms=self.terms,
                device=device,
                pixel_count=worlds.count * instant_count * self._tile_count * TILE * TILE,
            )
        self._render_outputs = RenderOutputs()

        def allocate(name: str, shape: tuple[int, ...], dtype: object) -> wp.array | None:
            if name not in {*rendered, *outputs}:
                return None
            array = wp.zeros(shape, dtype=dtype, device=device)
            setattr(self._render_outputs, name, array)
            return array

        images = (image_count, lens.height, lens.width)
        instants = (worlds.count * instant_count, lens.height, lens.width)
        allocate(FACE, instants, int)
        self.log_radiance = allocate("log_radiance", instants, float)
        self.rgb = allocate("rgb", (*images, 3), wp.uint8)
        self.radiance = allocate("radiance", images, wp.vec3)
        self.depth = allocate("depth", images, float)
        self.range = allocate("range", images, float)
        self.normal = allocate("normal", images, wp.vec3)
        self.instance = allocate("instance", images, int)
        self.returns = allocate("returns", images, wp.vec3)
        self._blind = BlindPixels(
            lenses,
            worlds.lens_of_world if worlds.lenses else wp.zeros(worlds.count, dtype=int, device=device),
            stride=instant_count,
            dark_floor=arrays.config.dark_floor,
        )

    def render(
        self,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        *,
        instant_count: int,
        bodies: BodyPoses | None = None,
        active: Any = None,
    ) -> None:
        """Render the first `instant_count` poses of each world into the outputs; see `Renderer.render`.

        Raises:
            ValueError: The scene has bodies and there are no poses of them, or no `active` of several worlds.
        """
        count = self._worlds.count
        if count > 1 and active is None:
            raise ValueError(f"render() of {count} worlds needs `active`: 1 where a world is rendered")
        pose_count = instant_count if count == 1 else count * self._stride
        if self._arrays.bodies is not None:
            if bodies is None:
                names = ", ".join(body.name for body in self._arrays.bodies.bodies)
                raise ValueError(f"bodies move in this scene ({names}): render() needs their poses")
            rows = pose_count * self._pose_count
            device = self._arrays.device
            place_camera(self._body_data, bodies, p_WC, q_WC, instant_count=rows, device=device)
        if self.candidates is not None:
            self.candidates.update(self.rays, p_WC, q_WC, instant_count=pose_count)
        view = self._view
        if active is not None:
            view.worlds.active = active
        view.instant_count, view.p_WC, view.q_WC, view.image_slot = instant_count, p_WC, q_WC, image_slot
        inputs, outputs = [self._arrays.data, view, self._body_data], [self._render_outputs]
        dim = count * -(-instant_count // self._group) * self._instant_threads
        device = self._arrays.device
        launch_split(self._kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)
        if self._fallback is not None and self.candidates is not None:
            dim = self.candidates.data.fallback_threads
            launch_split(self._fallback, dim=dim, inputs=inputs, outputs=outputs, device=device)
        if self._antialiasing is not None:
            pixel_count = count * instant_count * self._tile_count * TILE * TILE
            self._antialiasing.launch(inputs, outputs, pixel_count=pixel_count, instant_count=instant_count)
        self._blind.darken(image_slot, self._render_outputs, instant_count=instant_count)

    def _layers(self, lens: Lens, adaptive: bool, has_geometry: bool) -> NDArray[np.float32]:
        """Return the rays of the first pass: of one layer, or that of the centres first."""
        config = self._arrays.config
        if self._times is not None and not adaptive:
            return ray_layers(lens, self._times.sample_count, config.fill_factor)
        if config.samples_per_pixel != "adaptive":
            return ray_layers(lens, config.samples_per_pixel, config.fill_factor)
        centres = ray_layers(lens, 1)
        if not adaptive:
            return centres
        first = first_rays(lens, config.fill_factor)[None]
        return np.concatenate([centres, first]) if has_geometry else first

    def _choose_terms(self, rays: NDArray[np.float32], *, several: bool) -> CandidateListConfig | None:
        """Set `terms`, and return how tiles share candidate lists, if they do."""
        arrays, worlds = self._arrays, self._worlds
        terms = (worlds.terms or arrays.terms)._replace(
            worlds=several,
            world_lenses=len(worlds.lenses) > 1,
            supersampled=len(rays) > 1,
            timed=self._times is not None,
            quads=wp.get_device(arrays.device).is_cuda and len(rays) % 4 == 1 and len(rays) > 1,
        )
        shared = None
        # lists change nothing but the speed
        if not (terms.timed or terms.world_scenes or terms.world_lenses):
            shared = choose_candidate_lists(
                arrays.config.candidate_lists,
                rays,
                instant_count=self._stride,
                face_count=arrays.face_origin.shape[0],
                is_cuda=wp.get_device(arrays.device).is_cuda,
                embree=bool(terms.embree),
            )
        group = 0
        if shared is not None and several:  # groups end with the instants of a world
            group = 1 << min(2, self._stride.bit_length() - 1)
        elif shared is not None:
            group = math.gcd(shared.instants, 4)
        self.terms = terms._replace(candidate_group=group, by_tile=terms.by_tile and group > 0)
        return shared

    def _make_candidates(
        self, lens: Lens, rays: NDArray[np.float32], config: CandidateListConfig
    ) -> CandidateLists:
        """Return the lists that the instants of a tile share in each world."""
        arrays, count = self._arrays, self._worlds.count
        if count > 1:
            changes = {"instants": self._stride}
            if arrays.config.candidate_lists == "auto":  # lists are counted in 32 bits
                most = _THREAD_COUNT_MAX // (count * self._tile_count)
                changes["face_count_max"] = min(config.face_count_max, most)
            config = config.model_copy(update=changes)
        return CandidateLists(
            arrays.data.tree,
            rays,
            width=lens.width,
            height=lens.height,
            extent_m=float(np.abs(arrays.scene.bounds_m).max()),
            config=config,
            instant_count=count * self._stride,
            has_fallback=self._fallback is not None,
        )


def _check_thread_count(tile_count: int, lens: Lens, instant_count: int, world_count: int) -> None:
    most = _THREAD_COUNT_MAX // (tile_count * TILE * TILE)
    if world_count * instant_count <= most:
        return
    if world_count > 1:
        raise ValueError(
            f"{world_count} worlds of {instant_count} instants of {lens.width} x {lens.height} px "
            "are more than 2^31 rays a step: take fewer worlds, or commands more often"
        )
    raise ValueError(
        f"{instant_count} instants of {lens.width} x {lens.height} px are more than 2^31 - 1 rays a "
        f"launch: at most {most} instants of this size (instants_per_launch), or take fewer pixels"
    )
