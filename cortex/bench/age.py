"""How old a datum is when it is used by somebody slower than its publisher."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from cortex.bench.job import Job
from cortex.bench.tally import END, WARM

WORK_S = 0.002
"""Work per message [s]."""


class Ages:
    """Records the age of each datum at the start of its use, then works 2 ms: busy, or asleep."""

    def __init__(self, job: Job, connected: Callable[[], None]) -> None:
        """Begin with nothing used."""
        self.done = False
        self._busy = bool(job.options.get("busy", True))
        self._connected = connected
        self._ages_ns: list[int] = []
        self._last = -1
        self._seen_any = False
        self._misordered = 0

    def use(self, sequence: int, stamp_ns: int) -> None:
        """Use one message, stamped with CLOCK_MONOTONIC when it was published."""
        age_ns = time.monotonic_ns() - stamp_ns
        if not self._seen_any:
            self._seen_any = True
            self._connected()
        if sequence == END:
            self.done = True
        elif sequence != WARM:
            self._ages_ns.append(age_ns)
            self._misordered += sequence <= self._last
            self._last = sequence
            _work(busy=self._busy)

    def report(self) -> dict[str, Any]:
        """Return the percentiles of the age [us] and how many messages were used."""
        return {
            **percentiles(self._ages_ns, "age"),
            "received": len(self._ages_ns),
            "lost": 0,
            "misordered": self._misordered,
            "corrupt": 0,
        }


def percentiles(times_ns: list[int], name: str) -> dict[str, float]:
    """Return ``{name}_p50_us`` and ``{name}_p99_us`` of some times."""
    if not times_ns:
        return {}
    ordered = sorted(times_ns)
    return {
        f"{name}_p50_us": ordered[len(ordered) // 2] / 1e3,
        f"{name}_p99_us": ordered[min(len(ordered) - 1, len(ordered) * 99 // 100)] / 1e3,
    }


def _work(*, busy: bool) -> None:
    if not busy:
        time.sleep(WORK_S)
        return
    deadline = time.perf_counter() + WORK_S
    while time.perf_counter() < deadline:
        pass
