"""What limits how often Rerun is called: rates of pictures, and rows that are sent together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

_BATCH_ROWS = 1024


class RateLimit:
    """Lets so many pass that their mean rate is as wanted, whatever rate they come at."""

    def __init__(self, period_ns: int, *, burst_ns: int = 0) -> None:
        """Let the first one pass.

        `period_ns`: mean time between those that pass, at least [ns]. `burst_ns`: how far ahead of the mean
        rate they may be, when they come at once [ns].
        """
        self._period_ns = period_ns
        self._burst_ns = burst_ns
        self._due_ns: dict[str, int] = {}

    def passes(self, key: str, now_ns: int) -> bool:
        """Return whether one of a kind may pass now."""
        earliest_ns = now_ns - self._burst_ns
        due_ns = self._due_ns.get(key, earliest_ns)
        if now_ns < due_ns - self._period_ns:  # time has begun again
            due_ns = now_ns
        if now_ns < due_ns:
            return False
        self._due_ns[key] = max(due_ns + self._period_ns, earliest_ns)
        return True


class Table:
    """Rows of one entity that are sent together."""

    def __init__(self, entity: str, send: Callable[..., None], *, span_ns: int | None) -> None:
        """Start empty.

        `send`: called with the entity, the stamps [ns], and an array of rows for each column, by its name.
        `span_ns`: longest simulated time that rows wait [ns]; None: until there are 1024, or `send`.
        """
        self._entity = entity
        self._send = send
        self._span_ns = span_ns
        self._stamp_ns: list[int] = []
        self._rows: list[dict[str, Any]] = []

    def append(self, stamp_ns: int, **values: Any) -> None:
        """Add a row: a value or an array for each column."""
        if self._stamp_ns and stamp_ns < self._stamp_ns[-1]:  # after a reset
            self.send()
        self._stamp_ns.append(stamp_ns)
        self._rows.append({name: np.array(value, np.float64).reshape(-1) for name, value in values.items()})
        span_ns = stamp_ns - self._stamp_ns[0]
        if len(self._rows) >= _BATCH_ROWS or (self._span_ns is not None and span_ns >= self._span_ns):
            self.send()

    def send(self) -> None:
        """Send the rows that wait."""
        if self._rows:
            columns = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
            self._send(self._entity, np.array(self._stamp_ns, dtype=np.int64), **columns)
            self._stamp_ns, self._rows = [], []
