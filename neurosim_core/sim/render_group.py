# mypy: disable-error-code="attr-defined,no-untyped-call,call-overload"
"""One render group at work, in all worlds: the poses of a batch in, pictures and events out.

Several batches may be in flight. Each has a renderer of its own: what a batch saw stays until it has been
read. Instants are [world, K] in this order in all arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import Rate
from neurosim_core.packets import Packet
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
from neurosim_core.runtime.pinned import PinnedMapping
from neurosim_core.scene.bodies import (
    BodyConfig,
    BodyPoses,
    Motion,
    make_body_poses,
    pose_bodies,
    upload_motions,
)
from neurosim_core.sensors.base import (
    FrameContext,
    FrameSensor,
    FrameSensorConfig,
    PictureProcess,
    PictureSensorConfig,
    PictureViews,
    SensorConfig,
    WorldFrameContext,
    WorldFrameSensor,
)
from neurosim_core.sensors.displacement import DisplacementRule
from neurosim_core.sensors.render_plan import RenderGroup
from neurosim_core.sim.picture_views import Further, look_further, make_further, make_picture_context
from neurosim_core.sim.trace import Trace

_SLOT_LISTS_MAX = 256

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
    further: Sequence[Mapping[str, Further]]
    """What their processing needs besides, likewise."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Instants:
    """What a group sees in one batch."""

    lane: int
    """Which of the batches in flight it is."""
    stamps_ns: tuple[int, ...]
    """Stamps of the instants, at least one."""
    pictures: tuple[tuple[int, int, str], ...]
    """Stamp, image slot and camera of each picture."""
    frames: tuple[str, ...]
    """Frame sensors that see them."""
    rooms: dict[tuple[str, int], NDArray[Any]] = field(default_factory=dict)
    """Memory of the caller's that pictures are copied to, by camera and stamp."""


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
    # of n consecutive ticks of the group, every m-th is at most floor((n - 1) / m) + 1; cameras may alternate
    most = sum(int(capacity * i.rate.rate_hz / group.rate.rate_hz) + 1 for i in images.values())
    picture_count = max(1, min(capacity, most)) if on_host else 1
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
    motions: Any = upload_motions(bodies, device) if bodies else None
    contexts = [
        {
            name: make_picture_context(
                name,
                image.config,
                renderer,
                lens=group.lens,
                scene=scene,
                worlds=worlds,
                times=times,
                motions=motions,
                stride=capacity,
                seeds=seeds,
                device=device,
            )
            for name, image in images.items()
        }
        for renderer in renderers
    ]
    made = [{n: images[n].config.make_process(c) for n, c in by_name.items()} for by_name in contexts]
    processes = [{n: process for n, process in by_name.items() if process is not None} for by_name in made]
    for name, image in images.items():
        image.constants = image.config.constants(contexts[0][name])
    for name in processes[0]:
        images[name].source = f"{name}/processed"
    further = [
        {
            name: make_further(images[name].config, worlds.count * capacity, len(bodies or ()), device)
            for name in each
        }
        for each in processes
    ]
    p_BC, q_BC = wp.vec3d(*group.mount.position_m), wp.quatd(*group.mount.optical_quaternion())
    context = {
        name: FrameContext(
            name=name,
            width=group.lens.width,
            height=group.lens.height,
            device=device,
            in_flight=in_flight,
            seed=seed,
            lens=group.lens,
            scene=scene,
            motions=motions,
            history=history,
            p_BC=p_BC,
            q_BC=q_BC,
        )
        for name in group.frame_sensors
        if on_host
    }
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
            {
                image.source: HostCopy(
                    made[name].picture if name in made else getattr(renderer, image.output)
                )
                for name, image in images.items()
                if on_host
            }
            for renderer, made in zip(renderers, processes, strict=True)
        ],
        processes=processes,
        further=further,
        frames={
            name: config.make(context[name])
            for name in context
            if isinstance(config := sensors[name], FrameSensorConfig)
        },
        images=images,
        world_frames={
            name: config.make_worlds(world_context(name, _frames_of(renderers[0], worlds.count, capacity)))
            for name in group.frame_sensors
            if world_context is not None and isinstance(config := sensors[name], FrameSensorConfig)
        },
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
        rule=_make_rule(group, scene, p_BC, q_BC),
        make_room=make_room,
        chosen_slots=[HostInput(wp.zeros(capacity, dtype=int, device=device)) for _ in range(in_flight)]
        if group.max_displacement_px is not None
        else (),
    )


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


