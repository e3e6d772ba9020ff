"""Publishing: order, snapshots, latching, loans of small messages, threads, and the end."""

from __future__ import annotations

import logging
import time
from types import SimpleNamespace

import numpy as np
import pytest
import zmq
from peer import Number, Scan, connect
from processes import SOON_S, Beside, wait_for

from cortex import keep_last, message, reliable
from cortex.pub_socket import PubSockets
from cortex.publisher import Closed

LARGE = 100_000


def scan(number, size=3):
    return Scan(number, np.full(size, number, np.float32))


@pytest.mark.parametrize("listened", [False, True])
def test_a_message_of_another_type_is_refused(node, listened):
    publisher = node.publisher("/numbers", Number)
    if listened:
        node.subscriber("/numbers", Number)
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    for wrong in (scan(1), None, {"stamp_ns": 1}, Number):
        with pytest.raises(TypeError, match="/numbers carries Number, got"):
            publisher.publish(wrong)


@pytest.mark.parametrize(
    ("kind", "wrong", "right"),
    [
        (
            Scan,
            [Scan(1, np.zeros(3)), Scan(1, np.zeros(LARGE)), Scan(2**63, np.zeros(LARGE, np.float32))],
            scan,
        ),
        (
            Number,
            [Number(1, "none")],
            lambda number, size=3: Number(number, number),
        ),  # first written in the ring
    ],
)
def test_a_value_that_does_not_fit_takes_no_number(node, kind, wrong, right):
    """The subscriber sees no gap."""
    publisher, subscriber = connect(node, "/topic", kind)
    for number in range(4):
        for each in wrong:
            with pytest.raises((TypeError, ValueError), match=r"ranges|stamp_ns|value"):
                publisher.publish(each)
        assert publisher.publish(right(number, LARGE if number % 2 else 3))
        message, info = subscriber.recv_with_info(SOON_S)
        assert (message.stamp_ns, info.sequence) == (number, number)
    assert subscriber.counters.lost == 0


@pytest.mark.parametrize("topic", ["scan", "/", "/a//b", "/a b", "/ä", "", "/" + 200 * "x", 3])
def test_a_topic_has_a_form(node, topic):
    for make in (node.publisher, node.subscriber):
        with pytest.raises(ValueError, match="a topic or service is named like"):
            make(topic, Number)
    with pytest.raises(ValueError, match="inline_max must not be negative, got -1"):
        node.publisher("/nothing", Number, inline_max=-1)
    assert node.topics() == []


@message
class Nothing:
    pass


@pytest.mark.parametrize("inline_max", [0, 1])
def test_a_message_may_be_empty(node, inline_max):
    publisher, subscriber = connect(node, "/nothing", Nothing, inline_max=inline_max)
    assert publisher.publish(Nothing())
    assert subscriber.recv(SOON_S) == Nothing()


@pytest.mark.parametrize("size", [10, LARGE])
def test_what_was_published_may_be_changed(node, size):
    publisher, subscriber = connect(node, "/scans", Scan)
    ranges = np.ones(size, np.float32)
    publisher.publish(Scan(1, ranges))
    ranges[:] = 2.0
    assert (subscriber.recv(SOON_S).ranges == 1.0).all()
    counters = publisher.counters
    assert counters.published == 1
    assert 4 * size <= counters.bytes < 4 * size + 150


def test_small_and_large_messages_keep_their_order(node):
    publisher, subscriber = connect(node, "/scans", Scan, reliable(8, 60.0))
    sizes = [1, 1, 1, LARGE, 1, LARGE, LARGE, 1, 4096, 4097, 20_000, 1]
    with Beside(lambda: [subscriber.recv_with_info(SOON_S) for _ in range(240)]) as reading:
        for number in range(240):
            assert publisher.publish(scan(number, sizes[number % 12]))
    for number, (got, info) in enumerate(reading.results[0]):
        assert (got, info.sequence) == (scan(number, sizes[number % 12]), number)


@pytest.mark.parametrize("size", [3, LARGE])
@pytest.mark.parametrize("policy", [keep_last(4), reliable(4)], ids=str)
def test_a_late_subscriber_gets_the_last_message(node, size, policy):
    """Once; what follows comes as usual."""
    publisher = node.publisher("/scans", Scan, latch=True)
    for number in range(5):
        publisher.publish(scan(number, size))
    for late in range(3):
        subscriber = node.subscriber("/scans", Scan, policy=policy)
        message, info = subscriber.recv_with_info(SOON_S)
        assert (message.stamp_ns, info.sequence) == (4 + late, 4 + late)
        assert (message.ranges == 4.0 + late).all()
        with pytest.raises(TimeoutError):
            subscriber.recv(0.02)
        publisher.publish(scan(5 + late, size))
        assert subscriber.recv(SOON_S).stamp_ns == 5 + late
        assert subscriber.counters.lost == 0
        subscriber.close()


