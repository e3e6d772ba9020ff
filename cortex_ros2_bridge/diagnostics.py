"""What the bridge says of itself on /diagnostics: one status for each route, once a second."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.convert.records import record, status_record, time_of
from cortex_ros2_bridge.tally import Totals

TOPIC = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"

_SAID = {"dropped": "events dropped by the sensor"}
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
    counts = asdict(now)
    grown = {name: count - getattr(before, name) for name, count in counts.items()}
    gone = {_SAID.get(name, name): grown[name] for name in ("lost", "refused", "clamped", "dropped")}
    rate_hz = grown["sent"] / elapsed_s if elapsed_s > 0.0 else 0.0
    message = f"{rate_hz:.1f} Hz" if rate_hz else "idle"
    if any(gone.values()):
        parts = [f"{count} {what}" for what, count in gone.items() if count]
        message = f"{' and '.join(parts)} in {elapsed_s:.1f} s ({reason})"
    values = {**counts, "rate_hz": f"{rate_hz:.1f}", "listeners": listeners, "types": types}
    return Status(
        name=name,
        level=WARN if any(gone.values()) else OK,
        message=message,
        values=tuple((key, str(value)) for key, value in values.items()),
    )


def diagnostic_array(statuses: Iterable[Status], *, stamp_ns: int, node: str) -> Buffer:
    """Return the message for /diagnostics.

    Args:
        statuses: What to say.
        stamp_ns: Time of the statuses [ns].
        node: Name of the node that says it.
    """
    array = record(TYPE)(
        record("std_msgs/msg/Header")(time_of(stamp_ns), ""),
        [
            status_record(each.level, f"{node}: {each.name}", each.message, "cortex", each.values)
            for each in statuses
        ],
    )
    return cdr.encode(array)
