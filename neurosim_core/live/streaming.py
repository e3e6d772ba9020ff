"""Streaming: periods are flown ahead of the wall clock, rendered beside that, and published in time."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent import futures
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from neurosim_core.live.config import LiveConfig
from neurosim_core.live.pacing import Pacer
from neurosim_core.live.status import RunStats
from neurosim_core.live.vehicle import VehicleNode
from neurosim_core.packets import Packet
from neurosim_core.sim import Batch, State, render_batch, skip_batch

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
GIVE_UP_S = 0.5
"""How long the batch in work may take at the end of a run [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamingLoop:
    """Flies, renders and publishes the control periods of a streaming run.

    A period is computed when it begins, and its packets are published at their stamps, so the machine has the
    period to compute it. Lateness is caught up; if that is not possible, `live.overrun` says whether time is
    delayed or frames are dropped.
    """

    vehicles: Sequence[VehicleNode]
    cameras: CameraThread
    pacer: Pacer
    """Says when a stamp is due; sleeps on `wakeup`."""
    stats: RunStats
    live: Callable[[], LiveConfig]
    """Returns what gives way when the machine or the cameras are late."""
    stop: Callable[[], bool]
    requested: Callable[[], bool]
    wakeup: threading.Event
    """Set when there are new packets or requests."""

    def fly(self, stamp_ns: int, end_ns: int) -> bool:
        """Fly the control period from one tick [ns] to the next, and queue its pictures.

        Returns:
            Whether it was flown: not if `stop` ended the wait for the cameras.

        Raises:
            DynamicsError: The integration failed.
            RuntimeError: The cameras failed.
        """
        drop = self.live().overrun == "drop" and self.pacer.factor > 0.0
        for vehicle in self.vehicles:
            if drop:
                self.cameras.drop_until(vehicle, stamp_ns - vehicle.period_count_max * (end_ns - stamp_ns))
            if not self.cameras.wait_for(partial(vehicle.can_fly, drop=drop), self.stop):
                return False
            is_late = drop and self.pacer.lateness_ns(stamp_ns) > BEHIND_MAX_NS / 2
            self.cameras.render(vehicle, vehicle.fly(stamp_ns), is_late=is_late)
        return True

    def catch_up(self, stamp_ns: int) -> None:
        """Wait for the cameras, and publish what arrives by a tick at which time stops [ns]."""
        self.cameras.finish(self.stop)
        self.publish_rendered(stamp_ns)

    def publish_rendered(self, stamp_ns: int) -> None:
        """Publish what the cameras have rendered and what arrives by a tick at which time stands [ns]."""
        self.offer_rendered()
        for vehicle in self.vehicles:
            vehicle.publisher.publish_due(stamp_ns)

    def publish_until(self, stamp_ns: int, end_ns: int) -> bool:
        """Publish what arrives in the period from one tick [ns] to the next, each packet when it is due.

        Returns whether the end was reached. A request ends the wait unless the end is near: call it again
        then.
        """

        def leave() -> bool:
            return self.stop() or (self.requested() and self.pacer.lateness_ns(end_ns) < -ANSWER_NS)

        def interrupted() -> bool:
            self.wakeup.clear()  # before the reasons for which it is set are checked
            return leave() or self.cameras.has_packets

        self._handle_overrun(stamp_ns, end_ns)
        while not leave():
            self.offer_rendered()
            dues = (vehicle.publisher.next_due_ns for vehicle in self.vehicles)
            due_ns = min([end_ns, *(due for due in dues if due is not None)])
            late_ns = self.pacer.wait_until(due_ns, interrupted)
            if late_ns < 0:
                continue
            if due_ns == end_ns:
                self.stats.late_times.add(late_ns)
                return True
            for vehicle in self.vehicles:
                vehicle.publisher.publish_due(due_ns)
        return False

    def yield_to_readers(self, stamp_ns: int, end_ns: int) -> None:
        """Sleep for a moment, if there is time, after what arrives at the end of a period was published.

        A scheduler may wake a reader on the core of its publisher even if another core is idle; without the
        sleep it waits there until the next period has been flown.
        """
        factor = self.pacer.factor
        if not factor:
            return
        wall_ns = (end_ns - stamp_ns) / factor
        least_s, most_s = READERS_S
        sleep_s = min(READERS_SHARE * wall_ns * 1e-9, most_s)
        if sleep_s >= least_s and self.pacer.lateness_ns(end_ns) < BEHIND_SHARE * wall_ns:
            time.sleep(sleep_s)

    def offer_rendered(self) -> None:
        """Send what the cameras have rendered."""
        for vehicle, packets in self.cameras.take():
            vehicle.publisher.offer(packets)

    def _handle_overrun(self, stamp_ns: int, end_ns: int) -> None:
        """Delay time if a period was computed after its end [ns] and that cannot be caught up."""
        late_ns = self.pacer.lateness_ns(end_ns)
        if late_ns <= 0:
            return
        self.stats.overrun_count += 1
        had_ns = (end_ns - stamp_ns) / self.pacer.factor
        if late_ns > (max(had_ns, HICCUP_NS) if self.live().overrun == "slow" else BEHIND_MAX_NS):
            self.stats.slipped_ns += self.pacer.slip(end_ns)


@dataclass(kw_only=True, eq=False)
class _Job:
    """A batch of one vehicle that is to be rendered."""

    vehicle: VehicleNode
    state: State
    """Of the run in which it was flown."""
    batch: Batch
    is_late: bool = False
    """It is skipped and counted, unless it is being rendered already."""
    future: futures.Future[list[Packet] | None] = field(default_factory=futures.Future)
    """Its packets; None: it was skipped."""

    def render(self) -> list[Packet] | None:
        if not self.is_late:
            return render_batch(self.vehicle.model, self.state, self.batch)
        self.skip()
        return None

    def skip(self) -> None:
        """Render nothing of it: the sequence of each camera shows the gap."""
        skip_batch(self.vehicle.model, self.state, self.batch)


class _InlineExecutor(futures.Executor):
    """Runs what is submitted at once, in the thread that submits it."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **more: Any) -> futures.Future[Any]:
        future: futures.Future[Any] = futures.Future()
        try:
            future.set_result(function(*arguments, **more))
        except Exception as error:  # raised again by whoever takes the result
            future.set_exception(error)
        return future


class CameraThread:
    """Renders batches in order, and keeps their packets until `take`. For the simulation thread.

    On a CUDA device that thread renders inline, since only one thread can record CUDA graphs.

    Attributes:
        dropped: Frames that were not rendered since the last `reset`, by vehicle and sensor: pictures, or
            instants of an event camera.
    """

    def __init__(self, *, inline: bool, on_packets: Callable[[], object]) -> None:
        """Make the thread, which starts with the first batch.

        `on_packets`: called from the thread when there is something to `take`.
        """
        self.dropped: Counter[tuple[str, str]] = Counter()
        self._inline = inline
        self._on_packets = on_packets
        self._jobs: deque[_Job] = deque()
        """What has not been taken, in order: what is done, what is being rendered, what waits."""
        self._executor = _InlineExecutor() if inline else futures.ThreadPoolExecutor(1, "cameras")

    def render(self, vehicle: VehicleNode, batches: Sequence[Batch], *, is_late: bool) -> None:
        """Queue batches of a vehicle; a batch without frames is done at once if nothing waits before it.

        `is_late`: drop them where rendering is inline, so that no batch waits.
        """
        for batch in batches:
            job = _Job(vehicle=vehicle, state=vehicle.state, batch=batch, is_late=self._inline and is_late)
            if not self._unfinished() and not frame_counts(job.state, batch):
                job.skip()
                continue
            job.future = self._executor.submit(job.render)
            self._jobs.append(job)
            job.future.add_done_callback(lambda _: self._on_packets())
        self._check()

    def drop_until(self, vehicle: VehicleNode, stamp_ns: int) -> None:
        """Drop the batches of a vehicle that wait and end at a simulated time [ns] or before."""
        for job in self._unfinished():
            job.is_late |= job.vehicle is vehicle and job.batch.until_ns <= stamp_ns

    def wait_for(self, condition: Callable[[], bool], stop: Callable[[], bool]) -> bool:
        """Wait until a condition holds, which changes with each batch; return whether it does.

        `stop`: ends the wait; called every 20 ms.
        """
        while not (holds := condition()) and not stop():
            futures.wait([job.future for job in self._unfinished()[:1]], 0.02)
            self._check()
        return holds

    def take(self) -> list[tuple[VehicleNode, list[Packet]]]:
        """Return what was rendered since the last call: vehicle and packets, in order."""
        self._check()
        taken = []
        while self.has_packets:
            job = self._jobs.popleft()
            packets = job.future.result()
            if packets is None:
                self._count(job)
            elif packets:
                taken.append((job.vehicle, packets))
        return taken

    @property
    def has_packets(self) -> bool:
        """Whether there is something to `take`."""
        return bool(self._jobs) and self._jobs[0].future.done()

    def finish(self, stop: Callable[[], bool]) -> None:
        """Wait until everything is rendered, or `stop` ends the wait."""
        self.wait_for(lambda: not self._unfinished(), stop)

    def drop_rest(self) -> bool:
        """Finish the batch in work, drop and count those that wait.

        Returns whether the batch in work ended in time; if not, the thread still uses the engine.
        """
        ended = self._cancel()
        for job in [job for job in self._jobs if job.future.cancelled() or not job.future.done()]:
            self._jobs.remove(job)
            self._count(job)
            if ended:
                job.skip()
        return ended

    def reset(self) -> None:
        """Discard everything, and count from 0."""
        self._cancel()
        self._jobs.clear()
        self.dropped.clear()

    def close(self) -> None:
        """Discard what waits and end the thread."""
        self._cancel()
        self._executor.shutdown(wait=False)

    def _cancel(self) -> bool:
        """Cancel what waits; return whether the batch in work ended in time."""
        for job in reversed(self._jobs):  # so that none of them begins when the one in work ends
            job.future.cancel()
        rest = [job.future for job in self._jobs if not job.future.cancelled()]
        return not futures.wait(rest, GIVE_UP_S).not_done

    def _unfinished(self) -> list[_Job]:
        return [job for job in self._jobs if not job.future.done()]

    def _check(self) -> None:
        """Raise what went wrong in the thread."""
        for job in self._jobs:
            if job.future.done() and (error := job.future.exception()) is not None:
                raise RuntimeError(f"the cameras failed: {error}") from error

    def _count(self, job: _Job) -> None:
        for name, count in frame_counts(job.state, job.batch).items():
            self.dropped[job.vehicle.name, name] += count


def frame_counts(state: State, batch: Batch) -> Counter[str]:
    """Return the frames that a batch has to render, by camera: instants of an event camera, or pictures."""
    counts: Counter[str] = Counter()
    for index, group in enumerate(state.groups):
        stamps_ns = [batch.stamps_ns[place] for place in batch.stretch.group_places.get(index, ())]
        for name in batch.enabled_cameras.intersection(group.frames):
            counts[name] += len(stamps_ns)
        for name in batch.enabled_cameras.intersection(group.images):
            counts[name] += sum(map(group.images[name].rate.has_tick, stamps_ns))
    return +counts
