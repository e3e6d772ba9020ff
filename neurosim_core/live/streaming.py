"""Time that goes on by the wall clock: a control period of a streaming run, and what gives way when late."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from neurosim_core.live.cameras import Cameras
from neurosim_core.live.config import LiveConfig
from neurosim_core.live.craft import Craft
from neurosim_core.live.pacing import Pacer
from neurosim_core.live.status import Meter

HICCUP_NS = 10_000_000
"""The machine may be this late, or a control period if that is longer, and catch up [ns]."""
ANSWER_NS = 50_000_000
"""A request waits for the end of a control period that is this near [ns]."""
BEHIND_MAX_NS = 500_000_000
"""How far the machine may be behind where camera frames give way [ns]."""
READERS_SHARE = 0.04
"""What readers are left of a control period before the next one is flown."""
READERS_S = (50e-6, 250e-6)
"""The least that this is worth, and the most that they need: to take a picture and to answer it [s]."""
BEHIND_SHARE = 0.25
"""Share of a period that the machine may be behind, and leave readers this time."""


class Streaming:
    """Flies control periods ahead of the wall clock, and publishes when it says so.

    A period is computed when it begins, and what it yields is published at its own stamps, so the machine has
    the period to compute it. What it is late by is made up for; if that does not work, `live.overrun` says
    whether time is put off or frames are left out, and `meter` counts both.
    """

    def __init__(
        self,
        crafts: Sequence[Craft],
        cameras: Cameras,
        pacer: Pacer,
        meter: Meter,
        *,
        bell: threading.Event,
    ) -> None:
        """Take what is needed.

        Args:
            crafts: The vehicles.
            cameras: Looks at what they fly past.
            pacer: Says when a stamp is due; sleeps on `bell`.
            meter: Takes note of how late it is.
            bell: Rung when the cameras have seen something.
        """
        self._crafts = crafts
        for craft in crafts:
            if craft.model.config.live.mode == "streaming":
                craft.outlet.lateness_ns = pacer.lateness_ns
        self._cameras = cameras
        self._pacer = pacer
        self._meter = meter
        self._bell = bell

    def fly(self, stamp_ns: int, live: LiveConfig, stop: Callable[[], bool]) -> bool:
        """Fly the control period that begins at a tick [ns], and leave its pictures to the cameras.

        Args:
            stamp_ns: The tick.
            live: Says what gives way when the cameras are late.
            stop: Ends the wait for them.

        Returns:
            Whether it was flown: not if `stop` ended the wait.

        Raises:
            DynamicsError: The integration failed.
            RuntimeError: The cameras failed.
        """
        drop = live.overrun == "drop" and self._pacer.factor > 0.0
        for craft in self._crafts:
            if drop:
                self._cameras.leave_out(craft.name, stamp_ns - craft.lanes.lag_ns)
            if not self._cameras.wait_for_room(craft.state, craft.lanes.needed(drop=drop), stop):
                return False
            late = drop and self._pacer.lateness_ns(stamp_ns) > min(
                craft.lanes.lag_ns / self._pacer.factor, BEHIND_MAX_NS / 2
            )
            self._cameras.look(craft.name, craft.model, craft.state, craft.fly(stamp_ns), late=late)
        return True

    def catch_up(self, stamp_ns: int, stop: Callable[[], bool]) -> None:
        """Wait for the cameras, and publish what arrives by a tick at which time stops [ns].

        Args:
            stamp_ns: The tick.
            stop: Ends the wait.

        Raises:
            RuntimeError: The cameras failed.
        """
        self._cameras.finish(stop)
        self.publish_seen(stamp_ns)

    def publish_seen(self, stamp_ns: int) -> None:
        """Publish what the cameras have seen and what arrives by a tick at which time stands [ns]."""
        self.offer_seen()
        for craft in self._crafts:
            craft.outlet.publish_due(stamp_ns)

    def publish_until(
        self,
        end_ns: int,
        period_ns: int,
        live: LiveConfig,
        stop: Callable[[], bool],
        *,
        called: Callable[[], bool],
    ) -> bool:
        """Publish what arrives before the end of a control period, each when it is due, and wait for the end.

        Args:
            end_ns: End of the period [ns].
            period_ns: Its length [ns].
            live: Says what gives way when the machine is late.
            stop: Ends the wait.
            called: Whether somebody asks for something; that waits for an end that is near, and ends the wait
                for another.

        Returns:
            Whether it came to the end; where it was `called`, it can be called again to go on.
        """

        def leave() -> bool:
            return stop() or (called() and self._pacer.lateness_ns(end_ns) < -ANSWER_NS)

        def interrupted() -> bool:
            self._bell.clear()  # before the look at why it was rung
            return leave() or self._cameras.has_packets

        self._make_way(end_ns, period_ns, live)
        while not leave():
            self.offer_seen()
            due_ns = min([end_ns, *(d for c in self._crafts if (d := c.outlet.next_due_ns) is not None)])
            late_ns = self._pacer.wait_until(due_ns, interrupted)
            if late_ns < 0:
                continue
            if due_ns == end_ns:
                self._meter.late_times.add(late_ns)
                return True
            for craft in self._crafts:
                craft.outlet.publish_due(due_ns)
        return False

    def let_readers_go_first(self, end_ns: int, period_ns: int) -> None:
        """Sleep for a moment, if there is time, after what is due at the end of a period [ns] was published.

        A scheduler may put a reader that was woken onto the core of who woke it, even if another is idle, and
        let it wait there until the next period has been flown: half a millisecond, a picture's whole delivery
        four times over.

        Args:
            end_ns: End of the period [ns].
            period_ns: Its length [ns].
        """
        factor = self._pacer.factor
        if not factor:
            return
        wall_ns = period_ns / factor
        least_s, most_s = READERS_S
        left_s = min(READERS_SHARE * wall_ns * 1e-9, most_s)
        if left_s >= least_s and self._pacer.lateness_ns(end_ns) < BEHIND_SHARE * wall_ns:
            time.sleep(left_s)

    def offer_seen(self) -> None:
        """Send on their way what the cameras have seen."""
        for name, packets in self._cameras.take():
            next(craft for craft in self._crafts if craft.name == name).outlet.offer(packets)

    def _make_way(self, end_ns: int, period_ns: int, live: LiveConfig) -> None:
        """Put time off if a period was computed after its end [ns] and that cannot be made up for."""
        late_ns = self._pacer.lateness_ns(end_ns)
        if late_ns <= 0:
            return
        self._meter.overrun_count += 1
        had_ns = period_ns / self._pacer.factor
        if late_ns > (max(had_ns, HICCUP_NS) if live.overrun == "slow" else BEHIND_MAX_NS):
            self._meter.slipped_ns += self._pacer.slip(end_ns)
