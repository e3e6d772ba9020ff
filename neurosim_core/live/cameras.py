"""The thread that renders what a streaming run has flown, while the vehicles fly on."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from neurosim_core.live.vehicle import VehicleNode
from neurosim_core.packets import Packet
from neurosim_core.sim import Batch, State, render_batch, skip_batch

GIVE_UP_S = 0.5
"""How long the batch in work may take at the end of a run [s]."""


@dataclass(kw_only=True, eq=False)
class _Job:
    """A batch of one vehicle that waits to be rendered."""

    vehicle: VehicleNode
    state: State
    """Of the run in which it was flown."""
    batch: Batch
    dropped: bool = False
    """It is too late: it is skipped and counted."""
    discarded: bool = False
    """The run is over: nobody takes its packets."""

    def skip(self) -> None:
        """Render nothing of it: the sequence of each camera shows the gap."""
        skip_batch(self.vehicle.model, self.state, self.batch)


class CameraThread:
    """Renders batches in order, and collects their packets until `take`.

    On a CUDA device the thread that flies renders inline, since only one thread can record CUDA graphs.

    Attributes:
        dropped: Frames that were not rendered since the last `reset`, by vehicle and sensor: pictures, or
            instants of an event camera.
    """

    def __init__(self, *, inline: bool, on_packets: Callable[[], object]) -> None:
        """Start the thread.

        `on_packets`: called from the thread when there is something to `take`.
        """
        self.dropped: Counter[tuple[str, str]] = Counter()
        self._inline = inline
        self._on_packets = on_packets
        self._jobs: deque[_Job] = deque()
        self._done: deque[tuple[VehicleNode, list[Packet]]] = deque()
        self._work: _Job | None = None
        self._closed = False
        self._failure: Exception | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="cameras", daemon=True)
        if not inline:
            self._thread.start()

    def render(self, vehicle: VehicleNode, batches: Sequence[Batch], *, is_late: bool) -> None:
        """Queue batches of a vehicle; a batch without frames is done at once if nothing waits before it.

        `is_late`: drop them where rendering is inline, so that no batch waits.
        """
        for batch in batches:
            job = _Job(vehicle=vehicle, state=vehicle.state, batch=batch)
            with self._changed:
                if not (self._jobs or self._work or frame_counts(job.state, batch)):
                    job.skip()
                    continue
                self._jobs.append(job)
                self._changed.notify_all()
            if self._inline:
                self._jobs.popleft()
                job.dropped = is_late
                self._do(job)
        self.check()

    def drop_until(self, vehicle: VehicleNode, stamp_ns: int) -> None:
        """Drop the batches of a vehicle that wait and end at a simulated time [ns] or before."""
        with self._changed:
            for job in self._jobs:
                job.dropped |= job.vehicle is vehicle and job.batch.until_ns <= stamp_ns

    def wait_for(self, condition: Callable[[], bool], stop: Callable[[], bool]) -> bool:
        """Wait until a condition holds, which changes with each batch; return whether it does.

        `stop`: ends the wait; called every 20 ms.
        """
        with self._changed:
            while (holds := condition()) is False and self._failure is None and not stop():
                self._changed.wait(0.02)
        self.check()
        return holds

    def take(self) -> list[tuple[VehicleNode, list[Packet]]]:
        """Return what was rendered since the last call: vehicle and packets, in order."""
        taken = []
        while self._done:
            taken.append(self._done.popleft())
        return taken

    @property
    def has_packets(self) -> bool:
        """Whether there is something to `take`."""
        return bool(self._done)

    def finish(self, stop: Callable[[], bool]) -> None:
        """Wait until everything is rendered, or `stop` ends the wait."""
        self.wait_for(lambda: not self._jobs and self._work is None, stop)

    def drop_rest(self) -> bool:
        """Finish the batch in work, drop and count those that wait.

        Returns whether the batch in work ended in time; if not, the thread still uses the engine.
        """
        with self._changed:
            dropped = list(self._jobs)
            self._jobs.clear()
            ended = self._changed.wait_for(lambda: self._work is None, GIVE_UP_S)
            if self._work is not None:
                self._work.discarded = True
                dropped.insert(0, self._work)
            for job in dropped:
                self._count(job)
                if ended:
                    job.skip()
        return ended

    def reset(self) -> None:
        """Discard everything, and count from 0."""
        with self._changed:
            self._jobs.clear()
            if self._work is not None:
                self._work.discarded = True
            self._changed.wait_for(lambda: self._work is None, GIVE_UP_S)
            self._done.clear()
            self.dropped.clear()

    def check(self) -> None:
        """Raise what went wrong in the thread."""
        if self._failure is not None:
            raise RuntimeError(f"the cameras failed: {self._failure}") from self._failure

    def close(self) -> None:
        """Discard what waits and end the thread."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._changed.notify_all()
        if not self._inline:
            self._thread.join(GIVE_UP_S)

    def _run(self) -> None:
        while self._failure is None and (job := self._next()) is not None:
            self._do(job)

    def _do(self, job: _Job) -> None:
        """Render or skip a batch."""
        packets: list[Packet] = []
        try:
            if job.dropped:
                job.skip()
            else:
                packets = render_batch(job.vehicle.model, job.state, job.batch)
        except Exception as error:  # raised again in the thread that flies
            self._failure = error
        with self._changed:
            if job.discarded:
                return
            if job.dropped:
                self._count(job)
            if packets:
                self._done.append((job.vehicle, packets))
        self._on_packets()

    def _next(self) -> _Job | None:
        """Wait for the next job; None to end."""
        with self._changed:
            self._work = None
            self._changed.notify_all()
            while not self._jobs and not self._closed:
                self._changed.wait()
            if self._closed:
                return None
            self._work = self._jobs.popleft()
            return self._work

    def _count(self, job: _Job) -> None:
        for name, count in frame_counts(job.state, job.batch).items():
            self.dropped[job.vehicle.name, name] += count


def frame_counts(state: State, batch: Batch) -> Counter[str]:
    """Return the frames that a batch has to render, by camera: instants of an event camera, or pictures."""
    counts: Counter[str] = Counter()
    for index, group in enumerate(state.groups):
        stamps_ns = [boundary.stamp_ns for boundary in batch.boundaries if index in boundary.groups]
        for name in batch.wanted.intersection(group.frames):
            counts[name] += len(stamps_ns)
        for name in batch.wanted.intersection(group.images):
            counts[name] += sum(map(group.images[name].rate.has_tick, stamps_ns))
    return +counts
