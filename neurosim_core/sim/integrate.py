# mypy: disable-error-code="attr-defined"
"""The motion of one batch: from commands to the samples of state sensors and collisions."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import warp as wp
from numpy.typing import ArrayLike

from neurosim_core.control import CommandMode, Controller
from neurosim_core.control.setpoints import Setpoint
from neurosim_core.frames import as_rows
from neurosim_core.packets import Collision, Odometry, Packet
from neurosim_core.runtime.cuda import Launches
from neurosim_core.sensors.state_sampler import sample_packet
from neurosim_core.sim.inputs import CommandBuffer, as_device_array, check_rows
from neurosim_core.sim.model import Model
from neurosim_core.sim.schedule import Boundary, Stretch
from neurosim_core.sim.state import Batch, State
from neurosim_core.sim.trace import BODY_RATE, ORIENTATION, POSITION, ROTOR_SPEED, VELOCITY, TraceRows
from neurosim_core.vehicle import DynamicsError
from neurosim_core.vehicle.arrays import STATUS_COLLISION, check_status

logger = logging.getLogger(__name__)

COLLISION = "collision"
"""Sensor name of collision packets."""


def forget_controllers(state: State) -> None:
    """Discard the controllers of external commands, so that the next command makes them with new gains.

    The path controller stays, and so does the buffer of rotor speeds: graphs copy from it.
    """
    for mode in state.controllers:
        del state.commands[mode]
    state.controllers.clear()


Command = Setpoint | ArrayLike | None
"""Command of an external controller: a setpoint, a row of its mode, or None (hold the rotor speeds)."""


def set_command(model: Model, state: State, command: Command, mode: CommandMode) -> None:
    """Set the command of the next batch, which converts it to rotor speeds at its first state.

    Commands of one world come from the host; the batch before must have been read, since it shares the
    staging buffer. Commands of many worlds, shape [N, width], may be on the device.

    Raises:
        ValueError: The path prescribes the motion, the mode is unknown, or rows have a wrong shape or, on the
            host, are not finite.
    """
    if command is None:
        return
    if model.path.attitude is not None:
        raise ValueError("path.kind poses prescribes the motion and takes no commands: give no command")
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
    """Return the setpoint buffer of a mode; the first call makes its controller.

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
    """Return checked setpoints of the host as rows of the mode, shape [N, width]."""
    if mode == "motor_speeds":
        width = model.airframe.rotor_count
        return as_rows(command, name="rotor_speed_command", count=state.world_count, width=width)
    return state.controllers[mode].checked(command)


