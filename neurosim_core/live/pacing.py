"""Simulated time by the wall clock: deadlines that do not drift, and statistics of durations."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from fractions import Fraction

import numpy as np

_SLICE_NS = 20_000_000
"""Longest sleep before a wait checks whether it is to stop [ns]."""


class Pacer:
    """Says when a simulated time is due by the wall clock, and waits for it. Not thread-safe.

    Every deadline is computed from one origin in exact arithmetic: a late wake-up makes no later deadline
    late.
    """

    def __init__(
        self,
        factor: float,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Begin at stamp 0, now.

        `factor`: simulated over wall-clock time; 0: as fast as possible, without any wait. `clock_ns`: the
        wall clock [ns]; must not go backwards. `sleep`: sleeps for a time [s] or less; `Event.wait` lets a
        wait end at once.
        """
        self._clock_ns = clock_ns
        self._sleep = sleep
        self._ratio = _exact(factor)
        self.start(0)

    @property
    def factor(self) -> float:
        """Simulated over wall-clock time; 0: as fast as possible."""
        return self._ratio[0] / self._ratio[1]

    def start(self, stamp_ns: int) -> None:
        """Make a simulated time [ns] due now: at the beginning, and after a pause."""
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
        """Return how long a simulated time [ns] has been due [ns]; negative before it is due."""
        return self._clock_ns() - self.wall_ns(stamp_ns) if self._ratio[0] else 0

    def wait_until(self, stamp_ns: int, stop: Callable[[], bool] | None = None) -> int:
        """Wait until a simulated time is due.

        `stamp_ns`: the simulated time [ns]. `stop`: ends the wait when it returns true; called at least every
        20 ms. Returns how late it is on return [ns]; negative if `stop` ended the wait, 0 at factor 0.
        """
        self._stamp_ns = stamp_ns
        while (late_ns := self.lateness_ns(stamp_ns)) < 0 and not (stop is not None and stop()):
            self._sleep(min(-late_ns, _SLICE_NS) * 1e-9)
        return late_ns

    def slip(self, stamp_ns: int) -> int:
        """Move the deadline of an overdue simulated time, and all later ones, so that it is due now.

        This is for a machine that cannot keep up; the next deadline makes up for a late wake-up by itself.
        Returns by how much [ns]; 0 if it was not overdue.
        """
        late_ns = max(self.lateness_ns(stamp_ns), 0)
        self._origin_wall_ns += late_ns
        return late_ns

    def set_factor(self, factor: float) -> None:
        """Change the factor from now on; the simulated time of this moment stays what it is.

        Coming from factor 0, that is the time that was waited for last.
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
        raise ValueError(f"the real-time factor must be >= 0 and finite, got {factor}")
    return Fraction(str(factor)).as_integer_ratio()


class Timings:
    """Durations since the last `take`, in bounded memory."""

    def __init__(self, capacity: int = 4096) -> None:
        """Make it empty."""
        self._newest: deque[int] = deque(maxlen=capacity)

    def add(self, duration_ns: int) -> None:
        """Add a duration [ns]."""
        self._newest.append(duration_ns)

    def take(self) -> tuple[int, int]:
        """Return median and 99th percentile since the last call [ns], 0 if there was none; forget them."""
        if not self._newest:
            return 0, 0
        median_ns, p99_ns = np.percentile(self._newest, [50.0, 99.0])
        self._newest.clear()
        return round(median_ns), round(p99_ns)
