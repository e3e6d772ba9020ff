# mypy: disable-error-code="attr-defined"
"""The flight of one batch: commands in, the motion from boundary to boundary, what was sampled there out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import warp as wp
from numpy.typing import ArrayLike

from neurosim_core.control import CommandMode, Controller
from neurosim_core.control.setpoints import Setpoint
from neurosim_core.frames import as_rows
from neurosim_core.packets import Collision, Odometry, Packet
from neurosim_core.runtime.cuda import use_stream
from neurosim_core.runtime.timing import timed
from neurosim_core.sensors.state_sampler import sample_packet
from neurosim_core.sim.inputs import CommandBuffer, as_device_array, check_rows
from neurosim_core.sim.model import Model
from neurosim_core.sim.schedule import Boundary
from neurosim_core.sim.state import Batch, State
from neurosim_core.sim.trace import BODY_RATE, ORIENTATION, POSITION, ROTOR_SPEED, VELOCITY, TraceRows
from neurosim_core.vehicle import DynamicsError, Multirotor
from neurosim_core.vehicle.arrays import STATUS_COLLISION, check_status

logger = logging.getLogger(__name__)

COLLISION = "collision"
"""Name under which collisions are reported."""


def forget_controllers(state: State) -> None:
    """Have controllers of outside commands made anew, with other gains; the path controller stays."""
    state.controllers.clear()
    state.commands.clear()


Command = Setpoint | ArrayLike | None
"""What an outside controller commands: a setpoint, a row of its mode, or None: what holds now."""


def set_command(model: Model, state: State, command: Command, mode: CommandMode) -> None:
    """Have the next batch begin with a setpoint, which becomes rotor speeds at the state of the vehicle then.

    Rows of one world come from the host, and the batch before has been read: what it took from there is free.
    Those of many worlds, shape [N, width], may be on the device.

    Raises:
        ValueError: The path prescribes the motion, the mode is unknown, or rows are of a wrong shape or, on
            the host, not finite.
    """
    if command is None:
        return
    if model.path.attitude is not None:
        raise ValueError("path.kind poses is followed whatever is commanded: give no command")
    if isinstance(command, Setpoint):
        command, mode = command.row(), command.mode
    buffer = _command_buffer(model, state, mode)
    on_device = None if state.on_host else as_device_array(command, buffer.array.device)
    if on_device is not None:
        check_rows(on_device, buffer.array, "commands")
        wp.utils.array_cast(on_device, buffer.array)
    else:
        put = buffer.stage if state.on_host else buffer.write
        put(_checked_command(model, state, command, mode))
    state.command_mode = mode


def _command_buffer(model: Model, state: State, mode: CommandMode) -> CommandBuffer:
    """Return where the setpoints of a mode go; the first time, its controller is made.

    Raises:
        ValueError: The mode is unknown.
    """
    if mode not in state.commands:
        if mode == "motor_speeds":
            array: Any = state.vehicle.arrays.rotor_speed_command
        else:
            state.controllers[mode] = Controller(
                mode,
                model.airframe,
                model.config.control.gains,
                count=state.world_count,
                device=model.device,
            )
            array = state.controllers[mode].setpoint
        state.commands[mode] = CommandBuffer(array)
    return state.commands[mode]


def _checked_command(model: Model, state: State, command: ArrayLike, mode: CommandMode) -> Any:
    """Return setpoints of the host as rows of the mode, shape [N, width]."""
    if mode == "motor_speeds":
        width = model.airframe.rotor_count
        return as_rows(command, name="rotor_speed_command", count=state.world_count, width=width)
    return state.controllers[mode].checked(command)


def plan_batch(
    state: State,
    stretch: Sequence[Boundary],
    *,
    closed_loop: bool,
    begin_ns: int | None = None,
    last_seen_ns: Sequence[int] = (),
) -> Batch:
    """Return the batch that takes the vehicles through a stretch; nothing changes until it is launched.

    It begins at the end of what was launched, unless `begin_ns` says where. With `closed_loop` the path
    controller commands; otherwise the last command is held. Of many worlds `last_seen_ns` is for each group
    the instant before the stretch, from its begin [ns], <= 0.
    """
    closed_loop = closed_loop and state.path_controller is not None
    number, max_step_ns = state.launched_count, state.vehicle.max_step_ns
    at_ns = state.launched_ns if begin_ns is None else begin_ns
    elapsed_ns, pattern, step_count = [], [], 0
    for boundary in stretch:
        span_ns, at_ns = boundary.stamp_ns - at_ns, boundary.stamp_ns
        elapsed_ns.append(span_ns)
        pattern.append((span_ns, boundary.control, boundary.samplers))
        step_count += -(-span_ns // max_step_ns)
    return Batch(
        boundaries=stretch,
        elapsed_ns=elapsed_ns,
        pattern=tuple(pattern),
        closed_loop=closed_loop,
        step_count=step_count,
        command_count=sum(boundary.control for boundary in stretch) if closed_loop else 0,
        number=number,
        slot=number % state.render_backlog * (state.trace.arrays.states.shape[0] // state.render_backlog),
        wanted=state.wanted,
        last_seen_ns=last_seen_ns,
        until_ns=at_ns,
    )


def plan_flight(state: State, batch: Batch) -> tuple[Hashable, Callable[[], object]]:
    """Take the vehicle through a batch: return what launches that, with its key.

    A controller may be replaced by another; a graph keeps the one that it was made with.
    """
    mode, state.command_mode = state.command_mode, None
    controller = None if mode is None else state.controllers.get(mode)

    def flight() -> object:
        if mode is not None and state.on_host:
            state.commands[mode].upload()
        if controller is not None:
            controller.update(state.vehicle.arrays)
        integrate(state, batch)
        _fetch(state, batch)
        return controller

    state.launched_count += 1
    state.launched_ns = batch.until_ns
    return (mode, id(controller), batch.slot, batch.closed_loop, batch.pattern), flight


def launch_flight(state: State, batch: Batch, key: Hashable, flight: Callable[[], object]) -> None:
    """Launch a planned flight on its stream, and note its end."""
    with timed(state.wall_s, "dynamics and control"), use_stream(state.flight_stream):
        state.graphs.run(key, flight)
        state.flown[batch.number % state.render_backlog].set()


def integrate(state: State, batch: Batch) -> None:
    """Move the vehicles of all worlds from boundary to boundary, and sample what is due; launches only."""
    elapsed_ns = 0
    samplers = list(state.samplers.values())
    taken = [batch.slot] * len(samplers)
    vehicle, trace, slot = state.vehicle, state.trace, batch.slot
    for boundary, span_ns, count in _stretches(batch, joined=isinstance(vehicle, Multirotor)):
        end = slot + count
        record = {"first": slot == batch.slot, "last": end == batch.slot + len(batch.boundaries)}
        if isinstance(vehicle, Multirotor) and span_ns > 0:
            trace.fly(vehicle, slot, elapsed_ns, span_ns, count, **record)
        else:
            if span_ns > 0:
                vehicle.advance(span_ns)
            trace.record(slot, elapsed_ns + span_ns, **record)
        slot, elapsed_ns = end, elapsed_ns + count * span_ns
        for index in boundary.samplers:
            samplers[index].measure(taken[index])
            taken[index] += 1
        if batch.closed_loop and boundary.control and state.path_controller is not None:
            state.path_controller.update(vehicle.arrays)


def _stretches(batch: Batch, *, joined: bool) -> Iterator[tuple[Boundary, int, int]]:
    """Yield spans between boundaries: the boundary at the end, the length [ns] and how many are `joined`.

    Those are joined that are equal, and between which nothing is due.
    """
    count = 0
    following = [*batch.elapsed_ns[1:], -1]  # no span is that long: the last one is yielded, also one of 0
    for boundary, span_ns, next_ns in zip(batch.boundaries, batch.elapsed_ns, following, strict=True):
        count += 1
        if not joined or boundary.samplers or boundary.control or next_ns != span_ns:
            yield boundary, span_ns, count
            count = 0


def _fetch(state: State, batch: Batch) -> None:
    """Launch the copy of what was flown and sampled to the host."""
    state.trace.fetch(batch.slot, len(batch.boundaries))
    for index, copies in enumerate(state.sampler_copies.values()):
        sample_count = sum(index in boundary.samplers for boundary in batch.boundaries)
        for copy in copies.values():
            copy.fetch(batch.slot, sample_count)


def read_flight(model: Model, state: State, batch: Batch) -> list[Packet]:
    """Return what was sampled in a batch that is flown, and collisions."""
    rows = state.trace.numpy(batch.slot, len(batch.boundaries))
    state.stamp_ns = batch.boundaries[-1].stamp_ns
    state.counts["steps"] += batch.step_count
    state.counts["commands"] += batch.command_count
    _count_redone(state, sum(rows.redone[-1].tolist()))  # of few vehicles: ufuncs take ten times as long
    if any(status not in (0, int(STATUS_COLLISION)) for status in rows.status[-1].tolist()):
        state.failure = _failure(state)
        state.stamp_ns = min(state.stamp_ns, state.failure.stamp_ns)
    packets = _collide(model, state, batch, rows)  # may end the run before the end of the batch
    batch.until_ns = state.stamp_ns
    packets += _read_samplers(state, batch)
    reached = [b.stamp_ns for b in batch.boundaries if b.stamp_ns <= state.stamp_ns]
    if reached:
        row = rows.states[len(reached) - 1, 0]
        state.last = Odometry(
            stamp_ns=reached[-1],
            sensor="odometry",
            position=row[POSITION],
            orientation=row[ORIENTATION],
            velocity=row[VELOCITY],
            body_rate=row[BODY_RATE],
            rotor_speed=row[ROTOR_SPEED],
        )
    return packets


def _count_redone(state: State, redone_count: int) -> None:
    if redone_count > 0 and not state.counts["redone intervals"]:
        logger.info(
            "vehicle: steps of %g ms are too long at times; such intervals are redone with adaptive steps",
            1e-6 * state.vehicle.max_step_ns,
        )
    state.counts["redone intervals"] = redone_count


def _failure(state: State) -> DynamicsError:
    """Return why a vehicle is held."""
    try:
        check_status(state.vehicle.arrays)
    except DynamicsError as error:
        return error
    raise AssertionError("the status of a vehicle that is held does not change")


def _read_samplers(state: State, batch: Batch) -> list[Packet]:
    packets: list[Packet] = []
    for index, (name, copies) in enumerate(state.sampler_copies.items()):
        stamps = [boundary.stamp_ns for boundary in batch.boundaries if index in boundary.samplers]
        columns = {field: copy.rows(batch.slot, len(stamps))[:, 0] for field, copy in copies.items()}
        for sample, stamp_ns in enumerate(stamps):
            packet = sample_packet(
                state.samplers[name],
                {field: column[sample] for field, column in columns.items()},
                stamp_ns=stamp_ns,
                sequence=state.sequence[name],
                sensor=name,
            )
            if packet is not None:
                packets.append(packet)
            state.sequence[name] += 1
    return packets


def _collide(model: Model, state: State, batch: Batch, rows: TraceRows) -> list[Packet]:
    """Report each beginning of a touch; end the run at the first one if so configured."""
    packets: list[Packet] = []
    if not any(margin_m <= 0.0 for margin_m in rows.clearance[:, 0].tolist()):
        state.touching = False
        return packets
    for boundary, row, margin_m in zip(
        batch.boundaries, rows.states[:, 0], rows.clearance[:, 0], strict=True
    ):
        touching = bool(margin_m <= 0.0)
        if touching and not state.touching:
            packets.append(
                Collision(
                    stamp_ns=boundary.stamp_ns,
                    sequence=state.sequence[COLLISION],
                    sensor=COLLISION,
                    position=row[POSITION],
                    clearance_m=float(margin_m),
                )
            )
            state.sequence[COLLISION] += 1
            state.counts["collisions"] += 1
            if model.config.vehicle.on_collision == "end":
                state.ended = True
                state.stamp_ns = boundary.stamp_ns
                return packets
        state.touching = touching
    return packets


def in_order(model: Model, packets: list[Packet], until_ns: int) -> list[Packet]:
    """Return packets up to a stamp in the order of time, those of one stamp in that of the rig."""
    kept = [packet for packet in packets if packet.stamp_ns <= until_ns]
    if len(kept) < 2:
        return kept
    rank = {name: index for index, name in enumerate([*model.config.sensors, COLLISION])}
    return sorted(kept, key=lambda packet: (packet.stamp_ns, rank[packet.sensor]))
