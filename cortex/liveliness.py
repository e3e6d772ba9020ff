"""Who publishes: a callback for each publisher that comes, and for each that leaves or dies."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from cortex.records import NodeRecord
from cortex.topic import check_pattern, matches


class Liveliness(NamedTuple):
    """A publisher has come, or is gone."""

    topic: str
    type_name: str
    source: int
    """The publisher's number, as in `Info`."""
    node: int
    node_name: str
    alive: bool


class Watch:
    """What one callback has been told; made by `Node.watch`.

    Args:
        pattern: Of the topics.
        callback: Called with each change.
    """

    def __init__(self, pattern: str, callback: Callable[[Liveliness], object]) -> None:
        self._pattern = check_pattern(pattern)
        self._callback = callback
        self._known: dict[int, Liveliness] = {}
        self.stopped = False

    def changes(self, records: Iterable[NodeRecord]) -> list[Liveliness]:
        """What has changed since the last call: publishers that are gone first."""
        now = {
            publisher.source: Liveliness(
                publisher.topic, publisher.type_name, publisher.source, node.node, node.name, True
            )
            for node in records
            for publisher in node.publishers
            if matches(self._pattern, publisher.topic)
        }
        before, self._known = self._known, now
        gone = [seen._replace(alive=False) for source, seen in before.items() if source not in now]
        return gone + [seen for source, seen in now.items() if source not in before]

    def tell(self, change: Liveliness) -> None:
        """Call the callback, unless it was stopped."""
        if not self.stopped:
            self._callback(change)
