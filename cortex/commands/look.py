"""`cortex topics`, `nodes`, `top` and `info`: who is there, and what they have counted."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from cortex.commands.interrupts import raise_again
from cortex.commands.session import CommandError, hint, look_around, say_empty
from cortex.commands.text import bytes_of, number_of, plain, rate, seconds, table
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
        if topic not in {info.topic for info in node.topics()}:
            others = sorted({info.topic for info in node.topics()})
            there = f"there are {', '.join(others)}" if others else "there is none"
            raise CommandError(f"there is no topic {topic}; {there}")
        return _show_live(node, options, _info_lines, topic)


def show_top(options: argparse.Namespace) -> int:
    """`cortex top`."""
    node = look_around(options)
    if node is None:
        return 0
    with node:
        return _show_live(node, options, _top_lines)


def _show_live(
    node: Node,
    options: argparse.Namespace,
    lines: Callable[[Node, _Counts], Iterator[str]],
    topic: str | None = None,
) -> int:
    """Print what was counted in each second, again and again unless `--once`."""
    live = not options.once and sys.stdout.isatty()
    counts = _Counts(node, topic)
    while True:
        raise_again()
        time.sleep(_PERIOD_S)
        counts = _Counts(node, topic, counts)
        print((_CLEAR if live else "") + "\n".join(lines(node, counts)), flush=True)
        if options.once:
            return 0
        if not live:
            print()


_Publishers = dict[int, tuple[NodeRecord, PublisherStats, PublisherStats | None]]
_Subscribers = dict[tuple[int, int], tuple[NodeRecord, SubscriberStats, SubscriberStats | None]]
"""By node and number in it: a node counts its subscribers in the order in which it announces them."""


class _Counts:
    """What the nodes of a topic, or of all, have counted at one moment, and at an earlier one."""

    def __init__(self, node: Node, topic: str | None = None, before: _Counts | None = None) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self.topic = topic
        self.silent: list[str] = []
        self.publishers: _Publishers = {}
        self.subscribers: _Subscribers = {}
        self.at_s = time.monotonic()
        self._elapsed_s = self.at_s - before.at_s if before is not None else math.nan
        records = [record for record in node.nodes() if record.node != node.id and _is_on(record, topic)]
        with ThreadPoolExecutor(_ASKED_AT_ONCE) as pool:
            replies = list(pool.map(lambda record: _ask(node, record), records))
        pubs, subs = (before.publishers, before.subscribers) if before is not None else ({}, {})
        for record, reply in zip(records, replies, strict=True):
            if reply is None:
                self.silent.append(record.name)
                continue
            for pub in reply.publishers:
                if topic in (None, pub.topic):
                    was = pubs[pub.source][1] if pub.source in pubs else None
                    self.publishers[pub.source] = record, pub, was
            for key, sub in (((record.node, index), sub) for index, sub in enumerate(reply.subscribers)):
                if topic in (None, sub.topic):
                    had = subs[key][1] if key in subs and subs[key][1].topic == sub.topic else None
                    self.subscribers[key] = record, sub, had

    def per_s(self, name: str, now: Any, before: Any) -> float:
        """How much a count has grown in a second; nan if it is not known."""
        return math.nan if before is None else (getattr(now, name) - getattr(before, name)) / self._elapsed_s

    def silence(self) -> Iterator[str]:
        """Say which nodes have not answered."""
        return (f"node {plain(name)} did not answer" for name in self.silent)


def _is_on(record: NodeRecord, topic: str | None) -> bool:
    topics = {publisher.topic for publisher in record.publishers}
    return topic is None or topic in topics | {subscriber.topic for subscriber in record.subscribers}


def _ask(node: Node, record: NodeRecord) -> StatsReply | None:
    try:
        return node.ask_stats(record.node, _STATS_S)
    except (TimeoutError, KeyError, ConnectionError):
        return None


def _delays(latency_counts: Any) -> Iterator[str]:
    return (seconds(quantile_ns(latency_counts, fraction) * 1e-9) for fraction in (0.5, 0.99))


def _top_lines(node: Node, counts: _Counts) -> Iterator[str]:
    losses = ("lost", "overtaken", "rejected", "cut_off")
    topics = {stats.topic for _, stats, _ in counts.publishers.values()}
    topics |= {stats.topic for _, stats, _ in counts.subscribers.values()}
    rows = []
    for topic in sorted(topics):
        pubs = [each for each in counts.publishers.values() if each[1].topic == topic]
        subs = [each for each in counts.subscribers.values() if each[1].topic == topic]
        sums = [
            float(np.nansum([counts.per_s(name, *each[1:]) for each in pubs]))
            for name in ("published", "bytes")
        ]
        latency = sum((now.latency_counts - old.latency_counts for _, now, old in subs if old), np.zeros(1))
        rows.append(
            (
                plain(topic),
                str(len(pubs)),
                rate(sums[0]),
                f"{bytes_of(sums[1])}/s",
                str(len(subs)),
                *(f"{sum(getattr(stats, name) for _, stats, _ in subs):,}" for name in losses),
                f"{sum(stats.timeouts for _, stats, _ in pubs):,}",
                *_delays(latency),
            )
        )
    lost = [name.replace("_", " ") for name in losses]
    head = ("topic", "publishers", "rate", "bandwidth", "subscribers", *lost, "timeouts", "delay p50", "p99")
    yield from table(head, rows) if rows else ("nothing is published or subscribed",)
    yield from counts.silence()


def _info_lines(node: Node, counts: _Counts) -> Iterator[str]:
    infos = [info for info in node.topics() if info.topic == counts.topic]
    told = bool(_with_several_types(infos))
    yield from (str(counts.topic), "")
    yield from _publisher_table(counts, told)
    yield ""
    yield from _subscriber_table(counts, told)
    yield from counts.silence()
    for info in infos:
        yield ""
        if not info.schema:
            yield f"{plain(info.type_name) or 'any type'}: subscribed, not published"
            continue
        try:
            yield describe(Schema.from_json(info.schema))
        except SchemaError as error:
            yield f"{plain(info.type_name)}: unreadable schema: {error}"


def _publisher_table(counts: _Counts, told: bool) -> Iterator[str]:
    rows = []
    for record, stats, before in counts.publishers.values():
        facts = [plain(record.name)]
        for publisher in record.publishers:
            if publisher.source == stats.source:
                facts += [_type(publisher.type_name, publisher.fingerprint, told=True)] if told else []
                facts += ["latched"] if publisher.latch else []
        bandwidth = f"{bytes_of(counts.per_s('bytes', stats, before))}/s" if before else "-"
        rates = (rate(counts.per_s("published", stats, before)), bandwidth)
        numbers = (stats.subscribers, stats.timeouts, stats.skipped)
        rows.append(("  ".join(facts), f"{stats.published:,}", *rates, *(f"{each:,}" for each in numbers)))
    head = ("publishers", "published", "rate", "bandwidth", "subscribers", "timeouts", "skipped")
    yield from table(head, rows, folded=True) if rows else ("no publisher",)


def _subscriber_table(counts: _Counts, told: bool) -> Iterator[str]:
    rows = []
    for (_, index), (record, stats, before) in counts.subscribers.items():
        facts = [plain(record.name)]
        announced = record.subscribers[index : index + 1]
        if told and announced and announced[0].topic == stats.topic:
            facts.append(_type(announced[0].type_name, announced[0].fingerprint, told=True))
        facts.append(plain(stats.policy))
        losses = (stats.lost, stats.overtaken, stats.rejected, stats.cut_off)
        cells = (rate(counts.per_s("received", stats, before)), *(f"{each:,}" for each in losses))
        delays = _delays(stats.latency_counts.tolist())
        rows.append(("  ".join(facts), f"{stats.received:,}", *cells, *delays))
    losses_head = ("lost", "overtaken", "rejected", "cut off")
    head = ("subscribers", "received", "rate", *losses_head, "delay p50", "p99")
    yield from table(head, rows, folded=True) if rows else ("no subscriber",)


def _with_several_types(infos: list[TopicInfo]) -> set[str]:
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