def _frames_of(renderer: Renderer, world_count: int, capacity: int) -> Any:
    """Return the log radiance of all worlds, shape [N, K, H W]."""
    frames = renderer.log_radiance
    return frames.reshape((world_count, capacity, frames.shape[1] * frames.shape[2]))


def _make_rule(group: RenderGroup, scene: Any, p_BC: wp.vec3d, q_BC: wp.quatd) -> DisplacementRule | None:
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
    )


def render_terms(group: RenderGroupState) -> tuple[str, ...]:
    """Return what a group computes beyond its outputs: for the scene, its settings, lens, pictures."""
    terms = getattr(group.renderers[0], "terms", None)  # only Warp's has a kernel made to measure
    present = {} if terms is None else terms._asdict()
    made = (term for process in group.processes[0].values() for term in process.terms)
    return (*(name for name, value in present.items() if value), *made)


def is_due(group: RenderGroupState, stamp_ns: int, wanted: Collection[str]) -> bool:
    """Return whether a camera that is wanted sees the tick of a group."""
    return any(name in wanted for name in group.frames) or bool(_pictures_due(group, stamp_ns, wanted))


class Choice(NamedTuple):
    """What is rendered of the ticks that a group sees in a batch."""

    places: Sequence[int]
    """Indices of the ticks that are rendered."""
    left_out_count: int = 0
    """Ticks that are not rendered."""
    coarse_count: int = 0
    """Renders after which something moves further by the next tick than it should between renders."""


def choose_ticks(
    group: RenderGroupState,
    trace: Trace,
    slots: Sequence[int],
    stamps_ns: Sequence[int],
    *,
    end_ns: int,
    wanted: Collection[str],
    required: Mapping[str, Rate],
) -> Choice:
    """Return which of the ticks that are due an adaptive group has to render, and wait until that is known.

    These are the ticks that its rule asks for, those that its sensors require, the last tick of the run, and
    the first tick that a camera sees.

    Args:
        group: Adaptive; its rule moves on to the end of the batch.
        trace: Where the states of the batch are.
        slots: Slots of the ticks in the trace.
        stamps_ns: Their stamps.
        end_ns: End of the run [ns].
        wanted: Names of the cameras that look.
        required: Ticks that each frame sensor needs in any case, by name.
    """
    assert group.rule is not None
    if not slots:
        return Choice(places=[])
    looking = [name for name in group.frames if name in wanted]
    last_ns = group.rate.stamp_ns(group.rate.first_tick(end_ns + 1) - 1)
    forced = [s == last_ns or any(required[name].has_tick(s) for name in looking) for s in stamps_ns]
    forced[0] |= not all(group.frames[name].watching for name in looking)
    places = group.rule.choose(trace.states, slots, stamps_ns, forced)
    return Choice(places, len(slots) - len(places), group.rule.coarse_count)


def _pictures_due(group: RenderGroupState, stamp_ns: int, wanted: Collection[str]) -> list[str]:
    return [name for name, image in group.images.items() if name in wanted and image.rate.has_tick(stamp_ns)]


class RenderJob(NamedTuple):
    """A batch that a group is going to render."""

    group: RenderGroupState
    instants: Instants
    key: Hashable | None
    """Same key, same launches; None: they do not come again."""
    render: Callable[[], Any]
    """Launches the rendering and, unless that is done apart, the copy of the pictures; returns what must be
    kept for a graph of it."""


