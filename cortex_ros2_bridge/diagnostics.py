"""The status of the bridge on /diagnostics: one status for each route, once a second."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from cortex_ros2_bridge.convert.records import status_record
from cortex_ros2_bridge.links import Link

TOPIC = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"
HARDWARE = "cortex"

_SAID = {"dropped": "events dropped by the sensor"}
OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels, as in diagnostic_msgs/DiagnosticStatus."""


def route_status(link: Link, node: str, elapsed_s: float) -> Any:
    """Return how a route of a node is doing: a warning if anything went missing since the last status."""
    name = f"{node}: {link.route}"
    if link.gone_s is not None:
        return status_record(STALE, name, "its Cortex topic has gone", HARDWARE, ())
    before, link.before = link.before, link.tally.totals()
    counts = asdict(link.before)
    grown = {count: value - getattr(before, count) for count, value in counts.items()}
    gone = {_SAID.get(count, count): grown[count] for count in ("lost", "refused", "clamped", "dropped")}
    rate_hz = grown["sent"] / elapsed_s if elapsed_s > 0.0 else 0.0
    message = f"{rate_hz:.1f} Hz" if rate_hz else "idle"
    if any(gone.values()):
        parts = [f"{count} {what}" for what, count in gone.items() if count]
        message = f"{' and '.join(parts)} in {elapsed_s:.1f} s ({link.tally.reason})"
    types = f"{link.route.cortex_type} and {link.route.ros_type}"
    values = {**counts, "rate_hz": f"{rate_hz:.1f}", "listeners": link.listeners(), "types": types}
    level = WARN if any(gone.values()) else OK
    return status_record(level, name, message, HARDWARE, ((key, str(each)) for key, each in values.items()))
