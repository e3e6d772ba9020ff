"""What happens when: the boundaries of a run, in integer nanoseconds, as a pure function of its rates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True, kw_only=True)
class Boundary:
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

    def ticks(rate: Rate) -> set[int]:
        return set(rate.stamps(start_ns + 1, end_ns + 1))

    control = ticks(schedule.control)
    samplers = [ticks(rate) for rate in schedule.samplers]
    casts = [ticks(rate) for rate in schedule.casts]
    return [
        Boundary(
            stamp_ns=stamp_ns,
            control=stamp_ns in control,
            samplers=_indices(samplers, stamp_ns),
            casts=_indices(casts, stamp_ns),
        )
        for stamp_ns in sorted(control.union({end_ns}, *samplers, *casts))
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


def _indices(ticks: Sequence[set[int]], stamp_ns: int) -> tuple[int, ...]:
    return tuple(index for index, stamps in enumerate(ticks) if stamp_ns in stamps)
