"""Ways to receive: blocking, in batches, raw, by iterator, by callback, by asyncio; and what ends them."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import signal
import sys
import threading
import time

import numpy as np
import pytest
import zmq
from c_module import needs_native
from peer import Number, OtherNumber, Scan, connect
from processes import SOON_S, Beside, in_time, wait_for

from cortex import keep_last, receive_lock, reliable
from cortex.codec import RawMessage, codec_of
from cortex.publisher import Closed
from cortex.schema import TypeMismatch, schema_of

LARGE = 100_000


def scan(number, size=LARGE):
    return Scan(number, np.full(size, number, np.float32))


def test_nothing_comes_in_time(numbers):
    _, subscriber = numbers

    def receive():
        begin = time.monotonic()
        with pytest.raises(TimeoutError, match=r"/numbers: no message within 0\.05 s"):
            subscriber.recv(0.05)
        assert time.monotonic() - begin >= 0.05

    in_time(receive, 1.0)
    with pytest.raises(TimeoutError):
        subscriber.recv(0.0)


def test_an_answer_is_looked_for_without_sleeping(numbers, monkeypatch):
    publisher, subscriber = numbers
    with pytest.raises(TimeoutError):
        subscriber.recv(0.0)  # nothing is left of the beginning
    looks = []

    def give_up_core():
        looks.append(len(looks))
        if len(looks) == 3:
            publisher.publish(Number(0, 1))

    monkeypatch.setattr("cortex.subscriber.os.sched_yield", give_up_core)
    deadline_s = time.monotonic() + SOON_S
    while len(looks) < 3:  # it may find that something else has come
        subscriber.look_out(SOON_S)
        assert time.monotonic() < deadline_s
    assert subscriber.recv(SOON_S).value == 1


@pytest.mark.alone
@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers that send signals")
def test_a_handler_that_uses_the_subscriber_it_has_interrupted_is_told_so(numbers, monkeypatch):
    """It would wait for a lock that its own thread holds."""
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("only the main thread handles signals")
    publisher, subscriber = numbers
    monkeypatch.setattr(receive_lock, "PATIENCE_S", 0.05)
    before = signal.signal(signal.SIGALRM, lambda *_: subscriber.publisher_count)
    signal.setitimer(signal.ITIMER_REAL, 0.2, 0.2)  # again where it came between two waits
    try:
        with pytest.raises(RuntimeError, match="a signal handler cannot use a subscriber that it has interr"):
            subscriber.recv(SOON_S)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    publisher.publish(Number(0, 7))
    assert subscriber.recv(SOON_S) == Number(0, 7)


def test_an_exception_of_a_handler_where_the_lock_changes_hands_blocks_nobody(numbers, monkeypatch):
    """As Ctrl-C may come between the end of a block and the release of its lock."""
    publisher, subscriber = numbers
    monkeypatch.setattr(receive_lock, "PATIENCE_S", 0.05)

    def interrupt(frame, event, argument):
        if frame.f_code is receive_lock.ReceiveLock.__exit__.__code__:
            sys.settrace(None)
            raise KeyboardInterrupt

    sys.settrace(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            _ = subscriber.carriers
    finally:
        sys.settrace(None)
    publisher.publish(Number(0, 7))
    with Beside(lambda: (subscriber.carriers, subscriber.recv(SOON_S), subscriber.close())) as using:
        pass
    assert using.results[0][1] == Number(0, 7)


def test_a_message_wakes_who_waits(numbers):
    """It does not wait for the next look: a tenth of a second would be that."""
    publisher, subscriber = numbers

    def delay_ns():
        with Beside(lambda: (subscriber.recv(SOON_S).stamp_ns, time.monotonic_ns())) as receiving:
            time.sleep(2e-3)  # so that it waits, most likely
            publisher.publish(Number(time.monotonic_ns(), 0))
        ((sent_ns, received_ns),) = receiving.results
        return received_ns - sent_ns

    wait_for(lambda: max(delay_ns() for _ in range(10)) < 0.02e9)  # the machine may be busy for a while


def test_what_is_known_of_a_message(node, numbers):
    publisher, subscriber = numbers
    before_ns = time.monotonic_ns()
    for k in range(3):
        publisher.publish(Number(1000 + k, k))
    for k in range(3):
        message, info = subscriber.recv_with_info(SOON_S)
        assert message == Number(1000 + k, k)
        known = (info.topic, info.source, info.sequence, info.stamp_ns)
        assert known == ("/numbers", publisher.source, k, 1000 + k)
        assert before_ns <= info.publish_ns <= time.monotonic_ns()
        assert 0 < info.latency_ns < 1e9 * SOON_S
        assert info.size == codec_of(Number).fixed_size


@needs_native
def test_arrays_cannot_be_written(node):
    publisher, subscriber = connect(node, "/scans", Scan)
    for size in (10, LARGE):
        publisher.publish(scan(1, size))
        ranges = subscriber.recv(SOON_S).ranges
        with pytest.raises(ValueError, match="read-only"):
            ranges[0] = 1.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            ranges.flags.writeable = True


def test_several_threads_share_a_stream(numbers):
    """Each message goes to one of them, and each ends when the stream is closed."""
    publisher, subscriber = numbers
    threads = [Beside(lambda: [message.value for message in subscriber]) for _ in range(4)]
    for value in range(2000):
        assert publisher.publish(Number(0, value))
    wait_for(lambda: subscriber.counters.received == 2000)
    subscriber.close()
    taken = [values for thread in threads for values in thread.join()]
    assert sorted(itertools.chain.from_iterable(taken)) == list(range(2000))
    assert all(values == sorted(values) for values in taken)


@pytest.mark.parametrize("size", [3, LARGE])
def test_raw_bodies(node, size):
    """What echo and record read, bytes and schema; play publishes them as they are."""
    codec = codec_of(Scan)
    publisher, again = node.publisher("/scans", Scan), node.raw_publisher("/again", codec.schema)
    subscriber, typed = node.subscriber("/scans", None), node.subscriber("/again", Scan)
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert again.wait_for_subscribers(timeout_s=SOON_S)
    publisher.publish(scan(5, size))
    info, body, schema = subscriber.recv_raw(SOON_S)
    assert schema == codec.schema
    assert (info.sequence, info.stamp_ns, info.size) == (0, 5, len(body))
    assert codec.decode(bytes(body)) == scan(5, size)
    again.publish(RawMessage(bytes(body), 6))
    message, info = typed.recv_with_info(SOON_S)
    assert (message, info.stamp_ns) == (scan(5, size), 6)


def test_any_type_is_understood(node):
    """A subscriber without a type takes each publisher's own."""
    subscriber = node.subscriber("/mixed", None)
    first, second = node.publisher("/mixed", Number), node.publisher("/mixed", Scan)
    assert first.wait_for_subscribers(timeout_s=SOON_S)
    assert second.wait_for_subscribers(timeout_s=SOON_S)
    first.publish(Number(1, 2))
    got = subscriber.recv(SOON_S)
    assert (type(got).__name__, got.stamp_ns, got.value) == ("Number", 1, 2)
    for size in (4, LARGE):
        second.publish(scan(3, size))
        got = subscriber.recv(SOON_S)
        assert (type(got).__name__, got.stamp_ns) == ("Scan", 3)
        np.testing.assert_array_equal(got.ranges, scan(3, size).ranges)


