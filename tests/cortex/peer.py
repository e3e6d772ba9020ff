"""A process with a node, for tests: `python peer.py ROLE ARGUMENTS`, commanded by lines of JSON.

The message types here are those of the tests, too.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import select
import sys
import time
import zlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection
from typing import Any
from unittest import mock

import numpy as np

import cortex
import cortex.link
import cortex.node
from cortex import Array, Node, Policy, UInt32
from cortex.message_types import message


@message
class Number:
    """Of fixed size."""

    stamp_ns: int
    value: int


@message
class Scan:
    stamp_ns: int
    ranges: Array["float32", "n"]


@message
class Block:
    """Says itself whether it is whole."""

    number: int
    check: UInt32
    data: Array["uint8", "n"]


@message(name="Number")
class OtherNumber:
    """Another version of `Number`."""

    stamp_ns: int
    value: float


def make_block(number: int, size: int) -> Block:
    """A block whose content depends on its number."""
    data = np.arange(number, number + size, dtype=np.uint64).astype(np.uint8)
    return Block(number, zlib.crc32(data), data)


def is_whole(block: Block) -> bool:
    """Whether the content of a block is what it was made with."""
    return zlib.crc32(block.data) == block.check


TYPES = {kind.__name__: kind for kind in (Number, Scan, Block, OtherNumber)}


def make(kind: type, number: int, size: int) -> Any:
    """A message of one of the types with a number in it."""
    if kind is Block:
        return make_block(number, size)
    if kind is Scan:
        return Scan(number, np.full(size // 4, number, np.float32))
    return kind(number, number)


def number_of(received: Any) -> int:
    """The number that `make` was given."""
    return received.number if isinstance(received, Block) else received.stamp_ns


def connect(
    node: Node, topic: str, kind: Any, policy: Policy | None = None, callback: Any = None, **options: Any
) -> tuple[Any, Any]:
    """A publisher of a node, and a subscriber of the same node, or of `reader`, that is attached to it."""
    reader = options.pop("reader", node)
    publisher = node.publisher(topic, kind, **options)
    subscriber = reader.subscriber(topic, kind, callback, policy=policy)
    assert publisher.wait_for_subscribers(timeout_s=60.0)
    return publisher, subscriber


def stand_still(subscriber: Any) -> None:
    """Let nobody read for a subscriber from now on but who calls it: the node leaves it alone."""
    subscriber.top_up = subscriber.dismiss = lambda now_ns: None


def go_on(subscriber: Any) -> None:
    """Let the node read for a subscriber again."""
    del subscriber.top_up, subscriber.dismiss


def without_rings() -> AbstractContextManager[Any]:
    """Let readers that attach in the block do so as where the C module is missing: through sockets."""
    return mock.patch.object(cortex.link, "native", None)


def slots_held(publisher: Any) -> int:
    """Slots of shared memory that any reader of a publisher holds."""
    with publisher._pub_sockets.lock:
        return int(publisher._fanout.ring._ring.leased())


def take(subscriber: Any, timeout_s: float = 0.0) -> Any:
    """The next message; None if none comes in time."""
    try:
        return subscriber.recv(timeout_s)
    except TimeoutError:
        return None


def take_all(subscriber: Any) -> list[Any]:
    """The messages that are there now."""
    return list(iter(lambda: take(subscriber), None))


def accounted(counters: Any) -> int:
    """How many messages a subscriber knows of."""
    return counters.received + counters.lost + counters.overtaken


def policy_of(words: list[Any]) -> Policy:
    """A policy from its name and arguments."""
    return getattr(cortex, words[0])(**(words[1] if len(words) > 1 else {}))


def say(**words: Any) -> None:
    sys.stdout.write(json.dumps(words) + "\n")
    sys.stdout.flush()


def asked() -> bool:
    """Whether there is a line to read, or no line will come."""
    return bool(select.select([sys.stdin], [], [], 0.0)[0])


class Peer:
    """Does what it is told, line by line."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.publishers: dict[str, Any] = {}
        self.subscribers: dict[str, Any] = {}
        self.served_count = 0

    def publisher(self, topic: str, type: str, **options: Any) -> dict[str, Any]:
        self.publishers[topic] = self.node.publisher(topic, TYPES[type], **options)
        return {}

    def subscriber(self, topic: str, type: str | None, policy: list[Any]) -> dict[str, Any]:
        kind = None if type is None else TYPES[type]
        self.subscribers[topic] = self.node.subscriber(topic, kind, policy=policy_of(policy))
        return {}

    def await_subscribers(self, topic: str, count: int = 1) -> dict[str, Any]:
        return {"ok": self.publishers[topic].wait_for_subscribers(count, 60.0)}

    def publish(
        self,
        topic: str,
        count: int,
        start: int = 0,
        size: int = 0,
        rate_hz: float = 0.0,
        sizes: list[int] | None = None,
    ) -> dict[str, Any]:
        """Publish numbered messages; says how many were delivered."""
        sizes = sizes or [size]
        publisher = self.publishers[topic]
        delivered, begin_s = 0, time.monotonic()
        for k in range(count):
            if rate_hz:
                while time.monotonic() < begin_s + k / rate_hz:
                    time.sleep(100e-6)
            made = make(publisher.codec.type, start + k, sizes[k % len(sizes)])
            delivered += publisher.publish(made)
        return {"delivered": delivered}

    def leave(
        self, topic: str, count: int, size: int = 0, last_size: int = 0, orderly: bool = True
    ) -> dict[str, Any]:
        """Publish some messages, one of another size if that is given, and end the process at once."""
        publisher = self.publishers[topic]
        for k in range(count):
            publisher.publish(make(publisher.codec.type, k, size))
        if last_size:
            publisher.publish(make(publisher.codec.type, count, last_size))
        if orderly:
            publisher.close()
            self.node.close()
        os._exit(0)

    def receive(self, topic: str, until: int, timeout_s: float = 60.0) -> dict[str, Any]:
        """Receive until a number has come; says what came."""
        subscriber = self.subscribers[topic]
        count, last, ordered, whole = 0, -1, True, True
        first = None
        deadline_s = time.monotonic() + timeout_s
        while last < until:
            if (got := take(subscriber, deadline_s - time.monotonic())) is None:
                break
            number = number_of(got)
            first = number if first is None else first
            ordered &= number > last
            whole &= not isinstance(got, Block) or is_whole(got)
            count, last = count + 1, number
        return {"count": count, "first": first, "last": last, "ordered": ordered, "whole": whole}

    def counters(self, topic: str) -> dict[str, Any]:
        found = (self.subscribers.get(topic) or self.publishers[topic]).counters
        return {name: getattr(found, name) for name in found.__slots__}

    def close(self, topic: str) -> dict[str, Any]:
        (self.subscribers.pop(topic, None) or self.publishers.pop(topic)).close()
        return {}

    def serve(self, name: str) -> dict[str, Any]:
        """Offer a service that doubles a number, after as many milliseconds as its stamp says."""

        def double(request: Number) -> Number:
            self.served_count += 1
            time.sleep(request.stamp_ns * 1e-3)
            return Number(os.getpid(), 2 * request.value)

        self.node.service(name, Number, Number, double)
        return {}

    def served(self) -> dict[str, Any]:
        """How many calls have come."""
        return {"count": self.served_count}

    def nodes(self) -> dict[str, Any]:
        """The names of the nodes that are known, and whether the registry has told of all."""
        names = sorted(record.name for record in self.node.nodes())
        return {"names": names, "connected": self.node.wait_for_registry(0.0)}

    def memory(self) -> dict[str, Any]:
        """See `memory`."""
        return memory()


