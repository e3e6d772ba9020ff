"""What the cameras of a streaming run see, computed in a thread of its own while the vehicle flies on."""

from __future__ import annotations

import threading
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import warp as wp

from neurosim_core.packets import Packet
from neurosim_core.schedule import batch_end_ns
from neurosim_core.sensors.cast import is_due
from neurosim_core.simulation import Batch, Model, State, free_lanes, see, see_each, skip

_LAG_PERIODS = (2, 100)
"""Bounds of how far cameras may be behind, in control periods."""
_SPARE_PERIODS = 32
"""Further periods that are flown while one picture takes too long, where frames are left out."""
GIVE_UP_S = 0.5
"""How long the batch in work may take when nobody waits for more [s]."""


@dataclass(kw_only=True, eq=False)
class Job:
    """A stretch of one vehicle's flight that its cameras have to look at."""

    vehicle: str
    model: Model
    state: State
    batch: Batch
    left_out: bool = False
    """The machine is too slow for it."""
    done: set[int] = field(default_factory=set)
    """Casts whose packets can be taken."""
    forgotten: bool = False
    """Nobody wants what it shows any more."""


class Cameras:
    """Looks at what was flown, in order, and collects the packets until somebody takes them.

    On a CUDA device the thread that flies does it, and waits for the device: it flies on when the packets are
    there.

    Attributes:
        dropped: Frames that were left out, by vehicle and sensor, since the last `reset`. Pictures count one
            each, an event camera counts instants that it did not see.
    """

    def __init__(self, *, inline: bool, on_packets: Callable[[], object]) -> None:
        """Start the thread, if one is needed.

        Args:
            inline: Do without a thread.
            on_packets: Called, from the thread, when there is something to `take`.
        """
        self.dropped: dict[tuple[str, str], int] = defaultdict(int)
        self._on_packets = on_packets
        self._jobs: deque[Job] = deque()
        self._seen: deque[tuple[str, list[Packet]]] = deque()
        self._work: Job | None = None
        """What the thread looks at."""
        self._closed = False
        self._failure: Exception | None = None
        self._changed = threading.Condition()
        self._thread = None
        if not inline:
            self._thread = threading.Thread(target=self._run, name="cameras", daemon=True)
            self._thread.start()

    def look(
        self, vehicle: str, model: Model, state: State, batches: Sequence[Batch], *, late: bool = False
    ) -> None:
        """Have batches looked at, after those before; where there is nothing to see, without the thread.

        Args:
            vehicle: Name.
            model: What does not change.
            state: What does.
            batches: What was flown.
            late: They come too late, and are left out where there is no thread that could catch up.

        Raises:
            RuntimeError: The rendering failed.
        """
        for batch in batches:
            job = Job(vehicle=vehicle, model=model, state=state, batch=batch)
            with self._changed:
                idle = not self._jobs and self._work is None
                shows = _shows_anything(job)
                here = self._thread is None or (idle and not shows)
                if here:
                    job.left_out = late and shows
                else:
                    self._jobs.append(job)
                    self._changed.notify_all()
            if here:
                self._try(job)
                self.check()

    def leave_out(self, vehicle: str, until_ns: int) -> None:
        """Do not render what waits of a vehicle and ended at a simulated time [ns] or before."""
        with self._changed:
            for job in self._jobs:
                if job.vehicle == vehicle and job.batch.until_ns <= until_ns:
                    job.left_out = True

    def wait_for_room(self, state: State, count: int, stop: Callable[[], bool]) -> bool:
        """Wait until so many batches of a vehicle can be flown.

        Args:
            state: Of the vehicle.
            count: How many.
            stop: Ends the wait; asked every 20 ms.

        Returns:
            Whether there is room: not if `stop` ended the wait.

        Raises:
            RuntimeError: The rendering failed.
        """
        with self._changed:
            while (has_room := free_lanes(state) >= count) is False and self._failure is None and not stop():
                self._changed.wait(0.02)
        self.check()
        return has_room

    def take(self) -> list[tuple[str, list[Packet]]]:
        """Return what has been seen since the last time: vehicle and packets, in order."""
        taken = []
        while self._seen:
            taken.append(self._seen.popleft())
        return taken

    @property
    def has_packets(self) -> bool:
        """Whether there is something to `take`."""
        return bool(self._seen)

    def finish(self, stop: Callable[[], bool]) -> None:
        """Wait until everything has been looked at, or `stop` says so."""
        with self._changed:
            while (self._jobs or self._work is not None) and self._failure is None and not stop():
                self._changed.wait(0.02)
        self.check()

    def give_up(self, timeout_s: float = GIVE_UP_S) -> bool:
        """Let the batch in work end, and leave out and count what waits. What was seen can be taken.

        Args:
            timeout_s: How long the batch in work may take; then it is left out, too.

        Returns:
            Whether it has ended: else the states are in use by the thread.
        """
        with self._changed:
            left_out = list(self._jobs)
            self._jobs.clear()
            ended = self._wait_for_work(timeout_s)
            if self._work is not None:
                self._work.forgotten = True
                left_out.insert(0, self._work)
            for job in left_out:
                self._count(job)
                if ended:
                    skip(job.model, job.state, job.batch)
        return ended

    def reset(self) -> None:
        """Forget what waits and what was seen, and count from 0."""
        with self._changed:
            self._jobs.clear()
            if self._work is not None:
                self._work.forgotten = True
            self._wait_for_work(GIVE_UP_S)
            self._seen.clear()
            self.dropped.clear()

    def check(self) -> None:
        """Raise what went wrong in the thread.

        Raises:
            RuntimeError: The rendering failed.
        """
        if self._failure is not None:
            raise RuntimeError(f"the cameras failed: {self._failure}") from self._failure

    def close(self) -> None:
        """Forget what waits and end the thread."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(GIVE_UP_S)

    def _wait_for_work(self, timeout_s: float) -> bool:
        """Wait until the thread does nothing, with the lock held; return whether that is so."""
        return self._changed.wait_for(lambda: self._work is None, timeout_s)

    def _run(self) -> None:
        while (job := self._next()) is not None:
            self._try(job)

    def _next(self) -> Job | None:
        """Wait for the next job; None if there is to be none."""
        with self._changed:
            self._work = None
            self._changed.notify_all()
            while not self._jobs and not self._closed:
                self._changed.wait()
            if self._closed or self._failure is not None:
                return None
            self._work = self._jobs.popleft()
            return self._work

    def _try(self, job: Job) -> None:
        try:
            self._do(job)
        except Exception as error:  # told to the thread that flies
            self._failure = error

    def _do(self, job: Job) -> None:
        if job.left_out:
            skip(job.model, job.state, job.batch)
            with self._changed:
                if not job.forgotten:
                    self._count(job)
            return
        if self._thread is None:
            self._give(job, see(job.model, job.state, job.batch))
            return
        for cast, packets in see_each(job.model, job.state, job.batch):
            self._give(job, packets, cast)

    def _give(self, job: Job, packets: list[Packet], cast: int | None = None) -> None:
        """Let packets of a cast be taken, or of all."""
        with self._changed:
            if job.forgotten:
                return
            if cast is not None:
                job.done.add(cast)
            if not packets:
                return
            self._seen.append((job.vehicle, packets))
        self._on_packets()

    def _count(self, job: Job) -> None:
        """Count what a batch that is left out would have shown."""
        for index, cast in enumerate(job.model.casts):
            if index in job.done:
                continue
            stamps = [b.stamp_ns for b in job.batch.boundaries if index in b.casts]
            for name in job.batch.wanted.intersection(cast.event_cameras):
                self.dropped[job.vehicle, name] += len(stamps)
        for index, cast_state in enumerate(job.state.casts):
            if index in job.done:
                continue
            for name in job.batch.wanted.intersection(cast_state.images):
                rate = cast_state.images[name].rate
                due = sum(rate.has_tick(boundary.stamp_ns) for boundary in job.batch.boundaries)
                self.dropped[job.vehicle, name] += due


def _shows_anything(job: Job) -> bool:
    """Return whether a camera has to look at a batch."""
    return any(
        index in boundary.casts and is_due(cast, boundary.stamp_ns, job.batch.wanted)
        for index, cast in enumerate(job.state.casts)
        for boundary in job.batch.boundaries
    )


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """How far the cameras of a vehicle may be behind its flight."""

    batch_count: int
    """The most batches in a control period."""
    lag_ns: int
    """How long a picture may take: as long as there is between two of the slowest camera [ns]."""
    lag_count: int
    """Batches in that time."""
    count: int
    """The most batches that may wait."""

    def needed(self, *, drop: bool) -> int:
        """Return how many must be free before a control period is flown.

        Args:
            drop: What is too late is left out; otherwise it is waited for.
        """
        return self.batch_count if drop else self.count - self.lag_count + self.batch_count


def plan_lanes(model: Model) -> Lanes:
    """Return how far the cameras of a vehicle may be behind."""
    period_ns = model.schedule.control.stamp_ns(1)
    batch_ns = batch_end_ns(model.schedule, 0, period_ns)
    batch_count = -(-period_ns // max(batch_ns, 1)) + 1  # where rates do not divide, and for stamp 0
    least, most = _LAG_PERIODS
    slowest_ns = max((cast.rate.stamp_ns(1) for cast in model.casts), default=0)
    periods = min(max(-(-slowest_ns // period_ns), least), most)
    return Lanes(
        batch_count=batch_count,
        lag_ns=periods * period_ns,
        lag_count=batch_count * periods,
        count=batch_count * (periods + _SPARE_PERIODS),
    )


def sees_inline(device: str) -> bool:
    """Return whether the thread that flies looks itself: where a picture takes it little time."""
    return bool(wp.get_device(device).is_cuda)
