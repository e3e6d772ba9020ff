"""The data flow of the simulator in one function. Read `launch` first.

    command -> integrate -> sample the state -> pose cameras -> render -> scan frames -> packets

`model.py` holds the data that stay constant during a run, `state.py` the data that change: arrays with a
leading axis of worlds. A single run has one world. The schedule (`schedule.py`) cuts a run into batches.
Within a batch, the vehicles are integrated from boundary to boundary, and their states stay on the device
(`integrate.py`, `trace.py`). Then each render group renders all its instants in one launch, each frame sensor
scans them in one launch (`cameras.py`), and the results are read back to the host once.

`runtime/pipeline.py` decides how batches share a device (streams, graphs, several batches in flight). It does
not change the results.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from neurosim_core.packets import Packet
from neurosim_core.runtime.cuda import Launches
from neurosim_core.runtime.timing import timed
from neurosim_core.sim.cameras import (
    RenderJob,
    acquire_picture_buffers,
    fetch_pictures,
    launch_key,
    plan_jobs,
    plan_scans,
    pose_cameras,
    read_cameras,
    render,
)
from neurosim_core.sim.integrate import (
    fetch_flight,
    in_order,
    integrate,
    read_flight,
    take_command,
)
from neurosim_core.sim.model import Model
from neurosim_core.sim.state import Batch, State
from neurosim_core.warp_start import refuse_forked_process


def launch(model: Model, state: State, batch: Batch) -> None:
    """Launch one batch, from the command to the events, without waiting for a device.

    The batch lists the boundaries to integrate to and the sensors that are due there
    (`integrate.plan_batch`).
    """
    refuse_forked_process()
    with state.pipeline.batch(batch.number):
        launch_flight(state, batch)  # command -> integrate -> sample the state
        launch_cameras(model, state, batch)  # pose cameras -> render -> scan frames
    if state.on_host:
        state.in_flight.append(batch)


def launch_flight(state: State, batch: Batch) -> None:
    """Launch the motion of the vehicles through a batch."""
    state.launched_count += 1
    state.launched_ns = batch.until_ns
    command = take_command(state)
    key = (command.key, batch.slot, batch.closed_loop, batch.stretch.flight)

    def launch_motion() -> object:
        keep_alive = command.launch()  # setpoints -> rotor speeds
        integrate(state, batch)  # motion, from boundary to boundary; state sensors sample on the way
        fetch_flight(state, batch)  # -> host
        return keep_alive

    with state.pipeline.flight(batch.number):
        state.pipeline.run(Launches(key, launch_motion))


def launch_cameras(model: Model, state: State, batch: Batch) -> None:
    """Launch the enabled cameras of a batch whose motion has been launched."""

    def launch_render(job: RenderJob) -> object:
        views = pose_cameras(job)  # motion -> poses of cameras and bodies, at all instants
        render(job, views)  # all instants of all worlds in one launch; then the noise of pictures
        fetch_pictures(job)  # -> host
        return job.from_slots, job.to_slots

    jobs = plan_jobs(model, state, batch)
    with state.pipeline.renders(batch.number):
        for job in jobs:
            acquire_picture_buffers(job)
            state.pipeline.run(Launches(launch_key(job), partial(launch_render, job)))
    with state.pipeline.scans(batch.number):
        for scan in plan_scans(state, batch):  # log radiance -> events
            state.pipeline.run(scan)


def read(
    model: Model, state: State, *, last: bool = False, meanwhile: Callable[[], None] | None = None
) -> list[Packet]:
    """Wait for the oldest batch in flight and return its packets in the order of time.

    `state.stamp_ns` moves on to the end of the batch, or to the stamp at which a collision ended the run
    (`ended`) or the integration failed (`failure`). With `last`, the caller launches nothing before it has
    used the pictures, so they may be views (`State.borrow_pictures`). `meanwhile`: see `read_cameras`.
    """
    batch = state.in_flight.popleft()
    with timed(state.wall_s, "read-back"):
        state.pipeline.wait_flight(batch.number)
        packets = read_flight(model, state, batch)  # may end the run before the end of the batch
    packets += read_cameras(state, batch, borrow=last and state.borrow_pictures, meanwhile=meanwhile)
    state.rendered_count += 1
    return in_order(model, packets, batch.until_ns)