def test_another_type_is_told_once_with_both_structures(node):
    """Whoever waits is told; then the messages of others come."""
    node.publisher("/numbers", OtherNumber)
    subscriber = node.subscriber("/numbers", Number)
    messages = iter(subscriber)
    with pytest.raises(TypeMismatch) as caught:
        next(messages)
    text = str(caught.value)
    assert all(word in text for word in ("/numbers", "expected", "actual"))
    assert text.index("int64") < text.index("float64")
    assert (caught.value.expected, caught.value.actual) == (schema_of(Number), schema_of(OtherNumber))
    assert subscriber.counters.rejected == 1
    with pytest.raises(TimeoutError, match="because of its type") as timeout:
        subscriber.recv(0.05)
    assert timeout.value.__cause__ is caught.value
    right = node.publisher("/numbers", Number)
    assert right.wait_for_subscribers(timeout_s=SOON_S)
    with pytest.raises(TimeoutError) as timeout:
        subscriber.recv(0.05)
    assert timeout.value.__cause__ is None
    right.publish(Number(1, 1))
    assert next(messages) == Number(1, 1)


def test_use_after_close(numbers):
    _, subscriber = numbers
    subscriber.close()
    subscriber.close()
    for call in (
        lambda: subscriber.recv(0.0),
        lambda: subscriber.recv_with_info(0.0),
        lambda: subscriber.recv_raw(0.0),
        lambda: subscriber.wait_for_publisher(0.0),
        lambda: asyncio.run(subscriber.recv_async(0.0)),
    ):
        with pytest.raises(Closed, match="/numbers is closed"):
            call()
    assert list(subscriber) == []
    assert subscriber.publisher_count == 0


