"""One vehicle of a live run: its simulation, the commands it obeys, and what it publishes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from cortex import Node
from cortex.messages import Reset
from neurosim_core.config import SimulationConfig
from neurosim_core.live.commands import Command, CommandHold, CommandSubscriber
from neurosim_core.live.config import NO_LINK
from neurosim_core.live.engine import FlownBatch, Model, StartState, State, VehicleEngine
from neurosim_core.live.publisher import PacketPublisher
from neurosim_core.packets import Packet
from neurosim_core.vehicle.command_ranges import command_ranges


class VehicleNode:
    """Everything that belongs to one vehicle. For the thread that flies.

    Attributes:
        name: Of the vehicle.
        engine: Its simulation.
        subscriber: Commands that arrive.
        hold: The command that is held.
        publisher: What it publishes.
        awaited_ns: Stamp of the odometry whose command the next control period waits for [ns]; None: it waits
            for none, because the command has come or no odometry has arrived.
    """

    def __init__(
        self, node: Node, name: str, model: Model, *, record: Callable[[Packet], None] | None = None
    ) -> None:
        """Open the topics of a vehicle; `begin` starts its run.

        Args:
            node: Owner of the topics.
            name: Of the vehicle.
            model: What is flown.
            record: Called with every packet.
        """
        config = model.config
        lockstep = config.live.mode == "lockstep"
        link = config.links.get("command", NO_LINK)
        rotor_count = model.airframe.rotor_count
        self.name = name
        self.subscriber = CommandSubscriber(
            node,
            name,
            rotor_count=rotor_count,
            ranges=command_ranges(model.airframe),
            lockstep=lockstep,
        )
        self.hold = CommandHold(config.live, link, airframe=model.airframe, seed=config.seed)
        self.publisher = PacketPublisher(node, name, model, record=record)
        if not link.delivers_at_once:
            self.publisher.open_delivery("command")
        self.engine = VehicleEngine(model, lockstep=lockstep, acquire=self.publisher.acquire_buffer)
        if self.engine.writes_in_place:
            self.publisher.write_in_place(self.engine.settle)
        self.awaited_ns: int | None = None
        self._before_reset_ns = 0
        self._has_new_publisher = False
        self._active: frozenset[str] = frozenset()

    @property
    def config(self) -> SimulationConfig:
        """Settings of the vehicle."""
        return self.engine.model.config

    def begin(self, state: State, *, seed: int) -> None:
        """Begin a run, and publish where the vehicle is."""
        self.engine.reset(state)
        self._before_reset_ns = self.publisher.topics["odometry"].delivered_ns or 0
        self.hold.reset(seed=seed)
        self.subscriber.reset()
        self.publisher.reset(seed=seed)
        self.engine.choose_cameras(self._active)
        self.publisher.offer_state(self.engine.observe())
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

    def begin_step(self, stamp_ns: int) -> Callable[[], None]:
        """Launch the control period that begins at a tick [ns]; the returned function ends it.

        Raises:
            DynamicsError: The integration failed.
        """
        mode, setpoint = self.hold.command_at(stamp_ns, self.engine.observe)
        self.engine.choose_cameras(self._active)
        pending = self.engine.begin_step(mode, setpoint)

        def end_step() -> None:
            self.publisher.offer(self.engine.end_step(pending))
            self.publisher.offer_state(self.engine.observe())
            if self.engine.writes_in_place:  # the device still writes pictures
                self.engine.choose_cameras(self._active)
                self.engine.prepare_step()

        return end_step

    def prepare_step(self) -> None:
        """Prepare the next control period of lockstep while others read the last one."""
        if not self.engine.writes_in_place:
            self.engine.choose_cameras(self._active)
            self.engine.prepare_step()
        self.engine.acquire_buffers()

    def fly(self, stamp_ns: int) -> list[FlownBatch]:
        """Fly the control period that begins at a tick [ns]; return what remains to be rendered.

        Raises:
            DynamicsError: The integration failed.
        """
        mode, setpoint = self.hold.command_at(stamp_ns, self.engine.observe)
        self.engine.choose_cameras(self._active)
        packets, batches = self.engine.fly(mode, setpoint)
        self.publisher.offer(packets)
        self.publisher.offer_state(self.engine.observe())
        return batches

    def finish(self) -> None:
        """Send the events of windows that have not ended."""
        self.publisher.offer(self.engine.finish())

    def close_loans(self) -> None:
        """Give back the memory of pictures that are never published; call it before the topics close."""
        self.engine.forget_plan()
        self.publisher.close_loans()

    def configure(self, config: SimulationConfig) -> None:
        """Change links, gains and the fail-safe.

        Args:
            config: Settings of this vehicle.
        """
        self.engine.configure(dataclasses.replace(self.engine.model, config=config))
        self.hold.live = config.live
        links = {name: topic.link for name, topic in self.publisher.topics.items()}
        for name, link in (links | {"command": self.hold.link}).items():
            changed = config.links.get(name, NO_LINK)
            if changed != link.config:
                self.engine.forget_plan()
                link.configure(changed)
                self.publisher.open_delivery(name)


class ResetState(NamedTuple):
    """The beginning of a run, by vehicle."""

    states: dict[str, State]
    seeds: dict[str, int]


def make_reset(vehicles: Sequence[VehicleNode], config: SimulationConfig, request: Reset) -> ResetState:
    """Return the beginning of the run that a request asks for.

    Args:
        vehicles: All vehicles.
        config: Holds what the request leaves out.
        request: Seed, and the start of one vehicle.

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
        states[vehicle.name] = vehicle.engine.make_state(seed=seeds[vehicle.name], start=start)
    return ResetState(states, seeds)


class VehicleCollisions:
    """Vehicles that touch each other: spheres, checked once every control period."""

    def __init__(self) -> None:
        self._touching: set[tuple[str, str]] = set()

    def reset(self) -> None:
        """Forget which vehicles touch."""
        self._touching.clear()

    def check(self, vehicles: Sequence[VehicleNode]) -> None:
        """Report each pair that has begun to touch since the last call, as a collision of both."""
        for first, second in itertools.combinations(vehicles, 2):
            pair = (first.name, second.name)
            clearance_m = _clearance_m(first, second)
            if clearance_m > 0.0:
                self._touching.discard(pair)
            elif pair not in self._touching:
                self._touching.add(pair)
                for vehicle in (first, second):
                    vehicle.publisher.offer([vehicle.engine.report_collision(clearance_m)])


def _clearance_m(first: VehicleNode, second: VehicleNode) -> float:
    distance_m = np.linalg.norm(first.engine.observe().position - second.engine.observe().position)
    return float(distance_m) - sum(v.config.vehicle.collision_radius_m for v in (first, second))
