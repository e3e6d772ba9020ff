"""The connections of a node: its subscribers to publishers, its clients to services."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any, cast

import zmq

from cortex.codec import Codec, codec_of
from cortex.evolution import EvolvedCodec, is_evolved
from cortex.link import Link
from cortex.places import Reach, reach
from cortex.records import NodeRecord, PublisherRecord
from cortex.schema import Schema, SchemaError, TypeMismatch, type_from_schema
from cortex.security import Keys
from cortex.subscriber import Subscriber
from cortex.topic import is_pattern, matches

logger = logging.getLogger(__name__)


class Matcher:
    """Connects what one node has to what others have."""

    def __init__(self, host: str, keys: Keys | None, *, insecure: bool) -> None:
        self._host = host
        self._keys = keys
        self._insecure = insecure

    def match(self, subscriber: Subscriber[Any], own: NodeRecord, peers: Iterable[NodeRecord]) -> None:
        """Connect a subscriber to the publishers of its topic, and let go of those that have left."""
        wanted = {
            publisher.source: (node, publisher)
            for node in (own, *peers)
            for publisher in node.publishers
            if matches(subscriber.topic, publisher.topic)
        }
        subscriber.refused &= wanted.keys()
        for source in subscriber.sources().keys() - wanted.keys():
            subscriber.forget(source)
        for source, (node, publisher) in wanted.items():
            offset_ns = 0 if node.host == self._host else node.clock_offset_ns - own.clock_offset_ns
            if not subscriber.keep(source, offset_ns):
                self._connect(subscriber, node, publisher, offset_ns)

    def _connect(
        self, subscriber: Subscriber[Any], node: NodeRecord, publisher: PublisherRecord, clock_offset_ns: int
    ) -> None:
        if publisher.source in subscriber.refused:
            return
        try:
            schema = Schema.from_json(publisher.schema)
            if schema.fingerprint != publisher.fingerprint:
                raise SchemaError("its fingerprint is another")
            codec = subscriber.codec or codec_of(type_from_schema(schema))
            if codec.fingerprint != schema.fingerprint and is_evolved(codec.schema, schema):
                codec = cast(Codec, EvolvedCodec(schema, codec.type))
        except (SchemaError, ValueError, TypeError) as error:
            subscriber.refused.add(publisher.source)
            logger.warning("%s of %s: unreadable schema: %s", publisher.topic, node.name, error)
            return
        if codec.fingerprint != publisher.fingerprint:
            subscriber.refused.add(publisher.source)
            if is_pattern(subscriber.topic):
                return  # it asks for topics of its type
            what = (
                f"{publisher.topic}: node {node.name!r} publishes another type than this subscriber expects"
            )
            subscriber.complain(TypeMismatch(what, codec.schema, schema))
            return
        place = reach(node, self._host, self._keys, insecure=self._insecure)
        if place is None:
            logger.debug("%s of %s cannot be reached from here", publisher.topic, node.name)
            return
        try:
            link = Link(
                publisher,
                codec,
                place.endpoint.strict if subscriber.policy.reliable else place.endpoint.lossy,
                policy=subscriber.policy,
                local=place.local,
                shared_memory=place.local,
                counters=subscriber.counters,
                clock_offset_ns=clock_offset_ns,
                secure=place.secure,
            )
        except (OSError, zmq.ZMQError) as error:  # tried again when something changes
            logger.warning("%s of %s: cannot connect: %s", publisher.topic, node.name, error)
            return
        subscriber.connect(link)

    def find_service(
        self, name: str, number: int, expected: Schema, records: Iterable[NodeRecord]
    ) -> Reach | None:
        """Return where a service is offered; None if it is not.

        Raises:
            TypeMismatch: There is one of that name, with other types.
            ConnectionError: It cannot be reached from here.
        """
        other: str | None = None
        for node in records:
            for service in node.services:
                if service.name == name and service.service == number:
                    return self.reach_control(node)
                if service.name == name:
                    other = service.request_schema
        if other is not None:
            raise TypeMismatch(
                f"{name}: the service has other types than this client (request shown)",
                expected,
                Schema.from_json(other),
            )
        return None

    def reach_control(self, node: NodeRecord) -> Reach:
        """Return where the control socket of a node is.

        Raises:
            ConnectionError: It cannot be reached from here, or has none.
        """
        place = reach(node, self._host, self._keys, insecure=self._insecure)
        if place is None or not place.endpoint.control:
            raise ConnectionError(f"node {node.name!r} cannot be {'asked' if place else 'reached from here'}")
        return place
