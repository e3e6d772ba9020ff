"""The way of a message in: the C module against Python, and what is awaited against a coroutine."""

from __future__ import annotations

import asyncio
import gc
import random
import sys
import time
import weakref
from collections import deque
from types import SimpleNamespace

import pytest
import zmq
from peer import Number

from cortex import packer
from cortex.codec import codec_of
from cortex.inlet import NOTHING, PyInlet, make_arrivals, make_inlet
from cortex.stats import SubscriberCounters
from cortex.turn import Turn
from cortex.wire import MESSAGE, REST, message_head

CODEC = codec_of(Number)
HEAD = message_head(MESSAGE, 7, CODEC.fingerprint, stamped=True)


def frame_of(sequence, publish_ns=0):
    body = CODEC.encode(Number(0, sequence), 100)
    return HEAD + REST.pack(sequence, 0, publish_ns, len(body), 0) + body


class Way:
    """An inlet, with a link that brings what is put into `frames`."""

    def __init__(self, make=make_inlet, frames=()):
        self.turn, self.queue, self.counters = Turn(), deque(), SubscriberCounters()
        self.frames, self.accepted, self.flags = deque(frames), [], []
        self.inlet = make(self.turn, self.queue, self.counters, self.accept)
        reader = packer.make_reader(CODEC, HEAD)
        self.link = SimpleNamespace(
            receive=self.receive, read=reader.read, coder=reader.coder, expected=0, clock_offset_ns=0
        )
        self.inlet.open(self.link, self.link.coder)

    def receive(self, flags):
        assert self.turn.lock.locked()
        self.flags.append(flags)
        if not self.frames:
            raise zmq.Again
        frame = self.frames.popleft()
        if isinstance(frame, Exception):
            raise frame
        return frame

    def accept(self, link, frame):
        assert self.turn.lock.locked()
        assert link is self.link
        self.accepted.append(frame)


both = pytest.mark.parametrize("make", [PyInlet, make_inlet])


@pytest.mark.parametrize("seed", range(20))
def test_what_is_taken_counted_and_handed_on_is_that_of_python(seed):
    chance = random.Random(seed)
    frames = []
    for sequence in range(60):
        publish_ns = time.monotonic_ns() - (
            1 << chance.randrange(34, 50)
        )  # the buckets cannot change meanwhile
        frame = frame_of(sequence, publish_ns)
        odd = [
            frame[:-1],
            frame + b"\0",
            b"",
            bytes(chance.randrange(200)),
            frame_of(sequence + 2, publish_ns),
        ]
        frames.append(chance.choice(odd) if chance.random() < 0.2 else frame)

    def run(make):
        way = Way(make, frames)
        found = []
        for _ in frames:
            message = way.inlet(False)
            found.append((message, way.inlet.exhausted, way.link.expected))
            if message is NOTHING:
                way.link.expected += 1
        return found, way.accepted, way.flags, way.counters

    ours, pythons = run(make_inlet), run(PyInlet)
    assert ours == pythons
    assert ours[3].received == sum(message is not NOTHING for message, *_ in ours[0]) > 20
    assert sum(ours[3].latency) == ours[3].received


@both
def test_nothing_is_taken_past_the_queue_or_a_closed_inlet(make):
    way = Way(make, [frame_of(0)])
    way.queue.append(object())
    assert way.inlet(False) is NOTHING
    way.queue.clear()
    way.inlet.open(None, None)
    assert way.inlet(True) is NOTHING
    assert not way.flags
    way.inlet.open(way.link, way.link.coder)
    assert way.inlet(True) == Number(0, 0)
    assert way.inlet(False) is NOTHING
    assert way.inlet.exhausted
    assert way.flags == [0, zmq.DONTWAIT]
    assert not way.turn.lock.locked()


@both
def test_who_wants_the_lock_is_not_waited_past(make):
    way = Way(make, [frame_of(0)])
    way.turn.waiting = 1
    assert way.inlet(True) is NOTHING
    assert not way.flags
    assert way.inlet(False) == Number(0, 0)  # that takes no time


@both
def test_an_error_passes_and_gives_the_lock_back(make):
    way = Way(make, [OSError("gone"), frame_of(0)])
    with pytest.raises(OSError, match="gone"):
        way.inlet(False)
    assert not way.turn.lock.locked()
    assert way.inlet(False) == Number(0, 0)
    way.turn = None  # what `accept` raises, too
    way.frames.append(b"junk")
    with pytest.raises(AttributeError):
        way.inlet(False)


