"""Streaming: control periods are flown ahead of the wall clock, and published when it reaches them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

from neurosim_core.live.cameras import CameraThread
from neurosim_core.live.config import LiveConfig
from neurosim_core.live.pacing import Pacer
from neurosim_core.live.status import RunStats
from neurosim_core.live.vehicle import VehicleNode

HICCUP_NS = 10_000_000
"""How far the machine may be late, or a control period if that is longer, and catch up [ns]."""
ANSWER_NS = 50_000_000
"""A request waits for the end of a control period that is this near [ns]."""
BEHIND_MAX_NS = 500_000_000
"""How far the machine may be late where camera frames are dropped [ns]."""
READERS_SHARE = 0.04
"""Share of a control period that is left to readers before the next one is flown."""
READERS_S = (50e-6, 250e-6)
"""The least that is worth a sleep, and the most that readers need to take a picture and answer it [s]."""
BEHIND_SHARE = 0.25
"""Share of a period that the machine may be late and still leave time to readers."""


class StreamingLoop:
    """Flies, renders and publishes the control periods of a streaming run.

    A period is computed when it begins, and its packets are published at their stamps, so the machine has the
    period to compute it. Lateness is caught up; if that is not possible, `live.overrun` says whether time is
    delayed or frames are dropped.
    """

    def __init__(
        self,
        vehicles: Sequence[VehicleNode],
        cameras: CameraThread,
        pacer: Pacer,
        stats: RunStats,
        *,
        live: Callable[[], LiveConfig],
        stop: Callable[[], bool],
        requested: Callable[[], bool],
        wakeup: threading.Event,
    ) -> None:
        """Connect the parts.

        `pacer`: says when a stamp is due; sleeps on `wakeup`. `live`: returns what gives way when the machine
        or the cameras are late. `wakeup`: set when there are new packets or requests.
        """
        self._vehicles = vehicles
        for vehicle in vehicles:
            vehicle.publisher.lateness_ns = pacer.lateness_ns
        self._cameras = cameras
        self._pacer = pacer
        self._stats = stats
        self._live = live
        self._stop = stop
        self._requested = requested
        self._wakeup = wakeup

    def fly(self, stamp_ns: int, end_ns: int) -> bool:
        """Fly the control period from one tick [ns] to the next, and queue its pictures.

        Returns:
            Whether it was flown: not if `stop` ended the wait for the cameras.

        Raises:
            DynamicsError: The integration failed.
            RuntimeError: The cameras failed.
        """
        drop = self._live().overrun == "drop" and self._pacer.factor > 0.0
        for vehicle in self._vehicles:
            if drop:
                self._cameras.drop_until(vehicle, stamp_ns - vehicle.period_count_max * (end_ns - stamp_ns))
            if not self._cameras.wait_for(partial(vehicle.can_fly, drop=drop), self._stop):
                return False
            is_late = drop and self._pacer.lateness_ns(stamp_ns) > BEHIND_MAX_NS / 2
            self._cameras.render(vehicle, vehicle.fly(stamp_ns), is_late=is_late)
        return True

    def catch_up(self, stamp_ns: int) -> None:
        """Wait for the cameras, and publish what arrives by a tick at which time stops [ns]."""
        self._cameras.finish(self._stop)
        self.publish_rendered(stamp_ns)

    def publish_rendered(self, stamp_ns: int) -> None:
        """Publish what the cameras have rendered and what arrives by a tick at which time stands [ns]."""
        self.offer_rendered()
        for vehicle in self._vehicles:
            vehicle.publisher.publish_due(stamp_ns)

    def publish_until(self, stamp_ns: int, end_ns: int) -> bool:
        """Publish what arrives in the period from one tick [ns] to the next, each packet when it is due.

        Returns whether the end was reached. A request ends the wait unless the end is near: call it again
        then.
        """

        def leave() -> bool:
            return self._stop() or (self._requested() and self._pacer.lateness_ns(end_ns) < -ANSWER_NS)

        def interrupted() -> bool:
            self._wakeup.clear()  # before the reasons for which it is set are checked
            return leave() or self._cameras.has_packets

        self._handle_overrun(stamp_ns, end_ns)
        while not leave():
            self.offer_rendered()
            dues = (vehicle.publisher.next_due_ns for vehicle in self._vehicles)
            due_ns = min([end_ns, *(due for due in dues if due is not None)])
            late_ns = self._pacer.wait_until(due_ns, interrupted)
            if late_ns < 0:
                continue
            if due_ns == end_ns:
                self._stats.late_times.add(late_ns)
                return True
            for vehicle in self._vehicles:
                vehicle.publisher.publish_due(due_ns)
        return False

    def yield_to_readers(self, stamp_ns: int, end_ns: int) -> None:
        """Sleep for a moment, if there is time, after what arrives at the end of a period was published.

        A scheduler may wake a reader on the core of its publisher even if another core is idle; without the
        sleep it waits there until the next period has been flown.
        """
        factor = self._pacer.factor
        if not factor:
            return
        wall_ns = (end_ns - stamp_ns) / factor
        least_s, most_s = READERS_S
        sleep_s = min(READERS_SHARE * wall_ns * 1e-9, most_s)
        if sleep_s >= least_s and self._pacer.lateness_ns(end_ns) < BEHIND_SHARE * wall_ns:
            time.sleep(sleep_s)

    def offer_rendered(self) -> None:
        """Send what the cameras have rendered."""
        for vehicle, packets in self._cameras.take():
            vehicle.publisher.offer(packets)

    def _handle_overrun(self, stamp_ns: int, end_ns: int) -> None:
        """Delay time if a period was computed after its end [ns] and that cannot be caught up."""
        late_ns = self._pacer.lateness_ns(end_ns)
        if late_ns <= 0:
            return
        self._stats.overrun_count += 1
        had_ns = (end_ns - stamp_ns) / self._pacer.factor
        if late_ns > (max(had_ns, HICCUP_NS) if self._live().overrun == "slow" else BEHIND_MAX_NS):
            self._stats.slipped_ns += self._pacer.slip(end_ns)