def test_many_publishers_of_a_topic(node):
    publishers = [node.publisher("/numbers", Number) for _ in range(5)]
    subscriber = node.subscriber("/numbers", Number, policy=reliable(256, 60.0))
    assert all(publisher.wait_for_subscribers(timeout_s=SOON_S) for publisher in publishers)
    wait_for(lambda: subscriber.wait_for_publisher(SOON_S) and subscriber.publisher_count == 5)
    for value in range(40):
        for number, publisher in enumerate(publishers):
            publisher.publish(Number(number, value))
    streams = {publisher.source: [] for publisher in publishers}
    for _ in range(200):
        message, info = subscriber.recv_with_info(SOON_S)
        streams[info.source].append((message.stamp_ns, message.value, info.sequence))
    for number, publisher in enumerate(publishers):
        assert streams[publisher.source] == [(number, value, value) for value in range(40)]


@pytest.mark.parametrize("how", ["recv", "callback"])
@pytest.mark.parametrize("policy", [reliable(16, 60.0), keep_last(64)], ids=str)
def test_no_publisher_starves_another(node, policy, how):
    """Two that send more than is read: both come through."""
    streams, done = {0: [], 1: []}, threading.Event()

    def take(message):
        streams[message.stamp_ns].append(message.value)
        if min(map(len, streams.values())) > 500:
            done.set()
        time.sleep(100e-6)

    publishers = [node.publisher("/numbers", Number) for _ in range(2)]
    subscriber = node.subscriber("/numbers", Number, take if how == "callback" else None, policy=policy)
    assert all(publisher.wait_for_subscribers(timeout_s=SOON_S) for publisher in publishers)
    wait_for(lambda: subscriber.wait_for_publisher(SOON_S) and subscriber.publisher_count == 2)

    def publish(number):
        for value in itertools.takewhile(lambda _: not done.is_set(), itertools.count()):
            publishers[number].publish(Number(number, value))
            if value % 8 == 7:
                time.sleep(50e-6)  # else it is the threads of this process that starve each other

    threads = [Beside(publish, number) for number in range(2)]
    try:
        if how == "recv":
            wait_for(lambda: take(subscriber.recv(SOON_S)) or done.is_set(), every_s=0.0)
        assert done.wait(SOON_S), {number: len(values) for number, values in streams.items()}
    finally:
        done.set()
        subscriber.close()
        for thread in threads:
            thread.join()
    assert all(values == sorted(values) for values in streams.values())


@pytest.mark.parametrize("how", ["idle", "recv", "recv_async", "callback"])
@pytest.mark.parametrize("policy", [reliable(16, 1.0), keep_last(64)], ids=str)
def test_the_connection_to_a_publisher_that_left_is_closed(node, policy, how, monkeypatch):
    """Whether anybody reads or not: a publisher that comes and goes all day leaves nothing behind."""
    monkeypatch.setattr("cortex.subscriber.LEAVING_NS", 50_000_000)
    callback = (lambda message: None) if how == "callback" else None
    subscriber = node.subscriber("/numbers", Number, callback, policy=policy)
    for round_ in range(3):
        with node.publisher("/numbers", Number) as publisher:
            assert publisher.wait_for_subscribers(timeout_s=SOON_S)
            for value in range(10 if how == "recv" else 0):
                publisher.publish(Number(round_, value))
        if how == "recv":  # what was sent before still comes
            assert [subscriber.recv(SOON_S) for _ in range(10)] == [Number(round_, k) for k in range(10)]

    def closed():
        with contextlib.suppress(TimeoutError):
            if how == "recv":
                subscriber.recv(0.01)
            elif how == "recv_async":
                asyncio.run(subscriber.recv_async(0.01))
        return not subscriber.carriers

    wait_for(closed)
    assert subscriber.counters.lost == 0


@needs_native
def test_a_publisher_that_left_is_let_go_while_another_waits_for_room(node):
    """All that came of it was read; that more of the other is in flight is nothing to it."""
    subscriber = node.subscriber("/numbers", Number, policy=reliable(4, 60.0))
    busy = node.publisher("/numbers", Number)
    assert busy.wait_for_subscribers(timeout_s=SOON_S)
    for value in range(500):
        busy.publish(Number(0, value))
    with node.publisher("/numbers", Number) as brief:
        assert brief.wait_for_subscribers(timeout_s=SOON_S)
        brief.publish(Number(0, -1))
    wait_for(lambda: len(subscriber.sources()) == 1)
    values = []
    while len(subscriber.carriers) > 1:
        values.append(subscriber.recv(SOON_S).value)
        subscriber.dismiss(time.monotonic_ns() + 10**11)
        assert len(values) < 100
    while len(values) < 501:
        values.append(subscriber.recv(SOON_S).value)
    assert sorted(values) == list(range(-1, 500))
    assert subscriber.counters.lost == 0


