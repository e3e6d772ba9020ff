# mypy: disable-error-code="attr-defined"
"""Single runs: with the path controller on the device, or with an external controller.

`run_model` flies with the path controller. On a CUDA device it launches the next batches before it reads one
back, so the device always has work; batches launched beyond the end of a run are never read.

An external controller advances one control period at a time. `step` launches a period and returns its
packets. `begin_step` and `end_step` do the same in two halves, between which the host can work while a CUDA
device is busy. `integrate_period` launches the motion only; another thread renders with `render_batch` or
`skip_batch`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path as FilePath
from typing import Any, NamedTuple

from neurosim_core.config import SimulationConfig, as_config
from neurosim_core.control import CommandMode
from neurosim_core.packets import Odometry, Packet
from neurosim_core.runtime.timing import timed
from neurosim_core.sim.cameras import (
    acquire_picture_buffers,
    due_places,
    pictures_due,
    plan_ahead,
    read_cameras,
)
from neurosim_core.sim.integrate import (
    Command,
    in_order,
    plan_batch,
    read_flight,
    set_command,
)
from neurosim_core.sim.model import Model, make_model
from neurosim_core.sim.schedule import Stretch
from neurosim_core.sim.state import Batch, State, make_state
from neurosim_core.sim.step import launch, launch_cameras, launch_flight, read
from neurosim_core.vehicle.arrays import read_state


def run(config: SimulationConfig | Mapping[str, Any] | str | FilePath | None = None) -> Iterator[Packet]:
    """Yield every packet of a run in the order of time; packets with the same stamp come in the rig's order.

    Args:
        config: What `load_config` returns or accepts.

    Raises:
        DynamicsError: The integration failed; all packets before its stamp have been yielded.
    """
    config = as_config(config)
    model = make_model(config, meanwhile=warm_flight)
    yield from run_model(model, make_state(model))


def run_model(model: Model, state: State) -> Iterator[Packet]:
    """Yield every packet from the state's present stamp to the end of the run; see `run`.

    With several batches in flight, the vehicle is up to that many batches ahead of the packets.
    """
    if state.launched_count == 0:
        yield from start(model, state)

    def launch_ahead() -> None:
        while len(state.in_flight) < state.pipeline.in_flight and state.launched_ns < model.duration_ns:
            end_ns = model.schedule.batch_end_ns(state.launched_ns, model.duration_ns)
            launch_until(model, state, end_ns)

    while not state.ended:
        launch_ahead()
        if not state.in_flight:
            break
        yield from read(model, state, meanwhile=launch_ahead if state.pipeline.in_flight > 1 else None)
        if state.failure is not None:
            raise state.failure
    yield from finish(state)


def step(model: Model, state: State, command: Command, *, mode: CommandMode = "motor_speeds") -> list[Packet]:
    """Hold a command of an external controller until the next tick of the control clock.

    Args:
        model: The model of the run.
        state: The state of the run; advanced by one control period.
        command: A setpoint (`control.setpoints`), or a row of the mode (`control.modes.MODES`), by default
            rotor speeds [rad/s], shape [R]. Other modes are converted to rotor speeds once, at the beginning
            of the period. None: hold the present rotor speeds.
        mode: Command mode of a row.

    Returns:
        The packets in (stamp, next stamp], in the order of time; the first call also returns those of stamp
        0. The list ends early if a collision ended the run (`state.ended`) or the integration failed
        (`state.failure`).

    Raises:
        ValueError: The command has a wrong shape or is not finite.
        DynamicsError: The integration failed in an earlier period, whose packets have been returned.
    """
    return end_step(model, state, begin_step(model, state, command, mode=mode))


class PendingStep(NamedTuple):
    """A control period that `begin_step` has launched, and `end_step` will read back."""

    packets: list[Packet]
    """Packets from before the period: those of stamp 0 in the first period."""
    end_ns: int
    """Its end [ns]."""


def begin_step(
    model: Model, state: State, command: Command, *, mode: CommandMode = "motor_speeds"
) -> PendingStep:
    """Launch a control period like `step`, without waiting for a CUDA device.

    Args:
        model: The model of the run.
        state: The state of the run; the next call with it must be `end_step`.
        command: See `step`.
        mode: See `step`.

    Returns:
        The argument of `end_step`.

    Raises:
        RuntimeError: A period is pending, or `run_model` was interrupted.
        ValueError: The command has a wrong shape or is not finite.
        DynamicsError: The integration failed in an earlier period.
    """
    if state.failure is not None:
        raise state.failure
    _check_all_read(state)
    packets = start(model, state) if state.launched_count == 0 else []
    set_command(model, state, command, mode)
    batch, state.planned = state.planned, None
    if batch is None or (batch.number, batch.enabled_cameras) != (
        state.launched_count,
        state.enabled_cameras,
    ):
        batch = _plan_period(model, state)
    end_ns = model.schedule.period_end_ns(state.launched_ns)
    launch(model, state, batch)
    return PendingStep(packets, end_ns)


def prepare_step(model: Model, state: State) -> None:
    """Plan the next control period while a CUDA device is busy, so that `begin_step` takes less time.

    Args:
        model: The model of the run.
        state: Keeps the plan, which the next `begin_step` uses unless other cameras have been selected.
    """
    state.planned = _plan_period(model, state)
    plan_ahead(model, state, state.planned)


def acquire_next_picture_buffers(state: State) -> None:
    """Ask for picture buffers of a prepared control period, so that `begin_step` takes less time."""
    if state.planned is not None:
        for job in state.planned.jobs or ():
            acquire_picture_buffers(job)


def settle(state: State) -> None:
    """Wait until the device has written all pictures to the buffers of the caller (`allocate_picture`)."""
    state.pipeline.wait_all()


def end_step(model: Model, state: State, pending: PendingStep) -> list[Packet]:
    """Wait for a pending control period, and return its packets as `step` does.

    Args:
        model: The model of the run.
        state: The state of the run; advanced by the period.
        pending: The return value of `begin_step`.
    """
    packets = pending.packets + read(model, state, last=state.launched_ns >= pending.end_ns)
    while state.launched_ns < pending.end_ns and not (state.ended or state.failure is not None):
        part_ns = model.schedule.batch_end_ns(state.launched_ns, pending.end_ns)
        launch_until(model, state, part_ns, closed_loop=False)
        packets += read(model, state, last=part_ns >= pending.end_ns)
    return packets


def warm_up(model: Model) -> None:
    """Compile and load the kernels of all sensors: fly one control period of an episode and discard it."""
    step(model, make_state(model), None)


def warm_flight(model: Model, *_: object) -> None:
    """Compile and load the kernels of a flight: render once, and fly one control period.

    This is an argument for `make_model(meanwhile=...)`. It uses the current stream of the device, and no
    launch twice: a second launch would be recorded as a graph while other threads launch.
    """
    state = make_state(model, in_flight=1)
    start(model, state)
    state.enabled_cameras = frozenset()
    advance(model, state, model.schedule.batch_end_ns(0, model.schedule.period_end_ns(0)))


def integrate_period(
    model: Model, state: State, command: Command, *, mode: CommandMode = "motor_speeds"
) -> tuple[list[Packet], list[Batch]]:
    """Integrate one control period like `step`, without its cameras.

    Returns:
        Packets of state sensors and collisions, in the order of time; and the batches to render. Pass each
        batch to `render_batch` or `skip_batch`, in order, from one thread at a time.

    Raises:
        RuntimeError: Too many batches wait for rendering: see `render_backlog_left`.
        ValueError: The command has a wrong shape or is not finite.
        DynamicsError: The integration failed in an earlier period, whose packets have been returned.
    """
    if state.failure is not None:
        raise state.failure
    packets: list[Packet] = []
    batches: list[Batch] = []

    def fly(stretch: Stretch) -> None:
        if render_backlog_left(state) < 1:
            raise RuntimeError(
                f"{state.pipeline.flown_ahead} batches wait for render_batch() or skip_batch(), as many as "
                "make_state(render_backlog=...) allows: render or skip one"
            )
        batch = plan_batch(state, stretch, closed_loop=False)
        launch_flight(state, batch)
        batches.append(batch)
        with timed(state.wall_s, "read-back"):
            state.pipeline.wait_flight(batch.number)
            packets.extend(in_order(model, read_flight(model, state, batch), state.stamp_ns))

    if state.launched_count == 0:
        fly(model.schedule.first())
    set_command(model, state, command, mode)
    for end_ns in _parts_of_period(model, state):
        fly(model.schedule.stretch(state.launched_ns, end_ns))
        if state.ended or state.failure is not None:
            break
    return packets, batches


def render_backlog_left(state: State) -> int:
    """Return the number of batches that `integrate_period` may add before one is rendered or skipped."""
    return state.pipeline.flown_ahead - (state.launched_count - state.rendered_count)


def render_batch(model: Model, state: State, batch: Batch) -> list[Packet]:
    """Render a batch of `integrate_period`; return the packets of its cameras in the order of time.

    Args:
        model: The model of the run.
        state: The state of the run. Only camera data change, so another thread may integrate meanwhile.
        batch: The oldest batch that was neither rendered nor skipped.
    """
    launch_cameras(model, state, batch)
    packets = read_cameras(state, batch, borrow=state.borrow_pictures)
    state.rendered_count += 1
    return in_order(model, packets, batch.until_ns)


def skip_batch(model: Model, state: State, batch: Batch) -> int:
    """Skip the renders of a batch, in place of `render_batch`; arguments are the same.

    The sequence numbers of image cameras show the gap. For an event camera, log radiance is linear in time
    over the gap, and a window of events that should end in it extends to the next render.

    Returns:
        Number of instants that were not rendered.
    """
    count = 0
    for index, group in enumerate(state.groups):
        places = due_places(group, batch, index)
        count += len(places)
        for place in places:
            for name in pictures_due(group, batch.stamps_ns[place], batch.enabled_cameras):
                group.images[name].sequence += 1
    state.rendered_count += 1
    return count


def select_cameras(model: Model, state: State, names: Collection[str]) -> None:
    """Select the cameras that are rendered, from the next control period on.

    An event camera that is enabled again takes the next rendered instant as its reference, and its sequence
    numbers continue.

    Args:
        model: The model of the run.
        state: The state of the run, which keeps the selection.
        names: Names of the cameras in the settings.

    Raises:
        ValueError: There is no such camera.
    """
    known = {name for group in model.groups for name in group.names}
    if not known.issuperset(names):
        raise ValueError(f"unknown cameras {sorted(set(names) - known)}, known: {sorted(known)}")
    state.enabled_cameras = frozenset(names)


def observe(state: State) -> Odometry:
    """Return the true state of the vehicle at the state's stamp, as a packet named `odometry`."""
    if state.last is None:
        now = read_state(state.vehicle.arrays)._asdict()
        state.last = Odometry(sensor="odometry", **{name: rows[0] for name, rows in now.items()})
    return state.last


