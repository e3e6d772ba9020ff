"""Large messages in an unlucky order: rings announced late, replaced, lent, and full.

Descriptors come through a pipe, announcements of rings through a socket, so either may be ahead of the other.
A reliable reader must lose nothing by it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import zmq
from peer import Scan
from processes import SOON_S, wait_for
from test_large import connected, is_shared, scan

from cortex import Publisher, Subscriber, keep_last, reliable
from cortex.wire import ATTACH


@pytest.fixture
def node(make_node):
    return make_node(registry="off")


@contextmanager
def announcements_held(publisher: Publisher[Scan]) -> Iterator[Callable[[], None]]:
    """Keep back what the socket would bring to the only reader; the function sends it."""
    (reader,) = publisher._fanout.readers.values()
    held: list[bytes] = []
    send = reader.outlet.send

    def keep(frame: bytes, *rest: int) -> object:
        if frame[3:4] != ATTACH:
            return send(frame, *rest)
        held.append(frame)
        return None

    def release() -> None:
        assert held, "no ring was announced"
        for frame in held:
            send(frame, zmq.DONTWAIT)

    reader.outlet.send = keep  # type: ignore[assignment]
    try:
        yield release
    finally:
        reader.outlet.send = send


def before_announcements(subscriber: Subscriber[Scan], action: Callable[[], None]) -> list[bytes]:
    """Do something whenever the subscriber, its pipe being empty, has an announcement; return those."""
    (link,) = subscriber._links
    (prefix,) = (head for head in link._handlers if head[3:4] == ATTACH)
    handler = link._handlers[prefix]
    handled: list[bytes] = []

    def handle(frame: bytes):
        action()
        handled.append(frame)
        return handler(frame)

    link._handlers[prefix] = handle
    return handled


def take(subscriber: Subscriber[Scan], *expected: int) -> None:
    """Receive messages with these stamps, in shared memory, and let go of them."""
    for number in expected:
        message = subscriber.recv(SOON_S)
        assert message.stamp_ns == number
        assert (message.ranges == number).all()
        assert is_shared(message)
    counters = subscriber.counters
    assert (counters.lost, counters.rejected, counters.overtaken) == (0, 0, 0)


@pytest.mark.parametrize("policy", [reliable(64, 60.0), keep_last(64)], ids=str)
def test_a_late_announcement_takes_no_lease_back(node, policy):
    """Messages in a newer ring are on their way at the moment when that of an older ring is read."""
    publisher, subscriber = connected(node, Scan, policy)
    with announcements_held(publisher) as release:
        for number, size in enumerate((5_000, 50_000)):  # each makes a ring
            assert publisher.publish(scan(number, size))
        take(subscriber, 0, 1)

        def publish() -> None:
            if not handled:
                for number in (2, 3, 4):
                    assert publisher.publish(scan(number, 50_000))

        handled = before_announcements(subscriber, publish)
        release()
    take(subscriber, 2, 3, 4)
    assert handled
    assert publisher.publish(scan(5, 50_000))
    take(subscriber, 5)


def test_the_announcement_of_a_ring_that_is_gone_means_nothing(node):
    """It was read, given back, replaced and closed before the socket brought the news of it."""
    publisher, subscriber = connected(node, Scan, reliable(64, 60.0))
    with announcements_held(publisher) as release:
        for number, size in enumerate((5_000, 50_000)):
            assert publisher.publish(scan(number, size))
            take(subscriber, number)
        wait_for(lambda: len(publisher._large._rings) == 1)
        handled = before_announcements(subscriber, lambda: None)
        release()
    for number in (2, 3, 4):
        assert publisher.publish(scan(number, 50_000))
        take(subscriber, number)
    wait_for(lambda: handled or not subscriber.wait_for_publisher())


def test_the_ring_of_the_answer_may_be_gone(node):
    """A reader attaches while a ring is replaced: the answer names the old one."""
    publisher, first = connected(node, Scan, reliable(64, 60.0))
    publisher.publish(scan(0, 5_000))
    take(first, 0)
    subscriber = node.subscriber("/large", Scan, policy=reliable(64, 60.0))
    with subscriber._turn.lock:  # it reads nothing yet
        assert publisher.wait_for_subscribers(2, SOON_S)
        publisher.publish(scan(1, 50_000))
        take(first, 1)
        with publisher._outlets.lock:
            publisher._large.prune()  # the node's thread may wait for the subscriber
            assert len(publisher._large._rings) == 1
    take(subscriber, 1)
    publisher.publish(scan(2, 50_000))
    take(subscriber, 2)


@pytest.mark.parametrize("policy", [reliable(64, 60.0), keep_last(64)], ids=str)
def test_a_loan_in_an_older_ring_comes_after_a_newer_one(node, policy):
    """The reader has mapped the older ring and has no message of it when both are on their way."""
    publisher, subscriber = connected(node, Scan, policy)
    publisher.publish(scan(0, 5_000))
    take(subscriber, 0)
    with publisher.loan(n=5_000) as draft:
        draft.stamp_ns = 2
        draft.ranges[:] = 2.0
        publisher.publish(scan(1, 50_000))
    take(subscriber, 1, 2)


def test_rings_wait_for_a_reliable_reader(node):
    """Far more rings than are written at a time, all of them on their way to a reader that sleeps."""
    publisher, subscriber = connected(node, Scan, reliable(64, 60.0))
    sizes = [5_000 * 3**k // 2**k for k in range(12)]
    for number, size in enumerate(sizes):
        assert publisher.publish(scan(number, size))
    with publisher._outlets.lock:
        assert len(publisher._large._rings) > 4
    for number, size in enumerate(sizes):
        message = subscriber.recv(SOON_S)
        assert (message.stamp_ns, len(message.ranges)) == (number, size)
        assert (message.ranges == number).all()
    assert subscriber.counters.lost == subscriber.counters.rejected == 0
    del message
    publisher.publish(scan(99))
    assert is_shared(subscriber.recv(SOON_S))
    wait_for(lambda: len(publisher._large._rings) <= 2)


def test_who_hoards_every_slot_costs_a_reliable_reader_nothing(node):
    """It took them when it was alone; the one that joins gets messages that found no slot."""
    publisher, hoarder = connected(node, Scan, keep_last(255))
    hoard = []
    for number in range(3):  # the ring gets as many slots as it wants
        publisher.publish(scan(number))
        hoard.append(hoarder.recv(SOON_S))
    with publisher._outlets.lock:
        slots = publisher._large._rings[-1].slots
    for number in range(slots):
        publisher.publish(scan(number))
        hoard.append(hoarder.recv(SOON_S))
    subscriber = node.subscriber("/large", Scan, policy=reliable(8, 60.0))
    assert publisher.wait_for_subscribers(2, SOON_S)
    for number in range(100, 110):
        assert publisher.publish(scan(number))
        message = subscriber.recv(SOON_S)
        assert message.stamp_ns == number
        assert (message.ranges == number).all()
        hoard.append(message)
    assert subscriber.counters.lost == 0


class Interrupted(Exception):
    """Raised by a signal, as Ctrl-C raises KeyboardInterrupt."""


def accepted_before(error: type[Exception], publisher: Publisher[Scan]) -> int:
    """Publish until that raises; return how many messages were taken."""
    for count in range(64):
        try:
            publisher.publish(scan(1))
        except error:
            return count
    raise AssertionError("there was always room")


def test_an_interrupted_publish_gives_its_slot_back(node, monkeypatch):
    """A reliable reader has no room, and the wait for it is broken off, again and again."""
    publisher, subscriber = connected(node, Scan, reliable(2, timeout_s=60.0))
    publisher.publish(scan(0))
    wait_for(lambda: is_shared(subscriber.recv(SOON_S)))

    def interrupted(*_: object) -> bool:
        raise Interrupted

    accepted: list[int] = []
    for _ in range(12):  # more often than there are slots
        with monkeypatch.context() as patched:
            patched.setattr(publisher._large, "await_strict", interrupted)
            count = accepted_before(Interrupted, publisher)
        accepted.append(count)
        for _ in range(count):
            subscriber.recv(SOON_S)
    assert len(set(accepted)) == 1
    ring = publisher._large._ring
    assert ring is not None
    assert not ring.in_writing
