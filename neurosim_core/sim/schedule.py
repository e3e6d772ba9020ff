"""The schedule: the boundaries of a run, in integer nanoseconds, as a pure function of its rates."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

from neurosim_core.clock import Rate

TICKS_PER_INSTANT = 4
"""How many times as many ticks a batch takes of a group that renders only some of them."""
PERIOD_COUNT_MAX = 4096
"""Most periods that are remembered; where clocks hardly ever tick together, no two are alike."""
_COMMON_MAX_NS = 10**13


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Every clock of a run."""

    control: Rate
    samplers: tuple[Rate, ...]
    """Clocks of the sensors that read the state of the vehicle (IMU, odometry)."""
    groups: tuple[Rate, ...]
    """Clocks of the groups."""
    instants_per_launch: int
    """The most instants of one group in one batch; of a sparse group, times TICKS_PER_INSTANT."""
    sparse: frozenset[int] = frozenset()
    """Indices of the groups that render only some of their ticks."""
    poses: tuple[Rate, ...] = ()
    """Clocks at which nothing is due but the pose is recorded, for rays with times of their own."""

    @property
    def clocks(self) -> tuple[Rate, ...]:
        """All of them."""
        return (self.control, *self.samplers, *self.groups, *self.poses)

    def ticks_per_batch(self, group: int) -> int:
        """Return the most ticks of a group in one batch."""
        return self.instants_per_launch * (TICKS_PER_INSTANT if group in self.sparse else 1)


class Boundary(NamedTuple):
    """An instant at which the integration stops because something happens."""

    stamp_ns: int
    control: bool
    """A new command is due."""
    samplers: tuple[int, ...]
    """Indices of the samplers that read the state."""
    groups: tuple[int, ...]
    """Indices of the groups that see this instant."""


def batch_end_ns(schedule: Schedule, start_ns: int, limit_ns: int) -> int:
    """Return where the batch that follows `start_ns` ends: at most at `limit_ns`.

    It ends where the first of the groups has as many ticks as one launch takes; a rig without cameras counts
    commands instead.
    """
    rates = schedule.groups or (schedule.control,)
    ends = (_tick_after(rate, start_ns, schedule.ticks_per_batch(group)) for group, rate in enumerate(rates))
    return min([limit_ns, *ends])


def boundaries(schedule: Schedule, start_ns: int, end_ns: int) -> list[Boundary]:
    """Return the boundaries in (start_ns, end_ns] in order of time; the last is always at `end_ns`."""
    marks = {end_ns: 0}
    for place, rate in enumerate(schedule.clocks):
        mark = 1 << place
        for stamp_ns in rate.stamps(start_ns + 1, end_ns + 1):
            marks[stamp_ns] = marks.get(stamp_ns, 0) | mark
    sampler_count, group_count = len(schedule.samplers), len(schedule.groups)
    return [
        Boundary(stamp_ns, *_due(marks[stamp_ns], sampler_count, group_count)) for stamp_ns in sorted(marks)
    ]


def boundary_count_max(schedule: Schedule, span_s: float | None = None) -> int:
    """Return a bound on the number of boundaries in any stretch of a length [s]; None: in any batch."""
    if span_s is None:
        shortest = schedule.groups or (schedule.control,)
        span_s = min(schedule.ticks_per_batch(group) / rate.rate_hz for group, rate in enumerate(shortest))
    return sum(int(span_s * rate.rate_hz) + 2 for rate in schedule.clocks) + 1


def _tick_after(rate: Rate, stamp_ns: int, count: int) -> int:
    """Return the stamp of the count-th tick after a stamp."""
    return rate.stamp_ns(rate.first_tick(stamp_ns + 1) + count - 1)


@functools.cache
def _due(mark: int, sampler_count: int, group_count: int) -> tuple[bool, tuple[int, ...], tuple[int, ...]]:
    """Return whether a command is due, and the samplers and groups that are: from the lowest bit on."""
    samplers = tuple(index for index in range(sampler_count) if mark >> (1 + index) & 1)
    groups = tuple(index for index in range(group_count) if mark >> (1 + sampler_count + index) & 1)
    return bool(mark & 1), samplers, groups


