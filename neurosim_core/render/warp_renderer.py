# mypy: disable-error-code="attr-defined,var-annotated,type-arg,call-overload,assignment,no-any-return"
"""The renderer of the simulator: ray casting in Warp, the same source on CPU and CUDA."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.body_arrays import (
    make_body_data,
    place_camera,
)
from neurosim_core.render.camera import Lens
from neurosim_core.render.candidate_data import TILE, CandidateListData
from neurosim_core.render.candidate_lists import CandidateLists, choose_candidate_lists
from neurosim_core.render.embree import PACKET
from neurosim_core.render.launch import launch_split
from neurosim_core.render.lighting import (
    spread_order,
)
from neurosim_core.render.outputs import OUTPUTS, make_render_outputs
from neurosim_core.render.raycast import fallback_kernel, raycast_kernel
from neurosim_core.render.render_terms import instants_per_thread, with_candidate_lists
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.render.view_data import WorldData, make_view
from neurosim_core.scene.bodies import BodyPoses

_THREAD_COUNT_MAX = 2**31 - 1
"""Kernels count in 32 bits."""


def ray_layers(lens: Lens, sample_count: int) -> NDArray[np.float32]:
    """Return rays through the centres of pixels and, for several samples, through points spread over them.

    The points are a lattice: along rows and along columns each n-th of a pixel has one of the n.

    Returns:
        Direction in C and spread [rad], shape [1 or 1 + n, H * W, 4].
    """
    spread = lens.ray_spread()[..., None] / np.float32(np.sqrt(sample_count))
    offsets = [(0.5, 0.5)]
    if sample_count > 1:
        columns, rows = np.arange(sample_count), spread_order(sample_count)
        offsets += list(zip((columns + 0.5) / sample_count, (rows + 0.5) / sample_count, strict=True))
    layers = [np.concatenate([lens.ray_table(offset), spread], axis=-1).reshape(-1, 4) for offset in offsets]
    return np.stack(layers)


class WarpRenderer:
    """Renders K instants of one lens per launch. `render` neither allocates nor waits for a CUDA device.

    Outputs that are not requested are None. See `outputs.RenderOutputs` for what they are.

    Attributes:
        log_radiance: float32, shape [K, H, W].
        rgb: uint8, shape [M, H, W, 3].
        depth: float32, shape [M, H, W].
        normal: vec3, shape [M, H, W].
        instance: int32, shape [M, H, W].
        rays: Rays of the pixels: direction in C and spread [rad], vec4, shape [layer, H * W].
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
        thread_count: int | None = None,
    ) -> None:
        """Allocate the outputs and choose the kernel.

        Args:
            arrays: The scene; `upload_scene`.
            lens: Rays of the pixels.
            outputs: Some of "log_radiance", "rgb", "depth", "normal", "instance".
            instant_count: K, the most instants per launch.
            image_count: M, number of image slots.
            thread_count: Threads on a CPU device; all cores if None.

        Raises:
            ValueError: An output is unknown, none is requested, the instants have more than 2^31 - 1 rays of
            a
                layer together, or the lens does not suit candidate lists.
        """
        tiles = -(-lens.width // TILE) * -(-lens.height // TILE)
        most = _THREAD_COUNT_MAX // (tiles * TILE * TILE)
        if instant_count > most:
            raise ValueError(
                f"{instant_count} instants of {lens.width} x {lens.height} px are more than 2^31 - 1 rays a "
                f"launch: at most {most} instants of this size (instants_per_launch), or take fewer pixels"
            )
        rays = ray_layers(lens, arrays.config.samples_per_pixel)
        is_cuda = wp.get_device(arrays.device).is_cuda
        shared = choose_candidate_lists(
            arrays.config.candidate_lists,
            rays,
            instant_count=instant_count,
            face_count=arrays.face_origin.shape[0],
            is_cuda=is_cuda,
        )
        self.terms = terms = with_candidate_lists(arrays.terms, shared)
        self._kernel = raycast_kernel(outputs, terms)
        self._fallback = fallback_kernel(outputs, terms)
        self._group = instants_per_thread(terms)
        self._arrays = arrays
        self._thread_count = thread_count
        rays_together = TILE * TILE if terms.by_tile else PACKET if terms.embree else 1
        self._instant_threads = tiles * TILE * TILE // rays_together
        device = arrays.device
        self.rays: wp.array2d[wp.vec4] = wp.array(rays, dtype=wp.vec4, device=device)
        self._view = make_view(self.rays, lens.width, lens.height)
        self._body_data = make_body_data(arrays.bodies, instant_count, device)
        self._world_data = WorldData()
        self.candidates = None
        if shared is not None:
            self.candidates = CandidateLists(
                arrays.data.tree,
                rays,
                width=lens.width,
                height=lens.height,
                extent_m=float(np.abs(arrays.scene.bounds_m).max()),
                config=shared,
                instant_count=instant_count,
                has_fallback=self._fallback is not None,
                thread_count=thread_count,
            )
        self._candidate_data = CandidateListData() if self.candidates is None else self.candidates.data
        images = (image_count, lens.height, lens.width)

        def allocate(name: str, shape: tuple[int, ...], dtype: object) -> wp.array | None:
            return wp.zeros(shape, dtype=dtype, device=device) if name in outputs else None

        self.log_radiance = allocate("log_radiance", (instant_count, *images[1:]), float)
        self.rgb = allocate("rgb", (*images, 3), wp.uint8)
        self.depth = allocate("depth", images, float)
        self.normal = allocate("normal", images, wp.vec3)
        self.instance = allocate("instance", images, int)
        self._render_outputs = make_render_outputs(**{name: getattr(self, name) for name in OUTPUTS})

    def render(
        self,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        *,
        instant_count: int,
        bodies: BodyPoses | None = None,
    ) -> None:
        """Render the first `instant_count` poses into the outputs.

        Args:
            p_WC: Position of the camera [m], shape [K].
            q_WC: Orientation of the camera's optical frame, xyzw, shape [K].
            image_slot: Where the images of an instant go, shape [K]; -1: nowhere.
            instant_count: How many of the K instants are rendered.
            bodies: Where bodies are at the instants; not needed without bodies.

        Raises:
            ValueError: The scene has bodies and there are no poses of them.
        """
        if self._arrays.bodies is not None:
            if bodies is None:
                names = ", ".join(body.name for body in self._arrays.bodies.bodies)
                raise ValueError(f"bodies move in this scene ({names}): render() needs their poses")
            place_camera(
                self._arrays.bodies, bodies, p_WC, q_WC, instant_count=instant_count, data=self._body_data
            )
        if self.candidates is not None:
            self.candidates.update(self.rays, p_WC, q_WC, instant_count=instant_count)
        view = self._view
        view.instant_count, view.p_WC, view.q_WC, view.image_slot = instant_count, p_WC, q_WC, image_slot
        inputs = [self._arrays.data, view, self._body_data, self._world_data, self._candidate_data]
        outputs = [self._render_outputs]
        device = self._arrays.device
        launch_split(
            self._kernel,
            dim=-(-instant_count // self._group) * self._instant_threads,
            inputs=inputs,
            outputs=outputs,
            device=device,
            thread_count=self._thread_count,
        )
        if self._fallback is not None and self.candidates is not None:
            launch_split(
                self._fallback,
                dim=self.candidates.data.fallback_threads,
                inputs=inputs,
                outputs=outputs,
                device=device,
            )
