# mypy: disable-error-code="attr-defined,no-untyped-call"
"""The flight of one batch: commands in, the motion from boundary to boundary, what was sampled there out."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

from numpy.typing import ArrayLike

from neurosim_core.control import CommandMode, make_controller
from neurosim_core.frames import as_rows
from neurosim_core.model import Model
from neurosim_core.packets import Collision, ImuSample, Odometry, Packet
from neurosim_core.phases import timed
from neurosim_core.run_state import Batch, Pilot, State
from neurosim_core.schedule import Boundary
from neurosim_core.streams import HostInput, on
from neurosim_core.trace import BODY_RATE, ORIENTATION, POSITION, ROTOR_SPEED, VELOCITY, TraceRows
from neurosim_core.vehicle import DynamicsError, Multirotor

logger = logging.getLogger(__name__)

COLLISION = "collision"
"""Name under which collisions are reported."""


def set_command(model: Model, state: State, command: ArrayLike | None, mode: CommandMode) -> None:
    """Have the next batch begin with a setpoint, which becomes rotor speeds at the state of the vehicle then.

    The batch before has been read: what it took from the host is free.
    """
    if command is None:
        return
    if mode == "motor_speeds":
        rotor_count = model.airframe.rotor_count
        rows = as_rows(command, name="rotor_speed_command", count=1, width=rotor_count)
        state.rotor_speeds.rows[:] = rows
    else:
        if mode not in state.pilots:
            gains = model.config.control.gains
            controller = make_controller(mode, model.airframe, gains, device=model.device)
            state.pilots[mode] = Pilot(controller, HostInput(controller.setpoint))
        pilot = state.pilots[mode]
        pilot.setpoint.rows[:] = pilot.controller.checked(command)
    state.order = mode


def plan_batch(state: State, stretch: Sequence[Boundary], *, closed_loop: bool) -> Batch:
    """Return the batch that takes the vehicle through a stretch; nothing changes until it is launched.

    Args:
        state: As of the end of what was launched.
        stretch: What comes next.
        closed_loop: Let the path controller command; otherwise the last command is held.
    """
    number = state.launched_count
    stamps_ns = [state.launched_ns, *(boundary.stamp_ns for boundary in stretch)]
    elapsed_ns = [end - begin for begin, end in itertools.pairwise(stamps_ns)]
    return Batch(
        boundaries=stretch,
        elapsed_ns=elapsed_ns,
        pattern=tuple(
            (span_ns, boundary.control, boundary.samplers)
            for span_ns, boundary in zip(elapsed_ns, stretch, strict=True)
        ),
        closed_loop=closed_loop,
        step_count=sum(-(-span // state.vehicle.max_step_ns) for span in elapsed_ns),
        command_count=sum(closed_loop and boundary.control for boundary in stretch),
        number=number,
        slot=number % state.flight_lane_count * (state.trace.states.shape[0] // state.flight_lane_count),
        wanted=state.wanted,
        until_ns=stamps_ns[-1],
    )


def plan_flight(model: Model, state: State, batch: Batch) -> tuple[Hashable, Callable[[], object]]:
    """Take the vehicle through a batch: return what launches that, with its key.

    A pilot may be replaced by another; a graph keeps the one that it was made with.
    """
    order, state.order = state.order, None
    pilot = None if order is None else state.pilots.get(order)

    def flight() -> Pilot | None:
        if pilot is not None:
            pilot.setpoint.upload()
            pilot.controller.update(state.vehicle.arrays)
        elif order is not None:
            state.rotor_speeds.upload()
        _fly(model, state, batch)
        return pilot

    state.launched_count += 1
    state.launched_ns = batch.until_ns
    return (order, id(pilot), batch.slot, batch.closed_loop, batch.pattern), flight


def launch_flight(state: State, batch: Batch, key: Hashable, flight: Callable[[], object]) -> None:
    """Launch a planned flight on its stream, and note its end."""
    with timed(state.wall_s, "dynamics and control"), on(state.flight_stream):
        state.graphs.run(key, flight)
        state.flown[batch.number % state.flight_lane_count].set()


def _fly(model: Model, state: State, batch: Batch) -> None:
    """Move the vehicle from boundary to boundary and do what is due there, on the device only."""
    stretch, slot = batch.boundaries, batch.slot
    for place, (boundary, span_ns) in enumerate(zip(stretch, batch.elapsed_ns, strict=True), slot):
        if span_ns > 0:
            state.vehicle.advance(span_ns)
        state.trace.record(state.vehicle.arrays, place)
        for index in boundary.samplers:
            if (imu := state.imus.get(model.samplers[index])) is not None:
                imu.measure(place)
        if batch.closed_loop and boundary.control:
            state.controller.update(state.vehicle.arrays)
    ground = state.vehicle.config.ground
    state.trace.check_room(
        model.free_space.arrays,
        slot,
        len(stretch),
        radius_m=model.config.vehicle.collision_radius_m,
        ground_height_m=-math.inf if ground is None else ground.height_m,
    )
    state.trace.fetch(slot, len(stretch))
    for copy in itertools.chain.from_iterable(state.imu_copies.values()):
        copy.fetch(slot, len(stretch))


def read_flight(model: Model, state: State, batch: Batch) -> list[Packet]:
    """Return what was sampled in a batch that is flown, and collisions."""
    with timed(state.wall_s, "read-back"):
        rows = state.trace.numpy(batch.slot, len(batch.boundaries))
    state.stamp_ns = batch.boundaries[-1].stamp_ns
    state.counts["steps"] += batch.step_count
    state.counts["commands"] += batch.command_count
    _count_redone(state, sum(rows.redone[-1].tolist()))  # of few vehicles: ufuncs take ten times as long
    if any(rows.status[-1].tolist()):
        state.failure = _failure(state.vehicle)
        state.stamp_ns = min(state.stamp_ns, state.failure.stamp_ns)
    with timed(state.wall_s, "collision check"):
        packets = _collide(model, state, batch, rows)  # may end the run before the end of the batch
    batch.until_ns = state.stamp_ns
    with timed(state.wall_s, "read-back"):
        packets += _read_samplers(model, state, batch, rows)
    reached = [b.stamp_ns for b in batch.boundaries if b.stamp_ns <= state.stamp_ns]
    if reached:
        row = rows.states[len(reached) - 1, 0]
        state.last = _odometry(row, stamp_ns=reached[-1], sequence=0, sensor="odometry")
    return packets


def _count_redone(state: State, redone_count: int) -> None:
    if redone_count > 0 and not state.counts["redone intervals"]:
        logger.info(
            "vehicle: steps of %g ms are too long at times; such intervals are redone with adaptive steps",
            1e-6 * state.vehicle.max_step_ns,
        )
    state.counts["redone intervals"] = redone_count


def _failure(vehicle: Multirotor) -> DynamicsError:
    """Return why a vehicle is held."""
    try:
        vehicle.check()
    except DynamicsError as error:
        return error
    raise AssertionError("the status of a vehicle that is held does not change")


def _odometry(row: Any, *, stamp_ns: int, sequence: int, sensor: str) -> Odometry:
    return Odometry(
        stamp_ns=stamp_ns,
        sequence=sequence,
        sensor=sensor,
        position=row[POSITION],
        orientation=row[ORIENTATION],
        velocity=row[VELOCITY],
        body_rate=row[BODY_RATE],
        rotor_speed=row[ROTOR_SPEED],
    )


def _read_samplers(model: Model, state: State, batch: Batch, rows: TraceRows) -> list[Packet]:
    packets: list[Packet] = []
    for index, name in enumerate(model.samplers):
        copies = state.imu_copies.get(name)
        if copies is not None:
            specific_force, angular_rate = (c.rows(batch.slot, len(batch.boundaries))[:, 0] for c in copies)
        for place, boundary in enumerate(batch.boundaries):
            if index not in boundary.samplers:
                continue
            header: dict[str, Any] = {
                "stamp_ns": boundary.stamp_ns,
                "sequence": state.sequence[name],
                "sensor": name,
            }
            state.sequence[name] += 1
            if copies is not None:
                packets.append(
                    ImuSample(
                        **header,
                        specific_force=specific_force[place],
                        angular_rate=angular_rate[place],
                    )
                )
            else:
                packets.append(_odometry(rows.states[place, 0], **header))
    return packets


def _collide(model: Model, state: State, batch: Batch, rows: TraceRows) -> list[Packet]:
    """Report each beginning of a touch; end the run at the first one if so configured."""
    packets: list[Packet] = []
    if not any(margin_m <= 0.0 for margin_m in rows.clearance.tolist()):
        state.touching = False
        return packets
    for boundary, row, margin_m in zip(batch.boundaries, rows.states[:, 0], rows.clearance, strict=True):
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
