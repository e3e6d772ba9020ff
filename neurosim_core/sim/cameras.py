# mypy: disable-error-code="attr-defined,call-overload"
"""The cameras of a batch: the instants that each group renders, in one launch each, and the packets."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.packets import Image, Packet
from neurosim_core.render.outputs import INSTANT_OUTPUTS
from neurosim_core.runtime.cuda import Launches
from neurosim_core.runtime.pinned import PinnedMapping
from neurosim_core.runtime.timing import timed
from neurosim_core.scene.bodies import pose_bodies
from neurosim_core.sensors.base import PictureViews
from neurosim_core.sim.model import Model
from neurosim_core.sim.render_group import BatchBuffers, RenderGroupState
from neurosim_core.sim.state import Batch, State
from neurosim_core.sim.trace import Trace

_SLOT_LISTS_MAX = 256


@dataclass(kw_only=True, eq=False)
class RenderJob:
    """The instants of a batch that one group renders in one launch, at least one."""

    group: RenderGroupState
    buffers: BatchBuffers
    """The arrays that the job overwrites."""
    trace: Trace
    """The motion of the vehicles."""
    stamps_ns: Sequence[int]
    """Stamps of the instants, of the clock that all worlds share [ns]."""
    pictures: Sequence[tuple[int, int, str]]
    """Stamp, image slot and camera of each picture."""
    frames: Sequence[str]
    """Frame sensors that scan the instants."""
    pose_count: int
    """Number of instants whose poses are computed."""
    image_count: int
    """Number of image slots that are written."""
    from_slots: wp.array[int]
    """Slot of each instant in the trace."""
    to_slots: wp.array[int]
    """Image slot of each instant of all worlds; -1: no picture."""
    active: Any
    """0 where a world is not rendered, device array of int32, shape [world]; None: all are."""
    pattern: Hashable | None
    """Key of the launches: equal patterns have equal launches. None: the launches cannot be recorded."""
    picture_buffers: dict[tuple[str, int], NDArray[Any]] = field(default_factory=dict)
    """Buffers of the caller for pictures, by camera and stamp."""


def _choose_boundaries(model: Model, state: State, batch: Batch) -> list[Sequence[int]]:
    """Return the boundaries of a batch that each group renders; adaptive groups wait for the motion."""
    chosen: list[Sequence[int]] = []
    for index, group in enumerate(state.groups):
        due = due_places(group, batch, index)
        if group.rule is not None and due:
            with state.pipeline.choice(batch.number):
                due = _choose_adaptive(model, state, batch, group, due)
        chosen.append(due)
    return chosen


def _choose_adaptive(
    model: Model, state: State, batch: Batch, group: RenderGroupState, due: Sequence[int]
) -> list[int]:
    """Return the due boundaries that an adaptive group renders; waits for the motion of the batch.

    The group renders the ticks that its displacement rule chooses, the ends of the packets of its sensors,
    the last tick of the run, and the first tick of a camera. The rule moves on to the end of the batch.
    """
    assert group.rule is not None
    stamps_ns = [batch.stamps_ns[place] for place in due]
    enabled = [name for name in group.frames if name in batch.enabled_cameras]
    required = [model.config.sensors[name].packets for name in enabled]
    last_ns = group.rate.stamp_ns(group.rate.first_tick(model.duration_ns + 1) - 1)
    forced = [s == last_ns or any(clock.has_tick(s) for clock in required) for s in stamps_ns]
    forced[0] |= not group.referenced.issuperset(enabled)
    slots = [batch.slot + place for place in due]
    places = group.rule.choose(state.trace.arrays.states, slots, stamps_ns, forced)
    batch.left_out_count += len(due) - len(places)
    batch.coarse_count += group.rule.coarse_count
    return [due[place] for place in places]


def due_places(group: RenderGroupState, batch: Batch, index: int) -> Sequence[int]:
    """Return the boundaries at which enabled cameras of a group are due; others lose their reference."""
    group.referenced &= batch.enabled_cameras
    places = batch.stretch.group_places.get(index, ())
    if batch.enabled_cameras.isdisjoint(group.frames):  # a frame sensor needs every tick
        places = [p for p in places if pictures_due(group, batch.stamps_ns[p], batch.enabled_cameras)]
    return places


def pictures_due(group: RenderGroupState, stamp_ns: int, enabled: Collection[str]) -> list[str]:
    """Return the enabled image sensors that take a picture at a tick of a group."""
    return [name for name, image in group.images.items() if name in enabled and image.rate.has_tick(stamp_ns)]


def plan_jobs(model: Model, state: State, batch: Batch) -> Sequence[RenderJob]:
    """Return the renders of a batch, planned at the first call."""
    if batch.jobs is None:
        chosen = _choose_boundaries(model, state, batch)
        batch.jobs = [plan_job(state, batch, index, places) for index, places in enumerate(chosen) if places]
    return batch.jobs


def plan_ahead(model: Model, state: State, batch: Batch) -> None:
    """Plan the renders of a batch before it is launched, unless they depend on its motion."""
    if model.schedule.sparse or any(group.frames for group in state.groups):
        return
    plan_jobs(model, state, batch)


def plan_job(state: State, batch: Batch, index: int, places: Sequence[int]) -> RenderJob:
    """Return the job of a group that renders some boundaries of a batch, at least one."""
    group, buffer_index = state.groups[index], batch.number % state.pipeline.in_flight
    slots = tuple(batch.slot + place for place in places)
    stamps_ns = [batch.stamps_ns[place] for place in places]
    pictures = []
    image_slots = [-1] * len(places)
    used = 0
    for instant, stamp_ns in enumerate(stamps_ns if group.images else ()):
        due = pictures_due(group, stamp_ns, batch.enabled_cameras)
        pictures += [
            (stamp_ns, instant if group.images[name].output in INSTANT_OUTPUTS else used, name)
            for name in due
        ]
        if due:
            image_slots[instant] = used
            used += 1
    posed, placed = slots, tuple(image_slots)
    pattern: Hashable | None = None
    if group.only_launches:
        taken = tuple((slot, name) for _, slot, name in pictures)  # each picture has its own launches
        pattern = (id(group), buffer_index, posed, placed, taken)
    if group.world_count > 1:  # frustum candidate lists read the poses of all instants of a world
        posed += (slots[-1],) * (group.capacity - len(slots))
    buffers = group.buffers[buffer_index]
    if buffers.chosen_slots is None:
        from_slots = _on_device(group, (buffer_index, "from", posed), lambda: posed)
    else:
        pattern, from_slots = None, buffers.chosen_slots.array
        buffers.chosen_slots.rows[: len(slots)] = slots
    return RenderJob(
        group=group,
        buffers=buffers,
        trace=state.trace,
        stamps_ns=stamps_ns,
        pictures=pictures,
        frames=[name for name in group.frames if name in batch.enabled_cameras],
        pose_count=len(posed),
        image_count=used,
        from_slots=from_slots,
        to_slots=_on_device(group, (buffer_index, "to", placed), lambda: _image_slots(group, placed)),
        active=state.worlds.active if group.world_count > 1 else None,
        pattern=pattern,
    )


def acquire_picture_buffers(job: RenderJob) -> None:
    """Ask the caller for buffers for those pictures of a job that have none yet."""
    if job.group.allocate_picture is None:
        return
    for stamp_ns, slot, name in job.pictures:
        if (name, stamp_ns) not in job.picture_buffers:
            picture = job.buffers.copies[job.group.images[name].source].view(slot, 1)[0]
            buffer = job.group.allocate_picture(name, stamp_ns, picture)
            if buffer is not None:
                job.picture_buffers[name, stamp_ns] = buffer


def launch_key(job: RenderJob) -> Hashable | None:
    """Return the key of the launches of a job, which includes the addresses of picture buffers."""
    if job.pattern is None or job.group.allocate_picture is None:
        return job.pattern
    places = (job.picture_buffers.get((name, stamp_ns)) for stamp_ns, _, name in job.pictures)
    addresses = (0 if buffer is None else buffer.__array_interface__["data"][0] for buffer in places)
    return job.pattern, PinnedMapping.made_count, *addresses


def pose_cameras(job: RenderJob) -> PictureViews:
    """Launch the poses of cameras and bodies at the instants of a job; return their arrays."""
    group, buffers, instant_count = job.group, job.buffers, len(job.stamps_ns)
    p_WC, q_WC, stamps, bodies = buffers.p_WC, buffers.q_WC, buffers.stamps, buffers.bodies
    if buffers.chosen_slots is not None:
        buffers.chosen_slots.upload()
    camera: dict[str, Any] = {"count": job.pose_count, "p_BC": group.p_BC, "q_BC": group.q_BC}

    def pose(offsets_ns: Any, count: int, *, bodies: Any, **there: Any) -> None:
        job.trace.camera_poses(job.from_slots, offsets_ns, **camera, **there)
        if group.motions is not None and bodies is not None:
            pose_bodies(group.motions, there["stamps"], group.instants, count=count, poses=bodies)

    def compute_poses(offsets_ns: Any, **there: Any) -> None:
        pose(offsets_ns, there["stamps"].shape[0], **there)

    def compute_twists(twist: Any) -> None:
        job.trace.camera_twists(job.from_slots, twist, **camera)

    rows = instant_count * group.offsets_ns.shape[0] if group.world_count == 1 else stamps.shape[0]
    pose(group.offsets_ns, rows, p_WC=p_WC, q_WC=q_WC, stamps=stamps, bodies=bodies)
    return PictureViews(
        instant_count, job.to_slots, p_WC, q_WC, stamps, job.active, bodies, compute_poses, compute_twists
    )


def render(job: RenderJob, views: PictureViews) -> None:
    """Launch the rendering of all instants of a job, then the processing of pictures (`PictureProcess`)."""
    group, buffers = job.group, job.buffers
    buffers.renderer.render(
        views.p_WC,
        views.q_WC,
        views.image_slot,
        instant_count=views.instant_count,
        bodies=views.bodies,
        active=views.active,
    )
    for name in dict.fromkeys(name for _, _, name in job.pictures):
        if name in buffers.processes:
            buffers.processes[name].launch(views)
        if name in group.shared_pictures:
            wp.copy(group.pictures[name], group.shared_pictures[name])


def fetch_pictures(job: RenderJob) -> None:
    """Launch the copies of the pictures of a job to the host."""
    group, buffers = job.group, job.buffers
    if group.allocate_picture is None:
        for source, copy in buffers.copies.items():
            copy.fetch(0, len(job.stamps_ns) if source in INSTANT_OUTPUTS else job.image_count)
        return
    for stamp_ns, slot, name in job.pictures:
        copy = buffers.copies[group.images[name].source]
        buffer = job.picture_buffers.get((name, stamp_ns))
        if buffer is None:
            copy.fetch(slot, 1)
        else:
            copy.fetch_into(buffer, slot)


def plan_scans(state: State, batch: Batch) -> list[Launches]:
    """Return the launches of the enabled frame sensors for a batch.

    A sensor without a reference takes the first frame as its reference, and so do all sensors in worlds that
    are reset.
    """
    jobs = {id(job.group): job for job in batch.jobs or ()}
    scans: list[Launches] = []
    for group in state.groups:
        job = jobs.get(id(group))
        buffers, stamps_ns = (group.buffers[0], []) if job is None else (job.buffers, job.stamps_ns)
        for name, sensor in group.frames.items():
            if name not in batch.enabled_cameras:
                continue
            frames = buffers.renderer.log_radiance
            if stamps_ns and (batch.reset_mask is not None or name not in group.referenced):
                mask = state.worlds.active if batch.reset_mask is None else batch.reset_mask
                begin = partial(_begin, group, name, frames, stamps_ns, batch.until_ns, mask)
                scans.append(Launches(None, begin))
            elif (scan := sensor.plan(frames, stamps_ns, batch.until_ns)) is not None:
                key = None if scan.key is None else (name, scan.key)  # sensors of a kind have equal keys
                scans.append(scan._replace(key=key))
    return scans


def _begin(
    group: RenderGroupState, name: str, frames: Any, stamps_ns: Sequence[int], end_ns: int, mask: Any
) -> None:
    """Launch a sensor that takes the first frame as its reference, and scans the frames that follow."""
    sensor = group.frames[name]
    sensor.begin(frames, stamps_ns[0], mask)
    group.referenced.add(name)
    scan = sensor.plan(frames[1:], stamps_ns[1:], end_ns) if len(stamps_ns) > 1 else None
    if scan is not None:
        scan.launch()


def _is_all_in_place(batch: Batch) -> bool:
    """Return whether no run ends in the batch, and its only packets are pictures in buffers of the caller."""
    return batch.until_ns == batch.stamps_ns[-1] and all(
        not job.frames and len(job.picture_buffers) == len(job.pictures) for job in batch.jobs or ()
    )


def read_cameras(
    state: State, batch: Batch, *, borrow: bool, meanwhile: Callable[[], None] | None = None
) -> list[Packet]:
    """Wait for the renders and scans of a batch, and return the packets of its cameras.

    With `borrow`, pictures are views of the buffers of the batch. `meanwhile` is called while the device
    sorts events; it may launch the next batch with the same buffers.
    """
    packets: list[Packet] = []
    jobs = batch.jobs or ()
    with timed(state.wall_s, "camera read-back"):
        if not (state.pictures_in_place and _is_all_in_place(batch)):
            state.pipeline.wait(batch.number)
        readings = [
            job.group.frames[name].begin_read(job.stamps_ns, until_ns=batch.until_ns)
            for job in jobs
            for name in job.frames
        ]
        for job in jobs:
            state.counts["renders"] += len(job.stamps_ns)
            packets += _read_images(job, borrow=borrow)
    state.counts["ticks left out"] += batch.left_out_count
    state.counts["coarse ticks"] += batch.coarse_count
    if meanwhile is not None:
        meanwhile()
    with timed(state.wall_s, "events"):
        events = [packet for collect in readings for packet in collect()]
        state.counts["events dropped"] += sum(getattr(packet, "dropped_count", 0) for packet in events)
    return packets + events


def _read_images(job: RenderJob, *, borrow: bool) -> list[Packet]:
    """Return the pictures of a job that the device has finished.

    A picture in a buffer of the caller is returned there. Others are copies or, with `borrow`, views that are
    valid until the buffers are overwritten. Only an `Image` gets a view: packets of other classes may keep
    references to their picture.
    """
    copies: dict[tuple[str, int], NDArray[Any]] = {}
    packets: list[Packet] = []
    for stamp_ns, slot, name in job.pictures:
        image = job.group.images[name]
        picture = job.picture_buffers.pop((name, stamp_ns), None)
        if picture is None:
            picture = job.buffers.copies[image.source].view(slot, 1)[0]
            if not (borrow and image.gives_images):
                key = (image.source, slot)  # cameras that take the same picture share the copy
                picture = copies[key] if key in copies else copies.setdefault(key, np.array(picture))
        header = {"stamp_ns": stamp_ns, "sequence": image.sequence, "sensor": name}
        packet = image.config.packet(picture, **image.constants, **header)
        packets.append(packet)
        image.gives_images = isinstance(packet, Image)
        image.sequence += 1
    return packets


def _image_slots(group: RenderGroupState, image_slots: Sequence[int]) -> NDArray[Any]:
    """Return the image slots of the instants of all worlds, shape [N K]; -1: no picture."""
    own = np.full(group.capacity, -1)
    own[: len(image_slots)] = image_slots
    first = group.picture_count * np.arange(group.world_count)[:, None]
    return np.where(own < 0, -1, first + own).reshape(-1)


def _on_device(group: RenderGroupState, key: Hashable, slots: Callable[[], Any]) -> wp.array[int]:
    """Return a cached list of slots on the device; the key contains the index of the batch in flight."""
    if key not in group.slots:
        if len(group.slots) >= _SLOT_LISTS_MAX:
            del group.slots[next(iter(group.slots))]
        group.slots[key] = wp.array(np.array(slots(), dtype=np.int32), dtype=int, device=group.device)
    return group.slots[key]