def test_subscribers_are_counted(node):
    publisher = node.publisher("/numbers", Number)
    subscribers = [node.subscriber("/numbers", Number) for _ in range(3)]
    assert publisher.wait_for_subscribers(3, SOON_S)
    assert publisher.subscriber_count == 3
    for left in (2, 1, 0):
        subscribers.pop().close()
        wait_for(lambda left=left: publisher.subscriber_count == left)


def test_attached_means_that_nothing_is_missed(node):
    """From the moment that `wait_for_subscribers` returns, every message comes."""
    for round_ in range(20):
        publisher = node.publisher(f"/round{round_}", Number)
        subscriber = node.subscriber(f"/round{round_}", Number)
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        for value in range(3):
            publisher.publish(Number(0, value))
        assert [subscriber.recv(SOON_S).value for _ in range(3)] == [0, 1, 2]


@pytest.mark.parametrize("options", [{}, {"latch": True}])
def test_use_after_close(node, options):
    publisher, subscriber = connect(node, "/scans", Scan, **options)
    publisher.publish(scan(0))
    publisher.close()
    publisher.close()
    for size in (1, LARGE):
        with pytest.raises(Closed, match="the publisher of /scans is closed"):
            publisher.publish(scan(1, size))
        with pytest.raises(Closed, match="the publisher of /scans is closed"), publisher.loan(n=size):
            pass
    with pytest.raises(Closed):
        publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert subscriber.recv(SOON_S).stamp_ns == 0
    with pytest.raises(TimeoutError):
        subscriber.recv(0.02)
    assert publisher.counters.published == 1


def test_closing_while_another_thread_is_held_up(node):
    """It gets out with `Closed`, not when the reader's time is over."""
    publisher, _ = connect(node, "/numbers", Number, reliable(1, 4 * SOON_S))

    def publish():
        while True:
            publisher.publish(Number(0, 0))

    def ends():
        with pytest.raises(Closed, match="the publisher of /numbers is closed"):
            publish()
        return True

    threads = [Beside(ends), Beside(ends)]
    published = -1
    while published != (published := publisher.counters.published) or published < 100:
        time.sleep(0.05)
    publisher.close()
    assert [thread.join() for thread in threads] == [[True], [True]]


def test_a_reader_that_leaves_lets_the_publisher_go_on(node):
    publisher, subscriber = connect(node, "/numbers", Number, reliable(1, 4 * SOON_S), max_wait_s=4 * SOON_S)
    with Beside(lambda: all(publisher.publish(Number(0, value)) for value in range(40_000))) as publishing:
        publishing.thread.join(0.1)
        assert publishing.thread.is_alive()
        subscriber.close()
    assert publishing.results == [True]


def test_a_flood_of_subscriptions_holds_up_nobody():
    """A peer sends more of them than can be read."""
    flood = SimpleNamespace(get=lambda option: zmq.POLLIN, recv=lambda flags: b"\1" + bytes(32))
    pub_sockets = PubSockets()
    pub_sockets.add(SimpleNamespace(socket=flood, listener=None))
    Beside(pub_sockets.tick).join()


def test_a_log_that_travels_over_cortex(node):
    """A handler that publishes what is logged may run while a publisher has something to say."""
    log = node.publisher("/log", Number)
    slow, _ = connect(node, "/numbers", Number, reliable(1, 0.01))

    class Handler(logging.Handler):
        def emit(self, record):
            said.append(record.getMessage())
            log.publish(Number(0, len(said)))

    said: list[str] = []
    handler = Handler()
    logging.getLogger("cortex").addHandler(handler)
    try:
        number = 0
        while slow.publish(Number(0, number)):
            number += 1
        wait_for(lambda: any("too late" in text for text in said))
    finally:
        logging.getLogger("cortex").removeHandler(handler)


def test_the_first_message_is_checked_without_subscribers(node):
    """Later ones cost nothing where nobody listens."""
    publisher = node.publisher("/numbers", Number)
    with pytest.raises(TypeError, match=r"Number\.value"):
        publisher.publish(Number(0, "one"))
    assert publisher.counters.published == 0
    assert publisher.publish(Number(0, 1))
    assert publisher.counters.published == 1
