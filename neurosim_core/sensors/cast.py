"""One cast at work: the poses of a batch in, pictures and events out.

Several batches may be under way. Each has a lane, which has its own renderer: what a batch saw stays until it
has been read.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import Rate
from neurosim_core.packets import Events, Image, ImageEncoding, Packet
from neurosim_core.pinned import PinnedMapping
from neurosim_core.render.renderer import Renderer, SceneOnDevice, make_renderer
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.scene.bodies import (
    BodyConfig,
    BodyPoses,
    Motion,
    make_body_poses,
    pose_bodies,
    upload_motions,
)
from neurosim_core.sensors.displacement import DisplacementRule
from neurosim_core.sensors.events import EventCamera
from neurosim_core.sensors.rig import Cast, EventSensorConfig, ImageSensorConfig, SensorConfig
from neurosim_core.streams import HostCopy, HostInput
from neurosim_core.trace import Trace

_ENCODING: dict[str, ImageEncoding] = {"rgb": "rgb8", "depth": "32FC1"}
"""Encoding of each output of a renderer."""

_SLOT_LISTS_MAX = 256

MakeRoom = Callable[[str, int, NDArray[Any]], NDArray[Any] | None]
"""Returns memory for a camera's picture of a stamp [ns], like the one that is given; None: there is none.
On a CUDA device it is pinned, and the picture is there when the device has finished with the batch."""


@dataclass(kw_only=True, eq=False)
class EventChannel:
    """An event camera of a cast and the clock of its packets."""

    camera: EventCamera
    packets: Rate
    sequence: int = 0
    """Number of the next packet."""
    watching: bool = False
    """It has a reference, and saw every instant that was rendered since."""
    seen_ns: int = 0
    """The last instant that it saw and that counts [ns]."""


@dataclass(kw_only=True, eq=False)
class ImageChannel:
    """An image camera of a cast."""

    output: str
    """What the renderer calls its picture."""
    rate: Rate
    sequence: int = 0


@dataclass(kw_only=True, eq=False)
class CastState:
    """The device buffers of one cast, for batches of at most `capacity` instants."""

    device: str
    capacity: int
    rate: Rate
    renderers: list[Renderer]
    """One for each lane."""
    picture_copies: list[dict[str, HostCopy]]
    """Pictures on the host by output, for each lane."""
    events: dict[str, EventChannel]
    images: dict[str, ImageChannel]
    p_BC: wp.vec3d
    q_BC: wp.quatd
    p_WC: Sequence[wp.array[wp.vec3]]
    """Where the camera is at the instants [m], for each lane: they may be rendered at the same time."""
    q_WC: Sequence[wp.array[wp.quat]]
    motions: wp.array[Motion] | None = None
    """Of the bodies; None: nothing moves but the vehicle."""
    body_poses: Sequence[BodyPoses | None] = ()
    """Where bodies are at the instants, for each lane."""
    slots: dict[tuple[int, tuple[int, ...]], wp.array[int]] = field(default_factory=dict)
    """Lists of slots on the device by lane: the same few come again and again. What one lane uploads on its
    stream is not there yet for another, whose stream does not wait for it."""
    rule: DisplacementRule | None = None
    """Chooses the ticks that are rendered; None: all are."""
    chosen_slots: Sequence[HostInput] = ()
    """Slots of the ticks chosen, for each lane: they do not come again."""
    make_room: MakeRoom | None = None
    """Gives memory that pictures are copied to; None: they get their own."""
    brings_apart: bool = False
    """`bring_images` launches the copies of pictures to the host, as they go to other places each time."""
    lends: bool = False
    """They are part of the rendering, and go to the few places that `ask_for_room` is given in turn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Instants:
    """What a cast sees in one batch."""

    lane: int
    stamps_ns: tuple[int, ...]
    """Stamps of the instants, at least one."""
    pictures: tuple[tuple[int, int, str], ...]
    """Stamp, image slot and camera of each picture."""
    events: tuple[str, ...]
    """Event cameras that see them."""
    rooms: dict[tuple[str, int], NDArray[Any]] = field(default_factory=dict)
    """Memory of the caller's that pictures are copied to, by camera and stamp."""