@both
def test_soon_ends_with_its_count_or_its_time(make):
    way = Way(make, map(frame_of, range(10)))
    assert way.inlet.soon() is NOTHING  # nobody has said how long
    way.inlet.left, way.inlet.until_ns = 3, time.monotonic_ns() + 10**12
    assert [way.inlet.soon() for _ in range(4)] == [Number(0, 0), Number(0, 1), Number(0, 2), NOTHING]
    way.inlet.left, way.inlet.until_ns = 3, time.monotonic_ns()
    assert way.inlet.soon() is NOTHING
    assert len(way.frames) == 7


@both
def test_an_inlet_is_not_kept(make):
    way = Way(make, [frame_of(0)])
    way.arrivals = make_arrivals(way.inlet, way.accept)
    gone = weakref.ref(way)
    assert way.inlet(False) == Number(0, 0)
    del way
    gc.collect()
    assert gone() is None


# Arrivals


class Awaited:
    """Arrivals of a way whose inlet may always go on; what is not there comes from `slow`."""

    def __init__(self, frames=()):
        self.way = Way(frames=frames)
        self.way.inlet.left, self.way.inlet.until_ns = 10**6, time.monotonic_ns() + 10**15
        self.slow = []
        self.arrivals = make_arrivals(self.way.inlet, self.slowly)

    async def slowly(self):
        self.slow.append("begun")
        try:
            await asyncio.sleep(0)
        except asyncio.CancelledError:
            self.slow.append("cancelled")
            raise
        finally:
            self.slow.append("ended")
        if self.slow.count("begun") > 2:
            raise StopAsyncIteration
        return "slow"


def test_iteration_takes_what_is_there_and_waits_for_the_rest():
    awaited = Awaited(map(frame_of, range(100)))

    async def run():
        return [message async for message in awaited.arrivals]

    found = asyncio.run(run())
    assert found == [*(Number(0, k) for k in range(100)), "slow", "slow"]


def test_nothing_is_taken_before_it_is_awaited():
    awaited = Awaited([frame_of(0), frame_of(1)])

    async def run():
        awaited.arrivals.__anext__().close()
        task = asyncio.ensure_future(awaited.arrivals.__anext__())
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        early, late = awaited.arrivals.__anext__(), awaited.arrivals.__anext__()
        return [await late, await early]

    assert asyncio.run(run()) == [Number(0, 0), Number(0, 1)]
    assert not awaited.slow


def test_who_waits_can_be_cancelled():
    awaited = Awaited()

    async def run():
        task = asyncio.create_task(awaited.arrivals.__anext__())
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(run())
    assert awaited.slow == ["begun", "cancelled", "ended"]


def test_who_waits_can_be_left():
    """As when a coroutine that waits is thrown away."""
    awaited = Awaited()

    async def wait():
        await awaited.arrivals.__anext__()

    waiting = wait()
    waiting.send(None)
    assert awaited.slow == ["begun"]
    waiting.close()
    assert awaited.slow == ["begun", "ended"]


@pytest.mark.parametrize("frames", [[frame_of(0)], []], ids=["there", "slow"])
def test_none_is_awaited_twice(frames):
    awaited = Awaited(frames)

    async def run():
        arrival = awaited.arrivals.__anext__()
        await arrival
        with pytest.raises(RuntimeError, match="await"):
            await arrival
        with pytest.raises(RuntimeError, match="await"):
            arrival.throw(ValueError)
        arrival.close()

    asyncio.run(run())


def test_an_error_of_the_inlet_is_raised_where_it_is_awaited():
    awaited = Awaited([OSError("gone"), frame_of(0)])

    async def run():
        arrival = awaited.arrivals.__anext__()
        with pytest.raises(OSError, match="gone"):
            await arrival
        return await anext(awaited.arrivals)

    assert asyncio.run(run()) == Number(0, 0)


def test_a_message_may_be_of_any_kind():
    """Also one that StopIteration would take apart."""
    awaited = Awaited()
    for value in ((), (1, 2), StopIteration(3), None):
        arrival = make_arrivals(awaited.way.inlet, lambda value=value: _return(value)).__anext__()
        with pytest.raises(StopIteration) as caught:
            arrival.send(None)
        assert caught.value.value is value


async def _return(value):
    return value


def test_arrivals_leave_nothing_behind():
    awaited = Awaited()
    way = awaited.way

    async def run(count):
        way.frames.extend(frame_of(way.link.expected + k) for k in range(count))
        for _ in range(count):
            await awaited.arrivals.__anext__()

    asyncio.run(run(100))
    gc.collect()
    before = sys.getallocatedblocks()
    asyncio.run(run(20_000))
    gc.collect()
    assert sys.getallocatedblocks() - before < 1000
