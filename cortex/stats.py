"""Counters of a subscriber, and a histogram of latency that costs a few tens of nanoseconds to fill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

BUCKETS = 40
"""Bucket k counts latencies in [2^(k-1), 2^k) ns; bucket 0 those below 1 ns, the last all over 9 minutes."""


@dataclass(slots=True)
class SubscriberCounters:
    """What one subscriber has seen since it began."""

    received: int = 0
    lost: int = 0
    """Messages that were published and never arrived: gaps in the sequence."""
    overtaken: int = 0
    """Messages that arrived and gave way to newer ones before they were fetched."""
    rejected: int = 0
    """Frames that were malformed or of another type."""
    cut_off: int = 0
    """Publishers whose end was not heard, as they were killed, or the connection to them failed for good.

    How many messages were lost at the end is not known then. Counted by `reliable` subscribers."""
    latency: list[int] = field(default_factory=lambda: [0] * BUCKETS)
    """Counts of the time from `publish` to arrival, in buckets of powers of two of a nanosecond."""


@dataclass(slots=True)
class PublisherCounters:
    """What one publisher has done since it began."""

    published: int = 0
    """Messages that `publish` was called with."""
    bytes: int = 0
    timeouts: int = 0
    """Messages that at least one reliable subscriber lost, because it held up the publisher for too long."""
    skipped: int = 0
    """Large messages of which some subscriber got no lease, because it had not given back earlier ones.

    A `keep_last` subscriber copies them if it comes in time; else they are lost to it, and counted there."""


def note_latency(histogram: list[int], latency_ns: int) -> None:
    """Count a latency."""
    histogram[min(max(latency_ns, 0).bit_length(), len(histogram) - 1)] += 1


def quantile_ns(histogram: Sequence[int], fraction: float) -> float:
    """A quantile of a latency histogram [ns], interpolated within its bucket; nan for an empty one."""
    total = sum(histogram)
    if not total:
        return float("nan")
    rank, below = fraction * total, 0
    for bucket, count in enumerate(histogram):
        if count and below + count >= rank:
            low = 0.0 if bucket == 0 else 2.0 ** (bucket - 1)
            return low + (2.0**bucket - low) * (rank - below) / count
        below += count
    return 2.0 ** (len(histogram) - 1)
