# mypy: disable-error-code="attr-defined,call-overload"
"""The batches of a render group: which ticks are rendered, how, and what is read when that is done."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import Rate
from neurosim_core.packets import Image, Packet
from neurosim_core.render.outputs import INSTANT_OUTPUTS
from neurosim_core.runtime.pinned import PinnedMapping
from neurosim_core.scene.bodies import (
    pose_bodies,
)
from neurosim_core.sensors.base import (
    PictureViews,
)
from neurosim_core.sim.render_group import ImageChannel, RenderGroupState
from neurosim_core.sim.trace import Trace

_SLOT_LISTS_MAX = 256


@dataclass(frozen=True, kw_only=True, eq=False)
class Instants:
    """What a group sees in one batch."""

    buffer_index: int
    """Which of the batches in flight it is."""
    stamps_ns: tuple[int, ...]
    """Stamps of the instants, at least one."""
    pictures: tuple[tuple[int, int, str], ...]
    """Stamp, image slot and camera of each picture."""
    frames: tuple[str, ...]
    """Frame sensors that see them."""
    rooms: dict[tuple[str, int], NDArray[Any]] = field(default_factory=dict)
    """Memory of the caller's that pictures are copied to, by camera and stamp."""


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

    These are the ticks that its rule asks for, those that its sensors require, by name, the last tick of the
    run, and the first tick that a camera sees. The rule moves on to the end of the batch, of whose ticks
    slots in the trace and stamps are given.
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
    """Same key, same launches; None: they do not come again, or more than launches is done."""
    render: Callable[[], Any]
    """Launches the rendering and, unless that is done apart, the copy of the pictures; returns what must be
    kept for a graph of it."""


def plan_render(
    group: RenderGroupState,
    trace: Trace,
    slots: Sequence[int],
    stamps_ns: Sequence[int],
    *,
    buffer_index: int,
    wanted: Collection[str],
    active: Any = None,
) -> RenderJob:
    """Return how a group renders the instants of a batch, at least one; its buffers are overwritten by that.

    Stamps are of the clock that all worlds share, slots of the trace. `active` is 0 where a world is not
    rendered, device array of int32, shape [world]; None: all are.
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
    key: Hashable | None = (id(group), buffer_index, posed, placed) if group.only_launches else None
    if group.world_count > 1:  # shared walks look at all instants of a world
        posed += (slots[-1],) * (group.capacity - len(slots))
    buffers, chosen = group.buffers[buffer_index], None
    if group.rule is not None:
        key, chosen = None, buffers.chosen_slots
        assert chosen is not None
        chosen.rows[: len(slots)] = slots
    from_slots = (
        _on_device(group, (buffer_index, "from", posed), lambda: posed) if chosen is None else chosen.array
    )
    to_slots = _on_device(group, (buffer_index, "to", placed), lambda: _image_slots(group, placed))
    p_WC, q_WC, stamps, bodies = buffers.p_WC, buffers.q_WC, buffers.stamps, buffers.bodies

    def render() -> tuple[Any, Any]:
        if chosen is not None:
            chosen.upload()
        mount: dict[str, Any] = {"p_BC": group.p_BC, "q_BC": group.q_BC}
        poses = {"count": len(posed), **mount, "p_WC": p_WC, "q_WC": q_WC, "stamps": stamps}
        if group.offsets_ns is None:
            trace.camera_poses(from_slots, **poses)
        else:
            trace.ray_poses(from_slots, group.offsets_ns, **poses)
        if group.motions is not None and bodies is not None:
            rays = 1 if group.offsets_ns is None else group.offsets_ns.shape[0]
            count = len(slots) * rays if group.world_count == 1 else stamps.shape[0]
            pose_bodies(group.motions, stamps, group.instants, count=count, poses=bodies)
        buffers.renderer.render(p_WC, q_WC, to_slots, instant_count=len(slots), bodies=bodies, active=active)

        def look(offsets_ns: Any, **there: Any) -> None:
            bodies_then = there.pop("bodies")
            trace.ray_poses(from_slots, offsets_ns, count=len(posed), **mount, **there)
            if group.motions is not None:
                times = there["stamps"]
                pose_bodies(group.motions, times, group.instants, count=times.shape[0], poses=bodies_then)

        find_twists = partial(trace.camera_twists, from_slots, count=len(posed), **mount)
        views = PictureViews(len(slots), to_slots, p_WC, q_WC, stamps, active, bodies, look, find_twists)
        for name in {name: None for _, _, name in pictures}:
            if name in buffers.processes:
                buffers.processes[name].launch(views)
            if name in group.shared_pictures:
                wp.copy(group.pictures[name], group.shared_pictures[name])
        if group.make_room is None:
            for source, copy in buffers.copies.items():
                copy.fetch(0, len(slots) if source in INSTANT_OUTPUTS else used)
        else:
            _bring(group, instants)
        return from_slots, to_slots

    instants = Instants(
        buffer_index=buffer_index,
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
            picture = group.buffers[instants.buffer_index].copies[group.images[name].source].view(slot, 1)[0]
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
    frames = group.buffers[instants.buffer_index].renderer.log_radiance
    for name in instants.frames:
        group.frames[name].see(frames, instants.stamps_ns)


def begin_frames(
    group: RenderGroupState, instants: Instants, *, until_ns: int
) -> list[Callable[[], list[Packet]]]:
    """Return what gives the packets of each frame sensor that end in the batch, at most at a stamp."""
    return [group.frames[name].begin_read(instants.stamps_ns, until_ns=until_ns) for name in instants.frames]


def flush_frames(group: RenderGroupState, *, until_ns: int) -> list[Packet]:
    """Return the packets of frame sensors that have begun and not ended, cut at a stamp."""
    return [packet for sensor in group.frames.values() for packet in sensor.flush(until_ns=until_ns)]


def _bring(group: RenderGroupState, instants: Instants) -> None:
    """Launch the copies of pictures to the host: to the room that there is, or as usual."""
    for stamp_ns, slot, name in instants.pictures:
        copy = group.buffers[instants.buffer_index].copies[group.images[name].source]
        room = instants.rooms.get((name, stamp_ns))
        if room is None:
            copy.fetch(slot, 1)
        else:
            copy.fetch_into(room, slot)


def read_images(group: RenderGroupState, instants: Instants, *, borrow: bool = False) -> list[Packet]:
    """Return the pictures of a batch that the device has finished with.

    With `borrow` those for which the caller has no room are views that are valid until the buffers are
    overwritten, not copies, if what their sensor yields is an `Image`.
    """
    copies: dict[tuple[str, int], NDArray[Any]] = {}

    def copy_of(image: ImageChannel, slot: int, name: str, stamp_ns: int) -> NDArray[Any]:
        room = instants.rooms.pop((name, stamp_ns), None)
        if room is not None:
            return room
        picture: NDArray[Any] = group.buffers[instants.buffer_index].copies[image.source].view(slot, 1)[0]
        if borrow and image.gives_images:
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
        packet = image.config.packet(picture, **image.constants, **header)
        packets.append(packet)
        image.gives_images = isinstance(
            packet, Image
        )  # of other packets nobody knows whether they keep a view
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
