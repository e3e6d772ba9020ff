"""What a route has done, and what went wrong: counted always, said once a second at most."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass

logger = logging.getLogger(__name__)

SAY_INTERVAL_S = 1.0


class Tally:
    """Counts what happens to the messages of one route.

    From any thread.

    Attributes:
        received: Messages that came in.
        sent: Messages that went out; where a converter makes one of many, fewer than came in.
        lost: Messages that went missing: overtaken in a queue, or not taken by the other side.
        refused: Messages that make no sense: malformed, not finite, stale.
        clamped: Commands out of range, which went out as the nearest ones within it.
        dropped: Events that a sensor had no room for, as its messages say; they never were in one.
        reason: Why the last one was lost, refused or clamped; empty if none was.
    """

    def __init__(self, name: str) -> None:
        """Begin at nothing.

        Args:
            name: Of the route, for the log.
        """
        self.name = name
        self.received = self.sent = self.lost = self.refused = self.clamped = self.dropped = 0
        self.reason = ""
        self._said_s = -SAY_INTERVAL_S
        self._unsaid = 0
        self._lock = threading.Lock()

    def receive(self, count: int = 1) -> None:
        """Count messages that came in."""
        with self._lock:
            self.received += count

    def send(self) -> None:
        """Count a message that went out."""
        with self._lock:
            self.sent += 1

    def refuse(self, reason: str) -> None:
        """Count a message that makes no sense."""
        with self._lock:
            self.refused += 1
            self._say("refused", reason, 1)

    def clamp(self, reason: str) -> None:
        """Count a command that was out of range."""
        with self._lock:
            self.clamped += 1
            self._say("clamped", reason, 1)

    def lose(self, reason: str, count: int = 1) -> None:
        """Count messages that went missing."""
        with self._lock:
            self.lost += count
            self._say("lost", reason, count)

    def drop(self, count: int) -> None:
        """Count what a sensor had no room for."""
        with self._lock:
            self.dropped += count
            self._say("dropped", "events that did not fit into the sensor's buffer", count)

    def totals(self) -> Totals:
        """Return the counts as of now."""
        return Totals(
            received=self.received,
            sent=self.sent,
            lost=self.lost,
            refused=self.refused,
            clamped=self.clamped,
            dropped=self.dropped,
        )

    def _say(self, what: str, reason: str, count: int) -> None:
        self.reason = f"{what}: {reason}"
        self._unsaid += count
        now_s = time.monotonic()
        if now_s - self._said_s >= SAY_INTERVAL_S:
            logger.warning("%s: %s %d: %s", self.name, what, self._unsaid, reason)
            self._said_s, self._unsaid = now_s, 0


@dataclass(frozen=True, kw_only=True)
class Totals:
    """Counts of a route."""

    received: int = 0
    sent: int = 0
    lost: int = 0
    refused: int = 0
    clamped: int = 0
    dropped: int = 0
