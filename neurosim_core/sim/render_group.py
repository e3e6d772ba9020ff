# mypy: disable-error-code="attr-defined,no-untyped-call,call-overload"
"""The device buffers of one render group, in all worlds; `render_job.py` takes batches through them.

Several batches may be in flight. Each has a renderer of its own: what a batch saw stays until it has been
read. Instants are [world, K] in this order in all arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import Rate
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.outputs import INSTANT_OUTPUTS
from neurosim_core.render.ray_times import RayTimes
from neurosim_core.render.renderer import (
    ONE_WORLD,
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
    WorldFrameContext,
    WorldFrameSensor,
)
from neurosim_core.sensors.displacement import DisplacementRule
from neurosim_core.sensors.render_plan import RenderGroup

MakeRoom = Callable[[str, int, NDArray[Any]], NDArray[Any] | None]
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

    @property
    def output(self) -> str:
        """What is rendered for it."""
        return self.config.output


@dataclass(kw_only=True, eq=False)
class RenderGroupState:
    """The device buffers of one group, for batches of at most `capacity` instants."""

    device: str
    world_count: int
    capacity: int
    """K, the most instants of one batch in each world."""
    picture_count: int
    """M, the most pictures of one batch in each world."""
    rate: Rate
    renderers: list[Renderer]
    """One for each batch in flight."""
    picture_copies: list[dict[str, HostCopy]]
    """Pictures on the host by source, for each batch in flight; empty: they stay on the device."""
    processes: Sequence[Mapping[str, PictureProcess]]
    """What pictures go through on the device, by the name of the sensor, for each batch in flight."""
    frames: dict[str, FrameSensor]
    """The frame sensors, where packets go to the host."""
    images: dict[str, ImageChannel]
    world_frames: dict[str, WorldFrameSensor]
    """The frame sensors, where results stay on the device."""
    pictures: dict[str, Any]
    """The last picture of each image sensor, where they stay on the device: arrays [N, H, W, ...]."""
    shared_pictures: dict[str, Any]
    """What the renderer wrote, for image sensors whose last picture another one of the group replaces."""
    parity: int = field(default=0, kw_only=True)
    """Which of the two states of `world_frames` is the present one."""
    p_BC: wp.vec3d
    q_BC: wp.quatd
    offsets_ns: Any
    """From an instant to its J rays [ns], device array; None: all are cast at the instant."""
    p_WC: Sequence[wp.array[wp.vec3]]
    """Where the camera is at the instants [m], for each batch in flight, shape [N K]; [N K J] with
    `offsets_ns`."""
    q_WC: Sequence[wp.array[wp.quat]]
    stamps: Sequence[Any]
    """Times of the instants [ns], shape [N K, 1]; [N K J, 1] with `offsets_ns`; empty if nobody asks."""
    instants: Any = None
    """0, 1, ... N K - 1: the instants in order."""
    motions: wp.array[Motion] | None = None
    """Of the bodies; None: nothing moves but the vehicle."""
    body_poses: Sequence[BodyPoses | None] = ()
    """Where bodies are at the instants, for each batch in flight."""
    slots: dict[Hashable, wp.array[int]] = field(default_factory=dict)
    """Lists of slots on the device by batch in flight: the same few come again and again. What one uploads on
    its stream is not there yet for another, whose stream does not wait for it."""
    rule: DisplacementRule | None = None
    """Chooses the ticks that are rendered; None: all are."""
    chosen_slots: Sequence[HostInput] = ()
    """Slots of the ticks chosen, for each batch in flight: they do not come again."""
    make_room: MakeRoom | None = None
    """Gives memory that pictures are copied to as a part of the rendering; None: they get their own."""


def make_render_group(
    group: RenderGroup,
    sensors: Mapping[str, SensorConfig],
    scene: Any,
    *,
    capacity: int,
    in_flight: int,
    device: str,
    seed: int = 0,
    seeds: Any = None,
    bodies: Mapping[str, BodyConfig] | None = None,
    worlds: RenderWorlds = ONE_WORLD,
    on_host: bool = True,
    make_room: MakeRoom | None = None,
    world_context: Callable[[str, Any], WorldFrameContext] | None = None,
    history: Any = None,
) -> RenderGroupState:
    """Allocate the buffers of a group.

    Args:
        group: Which cameras it serves.
        sensors: All sensors of the rig.
        scene: What to look at.
        capacity: K, the most instants of one batch in each world.
        in_flight: The most batches in flight.
        device: Where to compute.
        seed: Seed of the noise of frame sensors.
        seeds: Of each world, for the noise of pictures, device array of uint64.
        bodies: What moves in the scene.
        worlds: Who is rendered together.
        on_host: Bring pictures and events to the host, as packets.
        make_room: Gives memory to copy a picture to, where the caller has a place for it; `acquire_room` asks
            for it before pictures are rendered.
        history: The flight, for sensors that look back.
        world_context: Without `on_host`: what the frame sensor of a name is made for, given its frames.

    Raises:
        ValueError: The renderer cannot say what moves how far, and the group is adaptive; or a picture is not
            for many worlds.
    """
    images = _image_channels(group, sensors, on_host=on_host)
    picture_count = _picture_count(group, images, capacity) if on_host else 1
    times = _ray_times(group, scene)
    renderers = [
        make_renderer(
            scene,
            group.lens,
            outputs=group.outputs,
            instant_count=capacity,
            image_count=worlds.count * picture_count,
            worlds=worlds,
            times=times,
        )
        for _ in range(in_flight)
    ]
    motions: Any = upload_motions(bodies, device, world_count=worlds.count) if bodies else None
    one_scene = not worlds.arrays or worlds.scene_of_world is None
    first_scene = wp.zeros(worlds.count, dtype=int, device=device)
    processes = _picture_processes(
        images,
        renderers,
        lenses=worlds.lenses or (group.lens,),
        lens_of_world=worlds.lens_of_world if worlds.lenses else [0] * worlds.count,
        scenes=(scene,) if one_scene else worlds.arrays,
        scene_of_world=first_scene if one_scene else worlds.scene_of_world,
        motions=motions,
        times=times,
        stride=capacity,
        seeds=seeds,
    )
    p_BC, q_BC = wp.vec3d(*group.mount.position_m), wp.quatd(*group.mount.optical_quaternion())
    offsets_ns: Any = None if times is None else wp.array(times.offsets_ns, dtype=wp.int64, device=device)
    rows = worlds.count * capacity * (1 if offsets_ns is None else offsets_ns.shape[0])
    timed_rows = rows if bodies or processes[0] else 0
    pictures, shared = ({}, {}) if on_host else _picture_arrays(images, renderers[0], processes[0])
    return RenderGroupState(
        device=device,
        world_count=worlds.count,
        capacity=capacity,
        picture_count=picture_count,
        rate=group.rate,
        renderers=renderers,
        picture_copies=[
            _picture_copies(images if on_host else {}, *each)
            for each in zip(renderers, processes, strict=True)
        ],
        processes=processes,
        frames=_frame_sensors(
            group.frame_sensors if on_host else (),
            sensors,
            lens=group.lens,
            device=device,
            in_flight=in_flight,
            seed=seed,
            scene=scene,
            motions=motions,
            history=history,
            p_BC=p_BC,
            q_BC=q_BC,
        ),
        images=images,
        world_frames=_world_frames(group, sensors, renderers[0], world_context, worlds.count, capacity),
        pictures=pictures,
        shared_pictures=shared,
        p_BC=p_BC,
        q_BC=q_BC,
        offsets_ns=offsets_ns,
        p_WC=[wp.zeros(rows, dtype=wp.vec3, device=device) for _ in renderers],
        q_WC=[wp.zeros(rows, dtype=wp.quat, device=device) for _ in renderers],
        stamps=[wp.zeros((timed_rows, 1), dtype=wp.int64, device=device) for _ in renderers],
        instants=wp.array(np.arange(timed_rows, dtype=np.int32), dtype=int, device=device),
        motions=motions,
        body_poses=[make_body_poses(rows, len(bodies), device) if bodies else None for _ in renderers],
        rule=_make_rule(group, scene, p_BC, q_BC, motions),
        make_room=make_room,
        chosen_slots=_chosen_slots(group, in_flight, capacity, device),
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


def _picture_processes(
    images: Mapping[str, ImageChannel], renderers: Sequence[Renderer], **context: Any
) -> list[dict[str, PictureProcess]]:
    """Return what makes pictures of what a renderer wrote, for each renderer; `context`: as `PictureContext`.

    Constants and sources of the channels are set.
    """
    processes: list[dict[str, PictureProcess]] = [{} for _ in renderers]
    for name, image in images.items():
        for renderer, by_name in zip(renderers, processes, strict=True):
            sources = {output: getattr(renderer, output) for output in image.config.outputs}
            made_for = PictureContext(
                name=name, source=getattr(renderer, image.output), sources=sources, **context
            )
            process = image.config.make_process(made_for)
            if process is not None:
                by_name[name] = process
                image.source = f"{name}/processed"
        image.constants = image.config.constants(made_for)
    return processes


def _picture_copies(
    images: Mapping[str, ImageChannel], renderer: Renderer, processes: Mapping[str, Any]
) -> dict[str, HostCopy]:
    """Return the pictures of a renderer on the host, by their sources."""
    return {
        image.source: HostCopy(
            processes[name].picture if name in processes else getattr(renderer, image.output)
        )
        for name, image in images.items()
    }


def _frame_sensors(
    names: Sequence[str], sensors: Mapping[str, SensorConfig], *, lens: Any, **context: Any
) -> dict[str, FrameSensor]:
    """Return frame sensors at work in one world, by name; `context`: as `FrameContext`."""
    return {
        name: config.make(FrameContext(name=name, width=lens.width, height=lens.height, lens=lens, **context))
        for name in names
        if isinstance(config := sensors[name], FrameSensorConfig)
    }


def _chosen_slots(group: RenderGroup, in_flight: int, capacity: int, device: str) -> Sequence[HostInput]:
    """Return where the slots of chosen ticks go, for each batch in flight; none if all ticks are rendered."""
    if group.max_displacement_px is None:
        return ()
    return [HostInput(wp.zeros(capacity, dtype=int, device=device)) for _ in range(in_flight)]


def _ray_times(group: RenderGroup, scene: Any) -> RayTimes | None:
    """Return when the rays of a group are cast; None: all at the stamp."""
    if group.timing is None:
        return None
    if not isinstance(scene, SceneArrays):
        names = ", ".join(group.names)
        raise ValueError(f"{names}: rays with times of their own need renderer: warp")
    return ray_times_of(group.timing, group.lens, scene)


def _picture_arrays(
    images: Mapping[str, ImageChannel], renderer: Renderer, processes: Mapping[str, PictureProcess]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return where the last picture of each image sensor is, and what has to be copied there from where."""
    fastest_hz = max((image.rate.rate_hz for image in images.values()), default=0.0)
    pictures = {name: getattr(renderer, image.output) for name, image in images.items()}
    pictures |= {name: process.picture for name, process in processes.items()}
    shared = {n: pictures[n] for n, image in images.items() if image.rate.rate_hz < fastest_hz}
    return pictures | {name: wp.empty_like(array) for name, array in shared.items()}, shared


