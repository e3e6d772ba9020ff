"""The policy of a subscriber: the last n, only the newest, or every message."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Policy:
    """How messages are queued for one subscriber; made by `keep_last`, `latest` or `reliable`."""

    depth: int
    """Most messages that wait for the subscriber in its own process."""
    reliable: bool
    """Whether a full queue holds up the publisher; otherwise the oldest message gives way and is counted."""
    timeout_s: float
    """Longest time that a full queue holds up one `publish` [s]; then the message is lost, and counted."""

    def __post_init__(self) -> None:
        if not 1 <= self.depth <= 65_536:
            raise ValueError(f"depth must be 1 to 65536, got {self.depth}")
        if not 0.0 <= self.timeout_s <= 4_000_000.0:  # 32 bits of milliseconds travel
            raise ValueError(f"timeout_s must be 0 to 4e6, got {self.timeout_s}")

    def __str__(self) -> str:
        if self.reliable:
            return f"reliable(depth={self.depth}, timeout_s={self.timeout_s:g})"
        return "latest()" if self.depth == 1 else f"keep_last({self.depth})"


def keep_last(depth: int = 64) -> Policy:
    """The last `depth` messages; older ones that were not fetched in time are dropped and counted."""
    return Policy(depth=depth, reliable=False, timeout_s=0.0)


def latest() -> Policy:
    """Only the newest message: what a controller wants of a sensor."""
    return Policy(depth=1, reliable=False, timeout_s=0.0)


def reliable(depth: int = 64, timeout_s: float = 1.0) -> Policy:
    """Every message: a full queue holds up the publisher, at most `timeout_s` for one message.

    After that the message is lost for this subscriber, counted on both sides, and the publisher goes on.
    Besides `depth` messages in the subscriber, the sockets between the two hold a bounded number more.
    """
    return Policy(depth=depth, reliable=True, timeout_s=timeout_s)