@dataclass(frozen=True, kw_only=True)
class Period:
    """A control period, relative to its begin. The same launches fly periods that are equal."""

    boundaries: tuple[Boundary, ...]
    """Stamps are relative to the begin of the period."""
    last_seen_ns: tuple[int, ...]
    """For each group, from the begin of the period to the last instant before it, <= 0 [ns]."""
    pictures: tuple[tuple[str, ...], ...]
    """For each group, the image sensors that take a picture, at the end of the period."""

    @property
    def duration_ns(self) -> int:
        """Length of the period [ns]."""
        return self.boundaries[-1].stamp_ns

    def offsets_ns(self, group: int) -> tuple[int, ...]:
        """Return when a group sees: the last instant before the period (<= 0), then its own [ns]."""
        return (self.last_seen_ns[group], *(b.stamp_ns for b in self.boundaries if group in b.groups))

    def sample_offsets_ns(self, sampler: int) -> tuple[int, ...]:
        """Return when a sampler reads the state [ns]."""
        return tuple(b.stamp_ns for b in self.boundaries if sampler in b.samplers)


class Timetable:
    """Finds the period that begins at a tick of the control clock.

    All clocks tick together after `common_ns`; 0: that takes hours.
    """

    def __init__(self, schedule: Schedule, images: tuple[dict[str, Rate], ...]) -> None:
        """Make it for a rig, and for each group the clocks of its image sensors by name."""
        self._schedule = schedule
        self._images = images
        self._periods: dict[int, Period] = {}
        rates = [rate for cameras in images for rate in cameras.values()]
        self.common_ns = _common_period_ns([*schedule.clocks, *rates])

    def at(self, begin_ns: int) -> Period:
        """Return the period that begins at a tick of the control clock."""
        key = begin_ns % self.common_ns if self.common_ns else begin_ns
        if key not in self._periods:
            if len(self._periods) >= PERIOD_COUNT_MAX:
                self._periods.clear()
            self._periods[key] = self._make(begin_ns)
        return self._periods[key]

    def first(self) -> Period:
        """Return what happens at stamp 0: everything."""
        return Period(
            boundaries=(everything(self._schedule),),
            last_seen_ns=tuple(0 for _ in self._schedule.groups),
            pictures=tuple(tuple(cameras) for cameras in self._images),
        )

    def instant_count_max(self) -> int:
        """Return the most instants of any group in a period, at least 1."""
        control = self._schedule.control
        return max((rate.ticks_within(control) for rate in self._schedule.groups), default=1) or 1

    def boundary_count_max(self) -> int:
        """Return a bound on the number of boundaries in a period."""
        return boundary_count_max(self._schedule, 1.0 / self._schedule.control.rate_hz)

    def _make(self, begin_ns: int) -> Period:
        control = self._schedule.control
        end_ns = control.stamp_ns(control.first_tick(begin_ns + 1))
        stops = boundaries(self._schedule, begin_ns, end_ns)
        return Period(
            boundaries=tuple(stop._replace(stamp_ns=stop.stamp_ns - begin_ns) for stop in stops),
            last_seen_ns=tuple(
                rate.stamp_ns(rate.first_tick(begin_ns + 1) - 1) - begin_ns for rate in self._schedule.groups
            ),
            pictures=tuple(
                tuple(name for name, clock in cameras.items() if clock.has_tick(end_ns))
                for cameras in self._images
            ),
        )


def everything(schedule: Schedule) -> Boundary:
    """Return the boundary at stamp 0, where all sensors sample."""
    return Boundary(
        stamp_ns=0,
        control=True,
        samplers=tuple(range(len(schedule.samplers))),
        groups=tuple(range(len(schedule.groups))),
    )


def _common_period_ns(rates: list[Rate]) -> int:
    """Return the least whole number of ns in which each clock makes a whole number of periods; 0: hours."""
    common = Fraction(0)
    for rate in rates:
        period = Fraction(10**9) / Fraction(str(rate.rate_hz))
        if common == 0:
            common = period
        common = Fraction(
            math.lcm(common.numerator * period.denominator, period.numerator * common.denominator),
            common.denominator * period.denominator,
        )
    return common.numerator if common.numerator <= _COMMON_MAX_NS else 0
