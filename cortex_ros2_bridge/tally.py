"""Counts of a route, and of its errors: counted always, said once a second at most."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, fields
from typing import Literal

logger = logging.getLogger(__name__)

SAY_INTERVAL_S = 1.0
What = Literal["received", "sent", "lost", "refused", "clamped", "dropped"]


@dataclass(kw_only=True, eq=False)
class Totals:
    """Counts of a route."""

    received: int = 0
    """Messages that came in."""
    sent: int = 0
    """Messages that went out; where a converter makes one of many, fewer than came in."""
    lost: int = 0
    """Messages that went missing: overtaken in a queue, or not taken by the other side."""
    refused: int = 0
    """Messages that make no sense: malformed, not finite, stale."""
    clamped: int = 0
    """Commands out of range, which went out as the nearest ones within it."""
    dropped: int = 0
    """Events that a sensor had no room for, as its messages say; they never were in one."""


class Tally(Totals):
    """Counts what happens to the messages of one route, whose name the log gets, from any thread.

    Attributes:
        reason: Why the last message was lost, refused or clamped; empty if none was.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        self.reason = ""
        self._said_s = -SAY_INTERVAL_S
        self._unsaid = 0
        self._lock = threading.Lock()

    def totals(self) -> Totals:
        """Return the counts as of now."""
        return Totals(**{field.name: getattr(self, field.name) for field in fields(Totals)})

    def count(self, what: What, reason: str = "", count: int = 1) -> None:
        """Count messages; the reason is said, once a second at most."""
        with self._lock:
            setattr(self, what, getattr(self, what) + count)
            if not reason:
                return
            self.reason = f"{what}: {reason}"
            self._unsaid += count
            now_s = time.monotonic()
            if now_s - self._said_s >= SAY_INTERVAL_S:
                logger.warning("%s: %s %d: %s", self.name, what, self._unsaid, reason)
                self._said_s, self._unsaid = now_s, 0
