"""What happens when: the boundaries of a run, in integer nanoseconds, as a pure function of its rates."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

from neurosim_core.clock import Rate

TICKS_PER_INSTANT = 4
"""How many times as many ticks a batch takes of a cast that renders only some of them."""


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Every clock of a run."""

    control: Rate
    samplers: tuple[Rate, ...]
    """Clocks of the sensors that read the state of the vehicle (IMU, odometry)."""
    casts: tuple[Rate, ...]
    """Clocks of the casts."""
    instants_per_launch: int
    """The most instants of one cast in one batch; of a sparse cast, times TICKS_PER_INSTANT."""
    sparse: frozenset[int] = frozenset()
    """Indices of the casts that render only some of their ticks."""

    def ticks_per_batch(self, cast: int) -> int:
        """Return the most ticks of a cast in one batch."""
        return self.instants_per_launch * (TICKS_PER_INSTANT if cast in self.sparse else 1)


class Boundary(NamedTuple):
    """An instant at which the integration stops because something happens."""

    stamp_ns: int
    control: bool
    """A new command is due."""
    samplers: tuple[int, ...]
    """Indices of the samplers that read the state."""
    casts: tuple[int, ...]
    """Indices of the casts that see this instant."""


def batch_end_ns(schedule: Schedule, start_ns: int, limit_ns: int) -> int:
    """Return where the batch that follows `start_ns` ends: at most at `limit_ns`.

    It ends where the first of the casts has as many ticks as one launch takes; a rig without cameras counts
    commands instead.
    """
    rates = schedule.casts or (schedule.control,)
    ends = (_tick_after(rate, start_ns, schedule.ticks_per_batch(cast)) for cast, rate in enumerate(rates))
    return min([limit_ns, *ends])


def boundaries(schedule: Schedule, start_ns: int, end_ns: int) -> list[Boundary]:
    """Return the boundaries in (start_ns, end_ns] in order of time; the last is always at `end_ns`."""
    marks = {end_ns: 0}
    for place, rate in enumerate((schedule.control, *schedule.samplers, *schedule.casts)):
        mark = 1 << place
        for stamp_ns in rate.stamps(start_ns + 1, end_ns + 1):
            marks[stamp_ns] = marks.get(stamp_ns, 0) | mark
    sampler_count, cast_count = len(schedule.samplers), len(schedule.casts)
    return [
        Boundary(stamp_ns, *_due(marks[stamp_ns], sampler_count, cast_count)) for stamp_ns in sorted(marks)
    ]


def boundary_count_max(schedule: Schedule) -> int:
    """Return a bound on the number of boundaries in any batch."""
    rates = [schedule.control, *schedule.samplers, *schedule.casts]
    shortest = schedule.casts or (schedule.control,)
    span_s = min(schedule.ticks_per_batch(cast) / rate.rate_hz for cast, rate in enumerate(shortest))
    return sum(int(span_s * rate.rate_hz) + 2 for rate in rates) + 1


def _tick_after(rate: Rate, stamp_ns: int, count: int) -> int:
    """Return the stamp of the count-th tick after a stamp."""
    return rate.stamp_ns(rate.first_tick(stamp_ns + 1) + count - 1)


@functools.cache
def _due(mark: int, sampler_count: int, cast_count: int) -> tuple[bool, tuple[int, ...], tuple[int, ...]]:
    """Return whether a command is due, and the samplers and casts that are: from the lowest bit on."""
    samplers = tuple(index for index in range(sampler_count) if mark >> (1 + index) & 1)
    casts = tuple(index for index in range(cast_count) if mark >> (1 + sampler_count + index) & 1)
    return bool(mark & 1), samplers, casts