def plan_render(
    group: RenderGroupState,
    trace: Trace,
    slots: Sequence[int],
    stamps_ns: Sequence[int],
    *,
    lane: int,
    wanted: Collection[str],
    active: Any = None,
) -> RenderJob:
    """Return how a group renders the instants of a batch.

    Args:
        group: The buffers of the batch are overwritten by the rendering.
        trace: Where the states of the batch are.
        slots: Slots of the instants in the trace, at least one.
        stamps_ns: Their stamps, of the clock that all worlds share.
        lane: Which of the batches in flight it is; the one that had its buffers before has been read.
        wanted: Names of the cameras that look.
        active: 0 where a world is not rendered, device array of int32, shape [world]; None: all are.
    """
    pictures = []
    image_slots = []
    used = 0
    for instant, stamp_ns in enumerate(stamps_ns):
        due = _pictures_due(group, stamp_ns, wanted) if group.images else ()
        pictures += [
            (stamp_ns, instant if group.images[name].output in INSTANT_OUTPUTS else used, name)
            for name in due
        ]
        image_slots.append(used if due else -1)
        used += bool(due)
    posed, placed = tuple(slots), tuple(image_slots)
    key: Hashable | None = (id(group), lane, posed, placed)
    if group.world_count > 1:  # shared walks look at all instants of a world
        posed += (slots[-1],) * (group.capacity - len(slots))
    chosen = None
    if group.rule is not None:
        key, chosen = None, group.chosen_slots[lane]
        chosen.rows[: len(slots)] = slots
    from_slots = _on_device(group, (lane, "from", posed), lambda: posed) if chosen is None else chosen.array
    to_slots = _on_device(group, (lane, "to", placed), lambda: _image_slots(group, placed))
    p_WC, q_WC, body_poses = group.p_WC[lane], group.q_WC[lane], group.body_poses[lane]

    def render() -> tuple[Any, Any]:
        if chosen is not None:
            chosen.upload()
        stamps = group.stamps[lane]
        mount = {"p_BC": group.p_BC, "q_BC": group.q_BC}
        poses = {"count": len(posed), **mount, "p_WC": p_WC, "q_WC": q_WC, "stamps": stamps}
        if group.offsets_ns is None:
            trace.camera_poses(from_slots, **poses)
        else:
            trace.ray_poses(from_slots, group.offsets_ns, **poses)
        if group.motions is not None and body_poses is not None:
            rays = 1 if group.offsets_ns is None else group.offsets_ns.shape[0]
            count = len(slots) * rays if group.world_count == 1 else stamps.shape[0]
            pose_bodies(group.motions, stamps, group.instants, count=count, poses=body_poses)
        group.renderers[lane].render(
            p_WC, q_WC, to_slots, instant_count=len(slots), bodies=body_poses, active=active
        )
        views = PictureViews(len(slots), to_slots, p_WC, q_WC, stamps, active, body_poses)
        for name in {name: None for _, _, name in pictures}:
            if name in group.processes[lane]:
                seen = look_further(
                    group.further[lane][name],
                    views,
                    trace,
                    from_slots,
                    count=len(posed),
                    **mount,
                    motions=group.motions,
                    instants=group.instants,
                )
                group.processes[lane][name].launch(seen)
            if name in group.shared_pictures:
                wp.copy(group.pictures[name], group.shared_pictures[name])
        if group.make_room is None:
            for source, copy in group.picture_copies[lane].items():
                copy.fetch(0, len(slots) if source in INSTANT_OUTPUTS else used)
        else:
            _bring(group, instants)
        return from_slots, to_slots

    instants = Instants(
        lane=lane,
        stamps_ns=tuple(stamps_ns),
        pictures=tuple(pictures),
        frames=tuple(name for name in group.frames if name in wanted),
    )
    return RenderJob(group, instants, key, render)


def acquire_room(job: RenderJob) -> None:
    """Ask for memory for the pictures of a job that have none yet, if a device copies them there."""
    group, instants = job.group, job.instants
    if group.make_room is None:
        return
    for stamp_ns, slot, name in instants.pictures:
        if (name, stamp_ns) not in instants.rooms:
            picture = group.picture_copies[instants.lane][group.images[name].source].view(slot, 1)[0]
            room = group.make_room(name, stamp_ns, picture)
            if room is not None:
                instants.rooms[name, stamp_ns] = room


def launch_key(job: RenderJob) -> Hashable | None:
    """Return the key of the launches of a job: they copy pictures to where there is room now."""
    if job.key is None or job.group.make_room is None:
        return job.key
    rooms = job.instants.rooms
    places = (rooms.get((name, stamp_ns)) for stamp_ns, _, name in job.instants.pictures)
    addresses = (0 if room is None else room.__array_interface__["data"][0] for room in places)
    return job.key, PinnedMapping.made_count, *addresses


