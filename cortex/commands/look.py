"""`cortex topics`, `nodes`, `top` and `info`: who is there, and what they have counted."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator

import numpy as np

from cortex.commands.session import CommandError, hint, look_around, say_empty
from cortex.commands.text import bytes_of, entries, is_terminal, number_of, plain, rate, seconds, table
from cortex.node import Node
from cortex.overview import TopicInfo
from cortex.records import NodeRecord, PublisherStats, StatsReply, SubscriberStats
from cortex.schema import Schema, SchemaError, describe
from cortex.stats import quantile_ns
from cortex.topic import check_topic

_STATS_S = 0.5
_ASKED_AT_ONCE = 16
_PERIOD_S = 1.0
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
    several = _with_several_types(topics)
    rows = [
        (
            info.topic,
            _type(info.type_name, info.fingerprint, told=info.topic in several),
            _names(info.publishers),
            _names(info.subscribers),
        )
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
        where = f"{place} ({', '.join(reach)})" if record.host == own.host else place
        rows.append((plain(record.name), str(record.pid), *map(str, counts), plain(where)))
    head = ("node", "process", "publishers", "subscribers", "services", "<where")
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
        if options.once:  # rates take two looks
            before = _Counts(node, topic)
            if before.publishers or before.subscribers:
                time.sleep(_PERIOD_S)
        while True:
            infos = [info for info in node.topics() if info.topic == topic]
            if not infos and (before is None or options.once):
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
            time.sleep(_PERIOD_S)


def show_top(options: argparse.Namespace) -> int:
    """`cortex top`."""
    node = look_around(options)
    if node is None:
        return 0
    with node:
        before = _Counts(node)
        while True:
            time.sleep(_PERIOD_S)
            counts = _Counts(node)
            live = not options.once and is_terminal()
            print((_CLEAR if live else "") + "\n".join(_top_lines(counts, before)), flush=True)
            if options.once:
                return 0
            before = counts


def _top_lines(counts: _Counts, before: _Counts) -> Iterator[str]:
    elapsed_s = counts.at_s - before.at_s
    earlier = {stats.source: stats for _, stats in before.publishers}
    last = {(record.node, index): stats for record, index, stats in before.subscribers}
    by_topic: dict[str, dict[str, int]] = {}
    delays: dict[str, np.ndarray] = {}
    losses = ("lost", "overtaken", "rejected", "cut_off", "timeouts")
    names = ("publishers", "published", "bytes", "subscribers", *losses)

    def add(topic: str, **values: int) -> None:
        row = by_topic.setdefault(topic, dict.fromkeys(names, 0))
        for name, value in values.items():
            row[name] += value

    for _, pub in counts.publishers:
        was = earlier.get(pub.source)
        published, size = (pub.published - was.published, pub.bytes - was.bytes) if was else (0, 0)
        add(pub.topic, publishers=1, published=published, bytes=size, timeouts=pub.timeouts)
    for record, index, sub in counts.subscribers:
        add(sub.topic, subscribers=1, **{name: getattr(sub, name) for name in losses[:-1]})
        old = last.get((record.node, index))
        if old is not None and old.topic == sub.topic:
            delays[sub.topic] = delays.get(sub.topic, 0) + (sub.latency_counts - old.latency_counts)
    rows = []
    for topic, row in sorted(by_topic.items()):
        latency = delays[topic].tolist() if topic in delays else [0]
        rows.append(
            (
                plain(topic),
                str(row["publishers"]),
                rate(row["published"] / elapsed_s),
                f"{bytes_of(row['bytes'] / elapsed_s)}/s",
                str(row["subscribers"]),
                *(f"{row[name]:,}" for name in losses),
                seconds(quantile_ns(latency, 0.5) * 1e-9),
                seconds(quantile_ns(latency, 0.99) * 1e-9),
            )
        )
    lost = [name.replace("_", " ") for name in losses]
    head = ("topic", "publishers", "rate", "bandwidth", "subscribers", *lost, "delay p50", "p99")
    yield from table(head, rows) if rows else ("nothing is published or subscribed",)
    for name in counts.silent:
        yield f"node {plain(name)} did not answer"


class _Counts:
    """What the nodes of a topic, or of all, have counted at one moment."""

    def __init__(self, node: Node, topic: str | None = None) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self.at_s = time.monotonic()
        self.silent: list[str] = []
        self.publishers: list[tuple[NodeRecord, PublisherStats]] = []
        self.subscribers: list[tuple[NodeRecord, int, SubscriberStats]] = []
        others = [record for record in node.nodes() if record.node != node.id]
        concerned = [record for record in others if topic is None or _is_on(record, topic)]
        with ThreadPoolExecutor(_ASKED_AT_ONCE) as pool:
            replies = list(pool.map(lambda record: _ask(node, record), concerned))
        for record, reply in zip(concerned, replies, strict=True):
            if reply is None:
                self.silent.append(record.name)
                continue
            every = topic is None
            self.publishers += [
                (record, stats) for stats in reply.publishers if every or stats.topic == topic
            ]
            own = [stats for stats in reply.subscribers if every or stats.topic == topic]
            self.subscribers += [(record, index, stats) for index, stats in enumerate(own)]


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
    told = topic in _with_several_types(infos)
    yield from _publisher_table(counts, before, told)
    yield ""
    yield from _subscriber_table(counts, before, told)
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


def _publisher_table(counts: _Counts, before: _Counts | None, told: bool) -> Iterator[str]:
    last = {stats.source: stats for _, stats in before.publishers} if before is not None else {}
    elapsed_s = counts.at_s - before.at_s if before is not None else math.nan
    rows = []
    for record, stats in counts.publishers:
        facts = [plain(record.name)]
        for publisher in record.publishers:
            if publisher.source == stats.source:
                facts += [_type(publisher.type_name, publisher.fingerprint, told=True)] if told else []
                facts += ["latched"] if publisher.latch else []
        earlier = last.get(stats.source)
        cells = (
            f"{stats.published:,}",
            rate((stats.published - earlier.published) / elapsed_s if earlier else math.nan),
            f"{bytes_of((stats.bytes - earlier.bytes) / elapsed_s)}/s" if earlier else "-",
            str(stats.subscribers),
            f"{stats.timeouts:,}",
            f"{stats.skipped:,}",
        )
        rows.append(("  ".join(facts), cells))
    head = ("published", "rate", "bandwidth", "subscribers", "timeouts", "skipped")
    yield from entries("publishers", head, rows) if rows else ("no publisher",)


def _subscriber_table(counts: _Counts, before: _Counts | None, told: bool) -> Iterator[str]:
    last = {(record.node, index): stats for record, index, stats in before.subscribers} if before else {}
    elapsed_s = counts.at_s - before.at_s if before is not None else math.nan
    rows = []
    for record, index, stats in counts.subscribers:
        facts = [plain(record.name)]
        # A node counts its subscribers in the order in which it announces them.
        announced = [subscriber for subscriber in record.subscribers if subscriber.topic == stats.topic]
        if told and index < len(announced):
            facts.append(_type(announced[index].type_name, announced[index].fingerprint, told=True))
        facts.append(plain(stats.policy))
        earlier = last.get((record.node, index))
        latency = stats.latency_counts.tolist()
        cells = (
            f"{stats.received:,}",
            rate((stats.received - earlier.received) / elapsed_s if earlier else math.nan),
            f"{stats.lost:,}",
            f"{stats.overtaken:,}",
            f"{stats.rejected:,}",
            f"{stats.cut_off:,}",
            seconds(quantile_ns(latency, 0.5) * 1e-9),
            seconds(quantile_ns(latency, 0.99) * 1e-9),
        )
        rows.append(("  ".join(facts), cells))
    head = ("received", "rate", "lost", "overtaken", "rejected", "cut off", "delay p50", "p99")
    yield from entries("subscribers", head, rows) if rows else ("no subscriber",)


def _with_several_types(infos: list[TopicInfo]) -> set[str]:
    """The topics that have several types; subscribers of any type have none."""
    types: dict[str, set[int]] = {}
    for info in infos:
        if info.fingerprint:
            types.setdefault(info.topic, set()).add(info.fingerprint)
    return {topic for topic, fingerprints in types.items() if len(fingerprints) > 1}


def _type(name: str, fingerprint: int, *, told: bool) -> str:
    """The name of a type, with the first digits of its fingerprint where it must be told from others."""
    if not fingerprint:
        return "any"
    return f"{plain(name)} {fingerprint:016x}"[: len(plain(name)) + 9] if told else plain(name)


def _names(names: tuple[str, ...]) -> str:
    return ", ".join(
        plain(name) + (f" ({names.count(name)})" if names.count(name) > 1 else "")
        for name in sorted(set(names))
    )


def _say_idle(options: argparse.Namespace, node: Node) -> None:
    others = [record for record in node.nodes() if record.node != node.id]
    if others:
        running = f"{number_of(len(others), 'node')} {'is' if len(others) == 1 else 'are'} running"
        hint(f"{running}, but none publishes or subscribes (`cortex nodes` lists them)")
    else:
        say_empty(options)
