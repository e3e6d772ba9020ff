# mypy: disable-error-code="attr-defined,no-untyped-call"
"""What the cameras see of one batch: which instants they render, in one launch each, and the packets."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from neurosim_core.model import Model
from neurosim_core.packets import Packet
from neurosim_core.phases import timed
from neurosim_core.run_state import Batch, State
from neurosim_core.sensors.cast import (
    Look,
    ask_for_room,
    bring_images,
    choose_ticks,
    close_eyes,
    is_due,
    launch_key,
    plan_look,
    read_events,
    read_images,
    scan_events,
)
from neurosim_core.streams import on


def look_at(model: Model, state: State, batch: Batch, casts: Collection[int] | None = None) -> None:
    """Let the cameras that are wanted see a batch, and launch the copies to the host.

    Args:
        model: What does not change.
        state: What does.
        batch: What was flown.
        casts: Which look; None: all.
    """
    looks = batch.looks
    due = choose(model, state, batch, casts) if looks is None else ()
    with timed(state.wall_s, "render"), on(state.render_streams[batch.number % len(state.lanes)]):
        state.flown[batch.number % state.flight_lane_count].hold()
        if looks is None:
            looks = plan_looks(state, batch, due)
        for look in looks:
            ask_for_room(look)
            if look.key is None:
                look.render()
            else:
                state.graphs.run(launch_key(look), look.render)
            bring_images(look.cast, look.instants)
        state.rendered.set()
    with on(state.event_stream):
        state.rendered.hold()
        scan(state, batch, looks)


def choose(model: Model, state: State, batch: Batch, casts: Collection[int] | None = None) -> list[list[int]]:
    """Return which boundaries of a batch each cast has to render; adaptive casts wait for the flight.

    Those that are not among `casts` have none.
    """
    chosen: list[list[int]] = []
    choices = []
    for index, cast in enumerate(state.casts):
        if casts is not None and index not in casts:
            chosen.append([])
            continue
        close_eyes(cast, batch.wanted)
        always = any(name in batch.wanted for name in cast.events)
        due = [
            place
            for place, boundary in enumerate(batch.boundaries)
            if index in boundary.casts and (always or is_due(cast, boundary.stamp_ns, batch.wanted))
        ]
        if cast.rule is not None:
            with timed(state.wall_s, "choice of renders"), on(state.choice_stream):
                state.flown[batch.number % state.flight_lane_count].hold()
                choice = choose_ticks(
                    cast,
                    state.trace,
                    slots=[batch.slot + place for place in due],
                    stamps_ns=[batch.boundaries[place].stamp_ns for place in due],
                    end_ns=model.duration_ns,
                    wanted=batch.wanted,
                )
            choices.append(choice)
            due = [due[place] for place in choice.places]
        chosen.append(due)
    batch.choices = choices
    return chosen


def plan_looks(state: State, batch: Batch, chosen: Sequence[Sequence[int]]) -> list[Look]:
    """Return what the casts have to render of a batch: at the boundaries chosen for each."""
    return [
        plan_look(
            cast,
            state.trace,
            slots=[batch.slot + place for place in places],
            stamps_ns=[batch.boundaries[place].stamp_ns for place in places],
            lane=batch.number % len(state.lanes),
            wanted=batch.wanted,
        )
        for cast, places in zip(state.casts, chosen, strict=True)
        if places
    ]


def scan(state: State, batch: Batch, looks: Sequence[Look]) -> None:
    """Let event cameras see what was rendered; that is the end of a batch on the device."""
    with timed(state.wall_s, "events"):
        for look in looks:
            scan_events(look.cast, look.instants)
        state.lanes[batch.number % len(state.lanes)].set()
    batch.seen = [(look.cast, look.instants) for look in looks]


def plan_ahead(model: Model, state: State, batch: Batch) -> None:
    """Plan what is rendered of a batch that is going to be flown, unless that depends on the flight."""
    if model.schedule.sparse or any(cast.events for cast in state.casts):
        return
    batch.looks = plan_looks(state, batch, choose(model, state, batch))


def _is_late(batch: Batch) -> bool:
    """Return whether all that cameras yield is pictures that go to room of the caller's, and all count."""
    return batch.until_ns == batch.boundaries[-1].stamp_ns and all(
        not instants.events and len(instants.rooms) == len(instants.pictures) for _, instants in batch.seen
    )


def read_cameras(state: State, batch: Batch, *, borrow: bool) -> list[Packet]:
    """Wait until the cameras have seen a batch, and return what they yield.

    Args:
        state: Where it is under way.
        batch: What was flown.
        borrow: Pictures are views of the lane's buffers.
    """
    packets: list[Packet] = []
    with timed(state.wall_s, "camera read-back"):
        if not (state.late_pictures and _is_late(batch)):
            state.lanes[batch.number % len(state.lanes)].wait()
    state.counts["renders"] += sum(len(instants.stamps_ns) for _, instants in batch.seen)
    for choice in batch.choices:
        state.counts["ticks left out"] += choice.left_out_count
        state.counts["coarse ticks"] += choice.coarse_count
    with timed(state.wall_s, "events"):
        for cast, instants in batch.seen:
            events = read_events(cast, instants, until_ns=batch.until_ns)
            state.counts["events dropped"] += sum(packet.dropped_count for packet in events)
            packets += events
    with timed(state.wall_s, "camera read-back"):
        for cast, instants in batch.seen:
            packets += read_images(cast, instants, borrow=borrow)
    return packets
