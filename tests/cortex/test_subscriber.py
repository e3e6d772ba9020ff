"""Ways to receive: blocking, in batches, raw, by iterator, by callback, by asyncio; and what ends them."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import logging
import threading
import time

import numpy as np
import pytest
from peer import Block, Number, OtherNumber, Scan, is_whole, make_block
from processes import wait_for

from cortex import keep_last, latest, reliable
from cortex.codec import codec_of
from cortex.publisher import Closed
from cortex.raw import RawMessage
from cortex.schema import TypeMismatch, schema_of

LARGE = 100_000


@pytest.fixture
def node(make_node):
    return make_node(registry="off")


@pytest.fixture
def numbers(node):
    publisher = node.publisher("/numbers", Number)
    subscriber = node.subscriber("/numbers", Number, policy=reliable(256, 5.0))
    assert publisher.wait_for_subscribers()
    return publisher, subscriber


def scan(number, size=LARGE):
    return Scan(number, np.full(size, number, np.float32))


# Blocking


def test_nothing_comes_in_time(numbers):
    _, subscriber = numbers
    begin = time.monotonic()
    with pytest.raises(TimeoutError, match=r"/numbers: no message within 0\.05 s"):
        subscriber.recv(0.05)
    assert 0.05 <= time.monotonic() - begin < 2.0
    with pytest.raises(TimeoutError):
        subscriber.recv(0.0)


def test_a_message_wakes_who_waits(numbers):
    """It does not wait for the next look: a tenth of a second would be that."""
    publisher, subscriber = numbers
    delays = []
    ready = threading.Event()

    def receive():
        for _ in range(20):
            ready.set()
            sent_ns = subscriber.recv(5.0).stamp_ns
            delays.append(time.monotonic_ns() - sent_ns)

    thread = threading.Thread(target=receive)
    thread.start()
    while thread.is_alive():
        if ready.is_set():
            ready.clear()
            wait_until = time.monotonic() + 2e-3  # so that it sleeps again
            while time.monotonic() < wait_until:
                time.sleep(1e-4)
            publisher.publish(Number(time.monotonic_ns(), 0))
    thread.join()
    assert np.median(delays) < 0.02e9


def test_what_is_known_of_a_message(node, numbers):
    publisher, subscriber = numbers
    before_ns = time.monotonic_ns()
    for k in range(3):
        publisher.publish(Number(1000 + k, k))
    for k in range(3):
        message, info = subscriber.recv_with_info(1.0)
        assert message == Number(1000 + k, k)
        assert (info.topic, info.source, info.sequence, info.stamp_ns) == (
            "/numbers",
            publisher.source,
            k,
            1000 + k,
        )
        assert before_ns <= info.publish_ns <= time.monotonic_ns()
        assert 0 < info.latency_ns < 5e9
        assert info.size == codec_of(Number).fixed_size


def test_a_type_without_a_stamp_has_none(node):
    publisher = node.publisher("/blocks", Block)
    subscriber = node.subscriber("/blocks", Block)
    assert publisher.wait_for_subscribers()
    publisher.publish(make_block(1, 10))
    publisher.publish(make_block(2, LARGE))
    for number in (1, 2):
        message, info = subscriber.recv_with_info(1.0)
        assert (message.number, info.stamp_ns) == (number, None)
        assert is_whole(message)


def test_arrays_cannot_be_written(node):
    publisher = node.publisher("/scans", Scan)
    subscriber = node.subscriber("/scans", Scan)
    assert publisher.wait_for_subscribers()
    for size in (10, LARGE):
        publisher.publish(scan(1, size))
        ranges = subscriber.recv(1.0).ranges
        with pytest.raises(ValueError, match="read-only"):
            ranges[0] = 1.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            ranges.flags.writeable = True


def test_several_threads_share_a_stream(numbers):
    """Each message goes to one of them."""
    publisher, subscriber = numbers
    taken = [[] for _ in range(4)]

    def receive(values):
        while True:
            try:
                values.append(subscriber.recv(10.0).value)
            except Closed:
                return

    threads = [threading.Thread(target=receive, args=(values,)) for values in taken]
    for thread in threads:
        thread.start()
    for value in range(2000):
        assert publisher.publish(Number(0, value))
    wait_for(lambda: sum(map(len, taken)) >= 2000)
    subscriber.close()
    for thread in threads:
        thread.join(5.0)
        assert not thread.is_alive()
    assert sorted(itertools.chain.from_iterable(taken)) == list(range(2000))
    assert all(values == sorted(values) for values in taken)
    assert subscriber.counters.received == 2000


# Batches


@pytest.mark.parametrize("coalesce", [False, True])
def test_a_batch_holds_what_is_there(node, coalesce):
    publisher = node.publisher("/numbers", Number, coalesce=coalesce)
    subscriber = node.subscriber("/numbers", Number, policy=reliable(256, 5.0))
    assert publisher.wait_for_subscribers()
    values, stamps, sizes = [], [], []
    for start in range(0, 1000, 200):
        for value in range(start, start + 200):
            publisher.publish(Number(10 * value, value))
        publisher.flush()
        while len(values) < start + 200:
            batch = subscriber.recv_batch(2.0)
            assert batch.dtype == codec_of(Number).record_dtype
            assert not batch.flags.writeable
            values += batch["value"].tolist()
            stamps += batch["stamp_ns"].tolist()
            sizes.append(len(batch))
    assert values == list(range(1000))
    assert stamps == [10 * value for value in values]
    assert max(sizes) > 10
    assert subscriber.counters.received == 1000
    with pytest.raises(TimeoutError):
        subscriber.recv_batch(0.0)


def test_single_messages_after_batches(node):
    """Who has asked for batches may go on one by one, in order."""
    publisher = node.publisher("/numbers", Number, coalesce=True)
    subscriber = node.subscriber("/numbers", Number, policy=reliable(256, 5.0))
    assert publisher.wait_for_subscribers()
    with pytest.raises(TimeoutError):
        subscriber.recv_batch(0.0)
    for value in range(100):
        publisher.publish(Number(value, value))
    publisher.flush()
    first = subscriber.recv_batch(1.0)["value"].tolist()
    rest = [subscriber.recv_with_info(1.0) for _ in range(100 - len(first))]
    assert first + [message.value for message, _ in rest] == list(range(100))
    assert [info.sequence for _, info in rest] == list(range(len(first), 100))
    assert subscriber.counters.received == 100


@pytest.mark.parametrize("depth", [1, 10])
def test_batches_are_bounded_by_the_policy(node, depth):
    """keep_last counts messages, not frames: of a thousand, the last ones wait."""
    publisher = node.publisher("/numbers", Number, coalesce=True)
    subscriber = node.subscriber("/numbers", Number, policy=keep_last(depth))
    assert publisher.wait_for_subscribers()
    with pytest.raises(TimeoutError):
        subscriber.recv_batch(0.0)
    for value in range(1000):
        publisher.publish(Number(value, value))
    publisher.flush()
    values = []
    while not values or values[-1] < 999:
        values += subscriber.recv_batch(1.0)["value"].tolist()
    assert values == list(range(1000 - depth, 1000))
    counters = subscriber.counters
    assert (counters.received, counters.overtaken) == (depth, 1000 - depth)


def test_a_type_of_varying_size_has_no_batches(node):
    subscriber = node.subscriber("/scans", Scan)
    with pytest.raises(TypeError, match="only a type of fixed size"):
        subscriber.recv_batch(0.0)
    with pytest.raises(TypeError, match="only a type of fixed size"):
        node.subscriber("/scans", None).recv_batch(0.0)


# Raw and generic


@pytest.mark.parametrize("size", [3, LARGE])
def test_raw_bodies(node, size):
    """What echo and record read: bytes and schema, enough to decode."""
    publisher = node.publisher("/scans", Scan)
    subscriber = node.subscriber("/scans", None)
    assert publisher.wait_for_subscribers()
    publisher.publish(scan(5, size))
    info, body, schema = subscriber.recv_raw(1.0)
    assert schema == schema_of(Scan)
    assert (info.sequence, info.stamp_ns, info.size) == (0, 5, len(body))
    assert codec_of(Scan).decode(bytes(body)) == scan(5, size)


def test_raw_bodies_are_published_as_they_are(node):
    """What play does."""
    codec = codec_of(Scan)
    publisher = node.raw_publisher("/scans", codec.schema)
    subscriber = node.subscriber("/scans", Scan)
    assert publisher.wait_for_subscribers()
    for size in (3, LARGE):
        body = codec.encode(scan(6, size), 1 << 30)
        publisher.publish(RawMessage(body, 6))
        message, info = subscriber.recv_with_info(1.0)
        assert message == scan(6, size)
        assert info.stamp_ns == 6


def test_any_type_is_understood(node):
    """A subscriber without a type takes each publisher's own."""
    subscriber = node.subscriber("/mixed", None)
    first, second = node.publisher("/mixed", Number), node.publisher("/mixed", Scan)
    assert first.wait_for_subscribers()
    assert second.wait_for_subscribers()
    first.publish(Number(1, 2))
    got = subscriber.recv(1.0)
    assert (type(got).__name__, got.stamp_ns, got.value) == ("Number", 1, 2)
    for size in (4, LARGE):
        second.publish(scan(3, size))
        got = subscriber.recv(1.0)
        assert (type(got).__name__, got.stamp_ns) == ("Scan", 3)
        np.testing.assert_array_equal(got.ranges, scan(3, size).ranges)