def plan_batch(state: State, stretch: Stretch, *, closed_loop: bool, reset_mask: Any = None) -> Batch:
    """Return the batch of a stretch that begins where the last launched batch ends; changes no state.

    With `closed_loop` the path controller commands; otherwise the last command is held. `reset_mask` is not 0
    for worlds whose episode begins with the batch, device array of int32, shape [N]; None: none.
    """
    closed_loop = closed_loop and state.path_controller is not None
    number, begin_ns, max_step_ns = state.launched_count, state.launched_ns, state.vehicle.max_step_ns
    slot_count = state.trace.arrays.states.shape[0] // state.pipeline.flown_ahead
    return Batch(
        stretch=stretch,
        stamps_ns=[begin_ns + boundary.stamp_ns for boundary in stretch.boundaries],
        closed_loop=closed_loop,
        step_count=sum(-(-span_ns // max_step_ns) for span_ns in stretch.elapsed_ns),
        command_count=sum(boundary.control for boundary in stretch.boundaries) if closed_loop else 0,
        number=number,
        slot=number % state.pipeline.flown_ahead * slot_count,
        enabled_cameras=state.enabled_cameras,
        reset_mask=reset_mask,
        until_ns=begin_ns + stretch.duration_ns,
    )


def take_command(state: State) -> Launches:
    """Return the launches that convert the command of `set_command` to rotor speeds, and clear the command.

    Their key contains the controller, because a graph uses the controller that it was recorded with.
    """
    mode, state.command_mode = state.command_mode, None
    controller = None if mode is None else state.controllers.get(mode)

    def convert() -> object:
        if mode is not None and state.on_host:
            state.commands[mode].upload()
        if controller is not None:
            controller.update(state.vehicle.arrays)
        return controller

    return Launches((mode, id(controller)), convert)


def integrate(state: State, batch: Batch) -> None:
    """Integrate the vehicles of all worlds from boundary to boundary, and sample sensors; launches only."""
    elapsed_ns = 0
    samplers = list(state.samplers.values())
    sample_slots = [batch.slot] * len(samplers)
    vehicle, trace, slot = state.vehicle, state.trace, batch.slot
    for boundary, span_ns, count in _spans(batch.stretch, joined=trace.joins_spans):
        end = slot + count
        record = {"first": slot == batch.slot, "last": end == batch.slot + len(batch.stamps_ns)}
        trace.advance(slot, elapsed_ns, span_ns, count, **record)
        slot, elapsed_ns = end, elapsed_ns + count * span_ns
        for index in boundary.samplers:
            samplers[index].measure(sample_slots[index])
            sample_slots[index] += 1
        if batch.closed_loop and boundary.control and state.path_controller is not None:
            state.path_controller.update(vehicle.arrays)


def _spans(stretch: Stretch, *, joined: bool) -> Iterator[tuple[Boundary, int, int]]:
    """Yield runs of equal spans: the boundary at their end, the length of a span [ns], and their number.

    With `joined`, equal spans with nothing due between them form one run; else each span is a run.
    """
    count = 0
    following = [*stretch.elapsed_ns[1:], -1]  # -1 differs from every span, so the last run is yielded
    for boundary, span_ns, next_ns in zip(stretch.boundaries, stretch.elapsed_ns, following, strict=True):
        count += 1
        if not joined or boundary.samplers or boundary.control or next_ns != span_ns:
            yield boundary, span_ns, count
            count = 0


def fetch_flight(state: State, batch: Batch) -> None:
    """Launch the copies of states and samples to the host."""
    state.trace.fetch(batch.slot, len(batch.stamps_ns))
    for index, copies in enumerate(state.sampler_copies.values()):
        sample_count = len(batch.stretch.sampler_places.get(index, ()))
        for copy in copies.values():
            copy.fetch(batch.slot, sample_count)


def read_flight(model: Model, state: State, batch: Batch) -> list[Packet]:
    """Return the packets of state sensors and the collisions of a batch whose motion is finished."""
    rows = state.trace.numpy(batch.slot, len(batch.stamps_ns))
    state.stamp_ns = batch.stamps_ns[-1]
    state.counts["steps"] += batch.step_count
    state.counts["commands"] += batch.command_count
    _count_redone(state, sum(rows.redone[-1].tolist()))  # of few vehicles: ufuncs take ten times as long
    if any(status not in (0, int(STATUS_COLLISION)) for status in rows.status[-1].tolist()):
        state.failure = _failure(state)
        state.stamp_ns = min(state.stamp_ns, state.failure.stamp_ns)
    packets = _collide(model, state, batch, rows)  # may end the run before the end of the batch
    batch.until_ns = state.stamp_ns
    packets += _read_samplers(state, batch)
    reached = [stamp_ns for stamp_ns in batch.stamps_ns if stamp_ns <= state.stamp_ns]
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
    """Return the error of a vehicle that is held after a failed integration."""
    try:
        check_status(state.vehicle.arrays)
    except DynamicsError as error:
        return error
    raise AssertionError("the status of a vehicle that is held does not change")


def _read_samplers(state: State, batch: Batch) -> list[Packet]:
    packets: list[Packet] = []
    for index, (name, copies) in enumerate(state.sampler_copies.items()):
        stamps = [batch.stamps_ns[place] for place in batch.stretch.sampler_places.get(index, ())]
        if not stamps:
            continue
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
    """Return a packet for each beginning of a contact; the first ends the run if so configured."""
    packets: list[Packet] = []
    if not any(margin_m <= 0.0 for margin_m in rows.clearance[:, 0].tolist()):
        state.touching = False
        return packets
    for stamp_ns, row, margin_m in zip(batch.stamps_ns, rows.states[:, 0], rows.clearance[:, 0], strict=True):
        touching = bool(margin_m <= 0.0)
        if touching and not state.touching:
            packets.append(
                Collision(
                    stamp_ns=stamp_ns,
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
                state.stamp_ns = stamp_ns
                return packets
        state.touching = touching
    return packets


def in_order(model: Model, packets: list[Packet], until_ns: int) -> list[Packet]:
    """Return packets up to a stamp in the order of time; packets of one stamp are in the order of the rig."""
    kept = [packet for packet in packets if packet.stamp_ns <= until_ns]
    if len(kept) < 2:
        return kept
    rank = {name: index for index, name in enumerate([*model.config.sensors, COLLISION])}
    return sorted(kept, key=lambda packet: (packet.stamp_ns, rank[packet.sensor]))
