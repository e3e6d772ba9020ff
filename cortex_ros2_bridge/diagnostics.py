"""What the bridge says of itself on /diagnostics: one status for each route, once a second."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.tally import Totals

TOPIC = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels, as in diagnostic_msgs/DiagnosticStatus."""


@dataclass(frozen=True, kw_only=True)
class Status:
    """How one part of the bridge is doing."""

    name: str
    level: int = OK
    message: str = ""
    values: Sequence[tuple[str, str]] = field(default_factory=tuple)


def route_status(
    name: str, now: Totals, before: Totals, *, listeners: int, elapsed_s: float, reason: str, types: str
) -> Status:
    """Return how a route is doing: a warning if anything went missing since the last status.

    Args:
        name: Of the route.
        now: What it has done.
        before: What it had done when it was last looked at.
        listeners: How many there are on the ROS side.
        elapsed_s: How long ago that was [s].
        reason: Why the last message was lost or refused.
        types: Which become which.
    """
    gone = {
        "lost": now.lost - before.lost,
        "refused": now.refused - before.refused,
        "clamped": now.clamped - before.clamped,
        "events dropped by the sensor": now.dropped - before.dropped,
    }
    rate_hz = (now.sent - before.sent) / elapsed_s if elapsed_s > 0.0 else 0.0
    if any(gone.values()):
        parts = [f"{count} {what}" for what, count in gone.items() if count]
        message = f"{' and '.join(parts)} in {elapsed_s:.1f} s ({reason})"
    else:
        message = f"{rate_hz:.1f} Hz" if rate_hz else "idle"
    return Status(
        name=name,
        level=WARN if any(gone.values()) else OK,
        message=message,
        values=(
            ("received", str(now.received)),
            ("sent", str(now.sent)),
            ("lost", str(now.lost)),
            ("refused", str(now.refused)),
            ("clamped", str(now.clamped)),
            ("dropped", str(now.dropped)),
            ("rate_hz", f"{rate_hz:.1f}"),
            ("listeners", str(listeners)),
            ("types", types),
        ),
    )


def diagnostic_array(statuses: Iterable[Status], *, stamp_ns: int, node: str) -> Buffer:
    """Return the message for /diagnostics.

    Args:
        statuses: What to say.
        stamp_ns: Time of the statuses [ns].
        node: Name of the node that says it.
    """
    status_class = message_class("diagnostic_msgs/msg/DiagnosticStatus")
    pair_class = message_class("diagnostic_msgs/msg/KeyValue")
    array = message_class(TYPE)()
    array.header.stamp.sec, array.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    array.status = [
        status_class(
            level=bytes([status.level]),
            name=f"{node}: {status.name}",
            message=status.message,
            hardware_id="cortex",
            values=[pair_class(key=key, value=value) for key, value in status.values],
        )
        for status in statuses
    ]
    return cdr.encode(array)
