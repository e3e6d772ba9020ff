"""Simulated time by the wall clock: deadlines that do not drift, and how long things took."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

_SLICE_NS = 20_000_000
"""Longest sleep before a wait looks whether it is to stop [ns]."""


class Pacer:
    """Says when a simulated time is due by the wall clock, and waits for it.

    Every deadline is computed from one origin, in exact arithmetic: a late wake-up makes no later deadline
    late. To be used by one thread.

    Attributes:
        slipped_ns: Wall-clock time by which deadlines have been put off by `slip`, all in all [ns].
    """

    def __init__(
        self,
        factor: float,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Begin at stamp 0, now.

        Args:
            factor: Simulated over wall-clock time; 0: as fast as it can, which means never to wait.
            clock_ns: The wall clock [ns]; must not go backwards.
            sleep: Sleeps for a time [s], or less: `Event.wait` lets a wait end at once, where `stop` is
                `Event.is_set`.

        Raises:
            ValueError: The factor is negative or not finite.
        """
        self._clock_ns = clock_ns
        self._sleep = sleep
        self._ratio = _exact(factor)
        self.slipped_ns = 0
        self.start(0)

    @property
    def factor(self) -> float:
        """Simulated over wall-clock time; 0: as fast as it can."""
        return self._ratio[0] / self._ratio[1]

    def start(self, stamp_ns: int) -> None:
        """Let a simulated time [ns] be now: at the beginning, and after a pause."""
        self._origin_wall_ns = self._clock_ns()
        self._origin_stamp_ns = stamp_ns
        self._stamp_ns = stamp_ns

    def wall_ns(self, stamp_ns: int) -> int:
        """Return when a simulated time [ns] is due by the wall clock [ns]; at factor 0: now."""
        if not self._ratio[0]:
            return self._clock_ns()
        numerator, denominator = self._ratio
        return self._origin_wall_ns + (stamp_ns - self._origin_stamp_ns) * denominator // numerator

    def lateness_ns(self, stamp_ns: int) -> int:
        """Return for how long a simulated time [ns] has been due [ns]; negative: it is not due yet."""
        return self._clock_ns() - self.wall_ns(stamp_ns) if self._ratio[0] else 0

    def wait_until(self, stamp_ns: int, stop: Callable[[], bool] | None = None) -> int:
        """Wait until a simulated time is due.

        Args:
            stamp_ns: The simulated time [ns].
            stop: Ends the wait when it returns true; asked at least every 20 ms.

        Returns:
            How late it is on return [ns]; negative if `stop` ended the wait, 0 at factor 0.
        """
        self._stamp_ns = stamp_ns
        while (late_ns := self.lateness_ns(stamp_ns)) < 0 and not (stop is not None and stop()):
            self._sleep(min(-late_ns, _SLICE_NS) * 1e-9)
        return late_ns

    def slip(self, stamp_ns: int) -> int:
        """Put off a simulated time that is overdue, and all after it, so that it is due now.

        For a machine that cannot keep up. Not for the lateness of a wake-up, which the next deadline makes
        up for.

        Returns:
            By how much [ns]; 0 if it was not overdue.
        """
        late_ns = max(self.lateness_ns(stamp_ns), 0)
        self._origin_wall_ns += late_ns
        self.slipped_ns += late_ns
        return late_ns

    def set_factor(self, factor: float) -> None:
        """Go on at another pace from now; the simulated time of this moment stays what it is.

        Coming from factor 0, it is the one that was waited for last.

        Raises:
            ValueError: The factor is negative or not finite.
        """
        ratio = _exact(factor)
        now_ns = self._clock_ns()
        numerator, denominator = self._ratio
        if numerator:
            self._origin_stamp_ns += (now_ns - self._origin_wall_ns) * numerator // denominator
        else:
            self._origin_stamp_ns = self._stamp_ns
        self._origin_wall_ns = now_ns
        self._ratio = ratio


def _exact(factor: float) -> tuple[int, int]:
    """Return a factor as a fraction, from its decimal form."""
    if not (math.isfinite(factor) and factor >= 0.0):
        raise ValueError(f"the real-time factor must be 0 or more, and finite, got {factor}")
    return Fraction(str(factor)).as_integer_ratio()


@dataclass(frozen=True)
class TimingSummary:
    """What durations were; all 0 if there were none."""

    count: int
    """How many there were."""
    median_ns: int
    """Median [ns]."""
    p99_ns: int
    """99th percentile [ns]."""
    max_ns: int
    """The longest [ns]."""


class Timings:
    """Durations since somebody last looked, in bounded memory."""

    def __init__(self, capacity: int = 4096) -> None:
        """Make it empty.

        Args:
            capacity: How many durations are kept; median and 99th percentile are those of the newest.
        """
        self._ring = np.zeros(capacity, dtype=np.int64)
        self._count = 0
        self._max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Take note of a duration [ns]."""
        self._ring[self._count % self._ring.size] = duration_ns
        self._max_ns = max(self._max_ns, duration_ns) if self._count else duration_ns
        self._count += 1

    def take(self) -> TimingSummary:
        """Return what has been noted since the last time, and forget it; count and maximum are of all."""
        count, self._count = self._count, 0
        if not count:
            return TimingSummary(0, 0, 0, 0)
        median_ns, p99_ns = np.percentile(self._ring[:count], [50.0, 99.0])
        return TimingSummary(count, round(median_ns), round(p99_ns), self._max_ns)
