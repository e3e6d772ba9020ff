# mypy: disable-error-code="attr-defined"
"""A run, batch by batch: with the path controller on the device, or with a controller outside.

On a CUDA device `run_model` launches the next batches before it reads one back, so the device always has
work; what was launched beyond the end of a run is never read.

An external controller steps one control period at a time: `step` flies one and returns its packets, or
`begin_step` and `end_step` do, with time between them while a CUDA device is at work. `integrate_period`
flies one and leaves the cameras to another thread, which calls `render_batch` or `skip_batch`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path as FilePath
from typing import Any, NamedTuple

from neurosim_core.config import SimulationConfig, load_config
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
    config = config if isinstance(config, SimulationConfig) else load_config(config)
    model = make_model(config, meanwhile=warm_flight)
    yield from run_model(model, make_state(model))


def run_model(model: Model, state: State) -> Iterator[Packet]:
    """Yield every packet from the state's present stamp to the end of the run; see `run`.

    Where the state keeps several batches in flight, the vehicle is up to as many ahead of the packets.
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
    """Hold a command of an outside controller until the next tick of the control clock.

    Args:
        model: What does not change.
        state: Moved on by one control period.
        command: A setpoint (`control.setpoints`), or a row of the mode (`control.modes.MODES`), by default
            rotor speeds [rad/s], shape [R]. Modes above it are turned into rotor speeds once, at the
            beginning of the period. None: the rotor speeds that hold now.
        mode: What a row is.

    Returns:
        What the sensors yield in (stamp, next stamp], in the order of time; the first call also yields stamp
        0. Less where a collision ended the run (`state.ended`) or the integration failed (`state.failure`).

    Raises:
        ValueError: The command is of a wrong shape or not finite.
        DynamicsError: The integration has failed before; what was measured until then has been returned.
    """
    return end_step(model, state, begin_step(model, state, command, mode=mode))


class PendingStep(NamedTuple):
    """A control period that has been launched as far as it can be."""

    packets: list[Packet]
    """Packets of the sensors up to its beginning, if they have not been returned yet."""
    end_ns: int
    """Its end [ns]."""


def begin_step(
    model: Model, state: State, command: Command, *, mode: CommandMode = "motor_speeds"
) -> PendingStep:
    """Begin a control period like `step`, without waiting for a CUDA device.

    Args:
        model: What does not change.
        state: Has to go to `end_step` before anything else is done to it.
        command: As of `step`.
        mode: As of `step`.

    Returns:
        What `end_step` needs.

    Raises:
        RuntimeError: A period is pending, or `run_model` was broken off.
        ValueError: The command is of a wrong shape or not finite.
        DynamicsError: The integration has failed before.
    """
    if state.failure is not None:
        raise state.failure
    _check_all_read(state)
    packets = start(model, state) if state.launched_count == 0 else []
    set_command(model, state, command, mode)
    batch, state.planned = state.planned, None
    if batch is None or (batch.number, batch.wanted) != (state.launched_count, state.wanted):
        batch = _plan_period(model, state)
    end_ns = model.schedule.period_end_ns(state.launched_ns)
    launch(model, state, batch)
    return PendingStep(packets, end_ns)


def prepare_step(model: Model, state: State) -> None:
    """Plan the next control period, for `begin_step` to launch it sooner; while a CUDA device is at work.

    Args:
        model: What does not change.
        state: Keeps the plan, which the next `begin_step` uses unless other cameras have been selected.
    """
    state.planned = _plan_period(model, state)
    plan_ahead(model, state, state.planned)


def acquire_next_picture_buffers(state: State) -> None:
    """Ask for buffers for the pictures of a control period that was prepared: `begin_step` is sooner then."""
    if state.planned is not None:
        for job in state.planned.jobs or ():
            acquire_picture_buffers(job)


def settle(state: State) -> None:
    """Wait until the device has written all pictures that were handed out (see `allocate_picture`)."""
    state.pipeline.wait_all()


def end_step(model: Model, state: State, pending: PendingStep) -> list[Packet]:
    """Wait for a control period that is pending, and return what `step` returns.

    Args:
        model: What does not change.
        state: Moved on by the period.
        pending: What `begin_step` returned.
    """
    packets = pending.packets + read(model, state, last=state.launched_ns >= pending.end_ns)
    while state.launched_ns < pending.end_ns and not (state.ended or state.failure is not None):
        part_ns = model.schedule.batch_end_ns(state.launched_ns, pending.end_ns)
        launch_until(model, state, part_ns, closed_loop=False)
        packets += read(model, state, last=part_ns >= pending.end_ns)
    return packets


def warm_up(model: Model) -> None:
    """Compile and load the kernels of all sensors: fly one control period of an episode that nobody sees."""
    step(model, make_state(model), None)


def warm_flight(model: Model, *_: object) -> None:
    """Compile and load the kernels of a flight: look once, and fly one control period.

    For `make_model(meanwhile=...)`. Nothing is in flight, and all is on the present stream of the device. No
    launches come twice, which would be recorded as a graph while other threads launch.
    """
    state = make_state(model, in_flight=1)
    start(model, state)
    state.wanted = frozenset()
    advance(model, state, model.schedule.batch_end_ns(0, model.schedule.period_end_ns(0)))