def _picture_count(group: RenderGroup, images: Mapping[str, ImageChannel], capacity: int) -> int:
    """Return the most pictures of a batch; cameras may alternate.

    Of n consecutive ticks of the group, every m-th is at most floor((n - 1) / m) + 1.
    """
    most = sum(int(capacity * i.rate.rate_hz / group.rate.rate_hz) + 1 for i in images.values())
    return max(1, min(capacity, most))


def _world_frames(
    group: RenderGroup,
    sensors: Mapping[str, SensorConfig],
    renderer: Renderer,
    context: Callable[[str, Any], WorldFrameContext] | None,
    world_count: int,
    capacity: int,
) -> dict[str, WorldFrameSensor]:
    """Return the frame sensors whose results stay on the device; they read log radiance [N, K, H W]."""
    if context is None:
        return {}
    found = {}
    for name in group.frame_sensors:
        if isinstance(config := sensors[name], FrameSensorConfig):
            frames = renderer.log_radiance
            shape = (world_count, capacity, frames.shape[1] * frames.shape[2])
            found[name] = config.make_worlds(context(name, frames.reshape(shape)))
    return found


def move_bodies(groups: Iterable[RenderGroupState], bodies: Mapping[str, BodyConfig]) -> None:
    """Let the same bodies move otherwise from now on; nothing may be being rendered."""
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
    renderer = group.renderers[0]
    terms = getattr(renderer, "terms", None)  # only Warp's has a kernel made to measure
    present = {} if terms is None else terms._asdict()
    if getattr(renderer, "antialiased", False):
        present |= {"supersampled": False, "antialiased": True}
    made = (term for process in group.processes[0].values() for term in process.terms)
    return (*(name for name, value in present.items() if value), *made)