# Another type


def test_another_type_is_told_once_with_both_structures(node):
    node.publisher("/numbers", OtherNumber)
    subscriber = node.subscriber("/numbers", Number)
    with pytest.raises(TypeMismatch) as caught:
        subscriber.recv(2.0)
    text = str(caught.value)
    assert "/numbers" in text
    assert "expected" in text
    assert "actual" in text
    assert text.index("int64") < text.index("float64")
    assert caught.value.expected == schema_of(Number)
    assert caught.value.actual == schema_of(OtherNumber)
    assert subscriber.counters.rejected == 1
    with pytest.raises(TimeoutError):
        subscriber.recv(0.05)
    right = node.publisher("/numbers", Number)
    assert right.wait_for_subscribers()
    right.publish(Number(1, 1))
    assert subscriber.recv(1.0) == Number(1, 1)


def test_a_new_subscriber_is_not_taken_for_a_dead_one(node):
    """One that did not fit is closed, and what comes in its place is not treated as it was."""
    publisher = node.publisher("/numbers", Number)
    for value in range(20):
        wrong = node.subscriber("/numbers", OtherNumber)
        with pytest.raises(TypeMismatch):
            wrong.recv(2.0)
        wrong.close()
        del wrong
        gc.collect()
        right = node.subscriber("/numbers", Number)
        assert publisher.wait_for_subscribers(1, 2.0)
        publisher.publish(Number(0, value))
        assert right.recv(2.0).value == value
        right.close()
        del right
        gc.collect()
        wait_for(lambda: publisher.subscriber_count == 0)


