"""Receiving with asyncio: iteration, several tasks and loops, cancelling, and being woken in time."""

from __future__ import annotations

import asyncio
import time
from itertools import pairwise

import pytest
from peer import Number
from processes import SOON_S, Beside, wait_for

from cortex import keep_last, latest, reliable
from cortex.fast_receive import PAUSE_COUNT

STREAM = 12 * PAUSE_COUNT


def test_async_iteration_until_close(numbers):
    publisher, subscriber = numbers

    async def collect():
        values = []
        async for message in subscriber:
            values.append(message.value)
            if message.value == 999:
                asyncio.get_running_loop().call_later(0.02, subscriber.close)
        return values

    def publish():
        for value in range(1000):
            publisher.publish(Number(0, value))

    with Beside(publish):
        assert asyncio.run(asyncio.wait_for(collect(), SOON_S)) == list(range(1000))


def test_two_subscribers_on_one_loop(node):
    """Neither starves the other, nor the loop's other tasks."""
    publishers = [node.publisher(f"/stream{k}", Number) for k in range(2)]
    subscribers = [node.subscriber(f"/stream{k}", Number, policy=reliable(64, 60.0)) for k in range(2)]
    assert all(publisher.wait_for_subscribers(timeout_s=SOON_S) for publisher in publishers)

    def publish(publisher):
        for value in range(STREAM):
            assert publisher.publish(Number(0, value))

    async def collect(subscriber):
        values = []
        while len(values) < STREAM:
            values.append((await subscriber.recv_async(SOON_S)).value)
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
        assert ticks > 10  # a turn after `PAUSE_COUNT` messages at the latest
        return results

    with Beside(publish, publishers[0]), Beside(publish, publishers[1]):
        assert asyncio.run(asyncio.wait_for(run(), SOON_S)) == [list(range(STREAM))] * 2


def test_two_tasks_on_one_subscriber(numbers):
    """Both wait; each message goes to one, and neither sleeps for ever."""
    publisher, subscriber = numbers

    async def run():
        tasks = [asyncio.ensure_future(subscriber.recv_async(SOON_S)) for _ in range(3)]
        await asyncio.sleep(0.02)  # all of them wait now
        for value in range(3):
            publisher.publish(Number(0, value))
        return sorted(message.value for message in await asyncio.gather(*tasks))

    assert asyncio.run(asyncio.wait_for(run(), SOON_S)) == [0, 1, 2]


def test_each_task_has_its_own_timeout(numbers):
    """One timer serves all of a loop's tasks: none gives up early, and none waits for another's time."""
    publisher, subscriber = numbers

    async def wait(timeout_s):
        begin_s = time.monotonic()
        with pytest.raises(TimeoutError):
            await subscriber.recv_async(timeout_s)
        return time.monotonic() - begin_s

    async def run():
        endless = asyncio.ensure_future(subscriber.recv_async())
        await asyncio.sleep(0.01)
        waited_s = await asyncio.gather(*map(wait, (0.15, 0.001, 0.05)))
        assert not endless.done()
        publisher.publish(Number(0, 7))
        assert (await endless).value == 7
        return waited_s

    waited_s = asyncio.run(asyncio.wait_for(run(), SOON_S))
    assert all(waited >= asked for waited, asked in zip(waited_s, (0.15, 0.001, 0.05), strict=True))


def test_a_cancelled_task_takes_nothing_along(numbers):
    publisher, subscriber = numbers

    async def run():
        task = asyncio.ensure_future(subscriber.recv_async())
        await asyncio.sleep(0.01)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        publisher.publish(Number(0, 1))
        assert (await subscriber.recv_async(SOON_S)).value == 1
        with pytest.raises(TimeoutError):
            await subscriber.recv_async(0.01)

    asyncio.run(run())


@pytest.mark.alone
def test_a_loop_is_woken_by_a_publisher_that_came_later(node):
    """Also if its descriptor has the number of one that was closed."""
    subscriber = node.subscriber("/numbers", Number, policy=latest())

    async def run():
        slowest_ns = 0
        for _ in range(3):
            publisher = node.publisher("/numbers", Number)
            while not publisher.wait_for_subscribers(1, 0.0):
                with pytest.raises(TimeoutError):
                    await subscriber.recv_async(0.005)
            for _ in range(5):
                asyncio.get_running_loop().call_later(
                    0.003, lambda p=publisher: p.publish(Number(time.monotonic_ns(), 0))
                )
                sent_ns = (await subscriber.recv_async(SOON_S)).stamp_ns
                slowest_ns = max(slowest_ns, time.monotonic_ns() - sent_ns)
            publisher.close()
            while subscriber.carriers:
                subscriber.dismiss(time.monotonic_ns() + 10**11)  # at once, instead of after two seconds
                with pytest.raises(TimeoutError):
                    await subscriber.recv_async(0.005)
        return slowest_ns

    wait_for(lambda: asyncio.run(run()) < 0.05e9)  # the machine may be busy for a while


@pytest.mark.parametrize("where", ["socket", "queue"])
def test_messages_that_wait_are_taken_without_a_switch_of_tasks(numbers, where, monkeypatch):
    """A task that was never suspended cannot have let another one run; here no time is too long for that."""
    monkeypatch.setattr("cortex.loop_reader.PAUSE_NS", 10**12)
    publisher, subscriber = numbers
    for value in range(200):
        publisher.publish(Number(0, value))
    if where == "queue":
        wait_for(lambda: subscriber.wait_for_publisher() and len(subscriber._queue) == 200)
    turns = set()  # by the number of messages there were: one that is still to come is waited for

    async def run():
        async def other():
            while True:
                turns.add(len(values))
                await asyncio.sleep(0)

        values: list[int] = [(await subscriber.recv_async(SOON_S)).value]
        task = asyncio.ensure_future(other())
        async for message in subscriber:
            values.append(message.value)
            if len(values) == 200:
                break
        task.cancel()
        return values

    assert asyncio.run(run()) == list(range(200))
    assert len(turns) < 150  # one for each message, were there a switch


@pytest.mark.parametrize("policy", [reliable(256, 60.0), keep_last(256), latest()], ids=str)
@pytest.mark.parametrize("publisher_count", [1, 2])
@pytest.mark.parametrize("how", ["iteration", "recv_async"])
def test_a_stream_that_never_ends_lets_others_run(node, policy, publisher_count, how):
    """Other tasks get a turn after so many messages at the latest, whichever way the messages take."""
    publishers = [node.publisher("/numbers", Number) for _ in range(publisher_count)]
    subscriber = node.subscriber("/numbers", Number, policy=policy)
    assert all(publisher.wait_for_subscribers(timeout_s=SOON_S) for publisher in publishers)

    async def messages():
        while True:
            yield await subscriber.recv_async(SOON_S)

    async def run():
        turns = [0]
        count = 0

        async def other():
            for _ in range(5):
                turns.append(count)
                await asyncio.sleep(0)

        task = asyncio.ensure_future(other())
        for publisher in publishers:
            publisher.publish(Number(0, 0))
        async for _ in subscriber if how == "iteration" else messages():
            publishers[count % publisher_count].publish(Number(0, 0))  # there is always one
            count += 1
            if task.done() or count == 100_000:
                break
        await task
        return [later - earlier for earlier, later in pairwise(turns)]

    assert max(asyncio.run(run())) <= PAUSE_COUNT
