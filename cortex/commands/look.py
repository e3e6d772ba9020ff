"""`cortex topics`, `nodes` and `info`: who is there, and what they have counted."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator

from cortex.commands.session import CommandError, hint, look_around, say_empty
from cortex.commands.text import bytes_of, is_terminal, plain, rate, seconds, table
from cortex.node import Node, TopicInfo
from cortex.records import NodeRecord, PublisherStats, StatsReply, SubscriberStats
from cortex.schema import Schema, SchemaError, describe
from cortex.stats import quantile_ns
from cortex.topic import check_topic

_STATS_S = 0.5
_ASKED_AT_ONCE = 16
_CLEAR = "\x1b[H\x1b[J"


def show_topics(options: argparse.Namespace) -> int:
    """`cortex topics`."""
    node = look_around(options)
    if node is None:
        return 0
    with node:
        topics = node.topics()
    if not topics:
        _say_idle(options, node)
        return 0
    rows = [
        (info.topic, plain(info.type_name) or "any", _names(info.publishers), _names(info.subscribers))
        for info in topics
    ]
    for line in table(("topic", "<type", "<publishers", "<subscribers"), rows):
        print(line)
    names = [info.topic for info in topics if info.publishers]
    for topic in sorted({name for name in names if names.count(name) > 1}):
        hint(f"{topic} is published with different types: `cortex info {topic}` shows them")
    return 0


def show_nodes(options: argparse.Namespace) -> int:
    """`cortex nodes`."""
    node = look_around(options)
    if node is None:
        return 0
    with node:
        own = next(record for record in node.nodes() if record.node == node.id)
        others = [record for record in node.nodes() if record.node != node.id]
    if not others:
        say_empty(options)
        return 0
    rows = []
    for record in sorted(others, key=lambda record: (record.name, record.pid)):
        counts = (len(record.publishers), len(record.subscribers), len(record.services))
        reach = sorted({endpoint.transport for endpoint in record.endpoints})
        remote = [endpoint.control for endpoint in record.endpoints if endpoint.transport == "tcp"]
        place = "this host" if record.host == own.host else ", ".join(remote) or "another host"
        rows.append(
            (
                plain(record.name),
                f"{record.node:016x}",
                str(record.pid),
                *map(str, counts),
                plain(place),
                plain(", ".join(reach)),
            )
        )
    head = ("node", "<number", "process", "publishers", "subscribers", "services", "<where", "<transports")
    for line in table(head, rows):
        print(line)
    return 0


def show_info(options: argparse.Namespace) -> int:
    """`cortex info`."""
    topic = check_topic(options.topic)
    node = look_around(options)
    if node is None:
        return 1
    with node:
        before: _Counts | None = None
        live = not options.once
        while True:
            infos = [info for info in node.topics() if info.topic == topic]
            if not infos and before is None:
                others = sorted({info.topic for info in node.topics()})
                raise CommandError(
                    f"there is no topic {topic}; "
                    + (f"there are {', '.join(others)}" if others else "there is none")
                )
            counts = _Counts(node, topic)
            lines = list(_info_lines(topic, infos, counts, before))
            print((_CLEAR if live and is_terminal() else "") + "\n".join(lines), flush=True)
            if not live:
                return 0
            if not is_terminal():
                print()
            before = counts
            time.sleep(1.0)


class _Counts:
    """What the nodes of a topic have counted at one moment."""

    def __init__(self, node: Node, topic: str) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self.at_s = time.monotonic()
        self.silent: list[str] = []
        self.publishers: list[tuple[str, PublisherStats, bool]] = []
        self.subscribers: list[tuple[str, int, SubscriberStats]] = []
        concerned = [record for record in node.nodes() if record.node != node.id and _is_on(record, topic)]
        with ThreadPoolExecutor(_ASKED_AT_ONCE) as pool:
            replies = list(pool.map(lambda record: _ask(node, record), concerned))
        for record, reply in zip(concerned, replies, strict=True):
            if reply is None:
                self.silent.append(record.name)
                continue
            latched = {publisher.source for publisher in record.publishers if publisher.latch}
            self.publishers += [
                (record.name, stats, stats.source in latched)
                for stats in reply.publishers
                if stats.topic == topic
            ]
            own = [stats for stats in reply.subscribers if stats.topic == topic]
            self.subscribers += [(record.name, record.node + index, stats) for index, stats in enumerate(own)]


def _is_on(record: NodeRecord, topic: str) -> bool:
    return any(p.topic == topic for p in record.publishers) or any(
        s.topic == topic for s in record.subscribers
    )


def _ask(node: Node, record: NodeRecord) -> StatsReply | None:
    try:
        return node.ask_stats(record.node, _STATS_S)
    except (TimeoutError, KeyError, ConnectionError):
        return None


def _info_lines(topic: str, infos: list[TopicInfo], counts: _Counts, before: _Counts | None) -> Iterator[str]:
    yield topic
    yield ""
    yield from _publisher_table(counts, before)
    yield ""
    yield from _subscriber_table(counts, before)
    for name in counts.silent:
        yield f"node {plain(name)} did not answer"
    for info in infos:
        yield ""
        if not info.schema:
            yield f"{plain(info.type_name) or 'any type'}: subscribed, not published"
            continue
        try:
            yield describe(Schema.from_json(info.schema))
        except SchemaError as error:
            yield f"{plain(info.type_name)}: unreadable schema: {error}"


def _publisher_table(counts: _Counts, before: _Counts | None) -> Iterator[str]:
    last = {stats.source: stats for _, stats, _ in before.publishers} if before is not None else {}
    elapsed_s = counts.at_s - before.at_s if before is not None else math.nan
    rows = []
    for name, stats, latch in counts.publishers:
        earlier = last.get(stats.source)
        rows.append(
            (
                plain(name),
                f"{stats.published:,}",
                rate((stats.published - earlier.published) / elapsed_s if earlier else math.nan),
                f"{bytes_of((stats.bytes - earlier.bytes) / elapsed_s)}/s" if earlier else "-",
                str(stats.subscribers),
                f"{stats.timeouts:,}",
                f"{stats.skipped:,}",
                "yes" if latch else "no",
            )
        )
    head = ("publisher", "published", "rate", "bandwidth", "subscribers", "timeouts", "skipped", "latch")
    yield from table(head, rows) if rows else ("no publisher",)


def _subscriber_table(counts: _Counts, before: _Counts | None) -> Iterator[str]:
    last = {key: stats for _, key, stats in before.subscribers} if before is not None else {}
    elapsed_s = counts.at_s - before.at_s if before is not None else math.nan
    rows = []
    for name, key, stats in counts.subscribers:
        earlier = last.get(key)
        latency = stats.latency_counts.tolist()
        rows.append(
            (
                plain(name),
                f"{stats.received:,}",
                rate((stats.received - earlier.received) / elapsed_s if earlier else math.nan),
                f"{stats.lost:,}",
                f"{stats.overtaken:,}",
                f"{stats.rejected:,}",
                seconds(quantile_ns(latency, 0.5) * 1e-9),
                seconds(quantile_ns(latency, 0.99) * 1e-9),
                plain(stats.policy),
            )
        )
    head = ("subscriber", "received", "rate", "lost", "overtaken", "rejected", "delay p50", "p99", "<policy")
    yield from table(head, rows) if rows else ("no subscriber",)


def _names(names: tuple[str, ...]) -> str:
    return ", ".join(
        plain(name) + (f" ({names.count(name)})" if names.count(name) > 1 else "")
        for name in sorted(set(names))
    )


def _say_idle(options: argparse.Namespace, node: Node) -> None:
    others = [record for record in node.nodes() if record.node != node.id]
    if others:
        hint(f"{len(others)} nodes are running, but none publishes or subscribes (`cortex nodes` lists them)")
    else:
        say_empty(options)
