# mypy: disable-error-code="attr-defined,call-overload"
"""The device buffers of a render group, in all worlds. `cameras.py` renders batches into them.

A render group is a set of cameras that share mount, lens and clock, and therefore rays. Each batch in flight
has its own renderer and buffers, which keep its pictures until they are read. All arrays of instants are in
the order [world, K].
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import Rate
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.outputs import INSTANT_OUTPUTS
from neurosim_core.render.ray_times import RayTimes
from neurosim_core.render.renderer import (
    Renderer,
    RenderWorlds,
    make_renderer,
)
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.render.warp_renderer import ray_times_of
from neurosim_core.runtime.cuda import HostCopy, HostInput
from neurosim_core.scene.bodies import (
    BodyConfig,
    BodyPoses,
    Motion,
    make_body_poses,
    upload_motions,
)
from neurosim_core.sensors.base import (
    FrameContext,
    FrameSensor,
    FrameSensorConfig,
    PictureContext,
    PictureProcess,
    PictureSensorConfig,
    SensorConfig,
)
from neurosim_core.sensors.render_plan import RenderGroup
from neurosim_core.sim.model import Model
from neurosim_core.sim.parameters import WorldSettings, lens_tables

if TYPE_CHECKING:
    from neurosim_core.sensors.displacement import DisplacementRule

PictureAllocator = Callable[[str, int, NDArray[Any]], NDArray[Any] | None]
"""Returns a buffer for a camera's picture of a stamp [ns], of the shape and dtype of the given array, or
None. On a CUDA device the buffer is pinned, and holds the picture once the device has finished the batch."""


@dataclass(kw_only=True, eq=False)
class ImageChannel:
    """An image sensor of a group."""

    config: PictureSensorConfig
    rate: Rate
    source: str
    """Name of the array that holds its pictures: an output of the renderer, or of its own processing."""
    constants: Mapping[str, Any] = field(default_factory=dict)
    """Packet fields that are the same in all its packets."""
    sequence: int = 0
    """Sequence number of its next packet."""
    gives_images: bool = False
    """Its last packet was an `Image`, so the next picture may be a view."""

    @property
    def output(self) -> str:
        """The render output that its pictures are made of."""
        return self.config.output


@dataclass(kw_only=True, eq=False)
class BatchBuffers:
    """The buffers that a group writes for one batch in flight."""

    renderer: Renderer
    copies: Mapping[str, HostCopy]
    """Host copies of pictures, by source; empty if pictures stay on the device."""
    processes: Mapping[str, PictureProcess]
    """Processing of pictures on the device, by the name of the sensor."""
    p_WC: wp.array[wp.vec3]
    """Positions of the camera at the instants [m], shape [N K]; [N K J] for rays with times of their own."""
    q_WC: wp.array[wp.quat]
    """Orientations of the camera at the instants, xyzw, same shape."""
    stamps: Any
    """Times of the instants [ns], shape [N K, 1] or [N K J, 1]; empty if neither bodies nor processing need
    them."""
    bodies: BodyPoses | None
    """Poses of bodies at the instants; None: there are no bodies."""
    chosen_slots: HostInput | None
    """Trace slots of the ticks that an adaptive group chose; None: the group renders all ticks."""


@dataclass(kw_only=True, eq=False)
class RenderGroupState:
    """The device buffers of one group, for batches of at most `capacity` instants."""

    plan: RenderGroup
    device: str
    world_count: int
    capacity: int
    """K, the largest number of instants of one batch in each world."""
    picture_count: int
    """M, the largest number of pictures of one batch in each world."""
    rate: Rate
    """Clock of the group."""
    worlds: RenderWorlds
    """Lens and scene of each world."""
    times: RayTimes | None
    """Times of the rays, relative to the instant; None: all rays are cast at the instant."""
    images: dict[str, ImageChannel]
    """The image sensors, by name."""
    buffers: Sequence[BatchBuffers] = ()
    """One for each batch in flight."""
    frames: dict[str, FrameSensor] = field(default_factory=dict)
    """The frame sensors, by name."""
    referenced: set[str] = field(default_factory=set)
    """Frame sensors that have a reference frame and have scanned every rendered instant since."""
    pictures: dict[str, Any] = field(default_factory=dict)
    """The last picture of each image sensor, if pictures stay on the device: arrays [N, H, W, ...]."""
    shared_pictures: dict[str, Any] = field(default_factory=dict)
    """Renderer outputs to copy into `pictures`, for image sensors slower than another one of the group."""
    p_BC: Any
    """Position of the camera on the body in each world [m], vec3d, shape [N]."""
    q_BC: Any
    """Its orientation there, xyzw, quatd, shape [N]."""
    offsets_ns: Any
    """The J ray times relative to the instant [ns], device array; [0] if all rays are cast at the stamp."""
    instants: Any
    """0, 1, ... N K J - 1: indices of the poses of a batch."""
    motions: wp.array[Motion] | None
    """Motions of the bodies; None: there are no bodies."""
    slots: dict[Hashable, wp.array[int]] = field(default_factory=dict)
    """Cache of slot lists on the device. Keys contain the batch in flight, because a list that is uploaded on
    the stream of one batch is not visible to the stream of another."""
    rule: DisplacementRule | None
    """Chooses the ticks that are rendered; None: all ticks are rendered."""
    only_launches: bool
    """See `RendererConfig.only_launches`."""
    allocate_picture: PictureAllocator | None
    """Returns buffers of the caller for pictures; None: pictures are copied to buffers of the engine."""


def make_render_groups(
    model: Model,
    worlds: WorldSettings,
    *,
    seeds: Any,
    history: Any,
    clock_ns: Any,
    in_flight: int,
    on_host: bool,
    allocate_picture: PictureAllocator | None,
) -> list[RenderGroupState]:
    """Allocate the buffers of all groups; there are none if the model has no cameras.

    `seeds` is a device array of uint64, `clock_ns` one of int64, both of shape [N]; `history` is the recorded
    motion for sensors that look back. With `on_host`, pictures and events become packets, and
    `allocate_picture` may return buffers for pictures.

    Raises:
        ValueError: A group is adaptive and its renderer or lens does not support that; or an adaptive group
            or an image sensor does not support many worlds.
    """
    groups: list[RenderGroupState] = []
    for index, plan in enumerate(model.groups if model.scene_on_device is not None else ()):
        if not on_host and plan.max_displacement_px is not None:
            raise ValueError(
                f"max_displacement_px of {', '.join(plan.frame_sensors)} is for single runs only: the "
                "host chooses the instants of one vehicle"
            )
        capacity = model.schedule.ticks_per_batch(index) if on_host else worlds.instant_count
        sensors = {name: model.config.sensors[name] for name in plan.frame_sensors}
        frames = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, FrameSensorConfig)}
        capacities = {  # checked before anything is allocated
            name: 0 if on_host else sensor.world_capacity(len(worlds.seeds), worlds.event_capacity)
            for name, sensor in frames.items()
        }
        group = _make_group(plan, model, worlds, capacity, allocate_picture, on_host=on_host)
        group.buffers = [
            _make_buffers(group, model, worlds, seeds, on_host=on_host) for _ in range(in_flight)
        ]
        if not on_host:
            group.pictures, group.shared_pictures = _picture_arrays(group)
        group.frames = {
            name: sensor.make(
                FrameContext(
                    name=name,
                    configs=[rig[name] for rig in worlds.rigs],
                    lens=plan.lens,
                    device=model.device,
                    on_host=on_host,
                    in_flight=in_flight,
                    instant_count=capacity,
                    capacity=capacities[name],
                    ordered=worlds.ordered,
                    seeds=worlds.seeds,
                    clock_ns=clock_ns,
                    scene=model.scene_on_device,
                    motions=group.motions,
                    history=history,
                    p_BC=wp.vec3d(*plan.mount.position_m),
                    q_BC=wp.quatd(*plan.mount.optical_quaternion()),
                )
            )
            for name, sensor in frames.items()
        }
        groups.append(group)
    return groups


def _make_group(
    plan: RenderGroup,
    model: Model,
    worlds: WorldSettings,
    capacity: int,
    allocate_picture: PictureAllocator | None,
    *,
    on_host: bool,
) -> RenderGroupState:
    """Return a group without buffers and frame sensors."""
    device, count, scene, bodies = model.device, len(worlds.seeds), model.scene_on_device, model.config.bodies
    images = _image_channels(plan, model.config.sensors, on_host=on_host)
    times = _ray_times(plan, scene)
    offsets_ns = [0] if times is None else times.offsets_ns
    row_count = count * capacity * len(offsets_ns)
    motions = upload_motions(bodies, device, world_count=count) if bodies else None
    p_BC, q_BC = wp.vec3d(*plan.mount.position_m), wp.quatd(*plan.mount.optical_quaternion())
    return RenderGroupState(
        plan=plan,
        device=device,
        world_count=count,
        capacity=capacity,
        picture_count=_picture_count(plan, images, capacity) if on_host else 1,
        rate=plan.rate,
        worlds=_render_worlds(plan, worlds, device),
        times=times,
        images=images,
        p_BC=wp.full(count, p_BC, dtype=wp.vec3d, device=device),
        q_BC=wp.full(count, q_BC, dtype=wp.quatd, device=device),
        offsets_ns=wp.array(offsets_ns, dtype=wp.int64, device=device),
        instants=wp.array(np.arange(row_count, dtype=np.int32), dtype=int, device=device),
        motions=motions,
        rule=_make_rule(plan, scene, p_BC, q_BC, motions),
        only_launches=model.config.renderer.only_launches,
        allocate_picture=allocate_picture,
    )


def _make_buffers(
    group: RenderGroupState, model: Model, worlds: WorldSettings, seeds: Any, *, on_host: bool
) -> BatchBuffers:
    """Allocate the buffers of one batch; also sets constants and sources of the image channels."""
    renderer = make_renderer(
        model.scene_on_device,
        group.plan.lens,
        outputs=group.plan.outputs,
        instant_count=group.capacity,
        image_count=group.world_count * group.picture_count,
        worlds=group.worlds,
        times=group.times,
    )
    processes: dict[str, PictureProcess] = {}
    for name, image in group.images.items():
        context = PictureContext(
            name=name,
            source=getattr(renderer, image.output),
            sources={output: getattr(renderer, output) for output in image.config.outputs},
            lenses=group.worlds.lenses,
            lens_of_world=group.worlds.lens_of_world,
            scenes=[scene.scene_on_device for scene in worlds.scenes.models],
            scene_of_world=worlds.scenes.scene,
            motions=group.motions,
            times=group.times,
            stride=group.capacity,
            seeds=seeds,
        )
        image.constants = image.config.constants(context)
        if (process := image.config.make_process(context)) is not None:
            processes[name] = process
            image.source = f"{name}/processed"
    sources = {
        image.source: processes[name].picture if name in processes else getattr(renderer, image.output)
        for name, image in group.images.items()
    }
    device, body_count, row_count = group.device, len(model.config.bodies), group.instants.shape[0]
    timed_rows = row_count if body_count or processes else 0
    adaptive = group.plan.max_displacement_px is not None
    return BatchBuffers(
        renderer=renderer,
        copies={source: HostCopy(array) for source, array in sources.items()} if on_host else {},
        processes=processes,
        p_WC=wp.zeros(row_count, dtype=wp.vec3, device=device),
        q_WC=wp.zeros(row_count, dtype=wp.quat, device=device),
        stamps=wp.zeros((timed_rows, 1), dtype=wp.int64, device=device),
        bodies=make_body_poses(row_count, body_count, device) if body_count else None,
        chosen_slots=HostInput(wp.zeros(group.capacity, int, device=device)) if adaptive else None,
    )


def _render_worlds(group: RenderGroup, worlds: WorldSettings, device: str) -> RenderWorlds:
    """Return lens and scene of each world."""
    lenses, lens_of_world = lens_tables(group, worlds)
    return RenderWorlds(
        count=len(worlds.seeds),
        lenses=lenses,
        lens_of_world=wp.array(lens_of_world, dtype=int, device=device),
        scenes=worlds.scenes.data,
        scene_of_world=worlds.scenes.row,
        terms=worlds.scenes.terms,
    )


def _image_channels(
    group: RenderGroup, sensors: Mapping[str, SensorConfig], *, on_host: bool
) -> dict[str, ImageChannel]:
    """Return the image sensors of a group, by name."""
    images = {
        name: ImageChannel(config=sensor, rate=sensor.clock, source=sensor.output)
        for name in group.image_sensors
        if isinstance(sensor := sensors[name], PictureSensorConfig)
    }
    instant_outputs = [name for name, image in images.items() if image.output in INSTANT_OUTPUTS]
    if instant_outputs and not on_host:
        raise ValueError(
            f"{', '.join(instant_outputs)}: pictures of log radiance are for single runs; in worlds, "
            "`rgb` and the results of event cameras stay on the device"
        )
    return images


def _ray_times(group: RenderGroup, scene: Any) -> RayTimes | None:
    """Return the times at which the rays of a group are cast; None: all at the stamp."""
    if group.timing is None:
        return None
    if not isinstance(scene, SceneArrays):
        names = ", ".join(group.names)
        raise ValueError(
            f"{names}: a shutter or LiDAR, whose rays have different times, needs renderer: warp"
        )
    return ray_times_of(group.timing, group.lens, scene)


def _picture_arrays(group: RenderGroupState) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the array of the last picture of each image sensor, and outputs to copy into some of them."""
    images, buffers = group.images, group.buffers[0]
    fastest_hz = max((image.rate.rate_hz for image in images.values()), default=0.0)
    pictures = {name: getattr(buffers.renderer, image.output) for name, image in images.items()}
    pictures |= {name: process.picture for name, process in buffers.processes.items()}
    shared = {n: pictures[n] for n, image in images.items() if image.rate.rate_hz < fastest_hz}
    return pictures | {name: wp.empty_like(array) for name, array in shared.items()}, shared


