"""What happens in a control period, relative to its begin: the same for all worlds, known to the host."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

from neurosim_core.clock import Rate
from neurosim_core.schedule import Boundary, Schedule, boundaries

PATTERN_COUNT_MAX = 4096
"""Most patterns that are remembered; where clocks hardly ever tick together, no two steps are alike."""
_KIND_COUNT_MAX = 64
_COMMON_MAX_NS = 10**13


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A place in a period where the integration stops because something happens."""

    span_ns: int
    """From the mark before, or the begin of the period [ns]."""
    samplers: tuple[int, ...]
    """Indices of the samplers that read the state."""
    casts: tuple[int, ...]
    """Indices of the casts that see this instant."""


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """A control period. Periods that are alike are equal, and flown by the same launches."""

    marks: tuple[Mark, ...]
    offsets_ns: tuple[tuple[int, ...], ...]
    """For each cast, from the begin of the period to the last instant before it (<= 0) and to its own."""
    pictures: tuple[tuple[str, ...], ...]
    """For each cast, the image cameras that take a picture, at the end of the period."""

    @property
    def duration_ns(self) -> int:
        """Length of the period [ns]."""
        return sum(mark.span_ns for mark in self.marks)


class Timetable:
    """Finds the pattern of each period.

    Args:
        schedule: Every clock of the rig.
        images: For each cast, the clocks of its image cameras by name.
    """

    def __init__(self, schedule: Schedule, images: tuple[dict[str, Rate], ...]) -> None:
        self._schedule = schedule
        self._images = images
        self._patterns: dict[int, Pattern] = {}
        rates = [schedule.control, *schedule.samplers, *schedule.casts]
        rates += [rate for cameras in images for rate in cameras.values()]
        self.common_ns = _common_period_ns(rates)
        """After this time all clocks tick together [ns]; 0: that takes hours."""

    def at(self, begin_ns: int) -> Pattern:
        """Return the period that begins at a tick of the control clock."""
        key = begin_ns % self.common_ns if self.common_ns else begin_ns
        if key not in self._patterns:
            if len(self._patterns) >= PATTERN_COUNT_MAX:
                self._patterns.clear()
            self._patterns[key] = self._make(begin_ns)
        return self._patterns[key]

    def first(self) -> Pattern:
        """Return what happens at stamp 0: everything."""
        casts = tuple(range(len(self._schedule.casts)))
        samplers = tuple(range(len(self._schedule.samplers)))
        return Pattern(
            marks=(Mark(span_ns=0, samplers=samplers, casts=casts),),
            offsets_ns=tuple((0, 0) for _ in casts),
            pictures=tuple(tuple(cameras) for cameras in self._images),
        )

    def instant_count_max(self) -> int:
        """Return the most instants of any cast in a period; a bound where periods are of many kinds."""
        period_s = 1.0 / self._schedule.control.rate_hz
        if 0 < self.common_ns <= _KIND_COUNT_MAX * 1e9 * period_s:
            counts = [len(offsets_ns) - 1 for kind in self._kinds() for offsets_ns in kind.offsets_ns]
            return max([1, *counts])
        return max((int(period_s * rate.rate_hz) + 2 for rate in self._schedule.casts), default=1)

    def _kinds(self) -> Iterator[Pattern]:
        """Yield the patterns of all periods until all clocks tick together."""
        now_ns = 0
        while now_ns < self.common_ns:
            pattern = self.at(now_ns)
            yield pattern
            now_ns += pattern.duration_ns

    def sample_count_max(self) -> int:
        """Return a bound on the samples of any sampler in a period."""
        period_s = 1.0 / self._schedule.control.rate_hz
        return max((int(period_s * rate.rate_hz) + 2 for rate in self._schedule.samplers), default=1)

    def _make(self, begin_ns: int) -> Pattern:
        control = self._schedule.control
        end_ns = control.stamp_ns(control.first_tick(begin_ns + 1))
        stops = boundaries(self._schedule, begin_ns, end_ns)
        stamps = [begin_ns, *(stop.stamp_ns for stop in stops)]
        marks = tuple(
            Mark(span_ns=after - before, samplers=stop.samplers, casts=stop.casts)
            for (before, after), stop in zip(itertools.pairwise(stamps), stops, strict=True)
        )
        casts = [self._cast(index, begin_ns, stops) for index in range(len(self._schedule.casts))]
        return Pattern(
            marks=marks,
            offsets_ns=tuple(offsets_ns for offsets_ns, _ in casts),
            pictures=tuple(pictures for _, pictures in casts),
        )

    def _cast(
        self, index: int, begin_ns: int, stops: list[Boundary]
    ) -> tuple[tuple[int, ...], tuple[str, ...]]:
        rate = self._schedule.casts[index]
        last_ns = rate.stamp_ns(rate.first_tick(begin_ns + 1) - 1)
        seen = [stop.stamp_ns for stop in stops if index in stop.casts]
        end_ns = stops[-1].stamp_ns
        return (
            tuple(stamp_ns - begin_ns for stamp_ns in (last_ns, *seen)),
            tuple(name for name, clock in self._images[index].items() if clock.has_tick(end_ns)),
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
