"""The fast paths of a message out and in: what is none of theirs, and errors, which leave no lock held."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest
import zmq
from peer import Number, Scan, connect, make
from processes import SOON_S

from cortex.codec import codec_of, coder_of
from cortex.compiled import native
from cortex.fast_receive import NOTHING, make_fast_receive
from cortex.fast_send import make_fast_send
from cortex.policy import reliable
from cortex.receive_lock import ReceiveLock
from cortex.stats import SubscriberCounters
from cortex.wire import MESSAGE, REST, message_head

pytestmark = pytest.mark.skipif(native is None, reason="cortex._native was not compiled")


def coder_with_head(kind: type) -> Any:
    codec = codec_of(kind)
    return coder_of(codec, message_head(MESSAGE, 7, codec.fingerprint, stamped=True))


def frame_of(number: int, kind: type = Number) -> bytes:
    codec = codec_of(kind)
    body = codec.encode(Number(number, number) if kind is Number else make(kind, number, 40), 1 << 20)
    assert body is not None
    head = message_head(MESSAGE, 7, codec.fingerprint, stamped=True)
    return head + REST.pack(number, 0, 0, len(body), 0) + body


class Script:
    """Hands out frames or raises errors, while the lock is held; then there is none."""

    def __init__(self, lock: Any, *steps: bytes | Exception) -> None:
        self.lock, self.steps, self.flags = lock, deque(steps), []

    def __call__(self, flags: int) -> bytes:
        assert self.lock.locked()
        self.flags.append(flags)
        step = self.steps.popleft() if self.steps else zmq.Again()
        if isinstance(step, Exception):
            raise step
        return step


@pytest.fixture
def receiver():
    """A fast path, the script of its link, and its lock."""
    lock, queue, counters = ReceiveLock(), deque(), SubscriberCounters()
    script = Script(lock.lock, frame_of(0))

    def accept(link, frame):
        raise AttributeError("none of ours")

    path = make_fast_receive(lock, queue, counters, accept)
    coder = coder_with_head(Number)
    path.open(SimpleNamespace(receive=script, coder=coder, expected=0, clock_offset_ns=0), coder)
    return path, script, lock


def test_a_full_queue_and_an_error_leave_the_lock_free():
    lock, retried = threading.Lock(), []

    def retry(frame, send):
        assert lock.locked()
        retried.append(send)
        return False

    def fail_with(error):
        def send(frame, flags):
            assert lock.locked()
            raise error

        return send

    full, broken = fail_with(zmq.Again()), fail_with(zmq.ZMQError(zmq.ENOTSOCK))
    send = make_fast_send(coder_with_head(Number), lock, slowly=pytest.fail, retry=retry, limit=1000)
    send.refresh_ns, send.sends = 2**62, (full,)
    assert send(Number(0, 0)) is False
    assert retried == [full]
    assert not lock.locked()
    send.sends = (broken,)
    with pytest.raises(zmq.ZMQError):
        send(Number(0, 0))
    assert not lock.locked()
    with pytest.raises(TypeError, match="one message"):
        send(Number(0, 0), Number(0, 0))


def test_an_error_passes_and_gives_the_lock_back(receiver):
    path, script, lock = receiver
    script.steps.appendleft(OSError("gone"))
    with pytest.raises(OSError, match="gone"):
        path(False)
    assert not lock.lock.locked()
    assert path(False) == Number(0, 0)
    script.steps.append(b"junk")
    with pytest.raises(AttributeError, match="none of ours"):  # what `accept` raises, too
        path(False)
    assert not lock.lock.locked()


def test_who_wants_the_lock_is_not_waited_past(receiver):
    path, script, lock = receiver
    lock.waiting = 1
    assert path(True) is NOTHING
    assert not script.flags
    assert path(False) == Number(0, 0)  # that takes no time


def test_drain_passes_errors_on_and_keeps_count():
    lock, messages = ReceiveLock(), deque()
    path = make_fast_receive(lock, deque(), SubscriberCounters(), lambda link, frame: None)
    script = Script(lock.lock, frame_of(0), frame_of(1), OSError("gone"), frame_of(2), frame_of(4), b"junk")
    link = SimpleNamespace(receive=script, coder=coder_with_head(Number), expected=0, clock_offset_ns=0)
    with lock.lock:
        with pytest.raises(OSError, match="gone"):
            path.drain(link, messages, 4, False)
        assert (list(messages), link.expected) == ([Number(0, 0), Number(1, 1)], 2)
        assert path.drain(link, messages, 4, False) == frame_of(4)
        assert (len(messages), link.expected) == (3, 3)
        assert path.drain(link, messages, 4, False) == b"junk"
        assert path.drain(link, messages, 4, False) is None
        link.coder = None
        with pytest.raises(TypeError, match="coder"):
            path.drain(link, messages, 4, False)


def test_who_publishes_into_a_ring_waits_for_the_lock(numbers):
    """It is not taken where it is free, but nobody passes one who has it."""
    publisher, subscriber = numbers
    assert publisher.publish(Number(0, 0))
    with publisher._lock:
        thread = threading.Thread(target=publisher.publish, args=(Number(1, 1),))
        thread.start()
        thread.join(0.05)
        assert publisher._fast_send.sequence == 1
    thread.join()
    assert [subscriber.recv(SOON_S).value for _ in range(2)] == [0, 1]


def test_who_receives_from_a_ring_waits_for_the_lock(numbers):
    """As a publisher; what is there is taken once the lock is free, in order."""
    publisher, subscriber = numbers
    assert publisher.publish(Number(0, 0))
    assert subscriber.recv(SOON_S).value == 0
    assert publisher.publish(Number(1, 1))
    got = []
    with subscriber._lock:
        thread = threading.Thread(target=lambda: got.append(subscriber.recv(SOON_S).value))
        thread.start()
        thread.join(0.05)
        assert got == []
    thread.join()
    assert got == [1]
    assert subscriber.counters.received == 2


@pytest.mark.parametrize("size", [3, 50_000], ids=["small", "in a slot"])
def test_who_waits_for_the_lock_overtakes_no_message_after_a_gap(node, monkeypatch, size):
    """It gets the lock before it gets the GIL, while another thread finds a frame that takes more care."""
    publisher, subscriber = connect(node, "/gap", Scan, reliable(64))
    monkeypatch.setattr(subscriber, "top_up", lambda now_ns: None)
    interval, got = sys.getswitchinterval(), []
    for number in range(3):
        publisher.publish(make(Scan, number, size))
        subscriber.recv(SOON_S)
    subscriber._links[0].expected -= 2  # as if two had been lost
    for number in (3, 4):
        publisher.publish(make(Scan, number, size))
    thread = threading.Thread(target=lambda: got.append(subscriber.recv(SOON_S)))
    sys.setswitchinterval(5.0)
    try:
        with subscriber._lock:
            thread.start()
            time.sleep(0.1)
        until_s = time.monotonic() + 0.05
        while time.monotonic() < until_s:
            pass
        got.append(subscriber.recv(SOON_S))
    finally:
        sys.setswitchinterval(interval)
    thread.join()
    assert sorted(message.stamp_ns for message in got) == [3, 4]
    assert (subscriber.counters.lost, subscriber.counters.rejected) == (2, 0)
