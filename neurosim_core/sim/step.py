"""The data flow of the simulator, in one function: read `launch` first.

    commands -> integrate -> sample the state -> pose cameras -> render -> scan events -> packets

What does not change is in `model.py`, what does in `state.py`: arrays with a leading axis of worlds, of which
a single run has one. A run is cut into batches (`schedule.py`). Within a batch the vehicles are integrated
from boundary to boundary, and their states stay on the device (`integrate.py`, `trace.py`). Then every render
group renders all its instants in one launch, every frame sensor scans them in one launch (`cameras.py`), and
what goes to the host is read back once.

How parts of a batch share a device (streams, graphs, several batches in flight) is in `runtime/cuda.py`; it
changes no result.
"""

from __future__ import annotations

from collections.abc import Callable

from neurosim_core.packets import Packet
from neurosim_core.runtime.timing import timed
from neurosim_core.sim.cameras import (
    acquire_picture_buffers,
    choose,
    find_in_worlds,
    launch_cameras,
    launch_key,
    plan_jobs,
    plan_world_frames,
    read_cameras,
    render,
    scan,
)
from neurosim_core.sim.integrate import in_order, launch_flight, plan_flight, read_flight
from neurosim_core.sim.model import Model
from neurosim_core.sim.state import Batch, State
from neurosim_core.warp_start import refuse_forked_process


def launch(model: Model, state: State, batch: Batch) -> None:
    """Launch one batch, from the command to the events, without waiting for a device.

    The batch says where the vehicles go, and which sensors are due there (`integrate.plan_batch`).
    """
    refuse_forked_process()
    # commands -> motor speeds -> motion, from boundary to boundary; state sensors measure on the way
    flight_key, flight = plan_flight(state, batch)
    if state.overlaps:  # each part on a stream of its own, while other batches are in flight
        launch_flight(state, batch, flight_key, flight)
        launch_cameras(model, state, batch)
    else:
        # poses of the cameras -> one render of all their instants
        jobs = plan_jobs(state, batch, choose(model, state, batch) if batch.jobs is None else ())
        for job in jobs:
            acquire_picture_buffers(job)
        frames = plan_world_frames(state, batch)

        def everything() -> tuple[object, ...]:
            held = flight(), *(render(job) for job in jobs)
            return *held, find_in_worlds(state, frames)  # log radiance -> events, in many worlds

        with timed(state.wall_s, "flight and render"):
            seen_key = tuple((each.offsets_ns, each.parity) for each in frames)
            state.graphs.run((flight_key, seen_key, *map(launch_key, jobs)), everything)
        scan(state, batch)  # log radiance -> events, in a world whose packets go to the host
    if state.on_host:
        state.in_flight.append(batch)


def launch_first(model: Model, state: State, batch: Batch) -> None:
    """Launch the batch at stamp 0 of many worlds: sensors sample, pictures are taken; nothing moves."""
    _, flight = plan_flight(state, batch)
    flight()
    for job in plan_jobs(state, batch, choose(model, state, batch)):
        render(job)


def read(
    model: Model, state: State, *, last: bool = False, meanwhile: Callable[[], None] | None = None
) -> list[Packet]:
    """Wait for the oldest batch in flight and return what the sensors yield in it, in the order of time.

    `state.stamp_ns` moves on to the end of the batch, or to where a collision ended the run (`ended`) or the
    integration failed (`failure`). If it is the `last`, nothing is launched before the pictures have been
    used: they may be borrowed, if that is wanted. `meanwhile`: see `read_cameras`.
    """
    batch = state.in_flight.popleft()
    with timed(state.wall_s, "read-back"):
        flown = state.flown if state.overlaps else state.batch_done  # one graph has one end
        flown[batch.number % len(flown)].wait()
        packets = read_flight(model, state, batch)  # may end the run before the end of the batch
    packets += read_cameras(state, batch, borrow=last and state.borrow_pictures, meanwhile=meanwhile)
    state.rendered_count += 1
    return in_order(model, packets, batch.until_ns)
