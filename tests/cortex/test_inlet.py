"""The fast path of a message in."""

from __future__ import annotations

import gc
import random
import time
import weakref
from collections import deque
from types import SimpleNamespace

import pytest
import zmq
from peer import Number

from cortex.codec import codec_of, coder_of
from cortex.inlet import NOTHING, make_inlet
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

    def __init__(self, frames=()):
        self.turn, self.queue, self.counters = Turn(), deque(), SubscriberCounters()
        self.frames, self.accepted, self.flags = deque(frames), [], []
        self.inlet = make_inlet(self.turn, self.queue, self.counters, self.accept)
        self.link = SimpleNamespace(
            receive=self.receive, coder=coder_of(CODEC, HEAD), expected=0, clock_offset_ns=0
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


@pytest.mark.parametrize("seed", range(20))
def test_what_simply_follows_is_taken_and_the_rest_handed_on(seed):
    chance = random.Random(seed)
    good = [frame_of(sequence, 1) for sequence in range(60)]
    odd = {}
    for sequence in range(60):
        if chance.random() < 0.2:
            frame = good[sequence]
            other = bytes(chance.randrange(200))
            odd[sequence] = chance.choice([frame[:-1], frame + b"\0", b"", other, frame_of(sequence + 2)])
    way = Way([odd.get(sequence, frame) for sequence, frame in enumerate(good)])
    for sequence in range(60):
        message = way.inlet(False)
        assert not way.inlet.exhausted
        if sequence in odd:
            assert message is NOTHING
            assert way.link.expected == sequence
            way.link.expected += 1
        else:
            assert message == Number(0, sequence)
            assert way.link.expected == sequence + 1
    assert way.accepted == list(odd.values())
    assert way.flags == [zmq.DONTWAIT] * 60
    assert way.counters.received == sum(way.counters.latency) == 60 - len(odd)


def test_nothing_is_taken_past_the_queue_or_a_closed_inlet():
    way = Way([frame_of(0)])
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


def test_who_wants_the_lock_is_not_waited_past():
    way = Way([frame_of(0)])
    way.turn.waiting = 1
    assert way.inlet(True) is NOTHING
    assert not way.flags
    assert way.inlet(False) == Number(0, 0)  # that takes no time


def test_an_error_passes_and_gives_the_lock_back():
    way = Way([OSError("gone"), frame_of(0)])
    with pytest.raises(OSError, match="gone"):
        way.inlet(False)
    assert not way.turn.lock.locked()
    assert way.inlet(False) == Number(0, 0)
    way.turn = None  # what `accept` raises, too
    way.frames.append(b"junk")
    with pytest.raises(AttributeError):
        way.inlet(False)


def test_soon_ends_with_its_count_or_its_time():
    way = Way(map(frame_of, range(10)))
    assert way.inlet.soon() is NOTHING  # nobody has said how long
    way.inlet.left, way.inlet.until_ns = 3, time.monotonic_ns() + 10**12
    assert [way.inlet.soon() for _ in range(4)] == [Number(0, 0), Number(0, 1), Number(0, 2), NOTHING]
    way.inlet.left, way.inlet.until_ns = 3, time.monotonic_ns()
    assert way.inlet.soon() is NOTHING
    assert len(way.frames) == 7


def test_an_inlet_is_not_kept():
    way = Way([frame_of(0)])
    gone = weakref.ref(way)
    assert way.inlet(False) == Number(0, 0)
    del way
    gc.collect()
    assert gone() is None
