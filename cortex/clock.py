"""One time for all hosts: that of the registry's host, estimated from the answers to a node's heartbeats.

An answer carries CLOCK_REALTIME of the registry's host, and was made at some moment between question and
answer: half the round trip is the largest error then, and it grows as the clocks run apart. The answer with
the smallest error now counts. The clocks of the hosts need not agree, and may be set. With a registry on this
host, or none, time is CLOCK_REALTIME itself.
"""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

ANSWERS = 256
"""So many are kept: those of a minute."""
DRIFT_MAX = 500e-6
"""No two clocks of computers run further apart than this."""
DRIFT_USUAL = 100e-6
"""Clocks that nobody sets run apart by so much: old answers count less."""


class Clock(NamedTuple):
    """This host's clock beside that of the registry's host."""

    ahead_ns: int
    """How far CLOCK_REALTIME of this host is ahead [ns]."""
    error_ns: int
    """How wrong `ahead_ns` can be [ns]: half of a quick round trip, and 0.1 ms for each second since then."""


def wall_offset_ns() -> int:
    """CLOCK_REALTIME less CLOCK_MONOTONIC, by the reading of three that was interrupted least [ns]."""

    def read() -> tuple[int, int]:
        before_ns = time.monotonic_ns()
        offset_ns = time.time_ns() - before_ns
        return time.monotonic_ns() - before_ns, offset_ns

    return min(read() for _ in range(3))[1]


class _Answer(NamedTuple):
    at_ns: int
    offset_ns: int
    trip_ns: int

    def error_ns(self, now_ns: int, drift: float = DRIFT_USUAL) -> float:
        """How wrong it can be by now, if the clocks have run apart by so much in a nanosecond."""
        return self.trip_ns / 2 + drift * (now_ns - self.at_ns)


class ClockEstimate:
    """What a node knows of the time of the registry's host; `add` belongs to one thread.

    Args:
        local: Whether that is this host: then `add` and `forget` must not be called.
    """

    def __init__(self, *, local: bool) -> None:
        self.local = local
        self._answers: deque[_Answer] = deque(maxlen=ANSWERS)
        self._best: _Answer | None = None
        self._offset_ns = wall_offset_ns()

    def add(self, asked_ns: int, told_ns: int, answered_ns: int) -> None:
        """Take an answer into account.

        Args:
            asked_ns: When it was asked for, by CLOCK_MONOTONIC of this host.
            told_ns: What it said, by CLOCK_REALTIME of the registry's host.
            answered_ns: When it came.
        """
        at_ns = (asked_ns + answered_ns) // 2
        answer = _Answer(at_ns, told_ns - at_ns, answered_ns - asked_ns)
        if self._answers:
            last = self._answers[-1]
            error_ns = answer.trip_ns / 2 + last.error_ns(at_ns, DRIFT_MAX)
            if abs(answer.offset_ns - last.offset_ns) > error_ns:  # somebody has set that clock
                self._answers.clear()
        self._answers.append(answer)
        self._best = min(self._answers, key=lambda each: each.error_ns(at_ns))
        self._offset_ns = self._best.offset_ns

    def forget(self) -> None:
        """Another registry answers from now on: begin anew, from where we are."""
        self._answers.clear()

    def offset_ns(self) -> int:
        """CLOCK_REALTIME of the registry's host less CLOCK_MONOTONIC of this one [ns]."""
        return wall_offset_ns() if self.local else self._offset_ns

    def clock(self, now_ns: int) -> Clock | None:
        """Return this host's clock beside that of the registry's host; None: it has not answered yet."""
        if self.local:
            return Clock(0, 0)
        best = self._best
        return best and Clock(wall_offset_ns() - best.offset_ns, round(best.error_ns(now_ns)))
