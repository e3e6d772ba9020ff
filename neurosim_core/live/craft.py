"""One vehicle of a live run: its simulation, who commands it, and what it publishes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

from cortex import Node
from neurosim_core.config import SimulationConfig
from neurosim_core.live.cameras import Lanes, plan_lanes, sees_inline
from neurosim_core.live.helm import Command, Helm
from neurosim_core.live.inbox import Inbox
from neurosim_core.live.outlet import NO_LINK, Outlet
from neurosim_core.packets import Odometry, Packet
from neurosim_core.simulation import (
    Batch,
    Begun,
    Model,
    StartState,
    State,
    begin_step,
    end_step,
    finish,
    fly_period,
    lend_rooms,
    make_state,
    observe,
    prepare_step,
    settle,
    want,
)
from neurosim_core.vehicle.command_ranges import command_ranges


class Craft:
    """Everything that belongs to one vehicle. To be used by the thread that flies.

    Attributes:
        name: Of the vehicle.
        model: What does not change.
        state: What does.
        inbox: Commands that come.
        helm: The command that holds.
        outlet: What is published.
        lanes: How far its cameras may be behind.
        answers_ns: Stamp of the odometry whose command the next control period waits for [ns]; None: it does
            not wait, as that has come or no odometry has arrived.
        has_newcomer: A controller has come since the last command.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        model: Model,
        *,
        record: Callable[[Packet], None] | None = None,
    ) -> None:
        """Open the topics of a vehicle; `begin` puts it into the world.

        Args:
            node: Whose topics they are.
            name: Of the vehicle.
            model: What is flown.
            record: Takes every packet.
        """
        config = model.config
        link = config.links.get("command", NO_LINK)
        self.name = name
        self.model = model
        self.inbox = Inbox(
            node,
            name,
            rotor_count=model.airframe.rotor_count,
            ranges=command_ranges(model.airframe),
            lockstep=config.live.mode == "lockstep",
        )
        self.helm = Helm(config.live, link, airframe=model.airframe, seed=config.seed)
        self.outlet = Outlet(node, name, model, record=record)
        if not link.delivers_at_once:
            self.outlet.announce_link("command")
        self.answers_ns: int | None = None
        self._before_reset_ns = 0
        self.has_newcomer = False
        self._cameras = frozenset(name for cast in model.casts for name in cast.names)
        self._active: frozenset[str] = frozenset()
        self._is_begun = False
        """A control period is under way, whose cameras are those with which it began."""
        self.lanes: Lanes = plan_lanes(model)
        self._is_late = config.live.mode == "lockstep" and sees_inline(model.device)
        """The device still writes pictures when they are offered."""
        self.state: State = self.make_state(seed=config.seed)

    def make_state(self, *, seed: int, start: StartState | None = None) -> State:
        """Return the beginning of an episode.

        Raises:
            ValueError: The start is of a wrong shape or not finite.
        """
        live = self.model.config.live
        return make_state(
            self.model,
            lane_count=1,
            flight_lane_count=1 if live.mode == "lockstep" else self.lanes.count,
            borrow_pictures=live.mode == "lockstep",
            late_pictures=self._is_late,
            # on a CPU, what is published at once is copied when it is published
            make_room=self.outlet.make_room if live.mode == "streaming" or self._is_late else None,
            seed=seed,
            start=start,
        )

    def begin(self, state: State, *, seed: int) -> None:
        """Begin an episode: forget everything, and publish where the vehicle is."""
        self.state = state
        if self._is_late:
            self.outlet.settle_with(functools.partial(settle, state))
        before_ns = self.outlet.streams["odometry"].delivered_ns
        self._before_reset_ns = 0 if before_ns is None else before_ns
        self.helm.reset(seed=seed)
        self.inbox.reset()
        self.outlet.reset(seed=seed)
        self._show()
        self.outlet.offer_state(observe(state))
        self.answers_ns = self.outlet.streams["odometry"].delivered_ns

    def look(self) -> tuple[int, ...]:
        """See who listens and turn cameras on and off; return how many are on each topic."""
        counts = self.outlet.look()
        active = self.outlet.active()
        if active != self._active:
            self._active = active
            if not self._is_begun:
                self._show()
        self.has_newcomer |= self.inbox.find_newcomers()
        return (*counts, self.inbox.publisher_count)

    def greet(self) -> None:
        """Ask again for the command that is waited for, if a new controller has come since the last time.

        It may have answered when nobody was connected to it yet, and would never speak again.
        """
        if self.has_newcomer:
            self.has_newcomer = False
            self.outlet.repeat_state()

    def answers(self, command: Command, *, lockstep: bool) -> bool:
        """Return whether the next control period may begin with a command.

        In streaming, stamps are free; but a command that answers what was before a reset comes too late.
        """
        if lockstep:
            return command.stamp_ns == self.answers_ns
        assert self.answers_ns is not None
        return not self.answers_ns < command.stamp_ns <= self._before_reset_ns

    def describe_silence(self) -> str:
        """Say which command a control period of lockstep waits for, and what came in its place."""
        mode = "any mode" if self.helm.holds is None else f"mode {self.helm.holds.mode}"
        missed = self.inbox.missed
        other = "" if missed is None else f"; the last other command answered {missed.stamp_ns} ns"
        return (
            f"it waits for a command of {mode} that answers the odometry of {self.answers_ns} ns, and "
            f"{self.inbox.publisher_count} publisher(s) of its commands are connected{other}"
        )

    def obey(self, command: Command, stamp_ns: int) -> None:
        """Send a command on its way at a tick [ns]."""
        self.answers_ns = None
        self.has_newcomer = False
        self.outlet.deliver(self.helm.send(command, stamp_ns=stamp_ns), "command")

    def begin_step(self, stamp_ns: int) -> Begun:
        """Begin to fly the control period from a tick [ns] on, cameras included; `end_step` has to follow.

        Raises:
            DynamicsError: The integration has failed.
        """
        mode, setpoint = self.helm.command_at(stamp_ns, self.observe)
        begun = begin_step(self.model, self.state, setpoint, mode=mode)
        self._is_begun = True
        return begun

    def end_step(self, begun: Begun) -> None:
        """Send on its way what a control period yields that was begun."""
        self._is_begun = False
        self.outlet.offer(end_step(self.model, self.state, begun))
        if self.state.wanted != self._active & self._cameras:
            self._show()
        self.outlet.offer_state(self.observe())
        if self._is_late:  # the device is still at work
            self._plan()

    def get_ready(self) -> None:
        """Do what can be done for the next control period while others read what this one has yielded."""
        if not self._is_late:
            self._plan()
        lend_rooms(self.state)

    def _show(self) -> None:
        """Have the cameras look that somebody listens to."""
        want(self.model, self.state, self._active & self._cameras)

    def _plan(self) -> None:
        """Plan the next control period."""
        if not self.state.ended and self.state.failure is None:
            prepare_step(self.model, self.state)

    def drop_loans(self) -> None:
        """Take back the room of pictures that never come, on which closing topics would wait, for good."""
        self.state.ahead = None
        self.outlet.drop_loans()

    def fly(self, stamp_ns: int) -> list[Batch]:
        """Fly the control period that begins at a tick [ns]; return what its cameras have to look at.

        Raises:
            DynamicsError: The integration failed.
        """
        mode, setpoint = self.helm.command_at(stamp_ns, self.observe)
        packets, batches = fly_period(self.model, self.state, setpoint, mode=mode)
        self.outlet.offer(packets)
        self.outlet.offer_state(self.observe())
        return batches

    def observe(self) -> Odometry:
        """Return the true state at the end of what was flown."""
        return observe(self.state)

    def finish(self) -> None:
        """Send on their way the events whose window has not ended."""
        self.outlet.offer(finish(self.state))

    def configure(self, config: SimulationConfig) -> None:
        """Change links, gains and what is done without a controller.

        Args:
            config: Settings of this vehicle.
        """
        if config.control.gains != self.model.config.control.gains:
            self.state.pilots.clear()
        self.model = dataclasses.replace(self.model, config=config)
        self.helm.live = config.live
        channels = {name: stream.channel for name, stream in self.outlet.streams.items()}
        for name, channel in (channels | {"command": self.helm.channel}).items():
            link = config.links.get(name, NO_LINK)
            if link != channel.config:
                self.state.ahead = None  # where its pictures go was planned for the link before
                channel.configure(link)
                self.outlet.announce_link(name)
