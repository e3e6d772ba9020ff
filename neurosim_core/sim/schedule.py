"""The schedule: the boundaries of a run, in integer nanoseconds, as a pure function of its rates."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import NamedTuple

from neurosim_core.clock import Rate

TICKS_PER_INSTANT = 4
"""A batch holds this many times as many ticks of an adaptive group, which renders only some of them."""
STRETCH_COUNT_MAX = 512
"""Largest number of cached stretches, equal to that of cached graphs. If clocks hardly ever tick together,
all stretches differ."""
_COMMON_MAX_NS = 10**13


class Boundary(NamedTuple):
    """An instant at which the integration stops because something happens."""

    stamp_ns: int
    control: bool
    """A new command is due."""
    samplers: tuple[int, ...]
    """Indices of the state sensors that sample here."""
    groups: tuple[int, ...]
    """Indices of the render groups that have a tick here."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """The boundaries of a part of a run, relative to its begin. Equal stretches need equal launches."""

    boundaries: tuple[Boundary, ...]
    """The boundaries, with stamps relative to the begin of the stretch."""
    pictures: frozenset[str]
    """Image sensors that take a picture at the end of the stretch."""

    @property
    def duration_ns(self) -> int:
        """Length of the stretch [ns]."""
        return self.boundaries[-1].stamp_ns

    @functools.cached_property
    def elapsed_ns(self) -> tuple[int, ...]:
        """Time from the previous boundary to each boundary [ns]."""
        return tuple(b - a for a, b in itertools.pairwise([0, *(b.stamp_ns for b in self.boundaries)]))

    @functools.cached_property
    def flight(self) -> Hashable:
        """Key of the launches of the motion: the spans, and what is due at their ends."""
        return tuple(
            (span, b.control, b.samplers) for span, b in zip(self.elapsed_ns, self.boundaries, strict=True)
        )

    @functools.cached_property
    def sampler_places(self) -> Mapping[int, Sequence[int]]:
        """Indices of the boundaries at which each state sensor samples, by the index of the sensor."""
        return _places([boundary.samplers for boundary in self.boundaries])

    @functools.cached_property
    def group_places(self) -> Mapping[int, Sequence[int]]:
        """Indices of the boundaries at which each render group has a tick, by the index of the group."""
        return _places([boundary.groups for boundary in self.boundaries])


def _places(due: Sequence[tuple[int, ...]]) -> dict[int, list[int]]:
    """Return the positions in `due` of each index."""
    places: dict[int, list[int]] = {}
    for place, indices in enumerate(due):
        for index in indices:
            places.setdefault(index, []).append(place)
    return places


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """All clocks of a run."""

    control: Rate
    samplers: tuple[Rate, ...]
    """Clocks of the sensors that read the state of the vehicle (IMU, odometry)."""
    groups: tuple[Rate, ...]
    """Clocks of the render groups."""
    instants_per_launch: int
    """Largest number of instants of one group in one batch; of a sparse group, times TICKS_PER_INSTANT."""
    images: Mapping[str, Rate] = field(default_factory=dict, hash=False)
    """Clocks of the image sensors, by name. Each tick is also a tick of the sensor's render group."""
    sparse: frozenset[int] = frozenset()
    """Indices of the adaptive groups, which render only some of their ticks."""
    poses: tuple[Rate, ...] = ()
    """Clocks at which only the pose is recorded, for rays with times of their own."""
    _stretches: dict[tuple[int, int], Stretch] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @functools.cached_property
    def clocks(self) -> tuple[Rate, ...]:
        """The clocks at whose ticks the integration stops."""
        return (self.control, *self.samplers, *self.groups, *self.poses)

    @functools.cached_property
    def common_ns(self) -> int:
        """Common period of all clocks [ns]; 0 if it is longer than hours."""
        return _common_period_ns([*self.clocks, *self.images.values()])

    def ticks_per_batch(self, group: int) -> int:
        """Return the largest number of ticks of a group in one batch."""
        return self.instants_per_launch * (TICKS_PER_INSTANT if group in self.sparse else 1)

    def batch_end_ns(self, start_ns: int, limit_ns: int) -> int:
        """Return the end of the batch that begins at `start_ns`, at most `limit_ns`.

        A batch ends when the first render group has as many ticks as one launch renders. A rig without
        cameras counts control ticks instead.
        """
        rates = self.groups or (self.control,)
        ends = (_tick_after(rate, start_ns, self.ticks_per_batch(group)) for group, rate in enumerate(rates))
        return min([limit_ns, *ends])

    def period_end_ns(self, start_ns: int) -> int:
        """Return the next tick of the control clock after a stamp [ns]."""
        return _tick_after(self.control, start_ns, 1)

    def first(self) -> Stretch:
        """Return the stretch of stamp 0, where every clock ticks."""
        everything = Boundary(
            stamp_ns=0,
            control=True,
            samplers=tuple(range(len(self.samplers))),
            groups=tuple(range(len(self.groups))),
        )
        return Stretch(boundaries=(everything,), pictures=frozenset(self.images))

    def stretch(self, start_ns: int, end_ns: int) -> Stretch:
        """Return the stretch (start_ns, end_ns]: boundaries in the order of time, the last at `end_ns`."""
        key = (start_ns % self.common_ns if self.common_ns else start_ns, end_ns - start_ns)
        stretch = self._stretches.get(key)
        if stretch is None:
            if len(self._stretches) >= STRETCH_COUNT_MAX:
                self._stretches.clear()
            stretch = self._stretches[key] = self._make_stretch(start_ns, end_ns)
        return stretch

    def _make_stretch(self, start_ns: int, end_ns: int) -> Stretch:
        marks = {end_ns: 0}
        for place, rate in enumerate(self.clocks):
            mark = 1 << place
            for stamp_ns in rate.stamps(start_ns + 1, end_ns + 1):
                marks[stamp_ns] = marks.get(stamp_ns, 0) | mark
        sampler_count, group_count = len(self.samplers), len(self.groups)
        return Stretch(
            boundaries=tuple(
                Boundary(stamp_ns - start_ns, *_due(marks[stamp_ns], sampler_count, group_count))
                for stamp_ns in sorted(marks)
            ),
            pictures=frozenset(name for name, rate in self.images.items() if rate.has_tick(end_ns)),
        )

    def boundary_count_max(self, span_s: float | None = None) -> int:
        """Return an upper bound of the boundaries in a stretch of a length [s]; None: in a batch."""
        if span_s is None:
            shortest = self.groups or (self.control,)
            span_s = min(self.ticks_per_batch(group) / rate.rate_hz for group, rate in enumerate(shortest))
        return sum(int(span_s * rate.rate_hz) + 2 for rate in self.clocks) + 1

    def instants_per_period(self) -> int:
        """Return the largest number of instants of a group in a control period, at least 1."""
        return max((rate.ticks_within(self.control) for rate in self.groups), default=1) or 1


def _tick_after(rate: Rate, stamp_ns: int, count: int) -> int:
    """Return the stamp of the count-th tick after a stamp."""
    return rate.stamp_ns(rate.first_tick(stamp_ns + 1) + count - 1)


@functools.cache
def _due(mark: int, sampler_count: int, group_count: int) -> tuple[bool, tuple[int, ...], tuple[int, ...]]:
    """Return whether a command is due, and which state sensors and groups are, from the bits of `mark`."""
    samplers = tuple(index for index in range(sampler_count) if mark >> (1 + index) & 1)
    groups = tuple(index for index in range(group_count) if mark >> (1 + sampler_count + index) & 1)
    return bool(mark & 1), samplers, groups


def _common_period_ns(rates: list[Rate]) -> int:
    """Return the shortest whole number of ns that is a whole number of periods of each clock; 0: hours."""
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
