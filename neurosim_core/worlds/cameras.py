# mypy: disable-error-code="attr-defined,no-untyped-call,call-overload,union-attr"
"""One cast in many worlds: the poses of all vehicles in, pictures and events out, in one launch each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.body_arrays import make_body_data, place_camera
from neurosim_core.render.candidate_data import TILE, CandidateListData
from neurosim_core.render.candidate_lists import CandidateLists, choose_candidate_lists
from neurosim_core.render.config import CandidateListConfig
from neurosim_core.render.embree import PACKET
from neurosim_core.render.launch import launch_split
from neurosim_core.render.outputs import make_render_outputs
from neurosim_core.render.raycast import fallback_kernel, raycast_kernel
from neurosim_core.render.render_terms import instants_per_thread, with_candidate_lists
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.render.view_data import WorldData, make_view
from neurosim_core.render.warp_renderer import ray_layers
from neurosim_core.scene.bodies import BodyConfig, make_body_poses, pose_bodies, upload_motions
from neurosim_core.sensors.rig import Cast, EventSensorConfig, ImageSensorConfig
from neurosim_core.vehicle import Multirotor
from neurosim_core.worlds import flight
from neurosim_core.worlds.parameters import Rig, lens_tables
from neurosim_core.worlds.scenes import SceneTable
from neurosim_core.worlds.world_events import WorldEventCamera

_INDEX_MAX = 2**31 - 1
"""Threads of a launch and events of all worlds are counted in 32 bits."""


class WorldCast:
    """The device buffers of one cast in all worlds.

    Instants are rendered into [world, K, H, W], and launched in the order world, tile, instant, pixel: the
    instants of a tile, which see the same triangles, run side by side, and then the next tile of the world.

    Args:
        cast: Which cameras it serves.
        rigs: The sensors of each world.
        scenes: What they look at.
        instant_count: K, the most instants of one step.
        capacity: Room for events of one world in one step; None: twice the pixels.
        seeds: Of each world.
        bodies: What moves in the scene.
        ordered: Sort events.

    Attributes:
        pictures: The last picture of each image camera by name, shape [world, H, W] or [world, H, W, 3].
        events: The event cameras by name.
        parity: Which of their two states is the present one; a step with a frame goes on to the other.

    Raises:
        ValueError: A camera has what only single runs have, or there is more than one launch can do.
    """

    def __init__(
        self,
        cast: Cast,
        rigs: Sequence[Rig],
        scenes: SceneTable,
        *,
        instant_count: int,
        capacity: int | None,
        seeds: Sequence[int],
        bodies: Mapping[str, BodyConfig],
        ordered: bool,
    ) -> None:
        arrays, terms = scenes.first, scenes.terms
        assert arrays is not None
        assert terms is not None
        _check(cast, rigs[0])
        world_count = len(rigs)
        self._device = device = arrays.device
        self._count = world_count
        self._stride = instant_count
        self._size = cast.lens.width, cast.lens.height
        lenses, chosen = lens_tables(cast, rigs)
        terms = terms._replace(world_lenses=len(lenses) > 1)
        rays = np.concatenate([ray_layers(lens, arrays.config.samples_per_pixel) for lens in lenses], axis=1)
        walk = None
        if not (terms.world_scenes or terms.world_lenses):  # walks change nothing but the speed
            walk = choose_candidate_lists(
                arrays.config.candidate_lists,
                rays,
                instant_count=instant_count,
                face_count=arrays.face_origin.shape[0],
                is_cuda=wp.get_device(device).is_cuda,
            )
        # groups end with the instants of a world
        terms = with_candidate_lists(terms, walk, group=1 << min(2, instant_count.bit_length() - 1))
        self._group = instants_per_thread(terms)
        room = capacity or max(1024, 2 * cast.lens.width * cast.lens.height)
        if cast.event_cameras and world_count * room > _INDEX_MAX:
            raise ValueError(
                f"{world_count} worlds with room for {room} events each are more than 2^31: give a smaller "
                f"event_capacity, at most {_INDEX_MAX // world_count}, or take fewer worlds"
            )
        tiles = -(-cast.lens.width // TILE) * -(-cast.lens.height // TILE)
        rays_together = TILE * TILE if terms.by_tile else PACKET if terms.embree else 1
        self._instant_threads = tiles * TILE * TILE // rays_together
        if world_count * instant_count * tiles * TILE * TILE > _INDEX_MAX:
            raise ValueError(
                f"{world_count} worlds of {instant_count} instants of {self._size[0]} x {self._size[1]} px "
                "are more than 2^31 rays a step: take fewer worlds, or commands more often"
            )
        self._kernel = raycast_kernel(cast.outputs, terms)
        self._fallback = fallback_kernel(cast.outputs, terms)
        self._rays: Any = wp.array(rays, dtype=wp.vec4, device=device)
        self._scene = arrays.data
        self._walk = None if walk is None else self._make_walk(arrays, rays, walk)
        self._candidate_data = CandidateListData() if self._walk is None else self._walk.data
        self._worlds = self._make_worlds(scenes, chosen if len(lenses) > 1 else None)
        self._p_BC = wp.vec3d(*cast.mount.position_m)
        self._q_BC = wp.quatd(*cast.mount.optical_quaternion())
        self._p_WC = wp.zeros(world_count * instant_count, dtype=wp.vec3, device=device)
        self._q_WC = wp.zeros(world_count * instant_count, dtype=wp.quat, device=device)
        self._view = make_view(self._rays, *self._size)
        self._view.p_WC, self._view.q_WC = self._p_WC, self._q_WC
        self._bodies = arrays.bodies
        self._make_bodies(bodies)
        self.parity = 0
        self._slots: dict[tuple[int, bool], Any] = {}
        shape = (world_count, cast.lens.height, cast.lens.width)
        frames = (world_count * instant_count, *shape[1:])
        made = {
            "log_radiance": (frames, float),
            "rgb": ((*shape, 3), wp.uint8),
            "depth": (shape, float),
        }
        self._outputs: dict[str, Any] = {
            name: wp.zeros(size, dtype=dtype, device=device) if name in cast.outputs else None
            for name, (size, dtype) in made.items()
        }
        self._render_outputs = make_render_outputs(**self._outputs)
        self.pictures: dict[str, Any] = {}
        self._own: dict[str, Any] = {}
        """Of image cameras that look less often than another of their kind in the cast, or than the cast."""
        self._make_pictures(cast, rigs[0])
        self.events = {
            name: WorldEventCamera(
                [rig[name].pixel for rig in rigs],
                width=cast.lens.width,
                height=cast.lens.height,
                frames=self._outputs["log_radiance"].reshape(
                    (world_count, instant_count, cast.lens.width * cast.lens.height)
                ),
                capacity=room,
                sensor=name,
                seeds=seeds,
                ordered=ordered,
            )
            for name in cast.event_cameras
        }

    def begin(self, vehicle: Multirotor, clock_ns: Any) -> None:
        """Note where the cameras are at stamp 0, for all instants: there is none without a pose."""
        for instant in range(self._stride):
            self.place(vehicle, clock_ns, instant, 0)

    def place(self, vehicle: Multirotor, clock_ns: Any, instant: int, offset_ns: int) -> None:
        """Note where the cameras are at an instant of a step, `offset_ns` after its begin; one launch."""
        wp.launch(
            flight.place_cameras,
            dim=self._count,
            inputs=[
                self._p_BC,
                self._q_BC,
                self._stride,
                vehicle.arrays.position,
                vehicle.arrays.orientation,
                clock_ns,
                instant,
                offset_ns,
            ],
            outputs=[self._p_WC, self._q_WC, self._stamps],
            device=self._device,
        )

    def prepare(self, offsets_ns: tuple[int, ...], *, picture: bool) -> None:
        """Allocate what depends on a pattern, so that `render` and the scan do not."""
        self._slots_of(len(offsets_ns) - 1, picture)
        for camera in self.events.values():
            camera.offsets(offsets_ns)

    def render(self, instant_count: int, names: Sequence[str], active: Any) -> None:
        """Render the first instants of all worlds; launches only.

        Args:
            instant_count: How many instants of each world.
            names: Image cameras that take a picture at the last of them.
            active: 1: this world is rendered, device array of int32, shape [world].
        """
        if self._bodies is not None:
            everywhere = self._count * self._stride
            pose_bodies(self._motions, self._stamps, self._everywhere, count=everywhere, poses=self._poses)
            place_camera(
                self._bodies,
                self._poses,
                self._p_WC,
                self._q_WC,
                instant_count=everywhere,
                data=self._body_data,
            )
        if self._walk is not None:
            self._walk.update(self._rays, self._p_WC, self._q_WC, instant_count=self._count * self._stride)
        self._worlds.active = active
        self._view.instant_count = instant_count
        self._view.image_slot = self._slots_of(instant_count, bool(names))
        inputs = [self._scene, self._view, self._body_data, self._worlds, self._candidate_data]
        outputs = [self._render_outputs]
        dim = self._count * -(-instant_count // self._group) * self._instant_threads
        launch_split(self._kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)
        if self._fallback is not None and self._walk is not None:
            dim = self._walk.data.fallback_threads
            launch_split(self._fallback, dim=dim, inputs=inputs, outputs=outputs, device=self._device)
        for name in names:
            if name in self._own:
                wp.copy(self.pictures[name], self._own[name])

    def _make_worlds(self, scenes: SceneTable, lens: list[int] | None) -> Any:
        worlds = WorldData()
        worlds.stride = self._stride
        if scenes.data is not None:
            worlds.scenes = scenes.data
            worlds.scene = scenes.scene
        if lens is not None:
            worlds.lens = wp.array(lens, dtype=int, device=self._device)
        return worlds

    def _make_walk(
        self, arrays: SceneArrays, rays: NDArray[np.float32], config: CandidateListConfig
    ) -> CandidateLists:
        """Return walks that the instants of a tile share in each world."""
        changes = {"instants": self._stride}
        if arrays.config.candidate_lists == "auto":  # lists are counted in 32 bits
            tiles = -(-self._size[0] // TILE) * -(-self._size[1] // TILE)
            changes["face_count_max"] = min(config.face_count_max, _INDEX_MAX // (self._count * tiles))
        return CandidateLists(
            arrays.data.tree,
            rays,
            width=self._size[0],
            height=self._size[1],
            extent_m=float(np.abs(arrays.scene.bounds_m).max()),
            config=config.model_copy(update=changes),
            instant_count=self._count * self._stride,
            has_fallback=self._fallback is not None,
        )

    def _make_bodies(self, bodies: Mapping[str, BodyConfig]) -> None:
        everywhere = self._count * self._stride if self._bodies is not None else 0
        self._stamps: Any = wp.zeros((everywhere, 1), dtype=wp.int64, device=self._device)
        self._body_data = make_body_data(self._bodies, everywhere, self._device)
        if self._bodies is not None:
            self._motions = upload_motions(bodies, self._device)
            self._poses = make_body_poses(everywhere, len(bodies), self._device)
            places = np.arange(everywhere, dtype=np.int32)
            self._everywhere: Any = wp.array(places, dtype=int, device=self._device)

    def _make_pictures(self, cast: Cast, rig: Rig) -> None:
        rates = {name: rig[name].rate_hz for name in cast.image_cameras}
        for name, rate_hz in rates.items():
            output = self._outputs[rig[name].kind]
            if rate_hz < max(rates.values()):
                self._own[name] = output
                output = wp.empty_like(output)
            self.pictures[name] = output

    def _slots_of(self, instant_count: int, picture: bool) -> Any:
        """Return where the pictures of instants go: that of the last instant to the place of its world."""
        key = instant_count, picture
        if key not in self._slots:
            slots = np.full((self._count, self._stride), -1, dtype=np.int32)
            if picture:
                slots[:, instant_count - 1] = np.arange(self._count)
            self._slots[key] = wp.array(slots.reshape(-1), dtype=int, device=self._device)
        return self._slots[key]


def _check(cast: Cast, rig: Rig) -> None:
    if cast.max_displacement_px is not None:
        raise ValueError(
            f"max_displacement_px of {', '.join(cast.event_cameras)} is for single runs: it chooses what to "
            "render for one vehicle, on the host"
        )
    for name in cast.names:
        sensor = rig[name]
        if isinstance(sensor, EventSensorConfig) and sensor.pixel.readout is not None:
            raise ValueError(
                f"readout of {name!r} is for single runs: events wait for each other on the host"
            )
        assert isinstance(sensor, EventSensorConfig | ImageSensorConfig)