@pytest.mark.parametrize("how", ["recv", "recv_async"])
def test_a_deadline_holds_while_what_comes_cannot_be_read(numbers, monkeypatch, how):
    """A publisher that only sends what is malformed does not keep a control loop waiting."""
    publisher, subscriber = numbers
    publisher.publish(Number(1, 1))
    assert subscriber.recv(SOON_S) == Number(1, 1)
    (link,) = subscriber._links
    end_s = time.monotonic() + 20.0

    def malformed(_flags: int) -> bytes:
        if time.monotonic() > end_s:
            raise zmq.Again
        return link.message_head + b"\xff" * 48

    monkeypatch.setattr(link, "receive", malformed)
    with pytest.raises(TimeoutError):
        subscriber.recv(0.1) if how == "recv" else asyncio.run(subscriber.recv_async(0.1))
    assert time.monotonic() < end_s
    assert subscriber.counters.rejected > 0


def test_callbacks_are_called_in_order(node):
    received = []
    publisher, subscriber = connect(node, "/numbers", Number, reliable(64, 60.0), received.append)
    for value in range(3000):
        assert publisher.publish(Number(value, value))
    wait_for(lambda: len(received) == 3000)
    assert [message.value for message in received] == list(range(3000))
    assert subscriber.counters.received == 3000
    assert sum(subscriber.counters.latency) >= 3000 / 8


def test_no_callback_after_close(node):
    """When `close` has returned, nothing more is called, and nothing is under way."""
    running, late, closed, started = [], [], threading.Event(), threading.Event()

    def slow(message):
        late.extend([message] if closed.is_set() else [])
        running.append(message)
        started.set()
        time.sleep(0.02)
        running.clear()

    publisher, subscriber = connect(node, "/numbers", Number, callback=slow)
    for value in range(30):
        publisher.publish(Number(value, value))
    assert started.wait(SOON_S)
    subscriber.close()
    assert not running
    closed.set()
    done = threading.Event()
    node.subscriber("/numbers", Number, lambda message: done.set())
    wait_for(lambda: publisher.publish(Number(0, 0)) and done.wait(0.01))
    assert not late


def test_a_callback_closes_its_subscriber(node):
    """It is called no more, although messages were there already."""
    received, subscribers = [], []

    def once(message):
        received.append(message.value)
        subscribers[0].close()

    publisher = node.publisher("/numbers", Number)
    blocker, free = threading.Event(), threading.Event()
    block, _ = connect(node, "/block", Number, callback=lambda _: (blocker.set(), free.wait(SOON_S)))
    subscribers.append(node.subscriber("/numbers", Number, once))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    block.publish(Number(0, 0))
    assert blocker.wait(SOON_S)
    for value in range(10):
        publisher.publish(Number(0, value))
    free.set()
    wait_for(lambda: publisher.subscriber_count == 0)
    assert received == [0]


def test_a_callback_closes_its_node(make_node):
    node = make_node(registry="off")
    closed = threading.Event()

    def close(message):
        node.close()
        closed.set()

    publisher, _ = connect(node, "/numbers", Number, callback=close)
    publisher.publish(Number(0, 0))
    assert closed.wait(SOON_S)
    with pytest.raises(Closed):
        publisher.publish(Number(0, 0))


def test_a_callback_publishes_and_subscribes(node):
    """A pipeline in one node: the callback thread may call whatever other threads may."""
    received = []
    second = node.publisher("/second", Number)
    extra = []

    def forward(message):
        if not extra:
            extra.append(node.subscriber("/second", Number, received.append, policy=reliable()))
        second.publish(Number(message.stamp_ns, message.value + 1))

    first, _ = connect(node, "/first", Number, reliable(), forward)
    first.publish(Number(0, 0))
    assert second.wait_for_subscribers(timeout_s=SOON_S)
    for value in range(1, 100):
        first.publish(Number(0, value))
    wait_for(lambda: received and received[-1].value == 100)


def test_coroutine_functions_are_refused(node):
    """Called, they would give coroutines that nobody awaits: each message would be lost without a word."""

    async def take(message):
        pass

    for call in (
        lambda: node.subscriber("/numbers", Number, take),
        lambda: node.service("/double", Number, Number, take),
        lambda: node.watch("/**", take),
    ):
        with pytest.raises(TypeError, match=r"coroutine function .*take.*, which no loop would run"):
            call()
    assert not node.topics()
