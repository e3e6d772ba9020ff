"""The network as the records of all nodes describe it: topics, and publishers that come and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from cortex.records import NodeRecord
from cortex.topic import check_pattern, matches


class TopicInfo(NamedTuple):
    """A topic as the nodes announce it."""

    topic: str
    type_name: str
    fingerprint: int
    schema: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]


def topics_of(records: Iterable[NodeRecord]) -> list[TopicInfo]:
    """Return all topics of some nodes, one entry for each type on a topic."""
    found: dict[tuple[str, int], TopicInfo] = {}
    records = list(records)
    for node in records:
        for pub in node.publishers:
            info = found.get((pub.topic, pub.fingerprint)) or TopicInfo(
                pub.topic, pub.type_name, pub.fingerprint, pub.schema, (), ()
            )
            found[pub.topic, pub.fingerprint] = info._replace(publishers=(*info.publishers, node.name))
    for node in records:
        for sub in node.subscribers:
            keys = [k for k in found if matches(sub.topic, k[0]) and sub.fingerprint in (0, k[1])]
            for key in keys or [(sub.topic, sub.fingerprint)]:
                info = found.get(key) or TopicInfo(sub.topic, sub.type_name, sub.fingerprint, "", (), ())
                found[key] = info._replace(subscribers=(*info.subscribers, node.name))
    return [found[key] for key in sorted(found)]


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
    """What one callback has been told; made by `Node.watch`."""

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