def test_a_callback_hears_of_another_type_in_the_log(node, caplog):
    node.publisher("/numbers", OtherNumber)
    node.subscriber("/numbers", Number, lambda message: None)
    wait_for(lambda: any("float64" in record.getMessage() for record in caplog.records))


# Callbacks


def test_callbacks_are_called_in_order(node):
    received = []
    publisher = node.publisher("/numbers", Number)
    subscriber = node.subscriber("/numbers", Number, received.append, policy=reliable(64, 5.0))
    assert publisher.wait_for_subscribers()
    for value in range(3000):
        assert publisher.publish(Number(value, value))
    wait_for(lambda: len(received) == 3000)
    assert [message.value for message in received] == list(range(3000))
    assert subscriber.counters.received == 3000
    assert sum(subscriber.counters.latency) >= 3000 / 8


def test_a_callback_that_raises_is_logged_and_called_again(node, caplog):
    received = []

    def fail(message):
        received.append(message)
        raise KeyError(message.stamp_ns)

    publisher = node.publisher("/scans", Scan)
    node.subscriber("/scans", Scan, fail)
    assert publisher.wait_for_subscribers()
    for number in range(3):
        publisher.publish(scan(number, 1))
    wait_for(lambda: len(received) == 3)
    wait_for(lambda: sum(r.exc_info is not None and r.levelno == logging.ERROR for r in caplog.records) == 3)


def test_callbacks_of_large_and_small_messages_keep_the_order(node):
    received = []
    publisher = node.publisher("/scans", Scan)
    node.subscriber("/scans", Scan, lambda m: received.append(m.stamp_ns), policy=reliable(8, 5.0))
    assert publisher.wait_for_subscribers()
    for number in range(300):
        assert publisher.publish(scan(number, LARGE if number % 3 == 0 else 5))
    wait_for(lambda: len(received) == 300)
    assert received == list(range(300))


