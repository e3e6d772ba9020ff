"""Conflicts with other nodes and with settings, for /diagnostics and the log."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from cortex import Node
from cortex_ros2_bridge.backend.base import Backend, Qos, TopicInfo
from cortex_ros2_bridge.config import BridgeConfig
from cortex_ros2_bridge.routes import Route, Seen, shared_topics, unfit, vehicle_of

UNFIT_S = 5.0
"""So long after the first topics are seen, settings that fit none of them are said [s]."""
TWICE_S = 12.0
"""So long others may publish our topics too: DDS forgets a bridge that was killed after 10 s [s]."""


class Neighbours:
    """Looks at both sides for what is wrong."""

    def __init__(self, backend: Backend, node: Node) -> None:
        self._backend = backend
        self._node = node
        self._unfit_s: float | None = None
        self._twice_s: float | None = None

    def notes(self, routes: Iterable[Route], seen: Seen, config: BridgeConfig, now_s: float) -> list[str]:
        """Return what is wrong at a time [s], a sentence each."""
        ours = {route.ros_topic: route for route in routes}
        others = self._backend.topics()
        return (
            _of_quality(ours, others)
            + _of_other_types(ours, others)
            + _of_unread_topics(ours, others)
            + self._of_another_bridge(ours, others, config, now_s)
            + self._of_settings(seen, config, now_s)
        )

    def _of_another_bridge(
        self, ours: dict[str, Route], others: list[TopicInfo], config: BridgeConfig, now_s: float
    ) -> list[str]:
        """Say that others publish what we do: then ROS gets every message twice, and Cortex every command."""
        own = {topic for topic, route in ours.items() if route.direction == "out"} - shared_topics(config)
        twice = sorted({t.topic for t in others if t.publishers and t.topic in own})
        if not twice:
            self._twice_s = None
            return []
        self._twice_s = now_s if self._twice_s is None else self._twice_s
        twins = [n for n in self._node.nodes() if n.node != self._node.id and n.name == self._node.name]
        if not twins and now_s - self._twice_s < TWICE_S:
            return []
        who = ", ".join(f"{twin.name}, process {twin.pid} on {twin.host}" for twin in twins)
        what = f"another bridge ({who})" if twins else "another node"
        more = f" and {len(twice) - 1} more of our topics" if len(twice) > 1 else ""
        return [f"{what} publishes {twice[0]}{more} too: ROS gets all of it twice, and Cortex every command"]

    def _of_settings(self, seen: Seen, config: BridgeConfig, now_s: float) -> list[str]:
        """Say which settings have fitted nothing for a while; what fits them may come yet."""
        if self._unfit_s is None and seen.topics:
            self._unfit_s = now_s + UNFIT_S
        if self._unfit_s is None or now_s < self._unfit_s:
            return []
        return unfit(seen, config)


def _of_quality(ours: dict[str, Route], others: list[TopicInfo]) -> list[str]:
    """Say which of our topics do not reach a node, or are not reached."""
    notes: dict[str, None] = {}
    for info in others:
        route = ours.get(info.topic)
        if route is None or info.type_name != route.ros_type:
            continue
        is_out = route.direction in ("out", "record")
        for other in info.subscribers if is_out else info.publishers:
            why = _why_apart(*((route.qos, other) if is_out else (other, route.qos)))
            if why:
                notes[f"{info.topic} does not reach a node: {why}"] = None
    return list(notes)


def _why_apart(writer: Qos, reader: Qos) -> str:
    """Return why two endpoints of a topic do not meet; empty if they do."""
    if reader.reliability == "reliable" and writer.reliability != "reliable":
        return "its subscriber wants it reliable, its publisher is not"
    if reader.durability == "transient_local" and writer.durability != "transient_local":
        return "its subscriber wants it transient local, its publisher is volatile"
    return ""


def _of_other_types(ours: dict[str, Route], others: list[TopicInfo]) -> list[str]:
    """Say which of our topics others use with another type, and which topic is for that."""
    notes = []
    for info in others:
        route = ours.get(info.topic)
        if route is None or info.type_name == route.ros_type:
            continue
        if route.direction == "out" and info.subscribers:
            notes.append(f"{info.topic}: a node subscribes to it as {info.type_name}, it is {route.ros_type}")
        elif route.direction != "out" and info.publishers:
            right = [other.ros_topic for other in ours.values() if _serves(other, route, info.type_name)]
            hint = f"; for {info.type_name}: {' or '.join(right)}" if right else ""
            notes.append(f"{info.topic}: a node publishes {info.type_name}, wanted is {route.ros_type}{hint}")
    return notes


def _of_unread_topics(ours: dict[str, Route], others: list[TopicInfo]) -> list[str]:
    """Say which topics that nobody reads look like one of our commands."""
    notes = []
    for info in others:
        if info.topic in ours or info.subscribers or not info.publishers:
            continue
        commands = [
            route.ros_topic
            for route in ours.values()
            if (route.direction, route.ros_type) == ("in", info.type_name)
        ]
        if near := difflib.get_close_matches(info.topic, commands, 1):
            notes.append(
                f"{info.topic}: a node publishes {info.type_name}, which nobody reads; "
                f"did you mean {near[0]}?"
            )
    return notes


def _serves(other: Route, route: Route, ros_type: str) -> bool:
    """Return whether a route takes messages of a type for the vehicle of another one."""
    same = vehicle_of(other.cortex_topic) == vehicle_of(route.cortex_topic)
    return other.direction == route.direction and same and other.ros_type == ros_type