def start(model: Model, state: State) -> list[Packet]:
    """Sample every sensor at stamp 0, and return the packets; event cameras take their reference there.

    Args:
        model: The model of the run.
        state: A new state, from `make_state`.
    """
    launch(model, state, plan_batch(state, model.schedule.first(), closed_loop=True))
    return read(model, state)


def advance(model: Model, state: State, end_ns: int) -> list[Packet]:
    """Fly one batch with the path controller, and return its packets.

    Args:
        model: The model of the run.
        state: The state of the run; advanced to `end_ns`, or to the stamp at which a collision ended the run
            (`ended`) or the integration failed (`failure`).
        end_ns: End of the batch [ns], after the state's stamp, at most `Schedule.batch_end_ns`.

    Raises:
        RuntimeError: `run_model` was interrupted, so batches are in flight.
    """
    _check_all_read(state)
    launch_until(model, state, end_ns)
    return read(model, state)


def launch_until(model: Model, state: State, end_ns: int, *, closed_loop: bool = True) -> None:
    """Launch one batch, as `advance` flies it, without waiting for a CUDA device.

    Args:
        model: The model of the run.
        state: The state of the run, with fewer batches in flight than its maximum.
        end_ns: End of the batch [ns], after the end of the last launched batch.
        closed_loop: The path controller commands; otherwise the last command is held.
    """
    stretch = model.schedule.stretch(state.launched_ns, end_ns)
    launch(model, state, plan_batch(state, stretch, closed_loop=closed_loop))


def finish(state: State) -> list[Packet]:
    """Return the packets of open windows, cut at the state's stamp; for the end of a run."""
    sensors = [
        group.frames[name] for group in state.groups for name in group.frames if name in group.referenced
    ]
    return [packet for sensor in sensors for packet in sensor.flush(until_ns=state.stamp_ns)]


def _check_all_read(state: State) -> None:
    if state.in_flight:
        raise RuntimeError(
            "batches are in flight: call end_step() after begin_step(); after an interrupted run_model(), "
            "call run_model() again"
        )


def _parts_of_period(model: Model, state: State) -> Iterator[int]:
    """Yield the end of each batch of a control period; the caller launches it before the next is yielded."""
    end_ns = model.schedule.period_end_ns(state.launched_ns)
    while state.launched_ns < end_ns:
        yield model.schedule.batch_end_ns(state.launched_ns, end_ns)


def _plan_period(model: Model, state: State) -> Batch:
    """Plan the first batch of the next control period."""
    stretch = model.schedule.stretch(state.launched_ns, next(_parts_of_period(model, state)))
    return plan_batch(state, stretch, closed_loop=False)