def test_no_callback_after_close(node):
    """When `close` has returned, nothing more is called, and nothing is under way."""
    state = {"running": False, "closed": False, "late": 0}
    started = threading.Event()

    def slow(message):
        state["late"] += state["closed"]
        state["running"] = True
        started.set()
        deadline = time.monotonic() + 0.02
        while time.monotonic() < deadline:
            time.sleep(1e-3)
        state["running"] = False

    publisher = node.publisher("/numbers", Number)
    subscriber = node.subscriber("/numbers", Number, slow)
    assert publisher.wait_for_subscribers()
    for value in range(30):
        publisher.publish(Number(value, value))
    assert started.wait(5.0)
    subscriber.close()
    running, state["closed"] = state["running"], True
    assert not running
    done = threading.Event()
    other = node.subscriber("/numbers", Number, lambda message: done.set())
    assert publisher.wait_for_subscribers(1, 5.0)
    wait_for(lambda: publisher.publish(Number(0, 0)) and done.wait(0.01))
    assert state["late"] == 0
    other.close()


def test_a_callback_closes_its_subscriber(node):
    """It is called no more, although messages were there already."""
    received = []
    subscribers = []

    def once(message):
        received.append(message.value)
        subscribers[0].close()

    publisher = node.publisher("/numbers", Number)
    blocker, free = threading.Event(), threading.Event()
    node.subscriber("/block", Number, lambda message: (blocker.set(), free.wait(5.0)))
    block = node.publisher("/block", Number)
    subscribers.append(node.subscriber("/numbers", Number, once))
    assert publisher.wait_for_subscribers()
    assert block.wait_for_subscribers()
    block.publish(Number(0, 0))
    assert blocker.wait(5.0)
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

    publisher = node.publisher("/numbers", Number)
    node.subscriber("/numbers", Number, close)
    assert publisher.wait_for_subscribers()
    publisher.publish(Number(0, 0))
    assert closed.wait(5.0)
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

    first = node.publisher("/first", Number)
    node.subscriber("/first", Number, forward, policy=reliable())
    assert first.wait_for_subscribers()
    first.publish(Number(0, 0))
    assert second.wait_for_subscribers()
    for value in range(1, 100):
        first.publish(Number(0, value))
    wait_for(lambda: received and received[-1].value == 100)


# Iterators


def test_an_iterator_ends_at_close(numbers):
    publisher, subscriber = numbers
    received = []

    def iterate():
        for message in subscriber:
            received.append(message.value)

    thread = threading.Thread(target=iterate)
    thread.start()
    for value in range(50):
        publisher.publish(Number(0, value))
    wait_for(lambda: len(received) == 50)
    subscriber.close()
    thread.join(2.0)
    assert not thread.is_alive()
    assert received == list(range(50))


def test_closing_wakes_all_who_wait(numbers):
    _, subscriber = numbers
    ended = []

    def wait():
        try:
            subscriber.recv()
        except Closed as error:
            ended.append(str(error))

    threads = [threading.Thread(target=wait) for _ in range(3)]
    for thread in threads:
        thread.start()
    subscriber.close()
    for thread in threads:
        thread.join(2.0)
    assert ended == ["the subscriber of /numbers is closed"] * 3


def test_use_after_close(numbers):
    _, subscriber = numbers
    subscriber.close()
    subscriber.close()
    calls = [
        lambda: subscriber.recv(0.0),
        lambda: subscriber.recv_with_info(0.0),
        lambda: subscriber.recv_raw(0.0),
        lambda: subscriber.recv_batch(0.0),
        lambda: subscriber.wait_for_publisher(0.0),
        lambda: asyncio.run(subscriber.recv_async(0.0)),
    ]
    for call in calls:
        with pytest.raises(Closed, match="/numbers is closed"):
            call()
    assert list(subscriber) == []
    assert subscriber.publisher_count == 0


# asyncio


def test_async_iteration(numbers):
    publisher, subscriber = numbers

    async def collect():
        values = []
        async for message in subscriber:
            values.append(message.value)
            if message.value == 999:
                return values

    def publish():
        for value in range(1000):
            publisher.publish(Number(0, value))

    thread = threading.Thread(target=publish)
    thread.start()
    assert asyncio.run(asyncio.wait_for(collect(), 20.0)) == list(range(1000))
    thread.join()


def test_async_iteration_ends_at_close(numbers):
    _, subscriber = numbers

    async def run():
        async def collect():
            return [message async for message in subscriber]

        task = asyncio.ensure_future(collect())
        await asyncio.sleep(0)
        asyncio.get_running_loop().call_later(0.02, subscriber.close)
        begin = time.monotonic()
        assert await asyncio.wait_for(task, 5.0) == []
        return time.monotonic() - begin

    assert asyncio.run(run()) < 1.0


