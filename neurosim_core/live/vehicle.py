"""One vehicle of a live run: its simulation, the commands it obeys, and what it publishes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from cortex import Node
from cortex.messages import Reset
from neurosim_core import sim
from neurosim_core.config import SimulationConfig
from neurosim_core.live.commands import Command, CommandHold, CommandSubscriber
from neurosim_core.live.config import NO_LINK
from neurosim_core.live.publisher import PacketPublisher
from neurosim_core.packets import Collision, Packet
from neurosim_core.sim import COLLISION, Batch, Model, StartState, State
from neurosim_core.vehicle.command_ranges import command_ranges

_PENDING_PERIODS = (2, 100)
"""Bounds of how far the cameras may lag behind the flight, in control periods."""
_SPARE_PERIODS = 32
"""Further periods that are flown while one picture takes too long and frames are dropped."""


class VehicleNode:
    """Everything that belongs to one vehicle. For the simulation thread.

    In lockstep `begin_step` flies a control period, cameras included. In streaming `fly` flies one, and the
    cameras look at its batches later (`streaming.py`).

    Attributes:
        name: Of the vehicle.
        model: What does not change during a run.
        state: What does; there is none before `begin`.
        subscriber: Commands that arrive.
        hold: The command that is held.
        publisher: What it publishes.
        is_cuda: It runs on a CUDA device.
        period_count_max: Control periods that the cameras may lag behind the flight before they are late.
        awaited_ns: Stamp of the odometry whose command the next control period waits for [ns]; None: it waits
            for none, because the command has come or no odometry has arrived.
    """

    state: State

    def __init__(
        self, node: Node, name: str, model: Model, *, record: Callable[[Packet], None] | None = None
    ) -> None:
        """Open the topics of a vehicle on a node; `begin` starts its run. `record` gets every packet."""
        config = model.config
        link = config.links.get("command", NO_LINK)
        self.name, self.model = name, model
        self._lockstep = config.live.mode == "lockstep"
        self.subscriber = CommandSubscriber(
            node,
            name,
            rotor_count=model.airframe.rotor_count,
            ranges=command_ranges(model.airframe),
            lockstep=self._lockstep,
        )
        self.hold = CommandHold(config.live, link, airframe=model.airframe, seed=config.seed)
        self.publisher = PacketPublisher(node, name, model, record=record)
        if not link.delivers_at_once:
            self.publisher.open_delivery("command")
        self.is_cuda = bool(wp.get_device(model.device).is_cuda)
        self._cameras = frozenset(name for group in model.groups for name in group.names)
        self._writes_in_place = self._lockstep and self.is_cuda
        """The device writes pictures into memory of topics, and may still do so after `end_step`."""
        if self._writes_in_place:
            self.publisher.write_in_place(lambda: sim.settle(self.state))
        period_ns = model.schedule.control.stamp_ns(1)
        slowest_ns = max((group.rate.stamp_ns(1) for group in model.groups), default=0)
        least, most = _PENDING_PERIODS
        self.period_count_max = min(max(-(-slowest_ns // period_ns), least), most)
        batch_ns = model.schedule.batch_end_ns(0, period_ns)
        self._batches_per_period = -(-period_ns // max(batch_ns, 1)) + 1  # one more where rates do not divide
        self.awaited_ns: int | None = None
        self._before_reset_ns = 0
        self._has_new_publisher = False
        self._active: frozenset[str] = frozenset()

    @property
    def config(self) -> SimulationConfig:
        """Settings of the vehicle."""
        return self.model.config

    def begin(self, state: State, *, seed: int) -> None:
        """Begin a run, and publish where the vehicle is."""
        self.state = state
        self._before_reset_ns = self.publisher.topics["odometry"].delivered_ns or 0
        self.hold.reset(seed=seed)
        self.subscriber.reset()
        self.publisher.reset(seed=seed)
        self._choose_cameras()
        self.publisher.offer_state(sim.observe(state))
        self.awaited_ns = self.publisher.topics["odometry"].delivered_ns

    def update_subscribers(self) -> tuple[int, ...]:
        """Note which sensors have subscribers; return how many subscribers each topic has."""
        counts = self.publisher.update()
        self._active = self.publisher.active()
        self._has_new_publisher |= self.subscriber.has_new_publisher()
        return (*counts, self.subscriber.publisher_count)

    def repeat_state(self) -> None:
        """Publish the state again if a new controller has connected since the last command.

        It may have answered before it was connected, and would wait forever.
        """
        if self._has_new_publisher:
            self._has_new_publisher = False
            self.publisher.repeat_state()

    def forget_new_publishers(self) -> None:
        """Do not repeat the state for those that have connected so far."""
        self._has_new_publisher = False

    def accepts(self, command: Command) -> bool:
        """Return whether the next control period may begin with a command.

        In lockstep its stamp has to be the one that is awaited. In streaming stamps are free, but a command
        that answers a state of before the reset is too late.
        """
        assert self.awaited_ns is not None
        if self.config.live.mode == "lockstep":
            return command.stamp_ns == self.awaited_ns
        return not self.awaited_ns < command.stamp_ns <= self._before_reset_ns

    def describe_missing_command(self) -> str:
        """Return which command a control period of lockstep waits for, and what came instead."""
        mode = "any mode" if self.hold.command is None else f"mode {self.hold.command.mode}"
        missed = self.subscriber.missed
        other = "" if missed is None else f"; the last other command answered {missed.stamp_ns} ns"
        return (
            f"it waits for a command of {mode} that answers the odometry of {self.awaited_ns} ns, and "
            f"{self.subscriber.publisher_count} publisher(s) of its commands are connected{other}"
        )

    def obey(self, command: Command, stamp_ns: int) -> None:
        """Send a command through its link at a tick [ns]."""
        self.awaited_ns = None
        self._has_new_publisher = False
        self.publisher.deliver(self.hold.send(command, stamp_ns=stamp_ns), "command")

    def make_state(self, *, seed: int, start: StartState | None) -> State:
        """Return the beginning of a run, for `begin`.

        Raises:
            ValueError: The start is of a wrong shape or not finite.
        """
        pending = 1 if self._lockstep else self._batches_per_period * (self.period_count_max + _SPARE_PERIODS)
        return sim.make_state(
            self.model,
            in_flight=1,
            render_backlog=pending,
            borrow_pictures=self._lockstep,
            allocate_picture=self.publisher.acquire_buffer if self._writes_in_place else None,
            seed=seed,
            start=start,
        )

    def begin_step(self, stamp_ns: int) -> Callable[[], None]:
        """Launch the control period that begins at a tick [ns]; the returned function ends it.

        Raises:
            DynamicsError: The integration failed.
        """
        mode, setpoint = self.hold.command_at(stamp_ns, lambda: sim.observe(self.state))
        self._choose_cameras()
        pending = sim.begin_step(self.model, self.state, setpoint, mode=mode)

        def end_step() -> None:
            self.publisher.offer(sim.end_step(self.model, self.state, pending))
            self.publisher.offer_state(sim.observe(self.state))
            if self._writes_in_place:  # the device still writes pictures
                self._plan_step()

        return end_step

    def prepare_step(self) -> None:
        """Prepare the next control period of lockstep while others read the last one."""
        if not self._writes_in_place:
            self._plan_step()
        sim.acquire_next_picture_buffers(self.state)

    def _plan_step(self) -> None:
        self._choose_cameras()
        if not self.state.ended and self.state.failure is None:
            sim.prepare_step(self.model, self.state)

    def can_fly(self, *, drop: bool) -> bool:
        """Return whether a control period may be flown before more batches have been rendered.

        With `drop` late frames are dropped: the flight may go on for some more periods.
        """
        spare = 0 if drop else self._batches_per_period * _SPARE_PERIODS
        return sim.render_backlog_left(self.state) >= self._batches_per_period + spare

    def fly(self, stamp_ns: int) -> list[Batch]:
        """Fly the control period that begins at a tick [ns]; return what remains to be rendered.

        Raises:
            DynamicsError: The integration failed.
        """
        mode, setpoint = self.hold.command_at(stamp_ns, lambda: sim.observe(self.state))
        self._choose_cameras()
        packets, batches = sim.integrate_period(self.model, self.state, setpoint, mode=mode)
        self.publisher.offer(packets)
        self.publisher.offer_state(sim.observe(self.state))
        return batches

    def finish(self) -> None:
        """Send the events of windows that have not ended."""
        self.publisher.offer(sim.finish(self.state))

    def report_collision(self, clearance_m: float) -> None:
        """Count and send a collision with another vehicle, which ends the run if so configured.

        `clearance_m`: distance between the two, minus their radii [m]; <= 0.
        """
        state, now = self.state, sim.observe(self.state)
        packet = Collision(
            stamp_ns=now.stamp_ns,
            sequence=state.sequence[COLLISION],
            sensor=COLLISION,
            position=now.position,
            clearance_m=clearance_m,
        )
        state.sequence[COLLISION] += 1
        state.counts["collisions"] += 1
        state.ended |= self.config.vehicle.on_collision == "end"
        self.publisher.offer([packet])

    def close_loans(self) -> None:
        """Give back the memory of pictures that are never published; call it before the topics close."""
        if hasattr(self, "state"):  # not where the start failed
            self.state.planned = None
        self.publisher.close_loans()

    def configure(self, config: SimulationConfig) -> None:
        """Change links, gains, the fail-safe, and bodies, for which nothing may be being rendered."""
        before, self.model = self.config, dataclasses.replace(self.model, config=config)
        if config.control.gains != before.control.gains:
            sim.forget_controllers(self.state)
        if config.bodies != before.bodies:
            self.state.planned = None
            sim.move_bodies(self.state.groups, config.bodies)
        self.hold.live = config.live
        links = {name: topic.link for name, topic in self.publisher.topics.items()}
        for name, link in (links | {"command": self.hold.link}).items():
            changed = config.links.get(name, NO_LINK)
            if changed != link.config:
                self.state.planned = None  # its pictures go elsewhere
                link.configure(changed)
                self.publisher.open_delivery(name)

    def _choose_cameras(self) -> None:
        """Render the cameras that somebody looks at, from the next control period on."""
        names = self._cameras & self._active
        if self.state.enabled_cameras != names:
            sim.select_cameras(self.model, self.state, names)


class ResetState(NamedTuple):
    """The beginning of a run, by vehicle."""

    states: dict[str, State]
    seeds: dict[str, int]


def make_reset(vehicles: Sequence[VehicleNode], config: SimulationConfig, request: Reset) -> ResetState:
    """Return the beginning of the run that a request asks for; what it leaves out is as configured.

    Raises:
        ValueError: There is no such vehicle, a seed is negative, or a start is not finite.
    """
    names = [vehicle.name for vehicle in vehicles]
    fields = {name: getattr(request, name) for name in ("position", "orientation", "velocity", "body_rate")}
    given = {name: value for name, value in fields.items() if value is not None}
    if request.vehicle and request.vehicle not in names:
        raise ValueError(f"unknown vehicle {request.vehicle!r}, known: {', '.join(names)}")
    if given and not request.vehicle and len(names) > 1:
        raise ValueError(f"say which vehicle starts elsewhere: one of {', '.join(names)}")
    if request.seed is not None:
        if request.seed < 0:
            raise ValueError(f"seed must be >= 0, got {request.seed}")
        config = config.model_copy(update={"seed": request.seed})
    seeds = {name: config.of(name).seed for name in names}
    states = {}
    for vehicle in vehicles:
        moved = given and request.vehicle in ("", vehicle.name)
        start = StartState(**given) if moved else None
        states[vehicle.name] = vehicle.make_state(seed=seeds[vehicle.name], start=start)
    return ResetState(states, seeds)


def report_touches(vehicles: Sequence[VehicleNode], touching: set[tuple[str, str]]) -> None:
    """Report each pair of vehicles that has begun to touch since the last call, as a collision of both.

    Vehicles are spheres here. `touching`: the pairs that touch; updated.
    """
    for first, second in itertools.combinations(vehicles, 2):
        pair = (first.name, second.name)
        clearance_m = _clearance_m(first, second)
        if clearance_m > 0.0:
            touching.discard(pair)
        elif pair not in touching:
            touching.add(pair)
            for vehicle in (first, second):
                vehicle.report_collision(clearance_m)


def _clearance_m(first: VehicleNode, second: VehicleNode) -> float:
    distance_m = np.linalg.norm(sim.observe(first.state).position - sim.observe(second.state).position)
    return float(distance_m) - sum(v.config.vehicle.collision_radius_m for v in (first, second))
