"""One time for all hosts: that of the registry's host, estimated from the answers to a node's heartbeats.

An answer carries CLOCK_REALTIME of the registry's host, and was made at some moment between question and
answer: half the round trip is the largest error then. Of each second the quickest answer counts, and a line
through those of a minute gives the drift. The clocks of the hosts need not agree, and may be set. With a
registry on this host, or none, time is CLOCK_REALTIME itself.
"""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

import numpy as np

WINDOW_NS = 1_000_000_000
"""Of so much time the quickest answer counts."""
WINDOWS = 64
DRIFT_WINDOWS = 16
"""A drift is estimated from so many windows on."""
JITTER_NS = 20_000
"""Answers that took so much longer than the quickest count half in the line."""
DRIFT_ERROR_MAX = 20e-6
"""A drift is used once its standard error is smaller."""
DRIFT_MAX = 500e-6
"""No two clocks of computers run further apart than this."""
DRIFT_USUAL = 100e-6
"""Clocks that nobody sets run apart by so much: old answers count less, while the drift is not known."""


class Clock(NamedTuple):
    """This host's clock beside that of the registry's host."""

    ahead_ns: int
    """How far CLOCK_REALTIME of this host is ahead [ns]."""
    error_ns: int
    """How wrong `ahead_ns` can be [ns]: half of the quickest round trip, and how far the clocks may have run
    apart since then: by 0.1 ms a second as long as the drift is not known, else by 20 us."""
    drift_ppm: float | None
    """How much faster this host's clock runs; None: not known to 20 ppm yet, which takes 16 s and more."""


def wall_offset_ns() -> int:
    """CLOCK_REALTIME less CLOCK_MONOTONIC, by the reading of three that was interrupted least [ns]."""

    def read() -> tuple[int, int]:
        before_ns = time.monotonic_ns()
        offset_ns = time.time_ns() - before_ns
        return time.monotonic_ns() - before_ns, offset_ns

    return min(read() for _ in range(3))[1]


class _Sample(NamedTuple):
    at_ns: int
    offset_ns: int
    trip_ns: int

    def error_ns(self, now_ns: int, drift: float) -> float:
        """How wrong it can be by now, if the clocks have run apart by so much in a nanosecond."""
        return self.trip_ns / 2 + drift * (now_ns - self.at_ns)


class ClockEstimate:
    """What a node knows of the time of the registry's host; `add` belongs to one thread.

    Args:
        local: Whether that is this host: then `add` and `forget` must not be called.
    """

    def __init__(self, *, local: bool) -> None:
        self.local = local
        self._samples: deque[_Sample] = deque(maxlen=WINDOWS)
        self._window_ns = 0
        self._line: tuple[int, int, float | None] = (time.monotonic_ns(), wall_offset_ns(), None)
        """By CLOCK_MONOTONIC: a time, the offset then, its growth in 1 ns or None; other threads read it."""

    def add(self, asked_ns: int, told_ns: int, answered_ns: int) -> None:
        """Take an answer into account.

        Args:
            asked_ns: When it was asked for, by CLOCK_MONOTONIC of this host.
            told_ns: What it said, by CLOCK_REALTIME of the registry's host.
            answered_ns: When it came.
        """
        at_ns, trip_ns = (asked_ns + answered_ns) // 2, answered_ns - asked_ns
        sample = _Sample(at_ns, told_ns - at_ns, trip_ns)
        if self._samples:
            last = self._samples[-1]
            error_ns = (trip_ns + last.trip_ns) / 2 + DRIFT_MAX * (at_ns - last.at_ns)
            if abs(sample.offset_ns - last.offset_ns) > error_ns:  # somebody has set that clock
                self._samples.clear()
        if not self._samples or at_ns - self._window_ns > WINDOW_NS:
            self._window_ns = at_ns
            self._samples.append(sample)
        elif trip_ns < self._samples[-1].trip_ns:
            self._samples[-1] = sample
        else:
            return
        self._fit()

    def _fit(self) -> None:
        now_ns = self._samples[-1].at_ns
        best = min(self._samples, key=lambda sample: sample.error_ns(now_ns, DRIFT_USUAL))
        line: tuple[int, int, float | None] = (best.at_ns, best.offset_ns, None)
        if len(self._samples) >= DRIFT_WINDOWS:
            times, offsets, trips = (
                np.array([sample[k] - best[k] for sample in self._samples], np.float64) for k in range(3)
            )
            weights = 1.0 / (trips - trips.min() + JITTER_NS)
            (drift, offset_ns), spread = np.polyfit(times, offsets, 1, w=weights, cov=True)
            if spread[0, 0] < DRIFT_ERROR_MAX**2 and abs(drift) <= DRIFT_MAX:
                line = (best.at_ns, best.offset_ns + round(offset_ns), float(drift))
        self._line = line

    def forget(self) -> None:
        """Another registry answers from now on: begin anew, from where we are."""
        self._samples.clear()

    def offset_ns(self, now_ns: int) -> int:
        """CLOCK_REALTIME of the registry's host less CLOCK_MONOTONIC of this one, which is given [ns]."""
        if self.local:
            return wall_offset_ns()
        at_ns, offset_ns, drift = self._line
        return offset_ns + round((drift or 0.0) * (now_ns - at_ns))

    def clock(self, now_ns: int) -> Clock | None:
        """Return this host's clock beside that of the registry's host; None: it has not answered yet."""
        if self.local:
            return Clock(0, 0, 0.0)
        samples = list(self._samples)
        if not samples:
            return None
        ahead_ns, drift = wall_offset_ns() - self.offset_ns(now_ns), self._line[2]
        unknown_drift = DRIFT_USUAL if drift is None else DRIFT_ERROR_MAX
        error_ns = min(sample.error_ns(now_ns, unknown_drift) for sample in samples)
        return Clock(ahead_ns, round(error_ns), None if drift is None else -drift * 1e6)
