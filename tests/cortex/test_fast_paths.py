"""The fast paths of a message out and in: what is none of theirs, and errors, which leave no lock held."""

from __future__ import annotations

import sys
import time

import pytest
from c_module import needs_native
from peer import Number, Scan, connect, make, stand_still
from processes import SOON_S, Beside

from cortex.policy import reliable

pytestmark = needs_native


@pytest.mark.usefixtures("sockets_alone")
def test_errors_of_sockets_pass_and_leave_no_lock_held(node, monkeypatch):
    """That of the publisher's socket, and of its reader's; both go on afterwards."""
    publisher, subscriber = connect(node, "/numbers", Number, reliable())
    stand_still(subscriber)
    for number in range(3):
        assert publisher.publish(Number(number, number))
        assert subscriber.recv(SOON_S).value == number

    def fails(*_):
        raise OSError("gone")

    sends, (link,) = publisher._fast_send.sends, subscriber._links
    publisher._fast_send.sends = (fails,)
    with pytest.raises(OSError, match="gone"):
        publisher.publish(Number(3, 3))
    publisher._fast_send.sends = sends
    assert publisher.publish(Number(3, 3))
    with monkeypatch.context() as broken:
        broken.setattr(link, "receive", fails)
        subscriber._open_fast_receive()
        with pytest.raises(OSError, match="gone"):
            subscriber.recv(SOON_S)
    subscriber._open_fast_receive()
    assert subscriber.recv(SOON_S).value == 3


@pytest.mark.parametrize("size", [3, 50_000], ids=["small", "in a slot"])
def test_who_waits_for_the_lock_overtakes_no_message_after_a_gap(node, size):
    """It gets the lock before it gets the GIL, while another thread finds a frame that takes more care."""
    publisher, subscriber = connect(node, "/gap", Scan, reliable(64))
    stand_still(subscriber)
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