def test_two_subscribers_on_one_loop(node):
    """Neither starves the other, nor the loop's other tasks."""
    publishers = [node.publisher(f"/stream{k}", Number) for k in range(2)]
    subscribers = [node.subscriber(f"/stream{k}", Number, policy=reliable(64, 10.0)) for k in range(2)]
    assert all(publisher.wait_for_subscribers() for publisher in publishers)

    def publish(publisher):
        for value in range(2000):
            assert publisher.publish(Number(0, value))

    async def collect(subscriber):
        values = []
        while len(values) < 2000:
            values.append((await subscriber.recv_async(10.0)).value)
        return values

    async def run():
        ticks = 0

        async def tick():
            nonlocal ticks
            while True:
                ticks += 1
                await asyncio.sleep(0)

        ticking = asyncio.ensure_future(tick())
        results = await asyncio.gather(*map(collect, subscribers))
        ticking.cancel()
        assert ticks > 10
        return results

    threads = [threading.Thread(target=publish, args=(publisher,)) for publisher in publishers]
    for thread in threads:
        thread.start()
    assert asyncio.run(asyncio.wait_for(run(), 30.0)) == [list(range(2000))] * 2
    for thread in threads:
        thread.join()


def test_two_tasks_on_one_subscriber(numbers):
    """Both wait; each message goes to one, and neither sleeps for ever."""
    publisher, subscriber = numbers

    async def run():
        tasks = [asyncio.ensure_future(subscriber.recv_async(5.0)) for _ in range(3)]
        await asyncio.sleep(0.02)  # all of them wait now
        for value in range(3):
            publisher.publish(Number(0, value))
        return sorted(message.value for message in await asyncio.gather(*tasks))

    assert asyncio.run(asyncio.wait_for(run(), 10.0)) == [0, 1, 2]


def test_a_cancelled_task_takes_nothing_along(numbers):
    publisher, subscriber = numbers

    async def run():
        task = asyncio.ensure_future(subscriber.recv_async())
        await asyncio.sleep(0.01)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        publisher.publish(Number(0, 1))
        begin = time.monotonic()
        assert (await subscriber.recv_async(5.0)).value == 1
        assert time.monotonic() - begin < 1.0
        with pytest.raises(TimeoutError):
            await subscriber.recv_async(0.01)

    asyncio.run(run())


def test_one_loop_after_another(numbers):
    """The second loop finds what the first did not take; then the blocking way works again."""
    publisher, subscriber = numbers
    for value in range(4):
        publisher.publish(Number(0, value))

    async def take():
        first = (await subscriber.recv_async(2.0)).value
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(_until_forever(), 0.01)
        return first

    async def _until_forever():
        await asyncio.get_running_loop().create_future()

    assert [asyncio.run(take()) for _ in range(3)] == [0, 1, 2]
    assert subscriber.recv(1.0).value == 3

    async def wait_in_vain():
        with pytest.raises(TimeoutError):
            await subscriber.recv_async(0.01)

    for _ in range(2):
        asyncio.run(wait_in_vain())
    publisher.publish(Number(0, 4))
    assert subscriber.recv(1.0).value == 4


def test_a_loop_is_woken_at_once(numbers):
    """Waking by the descriptor, not by looking ten times a second."""
    publisher, subscriber = numbers

    async def run():
        loop = asyncio.get_running_loop()
        delays = []
        for _ in range(20):
            loop.call_later(0.003, lambda: publisher.publish(Number(time.monotonic_ns(), 0)))
            sent_ns = (await subscriber.recv_async(5.0)).stamp_ns
            delays.append(time.monotonic_ns() - sent_ns)
        return delays

    assert np.median(asyncio.run(run())) < 0.02e9


def test_a_loop_is_woken_by_a_publisher_that_came_later(node):
    """Also if its descriptor has the number of one that was closed."""
    subscriber = node.subscriber("/numbers", Number, policy=latest())

    async def run():
        delays = []
        for _ in range(3):
            publisher = node.publisher("/numbers", Number)
            while not publisher.wait_for_subscribers(1, 0.0):
                with pytest.raises(TimeoutError):
                    await subscriber.recv_async(0.005)
            for _ in range(5):
                asyncio.get_running_loop().call_later(
                    0.003, lambda p=publisher: p.publish(Number(time.monotonic_ns(), 0))
                )
                sent_ns = (await subscriber.recv_async(5.0)).stamp_ns
                delays.append(time.monotonic_ns() - sent_ns)
            publisher.close()
            for link in list(subscriber._leaving):  # at once, instead of after two seconds
                subscriber._leaving[link] = 0
            while subscriber._links:
                with pytest.raises(TimeoutError):
                    await subscriber.recv_async(0.005)
        return delays

    delays = asyncio.run(run())
    assert max(np.median(delays[k : k + 5]) for k in (0, 5, 10)) < 0.05e9