def _picture_count(group: RenderGroup, images: Mapping[str, ImageChannel], capacity: int) -> int:
    """Return the largest number of pictures in a batch; cameras may alternate.

    n consecutive ticks of the group contain at most floor((n - 1) / m) + 1 of every m-th tick.
    """
    most = sum(int(capacity * i.rate.rate_hz / group.rate.rate_hz) + 1 for i in images.values())
    return max(1, min(capacity, most))


def move_bodies(groups: Iterable[RenderGroupState], bodies: Mapping[str, BodyConfig]) -> None:
    """Give the bodies other motions from now on; waits for the device.

    Args:
        groups: All render groups of a state; no render may be in flight.
        bodies: Settings of all bodies, by name, in the order of the model; only `motion` may differ.
    """
    for group in groups:
        if group.motions is not None:
            wp.copy(group.motions, upload_motions(bodies, group.device))
            wp.synchronize_device(group.device)
            if group.rule is not None:
                group.rule.begin_again()


def _make_rule(
    group: RenderGroup, scene: Any, p_BC: wp.vec3d, q_BC: wp.quatd, motions: Any
) -> DisplacementRule | None:
    if group.max_displacement_px is None:
        return None
    if not isinstance(scene, SceneArrays):
        raise ValueError(
            f"max_displacement_px of {', '.join(group.frame_sensors)} needs the renderer 'warp': "
            "others do not measure how far points move"
        )
    if not isinstance(group.lens, PinholeConfig):
        raise ValueError(
            f"max_displacement_px of {', '.join(group.frame_sensors)} needs a lens of kind pinhole, got "
            f"{getattr(group.lens, 'kind', 'none')}: without max_displacement_px all ticks are rendered"
        )
    from neurosim_core.sensors.displacement import DisplacementRule  # whose kernels few runs need

    return DisplacementRule(
        scene,
        group.lens,
        max_displacement_px=group.max_displacement_px,
        rate=group.rate,
        p_BC=p_BC,
        q_BC=q_BC,
        motions=motions,
    )


def render_terms(group: RenderGroupState) -> tuple[str, ...]:
    """Return the optional terms that are compiled into a group, besides its outputs."""
    renderer = group.buffers[0].renderer
    terms = getattr(renderer, "terms", None)  # only the renderer `warp` compiles a kernel for its terms
    present = {} if terms is None else terms._asdict()
    if getattr(renderer, "antialiased", False):
        present |= {"supersampled": False, "antialiased": True}
    made = (term for process in group.buffers[0].processes.values() for term in process.terms)
    return (*(name for name, value in present.items() if value), *made)