def make_cast_state(
    cast: Cast,
    sensors: dict[str, SensorConfig],
    scene: SceneOnDevice,
    *,
    capacity: int,
    lane_count: int,
    device: str,
    seed: int = 0,
    bodies: Mapping[str, BodyConfig] | None = None,
    make_room: MakeRoom | None = None,
    late: bool = False,
) -> CastState:
    """Allocate the buffers of a cast.

    Args:
        cast: Which cameras it serves.
        sensors: All sensors of the rig.
        scene: What to look at.
        capacity: The most instants of one batch.
        lane_count: The most batches under way.
        device: Where to compute.
        seed: Seed of the noise of event cameras.
        bodies: What moves in the scene.
        make_room: Gives memory to copy a picture to, where the caller has a place for it.
        late: It is asked for, by `ask_for_room`, before pictures are rendered, not when they are read.

    Raises:
        ValueError: The renderer cannot say what moves how far, and the cast is adaptive.
    """
    image_sensors = {name: sensors[name] for name in cast.image_cameras}
    # of n consecutive ticks of the cast, every m-th is at most floor((n - 1) / m) + 1; cameras may alternate
    picture_count = sum(
        int(capacity * sensor.rate_hz / cast.rate.rate_hz) + 1
        for sensor in image_sensors.values()
        if isinstance(sensor, ImageSensorConfig)
    )
    renderers = [
        make_renderer(
            scene,
            cast.lens,
            outputs=cast.outputs,
            instant_count=capacity,
            image_count=max(1, min(capacity, picture_count)),
        )
        for _ in range(lane_count)
    ]
    events = {}
    for name in cast.event_cameras:
        sensor = sensors[name]
        assert isinstance(sensor, EventSensorConfig)
        events[name] = EventChannel(
            camera=EventCamera(
                sensor.pixel,
                width=cast.lens.width,
                height=cast.lens.height,
                device=device,
                sensor=name,
                seed=seed,
                scan_count_max=lane_count,
                on_host=True,
            ),
            packets=sensor.packets,
        )
    images = {}
    for name, sensor in image_sensors.items():
        assert isinstance(sensor, ImageSensorConfig)
        images[name] = ImageChannel(output=sensor.kind, rate=Rate(sensor.rate_hz))
    p_BC, q_BC = wp.vec3d(*cast.mount.position_m), wp.quatd(*cast.mount.optical_quaternion())
    return CastState(
        device=device,
        capacity=capacity,
        rate=cast.rate,
        renderers=renderers,
        picture_copies=[
            {image.output: HostCopy(getattr(renderer, image.output)) for image in images.values()}
            for renderer in renderers
        ],
        events=events,
        images=images,
        p_BC=p_BC,
        q_BC=q_BC,
        p_WC=[wp.zeros(capacity, dtype=wp.vec3, device=device) for _ in renderers],
        q_WC=[wp.zeros(capacity, dtype=wp.quat, device=device) for _ in renderers],
        motions=upload_motions(bodies, device) if bodies else None,
        body_poses=[make_body_poses(capacity, len(bodies), device) if bodies else None for _ in renderers],
        rule=_make_rule(cast, scene, p_BC, q_BC),
        make_room=make_room,
        brings_apart=make_room is not None and not late and wp.get_device(device).is_cuda,
        lends=make_room is not None and late,
        chosen_slots=[HostInput(wp.zeros(capacity, dtype=int, device=device)) for _ in range(lane_count)]
        if cast.max_displacement_px is not None
        else (),
    )


def _make_rule(cast: Cast, scene: SceneOnDevice, p_BC: wp.vec3d, q_BC: wp.quatd) -> DisplacementRule | None:
    if cast.max_displacement_px is None:
        return None
    if not isinstance(scene, SceneArrays):
        raise ValueError(
            f"max_displacement_px of {', '.join(cast.event_cameras)} needs the renderer 'warp': "
            "the others do not know where things are"
        )
    return DisplacementRule(
        scene, cast.lens, max_displacement_px=cast.max_displacement_px, rate=cast.rate, p_BC=p_BC, q_BC=q_BC
    )


