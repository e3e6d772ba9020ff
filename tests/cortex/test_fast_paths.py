"""The fast paths of a message out and in: what is none of theirs, and errors, which leave no lock held."""

from __future__ import annotations

import sys
import time

import pytest
from peer import Number, Scan, connect, make
from processes import SOON_S, Beside

import cortex.link
from cortex.compiled import native
from cortex.policy import reliable

pytestmark = pytest.mark.skipif(native is None, reason="cortex._native was not compiled")


def test_errors_of_sockets_pass_and_leave_no_lock_held(node, monkeypatch):
    """That of the publisher's socket, and of its reader's; both go on afterwards."""
    monkeypatch.setattr(cortex.link, "native", None)  # all through sockets
    publisher, subscriber = connect(node, "/numbers", Number, reliable())
    monkeypatch.setattr(subscriber, "top_up", lambda now_ns: None)  # the node does not read
    for number in range(3):
        assert publisher.publish(Number(number, number))
        assert subscriber.recv(SOON_S).value == number

    def fails(*_):
        raise OSError("gone")

    sends, (link,) = publisher._fast_send.sends, subscriber._links
    publisher._fast_send.sends = (fails,)
    with pytest.raises(OSError, match="gone"):
        publisher.publish(Number(3, 3))
    assert not publisher._lock.locked()
    publisher._fast_send.sends = sends
    assert publisher.publish(Number(3, 3))
    with monkeypatch.context() as broken:
        broken.setattr(link, "receive", fails)
        subscriber._open_fast_receive()
        with pytest.raises(OSError, match="gone"):
            subscriber.recv(SOON_S)
    assert not subscriber._receive_lock.lock.locked()
    subscriber._open_fast_receive()
    assert subscriber.recv(SOON_S).value == 3


def test_who_publishes_into_a_ring_or_receives_from_it_waits_for_the_lock(numbers):
    """It is not taken where it is free, but nobody passes one who has it."""
    publisher, subscriber = numbers
    assert publisher.publish(Number(0, 0))
    with publisher._lock:
        publishing = Beside(publisher.publish, Number(1, 1))
        publishing.thread.join(0.05)
        assert publisher._fast_send.sequence == 1
    publishing.join()
    assert subscriber.recv(SOON_S).value == 0
    with subscriber._lock:
        receiving = Beside(lambda: subscriber.recv(SOON_S).value)
        receiving.thread.join(0.05)
        assert receiving.results == []
    assert receiving.join() == [1]
    assert subscriber.counters.received == 2


@pytest.mark.parametrize("size", [3, 50_000], ids=["small", "in a slot"])
def test_who_waits_for_the_lock_overtakes_no_message_after_a_gap(node, monkeypatch, size):
    """It gets the lock before it gets the GIL, while another thread finds a frame that takes more care."""
    publisher, subscriber = connect(node, "/gap", Scan, reliable(64))
    monkeypatch.setattr(subscriber, "top_up", lambda now_ns: None)
    interval = sys.getswitchinterval()
    for number in range(3):
        publisher.publish(make(Scan, number, size))
        subscriber.recv(SOON_S)
    subscriber._links[0].expected -= 2  # as if two had been lost
    for number in (3, 4):
        publisher.publish(make(Scan, number, size))
    sys.setswitchinterval(5.0)
    try:
        with subscriber._lock:
            other = Beside(subscriber.recv, SOON_S)
            time.sleep(0.1)
        until_s = time.monotonic() + 0.05
        while time.monotonic() < until_s:
            pass
        got = subscriber.recv(SOON_S)
    finally:
        sys.setswitchinterval(interval)
    assert sorted(message.stamp_ns for message in (got, *other.join())) == [3, 4]
    assert (subscriber.counters.lost, subscriber.counters.rejected) == (2, 0)
