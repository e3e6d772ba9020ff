# mypy: disable-error-code="attr-defined,no-untyped-call"
"""What changes during a run: the vehicle, the buffers of its sensors, and how far both have come."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from neurosim_core.clock import to_ns
from neurosim_core.control import CommandMode, Controller, make_controller
from neurosim_core.model import Model
from neurosim_core.packets import Odometry
from neurosim_core.schedule import Boundary, boundary_count_max
from neurosim_core.sensors.cast import (
    CastState,
    Choice,
    Instants,
    Look,
    MakeRoom,
    make_cast_state,
)
from neurosim_core.sensors.imu import Imu
from neurosim_core.sensors.rig import ImuSensorConfig
from neurosim_core.streams import Graphs, HostCopy, HostInput, Milestone, make_stream
from neurosim_core.trace import Trace
from neurosim_core.vehicle import DynamicsError, Multirotor

_LANES_ON_CUDA = 3
"""With three, one batch is flown and one rendered while the host reads a third."""


@dataclass(frozen=True, kw_only=True)
class StartState:
    """Where an episode starts, with rotors at hover; what is None is as configured: the start of the path."""

    position: ArrayLike | None = None
    """p_WB [m], shape [3]."""
    orientation: ArrayLike | None = None
    """q_WB, xyzw, shape [4]."""
    velocity: ArrayLike | None = None
    """v_WB in W [m/s], shape [3]."""
    body_rate: ArrayLike | None = None
    """w_WB in B [rad/s], shape [3]."""


@dataclass(kw_only=True, eq=False)
class Batch:
    """A stretch of a run that was flown, and that cameras may have to look at."""

    boundaries: Sequence[Boundary]
    elapsed_ns: Sequence[int]
    """From each boundary's predecessor to it [ns]."""
    pattern: Hashable
    """Same pattern, same flight: spans, and what is due at their ends."""
    closed_loop: bool
    """The path controller commands."""
    step_count: int
    """Steps of the integration."""
    command_count: int
    number: int
    """Counts the batches of a state."""
    slot: int
    """Slot of the first boundary in the trace."""
    wanted: frozenset[str]
    """Cameras that look."""
    until_ns: int
    """Packets up to here count [ns]: less than the whole batch where a collision ends the run."""
    looks: Sequence[Look] | None = None
    """What casts render of it, if that was planned ahead."""
    seen: Sequence[tuple[CastState, Instants]] = ()
    choices: Sequence[Choice] = ()
    """What adaptive casts render of it."""


class Ahead(NamedTuple):
    """A control period that was planned."""

    batch: Batch
    """The first of it."""
    end_ns: int
    """Where it ends [ns]."""


class Pilot(NamedTuple):
    """Turns the setpoints of one mode into rotor speeds."""

    controller: Controller
    setpoint: HostInput


