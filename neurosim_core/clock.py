"""Integer time: every stamp is a whole number of nanoseconds since the start of the episode."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

NS_PER_S = 1_000_000_000
NS_PER_US = 1_000


def to_ns(time_s: float) -> int:
    """Return a time in seconds as the nearest nanosecond.

    Raises:
        ValueError: If `time_s` is not finite.
    """
    if not math.isfinite(time_s):
        raise ValueError(f"time_s must be finite, got {time_s}")
    return round(Fraction(time_s) * NS_PER_S)


@dataclass(frozen=True)
class Rate:
    """A clock that ticks `rate_hz` times a second, for ever, without drift.

    Tick k is at floor(k * 1e9 / rate_hz) ns, computed in exact rational arithmetic from the decimal form of
    `rate_hz`. Where the rate does not divide a second (30 Hz, 333 Hz, 29.97 Hz), intervals between ticks
    differ by 1 ns, and no error accumulates.

    Attributes:
        rate_hz: Ticks per second [Hz], > 0 and at most 1e9.
    """

    rate_hz: float

    def __post_init__(self) -> None:
        if not (0.0 < self.rate_hz <= NS_PER_S):
            raise ValueError(f"rate_hz must be in (0, 1e9], got {self.rate_hz}")

    @cached_property
    def _period(self) -> tuple[int, int]:
        """Numerator and denominator of the period [ns]."""
        return (NS_PER_S / Fraction(str(self.rate_hz))).as_integer_ratio()

    def stamp_ns(self, tick: int) -> int:
        """Return the stamp of a tick [ns]; TypeError if it is no integer."""
        numerator, denominator = self._period
        return operator.index(tick) * numerator // denominator

    def first_tick(self, stamp_ns: int) -> int:
        """Return the first tick at or after a stamp; TypeError if it is no integer."""
        # floor(k p) >= s  <=>  k p >= s  for integer s
        numerator, denominator = self._period
        return -(-operator.index(stamp_ns) * denominator // numerator)

    def contains(self, other: Rate) -> bool:
        """Return whether every tick of another clock is one of this."""
        return (Fraction(str(self.rate_hz)) / Fraction(str(other.rate_hz))).denominator == 1

    def ticks_within(self, other: Rate) -> int:
        """Return the most ticks in a period of another clock, its begin left out."""
        if self.contains(other):
            return int(Fraction(str(self.rate_hz)) / Fraction(str(other.rate_hz)))
        longest_ns = math.ceil(Fraction(*other._period))
        return math.ceil(longest_ns / Fraction(*self._period))

    def has_tick(self, stamp_ns: int) -> bool:
        """Return whether a tick is at this stamp."""
        return self.stamp_ns(self.first_tick(stamp_ns)) == stamp_ns

    def stamps(self, start_ns: int, end_ns: int) -> Iterator[int]:
        """Yield the stamps of all ticks in [start_ns, end_ns); TypeError if they are no integers."""
        numerator, denominator = self._period
        for tick in range(self.first_tick(start_ns), self.first_tick(end_ns)):
            yield tick * numerator // denominator
