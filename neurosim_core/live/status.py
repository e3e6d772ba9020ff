"""What a simulator says of itself: what it flies, what time it is, and how it is doing."""

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
from neurosim_core.live.craft import Craft
from neurosim_core.live.pacing import Timings
from neurosim_core.vehicle.command_ranges import command_ranges
from neurosim_core.vehicle.multirotor import MultirotorConfig

STATUS_INTERVAL_S = 0.2


class Board:
    """The topics /simulation, /clock and /status.

    Attributes:
        on_status: Called with every status; None: nobody but subscribers wants to know.
    """

    def __init__(self, node: Node) -> None:
        """Open the topics.

        Args:
            node: Whose they are.
        """
        self.on_status: Callable[[SimulatorStatus], None] | None = None
        self._simulation = node.publisher(topics.SIMULATION, Simulation, latch=True)
        self._clock = node.publisher(topics.CLOCK, Clock)
        self._status = node.publisher(topics.STATUS, SimulatorStatus)
        self._clock_listeners = 0
        self._told_s = 0.0
        self._told_phase = ""

    def announce(self, config: SimulationConfig) -> None:
        """Say what is flown, and with which settings: at the beginning, and when they have changed."""
        airframes = [config.of(name).vehicle.airframe() for name in config.vehicles]
        ranges = [command_ranges(airframe) for airframe in airframes]
        self._simulation.publish(
            Simulation(
                config=to_yaml(config),
                version=__version__,
                vehicles=list(config.vehicles),
                mode=config.live.mode,
                control_rate_hz=config.control.rate_hz,
                thrust_max_n=[_thrust_max_n(airframe) for airframe in airframes],
                command_ranges=[CommandRanges(**dataclasses.asdict(each)) for each in ranges],
            )
        )

    def look(self) -> int:
        """See who listens to the clock; return how many."""
        self._clock_listeners = self._clock.subscriber_count
        return self._clock_listeners

    def strike(self, stamp_ns: int, live: LiveConfig, *, sequence: int) -> None:
        """Say what time it is, if anybody listens: at a tick [ns]."""
        if not self._clock_listeners:
            return
        factor = live.real_time_factor if live.mode == "streaming" else 0.0
        self._clock.publish(
            Clock(stamp_ns=stamp_ns, wall_ns=time.time_ns(), real_time_factor=factor, sequence=sequence)
        )

    def tell(self, phase: str, status: Callable[[], SimulatorStatus], *, at_once: bool = False) -> None:
        """Say how it is going, if it is time or the phase has changed, and somebody listens.

        Args:
            phase: As in the message.
            status: Makes the message.
            at_once: It is time.
        """
        now_s = time.monotonic()
        if not at_once and phase == self._told_phase and now_s - self._told_s < STATUS_INTERVAL_S:
            return
        self._told_s, self._told_phase = now_s, phase
        if self.on_status is None and not self._status.subscriber_count:
            return
        message = status()
        self._status.publish(message)
        if self.on_status is not None:
            self.on_status(message)


class Meter:
    """What is measured besides what the vehicles count.

    Attributes:
        step_times: To compute a control period, since the last status [ns].
        late_times: How late the wall clock was at its end [ns].
        step_count: Control periods since the beginning of the run.
        overrun_count: Those that took longer than they had.
        slipped_ns: By how much the run was held back [ns].
    """

    def __init__(self) -> None:
        self.step_times = Timings()
        self.late_times = Timings()
        self._sequence = 0
        self.reset()

    def reset(self) -> None:
        """Begin a new run at stamp 0."""
        self.step_times.take()
        self.late_times.take()
        self.step_count = 0
        self.overrun_count = 0
        self.slipped_ns = 0
        self._stamp_ns = 0
        self._wall_ns = time.monotonic_ns()

    def status(
        self,
        crafts: Sequence[Craft],
        dropped: Mapping[tuple[str, str], int],
        config: SimulationConfig,
        *,
        stamp_ns: int,
        phase: str,
        reason: str,
    ) -> SimulatorStatus:
        """Return the message, and begin to measure anew.

        Args:
            crafts: The vehicles.
            dropped: Frames that were not rendered, by vehicle and sensor.
            config: Settings that hold.
            stamp_ns: Simulated time [ns].
            phase: As in the message.
            reason: As in the message; where it is empty, topics are named whose readers hold up the run.
        """
        now_ns = time.monotonic_ns()
        elapsed_ns = max(now_ns - self._wall_ns, 1)
        factor = max(stamp_ns - self._stamp_ns, 0) / elapsed_ns
        self._stamp_ns, self._wall_ns = stamp_ns, now_ns
        steps, late = self.step_times.take(), self.late_times.take()
        self._sequence += 1
        streaming = config.live.mode == "streaming"
        held_up = [topic for craft in crafts for topic in craft.outlet.take_held_up()]
        if held_up and not reason:
            reason = f"reliable readers do not keep up with {', '.join(held_up)}"
        return SimulatorStatus(
            stamp_ns=stamp_ns,
            wall_ns=time.time_ns(),
            phase=phase,
            reason=reason,
            mode=config.live.mode,
            real_time_factor_wanted=config.live.real_time_factor if streaming else 0.0,
            real_time_factor=factor,
            step_count=self.step_count,
            step_median_ns=steps.median_ns,
            step_p99_ns=steps.p99_ns,
            late_median_ns=late.median_ns,
            late_p99_ns=late.p99_ns,
            overrun_count=self.overrun_count,
            slipped_ns=self.slipped_ns,
            sensors=[entry for craft in crafts for entry in _sensors(craft, dropped)],
            vehicles=[_vehicle(craft, stamp_ns) for craft in crafts],
            sequence=self._sequence - 1,
        )


def _sensors(craft: Craft, dropped: Mapping[tuple[str, str], int]) -> list[SensorStatus]:
    active = craft.outlet.active()
    entries = []
    for name in craft.model.config.sensors:
        stream = craft.outlet.streams[name]
        lost = stream.channel.lost_count
        entries.append(
            SensorStatus(
                vehicle=craft.name,
                name=name,
                active=name in active,
                subscriber_count=stream.subscriber_count,
                published_count=stream.published_count,
                dropped_count=dropped.get((craft.name, name), 0) + lost,
                injected_lost_count=lost,
                undelivered_count=stream.undelivered_count,
                late_p99_ns=stream.late_times.take().p99_ns,
            )
        )
    return entries


def _vehicle(craft: Craft, stamp_ns: int) -> VehicleStatus:
    helm, counts = craft.helm, craft.inbox.counts
    return VehicleStatus(
        name=craft.name,
        command_mode="" if helm.holds is None else helm.holds.mode,
        command_count=helm.counts.taken,
        refused_count=counts.refused,
        superseded_count=counts.superseded + helm.counts.superseded,
        lost_count=counts.lost + helm.channel.lost_count,
        command_age_ns=helm.age_ns(stamp_ns),
        fail_safe=helm.fail_safe,
        fail_safe_count=helm.counts.fail_safe,
        collision_count=craft.state.counts["collisions"],
        undelivered_count=craft.outlet.other_undelivered_count,
        refused_reason=craft.inbox.refusal if counts.refused else "",
        clamped_count=counts.clamped,
        clamped_reason=craft.inbox.clamping if counts.clamped else "",
    )


def _thrust_max_n(airframe: MultirotorConfig) -> float:
    return float(airframe.thrust_coefficients_n_s2.sum() * airframe.rotor_speed_max_rad_s**2)