@dataclass(kw_only=True, eq=False)
class State:
    """What changes during a run."""

    vehicle: Multirotor
    controller: Controller
    trace: Trace
    casts: list[CastState]
    imus: dict[str, Imu]
    imu_copies: dict[str, tuple[HostCopy, HostCopy]]
    """Specific force and angular rate of each IMU on the host, in the slots of the trace."""
    lanes: Sequence[Milestone]
    """For each batch that cameras may look at, the point where the device has finished it."""
    flight_lane_count: int
    """The most batches that may be flown and not looked at."""
    borrow_pictures: bool
    """Pictures are views that the next batch of their lane overwrites."""
    late_pictures: bool
    """Pictures for which the caller has room are handed out before the device has finished them."""
    wanted: frozenset[str]
    """Cameras that look, from the next batch on."""
    flight_stream: wp.Stream | None
    """Where the vehicle moves, ahead of the renderers; with one lane nothing overlaps, one stream does."""
    render_streams: Sequence[wp.Stream | None]
    """For each lane: the last rays of a batch and the first of the next fill the device together."""
    event_stream: wp.Stream | None
    """Where events are found, while the next batch is rendered."""
    choice_stream: wp.Stream | None
    """Where adaptive casts choose what to render, ahead of the renderers."""
    overlaps: bool
    """Parts of a batch are launched on their own; on a CUDA device with one lane, all as one graph, unless an
    adaptive cast or the host has to wait for the flight."""
    flown: Sequence[Milestone]
    """For each batch that may be flown and not looked at, its end on `flight_stream`."""
    rendered: Milestone
    """End of the batch whose rendering was launched last."""
    graphs: Graphs
    stamp_ns: int = 0
    """How far packets have been returned [ns]."""
    launched_ns: int = 0
    """How far the device has been told to go [ns]."""
    launched_count: int = 0
    """Batches flown so far."""
    looked_count: int = 0
    """Batches that cameras have looked at, or left out; written by the thread that does."""
    last: Odometry | None = None
    """The state at the end of what was flown and read."""
    rotor_speeds: HostInput
    """Where rotor speeds are commanded from outside."""
    pilots: dict[str, Pilot] = field(default_factory=dict)
    """Who flies in the command modes that were used."""
    order: CommandMode | None = None
    """Mode of the setpoint that the next batch begins with."""
    under_way: deque[Batch] = field(default_factory=deque)
    ahead: Ahead | None = None
    """The next control period, if it was planned while the device was at work."""
    sequence: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    touching: bool = False
    """The vehicle touched the scene at the last boundary."""
    ended: bool = False
    """A collision ended the run."""
    failure: DynamicsError | None = None
    """The integration failed; packets up to its stamp have been returned."""
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    """steps, commands, redone intervals (of the dynamics, in adaptive steps), renders, ticks left out, coarse
    ticks, events dropped, collisions."""
    wall_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Wall-clock time by phase [s]."""


def make_state(
    model: Model,
    *,
    lane_count: int | None = None,
    flight_lane_count: int | None = None,
    borrow_pictures: bool = False,
    late_pictures: bool = False,
    make_room: MakeRoom | None = None,
    seed: int | None = None,
    start: StartState | None = None,
) -> State:
    """Allocate everything an episode needs.

    Args:
        model: What does not change.
        lane_count: How many batches `run_model` keeps under way. By default 3 on a CUDA device, and 1 where a
            launch returns when it has finished. It changes no packet.
        flight_lane_count: How many batches of `fly_period` may wait for `see`; by default `lane_count`.
        borrow_pictures: Do not copy pictures: with one lane, each is valid until the next `step` or `see`;
            those that a step would overwrite itself are copied.
        late_pictures: Ask for room before pictures are rendered, and do not wait for those that a device
            copies there: they are there after `settle`.
        make_room: Gives memory to copy a picture to, where the caller has a place for it; called by the
            thread that reads the cameras; with `late_pictures` by the one that launches.
        seed: Seed of the sensor noise and of turbulence; None: as configured.
        start: Where the vehicle starts; None: as configured.

    Raises:
        ValueError: The start is of a wrong shape or not finite.
    """
    config, device = model.config, model.device
    if lane_count is None:
        ahead = wp.get_device(device).is_cuda and config.renderer != "pyrender"
        lane_count = _LANES_ON_CUDA if ahead else 1
    vehicle = Multirotor(
        model.airframe,
        device=device,
        max_step_ns=to_ns(config.vehicle.max_step_s),
        integrator=config.vehicle.integrator,
        seed=config.seed if seed is None else seed,
    )
    begin = model.path.evaluate([0])
    half_yaw = 0.5 * begin.yaw[0]
    chosen = start or StartState()
    vehicle.reset(
        position=begin.position if chosen.position is None else chosen.position,
        velocity=begin.velocity if chosen.velocity is None else chosen.velocity,
        orientation=[0.0, 0.0, np.sin(half_yaw), np.cos(half_yaw)]
        if chosen.orientation is None
        else chosen.orientation,
        body_rate=chosen.body_rate,
    )
    flight_lane_count = max(lane_count, flight_lane_count or 0)
    slot_count = flight_lane_count * boundary_count_max(model.schedule)
    imus = {
        name: Imu(
            sensor,
            vehicle,
            seed=config.seed if seed is None else seed,
            name=name,
            slot_count=slot_count,
        )
        for name, sensor in config.sensors.items()
        if isinstance(sensor, ImuSensorConfig)
    }
    return State(
        vehicle=vehicle,
        rotor_speeds=HostInput(vehicle.arrays.rotor_speed_command),
        overlaps=lane_count > 1
        or late_pictures
        or wp.get_device(device).is_cpu
        or bool(model.schedule.sparse),
        controller=make_controller(
            "path", model.airframe, config.control.gains, device=device, paths=model.path
        ),
        trace=Trace(
            capacity=slot_count,
            vehicle_count=1,
            rotor_count=model.airframe.rotor_count,
            device=device,
        ),
        casts=[
            make_cast_state(
                cast,
                config.sensors,
                model.scene_on_device,
                capacity=model.schedule.ticks_per_batch(index),
                lane_count=lane_count,
                device=device,
                seed=config.seed if seed is None else seed,
                bodies=config.bodies,
                make_room=make_room,
                late=late_pictures,
            )
            for index, cast in enumerate(model.casts)
            if model.scene_on_device is not None
        ],
        imus=imus,
        imu_copies={n: (HostCopy(i.specific_force), HostCopy(i.angular_rate)) for n, i in imus.items()},
        lanes=[Milestone(device) for _ in range(lane_count)],
        flight_lane_count=flight_lane_count,
        borrow_pictures=borrow_pictures,
        late_pictures=late_pictures,
        wanted=frozenset(name for cast in model.casts for name in cast.names),
        flight_stream=make_stream(device, urgent=True) if lane_count > 1 else None,
        render_streams=[make_stream(device) if lane_count > 1 else None for _ in range(lane_count)],
        event_stream=make_stream(device, urgent=True) if lane_count > 1 else None,
        choice_stream=make_stream(device, urgent=True) if lane_count > 1 and model.schedule.sparse else None,
        flown=[Milestone(device) for _ in range(flight_lane_count)],
        rendered=Milestone(device),
        graphs=Graphs(device),
    )