def integrate_period(
    model: Model, state: State, command: Command, *, mode: CommandMode = "motor_speeds"
) -> tuple[list[Packet], list[Batch]]:
    """Fly one control period like `step`, and leave the cameras for later.

    Returns:
        Packets of the IMU and of odometry, and collisions, in the order of time; and what the cameras have to
        look at: each batch goes to `render_batch` or `skip_batch`, in order, from one thread at a time.

    Raises:
        RuntimeError: More batches wait for the cameras than may: see `render_backlog_left`.
        ValueError: The command is of a wrong shape or not finite.
        DynamicsError: The integration has failed before; what was measured until then has been returned.
    """
    if state.failure is not None:
        raise state.failure
    packets: list[Packet] = []
    batches: list[Batch] = []

    def fly(stretch: Stretch) -> None:
        if render_backlog_left(state) < 1:
            raise RuntimeError(
                f"{state.pipeline.flown_ahead} batches wait for render_batch() or skip_batch(), "
                "and no more may"
            )
        batch = plan_batch(state, stretch, closed_loop=False)
        launch_flight(state, batch)
        batches.append(batch)
        with timed(state.wall_s, "read-back"):
            state.pipeline.wait_flown(batch.number)
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
    """Return how many batches `integrate_period` can fly before one of those that wait was looked at."""
    return state.pipeline.flown_ahead - (state.launched_count - state.rendered_count)


def render_batch(model: Model, state: State, batch: Batch) -> list[Packet]:
    """Render a batch of `integrate_period`; return the packets of its cameras in the order of time.

    Args:
        model: What does not change.
        state: Only what belongs to the cameras changes, so that another thread may fly on.
        batch: The oldest that neither `render_batch` nor `skip_batch` has had.
    """
    launch_cameras(model, state, batch)
    packets = read_cameras(state, batch, borrow=state.borrow_pictures)
    state.rendered_count += 1
    return in_order(model, packets, batch.until_ns)


def skip_batch(model: Model, state: State, batch: Batch) -> int:
    """Render nothing of a batch, in place of `render_batch`; arguments are the same.

    The sequence of each image camera shows the gap; for an event camera log radiance is linear in time over
    the gap, and a window of events that should have ended there is as much longer.

    Returns:
        How many instants were not rendered.
    """
    count = 0
    for index, group in enumerate(state.groups):
        places = due_places(group, batch, index)
        count += len(places)
        for place in places:
            for name in pictures_due(group, batch.stamps_ns[place], batch.wanted):
                group.images[name].sequence += 1
    state.rendered_count += 1
    return count


def select_cameras(model: Model, state: State, names: Collection[str]) -> None:
    """Choose the cameras that look, from the next control period on; the others are not rendered.

    An event camera that comes back takes the first instant that it sees as its reference, and its packets
    count on.

    Args:
        model: What does not change.
        state: The cameras that look are part of it.
        names: Names of the cameras that look, in the settings.

    Raises:
        ValueError: There is no such camera.
    """
    known = {name for group in model.groups for name in group.names}
    if not known.issuperset(names):
        raise ValueError(f"unknown cameras {sorted(set(names) - known)}, known: {sorted(known)}")
    state.wanted = frozenset(names)


def observe(state: State) -> Odometry:
    """Return the true state of the vehicle at the end of what was flown, as a packet named `odometry`."""
    if state.last is None:
        now = read_state(state.vehicle.arrays)._asdict()
        state.last = Odometry(sensor="odometry", **{name: rows[0] for name, rows in now.items()})
    return state.last


def start(model: Model, state: State) -> list[Packet]:
    """Sample every sensor at stamp 0, and return the packets; event cameras take it as their reference.

    Args:
        model: What does not change.
        state: As `make_state` returns it: nothing has been launched.
    """
    launch(model, state, plan_batch(state, model.schedule.first(), closed_loop=True))
    return read(model, state)


def advance(model: Model, state: State, end_ns: int) -> list[Packet]:
    """Fly one batch, at most to what `Schedule.batch_end_ns` gives, and return what the sensors yield in it.

    The path controller commands.

    Args:
        model: What does not change.
        state: Moved on to `end_ns`, or to where a collision ended the run (`ended`) or the integration failed
            (`failure`).
        end_ns: End of the batch [ns], after the state's stamp.

    Raises:
        RuntimeError: `run_model` was broken off, and the vehicle is ahead of the state's stamp.
    """
    _check_all_read(state)
    launch_until(model, state, end_ns)
    return read(model, state)


def launch_until(model: Model, state: State, end_ns: int, *, closed_loop: bool = True) -> None:
    """Launch one batch, as `advance` flies it, without waiting for a CUDA device.

    Args:
        model: What does not change.
        state: Has room for one more batch in flight.
        end_ns: End of the batch [ns], after what was launched before.
        closed_loop: The path controller commands; otherwise the last command is held.
    """
    stretch = model.schedule.stretch(state.launched_ns, end_ns)
    launch(model, state, plan_batch(state, stretch, closed_loop=closed_loop))


def finish(state: State) -> list[Packet]:
    """Return the packets whose windows have begun and not ended; for the end of a run."""
    sensors = [
        group.frames[name] for group in state.groups for name in group.frames if name in group.watching
    ]
    return [packet for sensor in sensors for packet in sensor.flush(until_ns=state.stamp_ns)]


def _check_all_read(state: State) -> None:
    if state.in_flight:
        raise RuntimeError(
            "batches are under way: run_model() was broken off, and only it can go on, or end_step() is due"
        )


def _parts_of_period(model: Model, state: State) -> Iterator[int]:
    """Yield the ends of the batches that a control period is cut into, each when the one before was flown."""
    end_ns = model.schedule.period_end_ns(state.launched_ns)
    while state.launched_ns < end_ns:
        yield model.schedule.batch_end_ns(state.launched_ns, end_ns)


def _plan_period(model: Model, state: State) -> Batch:
    """Plan the first batch of the next control period."""
    stretch = model.schedule.stretch(state.launched_ns, next(_parts_of_period(model, state)))
    return plan_batch(state, stretch, closed_loop=False)
