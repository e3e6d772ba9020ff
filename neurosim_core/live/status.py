"""The status of a simulator: its vehicles, its time, its speed and its losses."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence

from cortex import Node
from cortex.messages import Clock, CommandRanges, SensorStatus, Simulation, SimulatorStatus, VehicleStatus
from neurosim_core import __version__
from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.live import topics
from neurosim_core.live.config import LiveConfig
from neurosim_core.live.pacing import Timings
from neurosim_core.live.vehicle import VehicleNode
from neurosim_core.vehicle.command_ranges import command_ranges

STATUS_INTERVAL_S = 0.2
UPDATE_INTERVAL_S = 0.02
"""How often subscribers are counted, at most [s]."""
SETTLE_S = 0.1
"""For so long no subscriber may come or go before time begins [s]."""
SETTLE_MAX_S = 2.0


class StatusPublisher:
    """The topics /simulation, /clock and /status.

    Attributes:
        on_status: Called with every status; None: only subscribers get it.
    """

    def __init__(self, node: Node) -> None:
        """Open the topics on a node."""
        self.on_status: Callable[[SimulatorStatus], None] | None = None
        self._simulation = node.publisher(topics.SIMULATION, Simulation, latch=True)
        self._clock = node.publisher(topics.CLOCK, Clock)
        self._status = node.publisher(topics.STATUS, SimulatorStatus)
        self._clock_subscriber_count = 0
        self._published_s = 0.0
        self._phase = ""

    def announce(self, config: SimulationConfig) -> None:
        """Publish what is flown, with which settings."""
        airframes = [config.of(name).vehicle.airframe() for name in config.vehicles]
        ranges = [command_ranges(airframe) for airframe in airframes]
        self._simulation.publish(
            Simulation(
                config=to_yaml(config),
                version=__version__,
                vehicles=list(config.vehicles),
                mode=config.live.mode,
                control_rate_hz=config.control.rate_hz,
                thrust_max_n=[airframe.thrust_max_n for airframe in airframes],
                command_ranges=[CommandRanges(**dataclasses.asdict(each)) for each in ranges],
            )
        )

    def update_subscribers(self) -> int:
        """Return how many subscribers the clock has now."""
        self._clock_subscriber_count = self._clock.subscriber_count
        return self._clock_subscriber_count

    def publish_clock(self, stamp_ns: int, live: LiveConfig, *, sequence: int) -> None:
        """Publish the time at a tick [ns], if there are subscribers."""
        if not self._clock_subscriber_count:
            return
        factor = live.real_time_factor if live.mode == "streaming" else 0.0
        self._clock.publish(
            Clock(stamp_ns=stamp_ns, wall_ns=time.time_ns(), real_time_factor=factor, sequence=sequence)
        )

    def publish_status(
        self, phase: str, make: Callable[[], SimulatorStatus], *, at_once: bool = False
    ) -> None:
        """Publish a status, if it is time or the phase has changed, and there are subscribers."""
        now_s = time.monotonic()
        if not at_once and phase == self._phase and now_s - self._published_s < STATUS_INTERVAL_S:
            return
        self._published_s, self._phase = now_s, phase
        if self.on_status is None and not self._status.subscriber_count:
            return
        message = make()
        self._status.publish(message)
        if self.on_status is not None:
            self.on_status(message)


class SubscriberMonitor:
    """Counts the subscribers of all topics: a sensor without any is not computed."""

    def __init__(self, vehicles: Sequence[VehicleNode], status: StatusPublisher) -> None:
        self._vehicles = vehicles
        self._status = status
        self._counts: tuple[int, ...] = ()
        self._changed_s = self._updated_s = 0.0

    def update(self) -> None:
        """Count, if the last time is long enough ago."""
        if time.monotonic() - self._updated_s >= UPDATE_INTERVAL_S:
            self._update()

    def settle(self, wait: Callable[[float], bool]) -> None:
        """Wait until no subscriber comes or goes: the sender of the first command may have just subscribed.

        `wait`: waits for a time [s]; ends the wait by returning True.
        """
        give_up_s = time.monotonic() + SETTLE_MAX_S
        while time.monotonic() < give_up_s:
            self._update()
            left_s = self._changed_s + SETTLE_S - time.monotonic()
            if left_s <= 0.0 or wait(min(left_s, SETTLE_S / 10)):
                return

    def _update(self) -> None:
        self._updated_s = time.monotonic()
        vehicles = (count for vehicle in self._vehicles for count in vehicle.update_subscribers())
        counts = (self._status.update_subscribers(), *vehicles)
        if counts != self._counts:
            self._counts, self._changed_s = counts, self._updated_s


class RunStats:
    """Measurements of a run besides the counts of its vehicles, and the status made of them.

    Attributes:
        step_times: Time to compute a control period, since the last status [ns].
        late_times: How late the wall clock was at its end [ns].
        step_count: Control periods since the beginning of the run.
        overrun_count: Control periods that were computed after their end.
        slipped_ns: By how much the run was delayed [ns].
    """

    def __init__(self, vehicles: Sequence[VehicleNode]) -> None:
        self.step_times = Timings()
        self.late_times = Timings()
        self._vehicles = vehicles
        self._sequence = 0
        self.reset()

    def reset(self) -> None:
        """Begin a new run at stamp 0."""
        self.step_times.take()
        self.late_times.take()
        self.step_count = self.overrun_count = self.slipped_ns = 0
        self._stamp_ns = 0
        self._wall_ns = time.monotonic_ns()

    def make_status(
        self,
        live: LiveConfig,
        dropped: Mapping[tuple[str, str], int],
        *,
        stamp_ns: int,
        phase: str,
        reason: str,
    ) -> SimulatorStatus:
        """Return the message, and begin to measure anew.

        `dropped`: frames that were not rendered, by vehicle and sensor. `stamp_ns`: simulated time [ns].
        `reason`: as in the message; if empty, it names topics whose reliable readers hold up the run.
        """
        now_ns = time.monotonic_ns()
        factor = max(stamp_ns - self._stamp_ns, 0) / max(now_ns - self._wall_ns, 1)
        self._stamp_ns, self._wall_ns = stamp_ns, now_ns
        (step_median_ns, step_p99_ns), (late_median_ns, late_p99_ns) = (
            times.take() for times in (self.step_times, self.late_times)
        )
        self._sequence += 1
        lossy = [topic for vehicle in self._vehicles for topic in vehicle.publisher.take_lossy_topics()]
        if lossy and not reason:
            reason = f"reliable readers do not keep up with {', '.join(lossy)}"
        return SimulatorStatus(
            stamp_ns=stamp_ns,
            wall_ns=time.time_ns(),
            phase=phase,
            reason=reason,
            mode=live.mode,
            real_time_factor_wanted=live.real_time_factor if live.mode == "streaming" else 0.0,
            real_time_factor=factor,
            step_count=self.step_count,
            step_median_ns=step_median_ns,
            step_p99_ns=step_p99_ns,
            late_median_ns=late_median_ns,
            late_p99_ns=late_p99_ns,
            overrun_count=self.overrun_count,
            slipped_ns=self.slipped_ns,
            sensors=[entry for vehicle in self._vehicles for entry in _sensors(vehicle, dropped)],
            vehicles=[_vehicle(vehicle, stamp_ns) for vehicle in self._vehicles],
            sequence=self._sequence - 1,
        )


def _sensors(vehicle: VehicleNode, dropped: Mapping[tuple[str, str], int]) -> list[SensorStatus]:
    active = vehicle.publisher.active()
    entries = []
    for name in vehicle.config.sensors:
        topic = vehicle.publisher.topics[name]
        lost = topic.link.lost_count
        entries.append(
            SensorStatus(
                vehicle=vehicle.name,
                name=name,
                active=name in active,
                subscriber_count=topic.subscriber_count,
                published_count=topic.published_count,
                dropped_count=dropped.get((vehicle.name, name), 0) + lost,
                injected_lost_count=lost,
                undelivered_count=topic.undelivered_count,
                late_p99_ns=topic.late_times.take()[1],
            )
        )
    return entries


def _vehicle(vehicle: VehicleNode, stamp_ns: int) -> VehicleStatus:
    hold, counts = vehicle.hold, vehicle.subscriber.counts
    return VehicleStatus(
        name=vehicle.name,
        command_mode="" if hold.command is None else hold.command.mode,
        command_count=hold.taken_count,
        refused_count=counts.refused,
        superseded_count=counts.superseded + hold.superseded_count,
        lost_count=counts.lost + hold.link.lost_count,
        command_age_ns=hold.age_ns(stamp_ns),
        fail_safe=hold.fail_safe is not None,
        fail_safe_count=hold.fail_safe_count,
        collision_count=vehicle.state.counts["collisions"],
        undelivered_count=vehicle.publisher.other_undelivered_count,
        refused_reason=vehicle.subscriber.refusal if counts.refused else "",
        clamped_count=counts.clamped,
        clamped_reason=vehicle.subscriber.clamping if counts.clamped else "",
        command_source="" if hold.command is None else vehicle.subscriber.senders(hold.command.mode),
    )