def render_terms(cast: CastState) -> tuple[str, ...]:
    """Return what the renderer of a cast computes because of the scene, its settings, and the lens."""
    terms = getattr(cast.renderers[0], "terms", None)  # only Warp's has a kernel made to measure
    present = {} if terms is None else terms._asdict()
    return tuple(name for name, value in present.items() if value)


def is_due(cast: CastState, stamp_ns: int, wanted: Collection[str]) -> bool:
    """Return whether a camera that is wanted sees the tick of a cast."""
    return any(name in wanted for name in cast.events) or bool(_pictures_due(cast, stamp_ns, wanted))


class Choice(NamedTuple):
    """What is rendered of the ticks that a cast sees in a batch."""

    places: Sequence[int]
    """Indices of the ticks that are rendered."""
    left_out_count: int = 0
    """Ticks that are not rendered."""
    coarse_count: int = 0
    """Renders after which something moves further by the next tick than it should between renders."""


def choose_ticks(
    cast: CastState,
    trace: Trace,
    slots: Sequence[int],
    stamps_ns: Sequence[int],
    *,
    end_ns: int,
    wanted: Collection[str],
) -> Choice:
    """Return which of the ticks that are due an adaptive cast has to render, and wait until that is known.

    These are the ticks that its rule asks for, the ends of packets, the last tick of the run, and the first
    tick that a camera sees.

    Args:
        cast: Adaptive; its rule moves on to the end of the batch.
        trace: Where the states of the batch are.
        slots: Slots of the ticks in the trace.
        stamps_ns: Their stamps.
        end_ns: End of the run [ns].
        wanted: Names of the cameras that look.
    """
    assert cast.rule is not None
    if not slots:
        return Choice(places=[])
    channels = [channel for name, channel in cast.events.items() if name in wanted]
    last_ns = cast.rate.stamp_ns(cast.rate.first_tick(end_ns + 1) - 1)
    forced = [s == last_ns or any(c.packets.has_tick(s) for c in channels) for s in stamps_ns]
    forced[0] |= not all(channel.watching for channel in channels)
    places = cast.rule.choose(trace.states, slots, stamps_ns, forced)
    return Choice(places, len(slots) - len(places), cast.rule.coarse_count)


def _pictures_due(cast: CastState, stamp_ns: int, wanted: Collection[str]) -> list[str]:
    return [name for name, image in cast.images.items() if name in wanted and image.rate.has_tick(stamp_ns)]


class Look(NamedTuple):
    """A batch that a cast is going to render."""

    cast: CastState
    instants: Instants
    key: Hashable | None
    """Same key, same launches; None: they do not come again."""
    render: Callable[[], Any]
    """Launches the rendering and, unless that is done apart, the copy of the pictures; returns what must be
    kept for a graph of it."""


