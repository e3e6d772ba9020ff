"""What a node tells of itself, and what the records of all nodes say about their topics."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from cortex.publisher import Publisher
from cortex.records import (
    NodeRecord,
    PublisherRecord,
    PublisherStats,
    ServiceRecord,
    SubscriberRecord,
    SubscriberStats,
)
from cortex.schema import schema_of
from cortex.service import Service
from cortex.stats import array_of
from cortex.subscriber import Subscriber
from cortex.topic import matches


class TopicInfo(NamedTuple):
    """A topic as the nodes announce it."""

    topic: str
    type_name: str
    fingerprint: int
    schema: str
    publishers: tuple[str, ...]
    """Names of the nodes that publish it."""
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


def describe_publisher(publisher: Publisher[Any]) -> PublisherRecord:
    """What others must know of a publisher to connect to it."""
    codec = publisher.codec
    schema = codec.schema
    return PublisherRecord(
        publisher.topic,
        publisher.source,
        schema.name,
        codec.fingerprint,
        schema.to_json(),
        publisher.latch,
    )


def describe_subscriber(subscriber: Subscriber[Any]) -> SubscriberRecord:
    """What is announced of a subscriber."""
    codec = subscriber.codec
    return SubscriberRecord(
        subscriber.topic,
        "" if codec is None else codec.schema.name,
        0 if codec is None else codec.fingerprint,
        str(subscriber.policy),
    )


def describe_service(service: Service) -> ServiceRecord:
    """What others must know of a service to call it."""
    request, reply = schema_of(service.request_type), schema_of(service.reply_type)
    return ServiceRecord(service.name, service.number, request.to_json(), reply.to_json())


def publisher_stats(publisher: Publisher[Any]) -> PublisherStats:
    """What a publisher has counted."""
    counters = publisher.counters
    return PublisherStats(
        publisher.topic,
        publisher.source,
        publisher.subscriber_count,
        counters.published,
        counters.bytes,
        counters.timeouts,
        counters.skipped,
    )


def subscriber_stats(subscriber: Subscriber[Any]) -> SubscriberStats:
    """What a subscriber has counted."""
    counters = subscriber.counters
    return SubscriberStats(
        subscriber.topic,
        str(subscriber.policy),
        counters.received,
        counters.lost,
        counters.rejected,
        counters.overtaken,
        counters.cut_off,
        array_of(counters.latency),
    )
