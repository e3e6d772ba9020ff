"""The messages of the control plane: what nodes tell each other and the registry.

They are ordinary Cortex messages in frames of kind `C`. `registry.py` describes who sends which when.
"""

from __future__ import annotations

import numpy as np

from cortex.codec import MalformedMessage
from cortex.message_types import Array, Int64, UInt32, UInt64, message
from cortex.topic import check_pattern, check_topic


@message(name="cortex/PublisherRecord")
class PublisherRecord:
    """A publisher, as other nodes must know it to subscribe."""

    topic: str
    source: UInt64
    type_name: str
    fingerprint: UInt64
    schema: str
    latch: bool


@message(name="cortex/SubscriberRecord")
class SubscriberRecord:
    """A subscriber, for tools and for publishers that wait for one; fingerprint 0 takes any type."""

    topic: str
    type_name: str
    fingerprint: UInt64
    policy: str


@message(name="cortex/ServiceRecord")
class ServiceRecord:
    """A service that a node offers."""

    name: str
    service: UInt64
    request_schema: str
    reply_schema: str


@message(name="cortex/Endpoint")
class Endpoint:
    """The ZeroMQ addresses of a node over one transport ("ipc" or "tcp").

    `lossy` and `strict` are its XPUB sockets, `control` its ROUTER; `server_key` is its CURVE key in Z85, or
    empty.
    """

    transport: str
    lossy: str
    strict: str
    control: str
    server_key: str


@message(name="cortex/NodeRecord")
class NodeRecord:
    """All that others know of a node.

    `revision` grows with every change, so that an old record never replaces a newer one. `clock_offset_ns` is
    CLOCK_REALTIME of the registry's host, as estimated, less CLOCK_MONOTONIC on its own. Nodes with equal
    `host` share memory and unix sockets.
    """

    node: UInt64
    name: str
    host: str
    pid: UInt32
    revision: UInt64
    clock_offset_ns: Int64
    endpoints: list[Endpoint]
    publishers: list[PublisherRecord]
    subscribers: list[SubscriberRecord]
    services: list[ServiceRecord]


@message(name="cortex/Hello")
class Hello:
    """A node presents itself, or its changed record; with `snapshot` it asks for all records."""

    snapshot: bool
    record: NodeRecord


@message(name="cortex/Heartbeat")
class Heartbeat:
    """A node lives, with this revision of its record; `held` is 0."""

    node: UInt64
    revision: UInt64
    held: UInt64


@message(name="cortex/Alive")
class Alive:
    """Answer to a heartbeat.

    `epoch` is the registry's random number, `version` is the last change that it has
    announced, `held` the revision that it holds of the asker's record (0: none).
    """

    epoch: UInt64
    version: UInt64
    held: UInt64


@message(name="cortex/Welcome")
class Welcome:
    """Answer of a registry to `Hello`: the nodes that it knows, and the revisions of their records.

    If a snapshot was asked for, the records follow as `Changed`.
    """

    epoch: UInt64
    version: UInt64
    nodes: list[UInt64]
    revisions: list[UInt64]


@message(name="cortex/Changed")
class Changed:
    """A node is new or has changed. `version` counts the changes that a registry has announced."""

    version: UInt64
    record: NodeRecord


@message(name="cortex/Gone")
class Gone:
    """A node has left or its lease has run out."""

    version: UInt64
    node: UInt64
    reason: str


@message(name="cortex/Refused")
class Refused:
    """A registry does not take a node's record."""

    node: UInt64
    reason: str


@message(name="cortex/Leave")
class Leave:
    """A node closes."""

    node: UInt64


@message(name="cortex/PublisherStats")
class PublisherStats:
    """What one publisher has counted."""

    topic: str
    source: UInt64
    subscribers: UInt32
    published: UInt64
    bytes: UInt64
    timeouts: UInt64
    skipped: UInt64


@message(name="cortex/SubscriberStats")
class SubscriberStats:
    """What one subscriber has counted; `stats.BUCKETS` describes the histogram."""

    topic: str
    policy: str
    received: UInt64
    lost: UInt64
    rejected: UInt64
    overtaken: UInt64
    cut_off: UInt64
    latency_counts: Array[np.uint64, 40]


@message(name="cortex/StatsRequest")
class StatsRequest:
    """Asks a node for its counters; `node` is the asker, 0 for a tool."""

    node: UInt64


@message(name="cortex/StatsReply")
class StatsReply:
    """Counters of all publishers and subscribers of a node, and of the control frames that it rejected."""

    node: UInt64
    publishers: list[PublisherStats]
    subscribers: list[SubscriberStats]
    rejected: UInt64


@message(name="cortex/ServiceError")
class ServiceError:
    """Why a service call failed: `kind` is for programs, `text` for people."""

    kind: str
    text: str


CLOCK_OFFSET_MAX_NS = 2**62
"""146 years: sums with times of CLOCK_MONOTONIC stay within 64 bits."""


def check_record(record: NodeRecord) -> None:
    """Refuse a record that no node of ours would send.

    Raises:
        MalformedMessage: If a number is 0, the clock is far from any real one, or a topic, a service or an
            address is not one.
    """
    if not record.node or not record.revision or any(not p.source for p in record.publishers):
        raise MalformedMessage("a node, its revision and its sources must not be 0")
    if abs(record.clock_offset_ns) >= CLOCK_OFFSET_MAX_NS:
        raise MalformedMessage(f"a clock offset of {record.clock_offset_ns} ns is not one")
    names = [p.topic for p in record.publishers] + [s.name for s in record.services]
    for check, given in (check_topic, names), (check_pattern, [s.topic for s in record.subscribers]):
        for topic in given:
            try:
                check(topic)
            except ValueError as error:
                raise MalformedMessage(f"{topic[:200]!r} is not a topic") from error
    for endpoint in record.endpoints:
        for address in (endpoint.lossy, endpoint.strict, endpoint.control):
            if address and not address.startswith(f"{endpoint.transport}://"):
                raise MalformedMessage(f"{address[:200]!r} is not an address of {endpoint.transport[:20]!r}")