def plan_look(
    cast: CastState,
    trace: Trace,
    slots: Sequence[int],
    stamps_ns: Sequence[int],
    *,
    lane: int,
    wanted: Collection[str],
) -> Look:
    """Return how a cast renders the instants of a batch.

    Args:
        cast: The lane's buffers are overwritten by the rendering.
        trace: Where the states of the batch are.
        slots: Slots of the instants in the trace, at least one.
        stamps_ns: Their stamps.
        lane: Of the batch; the one that had it before has been read.
        wanted: Names of the cameras that look.
    """
    pictures = []
    image_slots = []
    used = 0
    for stamp_ns in stamps_ns:
        due = _pictures_due(cast, stamp_ns, wanted) if cast.images else ()
        pictures += [(stamp_ns, used, name) for name in due]
        image_slots.append(used if due else -1)
        used += bool(due)
    key: Hashable | None = (id(cast), lane, tuple(slots), tuple(image_slots))
    chosen = None
    if cast.rule is not None:
        key, chosen = None, cast.chosen_slots[lane]
        chosen.rows[: len(slots)] = slots
    from_slots = _slots_on_device(cast, lane, slots) if chosen is None else chosen.array
    to_slots = _slots_on_device(cast, lane, image_slots)

    p_WC, q_WC, body_poses = cast.p_WC[lane], cast.q_WC[lane], cast.body_poses[lane]

    def render() -> tuple[Any, Any]:
        if chosen is not None:
            chosen.upload()
        trace.camera_poses(from_slots, count=len(slots), p_BC=cast.p_BC, q_BC=cast.q_BC, p_WC=p_WC, q_WC=q_WC)
        if cast.motions is not None and body_poses is not None:
            pose_bodies(cast.motions, trace.stamps, from_slots, count=len(slots), poses=body_poses)
        cast.renderers[lane].render(p_WC, q_WC, to_slots, instant_count=len(slots), bodies=body_poses)
        if cast.lends:
            _bring(cast, instants)
        elif not cast.brings_apart:
            for copy in cast.picture_copies[lane].values():
                copy.fetch(0, used)
        return from_slots, to_slots

    instants = Instants(
        lane=lane,
        stamps_ns=tuple(stamps_ns),
        pictures=tuple(pictures),
        events=tuple(name for name in cast.events if name in wanted),
    )
    return Look(cast, instants, key, render)


def ask_for_room(look: Look) -> None:
    """Ask for memory for the pictures of a look that have none yet, if a device copies them there."""
    cast, instants = look.cast, look.instants
    if not cast.lends:
        return
    for stamp_ns, slot, name in instants.pictures:
        if (name, stamp_ns) not in instants.rooms:
            picture = cast.picture_copies[instants.lane][cast.images[name].output].view(slot, 1)[0]
            room = _room_for(cast, name, stamp_ns, picture)
            if room is not None:
                instants.rooms[name, stamp_ns] = room


def launch_key(look: Look) -> Hashable | None:
    """Return the key of the launches of a look: they copy pictures to where there is room now."""
    if look.key is None or not look.cast.lends:
        return look.key
    rooms = look.instants.rooms
    places = (rooms.get((name, stamp_ns)) for stamp_ns, _, name in look.instants.pictures)
    addresses = (0 if room is None else room.__array_interface__["data"][0] for room in places)
    return look.key, PinnedMapping.made_count, *addresses


def close_eyes(cast: CastState, wanted: Collection[str]) -> None:
    """Let event cameras that are not wanted forget what they have seen."""
    for name, channel in cast.events.items():
        channel.watching = channel.watching and name in wanted


def leave_out(cast: CastState, stamps_ns: Iterable[int], wanted: Collection[str]) -> None:
    """Note that ticks of a cast are not rendered: the sequence of its pictures shows the gap."""
    for stamp_ns in stamps_ns:
        for name in _pictures_due(cast, stamp_ns, wanted):
            cast.images[name].sequence += 1


def scan_events(cast: CastState, instants: Instants) -> None:
    """Let the event cameras see the instants just rendered.

    One that has not seen the instants before takes the first as its reference.
    """
    log_radiance = cast.renderers[instants.lane].log_radiance
    for name in instants.events:
        channel = cast.events[name]
        first = 0
        if not channel.watching:
            channel.camera.reset(log_radiance[0], instants.stamps_ns[0], sequence=channel.sequence)
            channel.watching = True
            first = 1
        stamps_ns = instants.stamps_ns[first:]
        if stamps_ns:
            channel.camera.feed_device(log_radiance[first:] if first else log_radiance, stamps_ns)


def _window_ends(channel: EventChannel, stamps_ns: Sequence[int]) -> list[int]:
    """Return the instants at which packets end."""
    ticks = channel.packets.stamps(stamps_ns[0], stamps_ns[-1] + 1)
    return [tick for tick in ticks if tick in stamps_ns]