def disable_frame_sensors(group: RenderGroupState, wanted: Collection[str]) -> None:
    """Let frame sensors that are not wanted forget what they have seen."""
    for name, sensor in group.frames.items():
        sensor.watching = sensor.watching and name in wanted


def leave_out(group: RenderGroupState, stamps_ns: Iterable[int], wanted: Collection[str]) -> None:
    """Note that ticks of a group are not rendered: the sequence of its pictures shows the gap."""
    for stamp_ns in stamps_ns:
        for name in _pictures_due(group, stamp_ns, wanted):
            group.images[name].sequence += 1


def scan_frames(group: RenderGroupState, instants: Instants) -> None:
    """Let the frame sensors see the instants just rendered."""
    frames = group.renderers[instants.lane].log_radiance
    for name in instants.frames:
        group.frames[name].see(frames, instants.stamps_ns)


def read_frames(group: RenderGroupState, instants: Instants, *, until_ns: int) -> list[Packet]:
    """Return the packets of frame sensors that end in the batch, at most at a stamp."""
    packets: list[Packet] = []
    for name in instants.frames:
        packets += group.frames[name].read(instants.stamps_ns, until_ns=until_ns)
    return packets


def flush_frames(group: RenderGroupState, *, until_ns: int) -> list[Packet]:
    """Return the packets of frame sensors that have begun and not ended, cut at a stamp."""
    return [packet for sensor in group.frames.values() for packet in sensor.flush(until_ns=until_ns)]


def _bring(group: RenderGroupState, instants: Instants) -> None:
    """Launch the copies of pictures to the host: to the room that there is, or as usual."""
    for stamp_ns, slot, name in instants.pictures:
        copy = group.picture_copies[instants.lane][group.images[name].source]
        room = instants.rooms.get((name, stamp_ns))
        if room is None:
            copy.fetch(slot, 1)
        else:
            copy.fetch_into(room, slot)


def read_images(group: RenderGroupState, instants: Instants, *, borrow: bool = False) -> list[Packet]:
    """Return the pictures of a batch that the device has finished with.

    Args:
        group: Which cameras.
        instants: What they have seen.
        borrow: Return views that are valid until the buffers are overwritten, not copies; of those for which
            the caller has no room.
    """
    copies: dict[tuple[str, int], NDArray[Any]] = {}

    def copy_of(image: ImageChannel, slot: int, name: str, stamp_ns: int) -> NDArray[Any]:
        room = instants.rooms.pop((name, stamp_ns), None)
        if room is not None:
            return room
        picture: NDArray[Any] = group.picture_copies[instants.lane][image.source].view(slot, 1)[0]
        if borrow:
            return picture
        key = (image.source, slot)  # cameras that take the same picture share the copy
        if key not in copies:
            copies[key] = np.array(picture)
        return copies[key]

    packets: list[Packet] = []
    for stamp_ns, slot, name in instants.pictures:
        image = group.images[name]
        picture = copy_of(image, slot, name, stamp_ns)
        header = {"stamp_ns": stamp_ns, "sequence": image.sequence, "sensor": name}
        packets.append(image.config.packet(picture, **image.constants, **header))
        image.sequence += 1
    return packets


def _image_slots(group: RenderGroupState, image_slots: Sequence[int]) -> NDArray[Any]:
    """Return where the images of the instants of all worlds go, shape [N K]."""
    own = np.full(group.capacity, -1)
    own[: len(image_slots)] = image_slots
    first = group.picture_count * np.arange(group.world_count)[:, None]
    return np.where(own < 0, -1, first + own).reshape(-1)


def _on_device(group: RenderGroupState, key: Hashable, slots: Callable[[], Any]) -> wp.array[int]:
    """Return a list of slots on the device; the same key, which names a batch in flight, gives the same."""
    if key not in group.slots:
        if len(group.slots) >= _SLOT_LISTS_MAX:
            del group.slots[next(iter(group.slots))]
        group.slots[key] = wp.array(np.array(slots(), dtype=np.int32), dtype=int, device=group.device)
    return group.slots[key]
