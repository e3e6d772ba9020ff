# mypy: disable-error-code="attr-defined"
"""What the cameras see of one batch: which instants they render, in one launch each, and the packets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from neurosim_core.clock import Rate
from neurosim_core.packets import Packet
from neurosim_core.runtime.cuda import use_stream
from neurosim_core.runtime.timing import timed
from neurosim_core.sim.model import Model
from neurosim_core.sim.render_group import RenderGroupState
from neurosim_core.sim.render_job import (
    RenderJob,
    acquire_room,
    begin_frames,
    choose_ticks,
    disable_frame_sensors,
    is_due,
    launch_key,
    plan_render,
    read_images,
    scan_frames,
)
from neurosim_core.sim.state import Batch, State


def launch_cameras(model: Model, state: State, batch: Batch) -> None:
    """Let the cameras that are wanted see a batch, and launch the copies to the host."""
    jobs = batch.jobs
    due = choose(model, state, batch) if jobs is None else ()
    stream = state.render_streams[batch.number % len(state.batch_done)]
    with timed(state.wall_s, "render"), use_stream(stream):
        state.flown[batch.number % state.render_backlog].wait_on_stream()
        if jobs is None:
            jobs = plan_jobs(state, batch, due)
        for job in jobs:
            acquire_room(job)
            if job.key is None:
                job.render()
            else:
                state.graphs.run(launch_key(job), job.render)
        state.rendered.set()
    with use_stream(state.event_stream):
        state.rendered.wait_on_stream()
        scan(state, batch, jobs)


def choose(model: Model, state: State, batch: Batch) -> list[list[int]]:
    """Return which boundaries of a batch each group has to render; adaptive groups wait for the flight."""
    chosen: list[list[int]] = []
    choices = []
    for index, group in enumerate(state.groups):
        disable_frame_sensors(group, batch.wanted)
        always = bool(group.world_frames) or any(name in batch.wanted for name in group.frames)
        due = [
            place
            for place, boundary in enumerate(batch.boundaries)
            if index in boundary.groups and (always or is_due(group, boundary.stamp_ns, batch.wanted))
        ]
        if group.rule is not None:
            with timed(state.wall_s, "choice of renders"), use_stream(state.choice_stream):
                state.flown[batch.number % state.render_backlog].wait_on_stream()
                choice = choose_ticks(
                    group,
                    state.trace,
                    slots=[batch.slot + place for place in due],
                    stamps_ns=[batch.boundaries[place].stamp_ns for place in due],
                    end_ns=model.duration_ns,
                    wanted=batch.wanted,
                    required=_required_clocks(model, group),
                )
            choices.append(choice)
            due = [due[place] for place in choice.places]
        chosen.append(due)
    batch.choices = choices
    return chosen


def _required_clocks(model: Model, group: RenderGroupState) -> dict[str, Rate]:
    """Return the clocks whose ticks an adaptive group renders in any case, by frame sensor."""
    return {name: model.config.sensors[name].packets for name in group.frames}


def plan_jobs(state: State, batch: Batch, chosen: Sequence[Sequence[int]]) -> list[RenderJob]:
    """Return what the groups have to render of a batch: at the boundaries chosen for each."""
    return [
        plan_render(
            group,
            state.trace,
            slots=[batch.slot + place for place in places],
            stamps_ns=[batch.boundaries[place].stamp_ns for place in places],
            buffer_index=batch.number % len(state.batch_done),
            wanted=batch.wanted,
            active=state.worlds.active if state.world_count > 1 else None,
        )
        for group, places in zip(state.groups, chosen, strict=True)
        if places
    ]


def scan(state: State, batch: Batch, jobs: Sequence[RenderJob]) -> None:
    """Let event cameras see what was rendered; that is the end of a batch on the device."""
    with timed(state.wall_s, "events"):
        for job in jobs:
            scan_frames(job.group, job.instants)
        state.batch_done[batch.number % len(state.batch_done)].set()
    batch.seen = [(job.group, job.instants) for job in jobs]


def plan_ahead(model: Model, state: State, batch: Batch) -> None:
    """Plan what is rendered of a batch that is going to be flown, unless that depends on the flight."""
    if model.schedule.sparse or any(group.frames for group in state.groups):
        return
    batch.jobs = plan_jobs(state, batch, choose(model, state, batch))


def _is_late(batch: Batch) -> bool:
    """Return whether all that cameras yield is pictures that go to room of the caller's, and all count."""
    return batch.until_ns == batch.boundaries[-1].stamp_ns and all(
        not instants.frames and len(instants.rooms) == len(instants.pictures) for _, instants in batch.seen
    )


def read_cameras(
    state: State, batch: Batch, *, borrow: bool, meanwhile: Callable[[], None] | None = None
) -> list[Packet]:
    """Wait until the cameras have seen a batch, and return what they yield.

    With `borrow` pictures are views of the buffers of the batch. `meanwhile` is called while a device sorts
    events; the next batch with the same buffers may be launched there.
    """
    packets: list[Packet] = []
    with timed(state.wall_s, "camera read-back"):
        if not (state.pictures_in_place and _is_late(batch)):
            state.batch_done[batch.number % len(state.batch_done)].wait()
        seen = [begin_frames(*each, until_ns=batch.until_ns) for each in batch.seen]
        for group, instants in batch.seen:
            state.counts["renders"] += len(instants.stamps_ns)
            packets += read_images(group, instants, borrow=borrow)
    for choice in batch.choices:
        state.counts["ticks left out"] += choice.left_out_count
        state.counts["coarse ticks"] += choice.coarse_count
    if meanwhile is not None:
        meanwhile()
    with timed(state.wall_s, "events"):
        events = [packet for sensors in seen for hand_out in sensors for packet in hand_out()]
        state.counts["events dropped"] += sum(getattr(packet, "dropped_count", 0) for packet in events)
    return packets + events


class WorldFrames(NamedTuple):
    """What the frame sensors of a group see of a batch in many worlds."""

    group: RenderGroupState
    offsets_ns: tuple[int, ...]
    """From the end of the batch to the instant before it and to those within it [ns]."""
    parity: int
    """Which of the two states of the sensors is the present one."""


def plan_world_frames(state: State, batch: Batch) -> list[WorldFrames]:
    """Return what frame sensors see of a batch in many worlds; groups that do are in their other state then.

    What they need on the device is allocated.
    """
    begin_ns, end_ns = batch.until_ns - sum(batch.elapsed_ns), batch.until_ns
    found = []
    for index, group in enumerate(state.groups):
        seen = [b.stamp_ns - end_ns for b in batch.boundaries if index in b.groups]
        if group.world_frames:
            offsets_ns = (batch.last_seen_ns[index] + begin_ns - end_ns, *seen)
            found.append(WorldFrames(group, offsets_ns, group.parity))
            for sensor in group.world_frames.values():
                sensor.offsets(offsets_ns)
        if seen:
            group.parity = 1 - group.parity
    return found


def find_in_worlds(state: State, frames: Sequence[WorldFrames]) -> list[object]:
    """Let the frame sensors of many worlds see what was rendered; launches only.

    The clocks of the worlds are at the end of the batch. What is returned has to be kept by a graph of these
    launches.
    """
    held: list[object] = []
    for group, offsets_ns, parity in frames:
        for sensor in group.world_frames.values():
            held.append(sensor.offsets(offsets_ns))
            sensor.find(state.worlds.clock_ns, offsets_ns, parity)
    return held