def read_events(cast: CastState, instants: Instants, *, until_ns: int) -> list[Events]:
    """Return the packets of events whose windows ended in the batch, at most at a stamp."""
    packets: list[Events] = []
    for name in instants.events:
        channel = cast.events[name]
        begun_ns = channel.camera.window_start_ns
        ends = [end for end in _window_ends(channel, instants.stamps_ns) if begun_ns < end <= until_ns]
        fed = instants.stamps_ns[-1] > channel.camera.stamp_ns
        channel.seen_ns = max((s for s in instants.stamps_ns if s <= until_ns), default=channel.seen_ns)
        packets += channel.camera.collect_windows(ends, scan_count=int(fed))
        channel.sequence += len(ends)
    return packets


def flush_events(cast: CastState, *, until_ns: int) -> list[Events]:
    """Return the packets whose windows have begun and not ended, cut at the last instant until a stamp."""
    packets: list[Events] = []
    for channel in cast.events.values():
        if not channel.watching:
            continue
        cut_ns = min(until_ns, channel.seen_ns)
        if channel.camera.window_start_ns < cut_ns:
            packets += channel.camera.collect_windows([cut_ns], scan_count=0)
            channel.sequence += 1
    return packets


def bring_images(cast: CastState, instants: Instants) -> None:
    """Launch the copies of the pictures just rendered, unless that was part of the rendering.

    The device copies a picture to where the caller has room for it, and there is nothing left to do.
    """
    if not cast.brings_apart:
        return
    for stamp_ns, slot, name in instants.pictures:
        copy = cast.picture_copies[instants.lane][cast.images[name].output]
        room = _room_for(cast, name, stamp_ns, copy.view(slot, 1)[0])
        if room is not None:
            instants.rooms[name, stamp_ns] = room
    _bring(cast, instants)


def _bring(cast: CastState, instants: Instants) -> None:
    """Launch the copies of pictures to the host: to the room that there is, or as usual."""
    for stamp_ns, slot, name in instants.pictures:
        copy = cast.picture_copies[instants.lane][cast.images[name].output]
        room = instants.rooms.get((name, stamp_ns))
        if room is None:
            copy.fetch(slot, 1)
        else:
            copy.fetch_into(room, slot)


def _room_for(cast: CastState, name: str, stamp_ns: int, picture: NDArray[Any]) -> NDArray[Any] | None:
    return None if cast.make_room is None else cast.make_room(name, stamp_ns, picture)


def read_images(cast: CastState, instants: Instants, *, borrow: bool = False) -> list[Packet]:
    """Return the pictures of a batch that the device has finished with.

    Args:
        cast: Which cameras.
        instants: What they have seen.
        borrow: Return views that are valid until the lane's buffers are overwritten, not copies; of those for
            which the caller has no room.
    """
    copies: dict[tuple[str, int], NDArray[Any]] = {}

    def copy_of(image: ImageChannel, slot: int, name: str, stamp_ns: int) -> NDArray[Any]:
        room = instants.rooms.pop((name, stamp_ns), None)
        if room is not None:
            return room
        picture: NDArray[Any] = cast.picture_copies[instants.lane][image.output].view(slot, 1)[0]
        if not (cast.brings_apart or cast.lends):
            room = _room_for(cast, name, stamp_ns, picture)
        if room is not None:
            np.copyto(room, picture)
            return room
        if borrow:
            return picture
        key = (image.output, slot)  # cameras that take the same picture share the copy
        if key not in copies:
            copies[key] = np.array(picture)
        return copies[key]

    packets: list[Packet] = []
    for stamp_ns, slot, name in instants.pictures:
        image = cast.images[name]
        packets.append(
            Image(
                stamp_ns=stamp_ns,
                sequence=image.sequence,
                sensor=name,
                data=copy_of(image, slot, name, stamp_ns),
                encoding=_ENCODING[image.output],
            )
        )
        image.sequence += 1
    return packets


def _slots_on_device(cast: CastState, lane: int, slots: Sequence[int]) -> wp.array[int]:
    """Return slots as an array that the lane has uploaded before, if the same were."""
    key = lane, tuple(slots)
    if key not in cast.slots:
        if len(cast.slots) >= _SLOT_LISTS_MAX:
            del cast.slots[next(iter(cast.slots))]
        cast.slots[key] = wp.array(np.array(slots, dtype=np.int32), dtype=int, device=cast.device)
    return cast.slots[key]
