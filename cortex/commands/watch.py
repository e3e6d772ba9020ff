"""`cortex echo` and `hz`: what goes over a topic, and how regularly."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cortex.codec import MalformedMessage, codec_of
from cortex.commands.interrupts import raise_again
from cortex.commands.session import CommandError, WaitingHint, hint, open_node
from cortex.commands.text import bytes_of, message_lines, number_of, rate, seconds, to_plain
from cortex.link import Info
from cortex.node import Node
from cortex.policy import keep_last
from cortex.schema import type_from_schema
from cortex.subscriber import Subscriber

_WAIT_S = 0.1
_PERIOD_NS = 1_000_000_000
_HEAD_EVERY = 20
_QUEUE = 4096
_WIDTHS = (9, 8, 8, 10, 8, 9, 8, 5)
"""Of the columns: 79 in all, with two blanks in between."""


def echo(options: argparse.Namespace) -> int:
    """`cortex echo`."""
    arrays = "none" if options.no_arrays else "full" if options.full else "short"
    with open_node(options) as node, _subscribe(node, options.topic, 64) as subscriber:
        waiting_hint = WaitingHint(node, options.topic)
        shown = 0
        try:
            while options.count is None or shown < options.count:
                raise_again()
                try:
                    info, body, schema = subscriber.recv_raw(_WAIT_S)
                except TimeoutError:
                    waiting_hint.check()
                    continue
                waiting_hint.heard()
                try:
                    message = codec_of(type_from_schema(schema)).decode(body)
                except MalformedMessage as error:
                    hint(f"{info.topic} #{info.sequence} cannot be read: {error}")
                    continue
                shown += 1
                if options.json:
                    _print_json(info, to_plain(schema, message, arrays=not options.no_arrays))
                else:
                    facts = f"#{info.sequence}  {bytes_of(info.size)}  {seconds(info.latency_ns * 1e-9)}"
                    lines = [f"--- {info.topic}  {facts}", *message_lines(schema, message, arrays=arrays)]
                    print("\n".join(lines), flush=True)
        finally:
            missed = subscriber.counters.overtaken + subscriber.counters.lost
            if missed:
                hint(f"{number_of(missed, 'further message')} came faster than they could be shown")
    return 0


def _print_json(info: Info, message: dict[str, Any]) -> None:
    numbers = {name: getattr(info, name) for name in ("sequence", "latency_ns", "size")}
    facts = {"topic": info.topic, "source": f"{info.source:016x}", **numbers, "message": message}
    print(json.dumps(facts, allow_nan=False), flush=True)


def show_rate(options: argparse.Namespace) -> int:
    """`cortex hz`: a line of statistics each second, over the last `--window` seconds."""
    with open_node(options) as node, _subscribe(node, options.topic, _QUEUE) as subscriber:
        waiting_hint = WaitingHint(node, options.topic)
        window: deque[_Second] = deque(maxlen=max(1, round(options.window)))
        for printed, second in enumerate(_by_second(node, subscriber, waiting_hint, by_stamp=options.stamp)):
            window.append(second)
            if printed % _HEAD_EVERY == 0:
                print(_line("rate", "std", "max", "bandwidth", "size", "delay p50", "p99", "lost"))
            print(_statistics(window), flush=True)
            if printed + 1 == options.count:
                break
    return 0


@dataclass
class _Second:
    """What came within one second, after a message that was published at `since_ns`."""

    since_ns: int
    last_ns: int
    periods_s: list[float] = field(default_factory=list)
    """Between messages as they were published, which our own delays do not change."""
    delays_s: list[float] = field(default_factory=list)
    seen: int = 0
    bytes: int = 0
    missed: int = 0
    began_ns: int = field(default_factory=time.monotonic_ns)


def _by_second(
    node: Node, subscriber: Subscriber[Any], waiting_hint: WaitingHint, *, by_stamp: bool
) -> Iterator[_Second]:
    second: _Second | None = None
    before = 0
    last: dict[int, Info] = {}
    while True:
        raise_again()
        left_ns = 1 if second is None else second.began_ns + _PERIOD_NS - time.monotonic_ns()
        if second is not None and left_ns <= 0:
            missed = subscriber.counters.lost + subscriber.counters.overtaken
            second.missed, before = missed - before, missed
            yield second
            second = _Second(second.last_ns, second.last_ns)
            continue
        try:
            info, _, _ = subscriber.recv_raw(_WAIT_S if second is None else min(left_ns * 1e-9, _WAIT_S))
        except TimeoutError:
            waiting_hint.check()
            continue
        waiting_hint.heard()
        if by_stamp and info.stamp_ns is None:
            raise CommandError(f"the messages of {info.topic} have no stamp_ns")
        previous, last[info.source] = last.get(info.source), info
        if second is None:  # the first message begins the first second, and counts for none
            second = _Second(info.publish_ns, info.publish_ns)
            continue
        if previous is not None and previous.sequence + 1 == info.sequence:
            second.periods_s.append((info.publish_ns - previous.publish_ns) * 1e-9)
        age_ns = info.latency_ns if info.stamp_ns is None or not by_stamp else node.now_ns() - info.stamp_ns
        second.delays_s.append(age_ns * 1e-9)
        second.seen += 1
        second.bytes += info.size
        second.last_ns = max(second.last_ns, info.publish_ns)


def _statistics(window: deque[_Second]) -> str:
    seen = sum(second.seen for second in window)
    missed = sum(second.missed for second in window)
    silence_s = (time.monotonic_ns() - window[-1].last_ns) * 1e-9
    if not seen:
        return f"no message for {silence_s:.0f} s"
    # From message to message: the edges of the window would make the rate of a slow topic jump.
    elapsed_s = (window[-1].last_ns - window[0].since_ns) * 1e-9
    if silence_s > 1.0 and silence_s > 3.0 * elapsed_s / seen:
        elapsed_s += silence_s
    # What we did not see was published, too; it is taken to be as large as the rest.
    published_hz = (seen + missed) / elapsed_s if elapsed_s > 0.0 else math.nan
    mean_bytes = sum(second.bytes for second in window) / seen
    periods_s = np.array([each for second in window for each in second.periods_s] or [math.nan])
    delays_s = np.percentile([each for second in window for each in second.delays_s], (50, 99))
    return _line(
        rate(published_hz),
        *(seconds(float(each)) for each in (periods_s.std(), periods_s.max())),
        f"{bytes_of(mean_bytes * published_hz)}/s",
        bytes_of(mean_bytes),
        *(seconds(float(each)) for each in delays_s),
        f"{missed:,}",
    )


def _line(*cells: str) -> str:
    return "  ".join(cell.rjust(width) for cell, width in zip(cells, _WIDTHS, strict=True))


def _subscribe(node: Node, topic: str, depth: int) -> Subscriber[Any]:
    subscriber: Subscriber[Any] = node.subscriber(topic, None, policy=keep_last(depth))
    sys.stdout.flush()
    return subscriber
