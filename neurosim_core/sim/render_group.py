# mypy: disable-error-code="attr-defined,call-overload"
"""The device buffers of one render group, in all worlds; `cameras.py` takes batches through them.

Several batches may be in flight. Each has a renderer of its own: what a batch saw stays until it has been
read. Instants are [world, K] in this order in all arrays.
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
"""Returns memory for a camera's picture of a stamp [ns], like the one that is given; None: there is none.
On a CUDA device it is pinned, and the picture is there when the device has finished with the batch."""


@dataclass(kw_only=True, eq=False)
class ImageChannel:
    """An image sensor of a group."""

    config: PictureSensorConfig
    rate: Rate
    source: str
    """Its pictures are those of this output of the renderer, or those that its own processing makes."""
    constants: Mapping[str, Any] = field(default_factory=dict)
    """Fields that all its packets have."""
    sequence: int = 0
    gives_images: bool = False
    """Its last packet was an `Image`: pictures of its next one may be lent."""

    @property
    def output(self) -> str:
        """The render outputs that it needs."""
        return self.config.output


@dataclass(kw_only=True, eq=False)
class BatchBuffers:
    """The buffers that a group writes for one batch in flight."""

    renderer: Renderer
    copies: Mapping[str, HostCopy]
    """Pictures on the host by source; empty: they stay on the device."""
    processes: Mapping[str, PictureProcess]
    """Processing of pictures on the device, by the name of the sensor."""
    p_WC: wp.array[wp.vec3]
    """Positions of the camera at the instants [m], shape [N K]; [N K J] where rays have own times."""
    q_WC: wp.array[wp.quat]
    stamps: Any
    """Times of the instants [ns], shape [N K, 1], or [N K J, 1]; empty if nobody asks."""
    bodies: BodyPoses | None
    """Poses of bodies at the instants; None: nothing moves but the vehicle."""
    chosen_slots: HostInput | None
    """Slots of the ticks chosen, which do not come again; None: all ticks are rendered."""


@dataclass(kw_only=True, eq=False)
class RenderGroupState:
    """The device buffers of one group, for batches of at most `capacity` instants."""

    plan: RenderGroup
    device: str
    world_count: int
    capacity: int
    """K, the most instants of one batch in each world."""
    picture_count: int
    """M, the most pictures of one batch in each world."""
    rate: Rate
    worlds: RenderWorlds
    """The cameras that are rendered together."""
    times: RayTimes | None
    """When rays are cast; None: at the instant."""
    images: dict[str, ImageChannel]
    buffers: Sequence[BatchBuffers] = ()
    """One for each batch in flight."""
    frames: dict[str, FrameSensor] = field(default_factory=dict)
    """The frame sensors."""
    watching: set[str] = field(default_factory=set)
    """Frame sensors that have a reference, and saw every instant that was rendered since."""
    pictures: dict[str, Any] = field(default_factory=dict)
    """The last picture of each image sensor, where they stay on the device: arrays [N, H, W, ...]."""
    shared_pictures: dict[str, Any] = field(default_factory=dict)
    """Pictures of the renderer, for image sensors whose last picture another one of the group replaces."""
    p_BC: Any
    """Position of the camera on the body in each world [m], vec3d, shape [N]."""
    q_BC: Any
    """Its orientation there, xyzw, quatd, shape [N]."""
    offsets_ns: Any
    """From an instant to its J rays [ns], device array; [0] where all are cast at the instant."""
    instants: Any
    """0, 1, ... N K J - 1: the rows of the poses of a batch in order."""
    motions: wp.array[Motion] | None
    """Of the bodies; None: nothing moves but the vehicle."""
    slots: dict[Hashable, wp.array[int]] = field(default_factory=dict)
    """Lists of slots on the device by batch in flight: the same few come again and again. What one uploads on
    its stream is not there yet for another, whose stream does not wait for it."""
    rule: DisplacementRule | None
    """Chooses the ticks that are rendered; None: all are."""
    only_launches: bool
    """See `RendererConfig.only_launches`."""
    allocate_picture: PictureAllocator | None
    """Gives memory that pictures are copied to as a part of the rendering; None: they get their own."""


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
    """Allocate the buffers of all groups; there are none where the scene is not on the device.

    Seeds are those of each world, device array of uint64; the history is for sensors that look back, and the
    clock that of each world. With `on_host` pictures and events become packets, and `allocate_picture` may
    give memory to copy a picture to.

    Raises:
        ValueError: The renderer cannot say what moves how far, and a group is adaptive; or a picture, or an
            adaptive group, is not for many worlds.
    """
    groups: list[RenderGroupState] = []
    for index, plan in enumerate(model.groups if model.scene_on_device is not None else ()):
        if not on_host and plan.max_displacement_px is not None:
            raise ValueError(
                f"max_displacement_px of {', '.join(plan.frame_sensors)} is for single runs: it chooses "
                "what to render for one vehicle, on the host"
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
    """Allocate what one batch writes; constants and sources of the images are set."""
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
    """Return who is rendered together."""
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
    """Return when the rays of a group are cast; None: all at the stamp."""
    if group.timing is None:
        return None
    if not isinstance(scene, SceneArrays):
        names = ", ".join(group.names)
        raise ValueError(f"{names}: rays with times of their own need renderer: warp")
    return ray_times_of(group.timing, group.lens, scene)


def _picture_arrays(group: RenderGroupState) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return where the last picture of each image sensor is, and what has to be copied there from where."""
    images, buffers = group.images, group.buffers[0]
    fastest_hz = max((image.rate.rate_hz for image in images.values()), default=0.0)
    pictures = {name: getattr(buffers.renderer, image.output) for name, image in images.items()}
    pictures |= {name: process.picture for name, process in buffers.processes.items()}
    shared = {n: pictures[n] for n, image in images.items() if image.rate.rate_hz < fastest_hz}
    return pictures | {name: wp.empty_like(array) for name, array in shared.items()}, shared


def _picture_count(group: RenderGroup, images: Mapping[str, ImageChannel], capacity: int) -> int:
    """Return the most pictures of a batch; cameras may alternate.

    Of n consecutive ticks of the group, every m-th is at most floor((n - 1) / m) + 1.
    """
    most = sum(int(capacity * i.rate.rate_hz / group.rate.rate_hz) + 1 for i in images.values())
    return max(1, min(capacity, most))


def move_bodies(groups: Iterable[RenderGroupState], bodies: Mapping[str, BodyConfig]) -> None:
    """Let the same bodies move otherwise from now on; waits for the device.

    Args:
        groups: All render groups of a state; nothing may be being rendered.
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
            "the others do not know where things are"
        )
    if not isinstance(group.lens, PinholeConfig):
        raise ValueError(
            f"max_displacement_px of {', '.join(group.frame_sensors)} needs a lens of kind pinhole, got "
            f"{getattr(group.lens, 'kind', 'none')}: leave it out, and all ticks are rendered"
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
    """Return what a group computes beyond its outputs: for the scene, its settings, lens, pictures."""
    renderer = group.buffers[0].renderer
    terms = getattr(renderer, "terms", None)  # only Warp's has a kernel made to measure
    present = {} if terms is None else terms._asdict()
    if getattr(renderer, "antialiased", False):
        present |= {"supersampled": False, "antialiased": True}
    made = (term for process in group.buffers[0].processes.values() for term in process.terms)
    return (*(name for name, value in present.items() if value), *made)