# Publishers that leave


def test_what_was_sent_before_a_publisher_left_still_comes(node):
    subscriber = node.subscriber("/numbers", Number, policy=reliable(256, 5.0))
    for round_ in range(3):
        with node.publisher("/numbers", Number, coalesce=True) as publisher:
            assert publisher.wait_for_subscribers()
            for value in range(100):
                publisher.publish(Number(round_, value))
        assert [subscriber.recv(2.0).value for _ in range(100)] == list(range(100))
    counters = subscriber.counters
    assert (counters.received, counters.lost) == (300, 0)


def test_many_publishers_of_a_topic(node):
    publishers = [node.publisher("/numbers", Number) for _ in range(5)]
    subscriber = node.subscriber("/numbers", Number, policy=reliable(256, 5.0))
    assert all(publisher.wait_for_subscribers() for publisher in publishers)
    wait_for(lambda: subscriber.wait_for_publisher() and subscriber.publisher_count == 5)
    for value in range(40):
        for number, publisher in enumerate(publishers):
            publisher.publish(Number(number, value))
    streams = {publisher.source: [] for publisher in publishers}
    for _ in range(200):
        message, info = subscriber.recv_with_info(1.0)
        streams[info.source].append((message.stamp_ns, message.value, info.sequence))
    for number, publisher in enumerate(publishers):
        assert streams[publisher.source] == [(number, value, value) for value in range(40)]


@pytest.mark.parametrize("how", ["recv", "recv_batch", "callback"])
@pytest.mark.parametrize("policy", [reliable(16, 10.0), keep_last(64)], ids=str)
def test_no_publisher_starves_another(node, policy, how):
    """Two that send more than is read: both come through."""
    streams = {0: [], 1: []}
    done = threading.Event()

    def take(message):
        streams[message.stamp_ns].append(message.value)
        if min(map(len, streams.values())) > 500:
            done.set()
        time.sleep(100e-6)

    publishers = [node.publisher("/numbers", Number) for _ in range(2)]
    subscriber = node.subscriber("/numbers", Number, take if how == "callback" else None, policy=policy)
    assert all(publisher.wait_for_subscribers() for publisher in publishers)
    wait_for(lambda: subscriber.wait_for_publisher() and subscriber.publisher_count == 2)

    def publish(number):
        value = 0
        while not done.is_set():
            publishers[number].publish(Number(number, value))
            value += 1

    threads = [threading.Thread(target=publish, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + 5.0
    try:
        while not done.is_set() and time.monotonic() < deadline:
            if how == "callback":
                done.wait(0.01)
            elif how == "recv":
                take(subscriber.recv(1.0))
            else:
                for stamp_ns, value in subscriber.recv_batch(1.0).tolist():
                    take(Number(stamp_ns, value))
    finally:
        starved = not done.is_set()
        done.set()
        subscriber.close()
        for thread in threads:
            thread.join()
    assert not starved, {number: len(values) for number, values in streams.items()}
    assert all(values == sorted(values) for values in streams.values())


@pytest.mark.parametrize("how", ["idle", "recv", "recv_async", "callback"])
@pytest.mark.parametrize("policy", [reliable(16, 1.0), keep_last(64)], ids=str)
def test_the_connection_to_a_publisher_that_left_is_closed(node, policy, how, monkeypatch):
    """Whether anybody reads or not: a publisher that comes and goes all day leaves nothing behind."""
    monkeypatch.setattr("cortex.subscriber.LEAVING_NS", 50_000_000)
    callback = (lambda message: None) if how == "callback" else None
    subscriber = node.subscriber("/numbers", Number, callback, policy=policy)
    for _ in range(3):
        with node.publisher("/numbers", Number) as publisher:
            assert publisher.wait_for_subscribers()

    def closed():
        with contextlib.suppress(TimeoutError):
            if how == "recv":
                subscriber.recv(0.01)
            elif how == "recv_async":
                asyncio.run(subscriber.recv_async(0.01))
        return not subscriber.fds()

    wait_for(closed, 3.0)