def memory() -> dict[str, int]:
    """Resident memory now, and what a ring may use is part of it."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return {"bytes": int(file.read().split()[1]) * resource.getpagesize()}


def node_at(name: str, host: str = "", **options: Any) -> Node:
    """A node, of another host if that is named."""
    if host:
        cortex.node.host_id = lambda: host
    return Node(name, **options)


def limit_files(most_bytes: int | None) -> None:
    """Let no file grow larger."""
    if most_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))


def as_peer(name: str = "peer", limit_file_bytes: int | None = None, **options: Any) -> None:
    """Does what it is told until its input ends."""
    limit_files(limit_file_bytes)
    if "keys" in options:
        from pathlib import Path

        from cortex.security import load_keys

        options["keys"] = load_keys(Path(options["keys"]))
    with node_at(name, **options) as node:
        peer = Peer(node)
        say(node=node.id)
        for line in sys.stdin:
            words = json.loads(line)
            say(**getattr(peer, words.pop("do"))(**words))


def as_endless_publisher(
    topic: str, sizes: list[int], rate_hz: float, count_file: str = "", **place: Any
) -> None:
    """Publishes blocks, of these sizes in turn, until its input ends; says what was published when asked.

    With a file of 8 bytes it begins once somebody reads, and keeps there how many it has published.
    """
    with node_at("endless publisher", **place) as node, node.publisher(topic, Block) as publisher:
        say(pid=os.getpid())
        blocks = [make_block(0, size) for size in sizes]
        counts = np.memmap(count_file, np.uint64) if count_file else np.zeros(1, np.uint64)
        if count_file:
            publisher.wait_for_subscribers(timeout_s=60.0)
        number = 0
        next_s = time.monotonic()
        while True:
            while asked():
                if not sys.stdin.readline():
                    return
                say(published=number)
            block = blocks[number % len(blocks)]
            publisher.publish(Block(number, block.check, block.data))
            number += 1
            counts[0] = number
            next_s += 1.0 / rate_hz
            time.sleep(max(next_s - time.monotonic(), 0.0))


def as_endless_subscriber(topic: str, policy: list[Any], keep: int = 0, **place: Any) -> None:
    """Receives and checks blocks until its input ends; says what has come when asked."""
    kept: list[Block] = []
    node = node_at("endless subscriber", **place)
    with node, node.subscriber(topic, Block, policy=policy_of(policy)) as sub:
        say(pid=os.getpid())
        torn = count = 0
        while True:
            while asked():
                if not sys.stdin.readline():
                    return
                torn += sum(not is_whole(block) for block in kept)
                lost, overtaken = sub.counters.lost, sub.counters.overtaken
                say(count=count, torn=torn, lost=lost, overtaken=overtaken, rejected=sub.counters.rejected)
            if (block := take(sub, 0.02)) is not None:
                count += 1
                torn += not is_whole(block)
                kept.append(block)
                del kept[: len(kept) - keep]


def as_recorder(path: str, limit_file_bytes: int | None = None) -> None:
    """Publishes numbers and records them, until that fails; says now and then how many there were."""
    from cortex.log import Recorder

    limit_files(limit_file_bytes)
    with Node("recorder", registry="off") as node, node.publisher("/number", Number) as publisher:
        recorder = Recorder(node, path)
        publisher.wait_for_subscribers(timeout_s=60.0)
        for number in itertools.takewhile(lambda _: recorder.running, itertools.count()):
            publisher.publish(Number(time.monotonic_ns(), number))
            if number % 10 == 9:
                say(count=number + 1)
                time.sleep(1e-3)
        try:
            recorder.close()
        except OSError as error:
            stats = recorder.stats
            say(written=stats.written, unwritten=stats.unwritten, errno=error.errno, error=str(error))


ROLES: dict[str, Callable[..., None]] = {
    "peer": as_peer,
    "endless_publisher": as_endless_publisher,
    "endless_subscriber": as_endless_subscriber,
    "recorder": as_recorder,
}


def forked(role: str, arguments: dict[str, Any], directory: str, *streams: Connection) -> None:
    """In a process that was forked: what `main` does, with these standard streams."""
    os.environ["CORTEX_RUNTIME_DIR"] = directory
    for number, stream in enumerate(streams):
        os.dup2(stream.fileno(), number)
        stream.close()
    sys.stdin, sys.stdout, sys.stderr = (os.fdopen(number, mode) for number, mode in enumerate("rww"))
    ROLES[role](**arguments)


def main() -> None:
    ROLES[sys.argv[1]](**json.loads(sys.argv[2]))


if __name__ == "__main__":
    main()
