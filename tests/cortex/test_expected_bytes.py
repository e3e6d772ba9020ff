"""Memory of large messages that is made when a reader comes, not while they are sent."""

from __future__ import annotations

import numpy as np
import pytest
from peer import Scan, connect
from processes import SOON_S

from cortex import keep_last, latest, reliable

EXPECTED = 400_000


def scan(number, size_bytes):
    return Scan(number, np.full(size_bytes // 4, number, np.float32))


def slots_of(publisher):
    """Number and size of a publisher's slots; None if there is no ring."""
    with publisher._pub_sockets.lock:
        ring = publisher._fanout.ring._ring
        return None if ring is None else (ring.slots, ring.slot_bytes)


@pytest.mark.parametrize("policy", [latest(), keep_last(), keep_last(256), reliable()])
def test_messages_find_the_memory_that_was_made_before_them(node, policy):
    publisher = node.publisher("/large", Scan, expected_bytes=EXPECTED)
    assert slots_of(publisher) is None  # nobody listens
    subscriber = node.subscriber("/large", Scan, policy=policy)
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    made = slots_of(publisher)
    assert made[1] >= EXPECTED
    for number, size in enumerate((20_000, 100_000, 30_000, 300_000, EXPECTED - 4096)):
        publisher.publish(scan(number, size))
        message = subscriber.recv(SOON_S)
        assert (message.stamp_ns, message.ranges.nbytes) == (number, size)
        del message
    assert slots_of(publisher) == made


def test_a_larger_message_than_expected_makes_memory_of_its_own(node):
    publisher, subscriber = connect(node, "/large", Scan, latest(), expected_bytes=EXPECTED)
    publisher.publish(scan(1, 3 * EXPECTED))
    message = subscriber.recv(SOON_S)
    assert (message.stamp_ns, message.ranges.nbytes) == (1, 3 * EXPECTED)
    assert slots_of(publisher)[1] >= 3 * EXPECTED


def test_one_reader_more_is_given_its_share_when_it_comes(node):
    """A share is two slots: more readers need more, and who is there already is told of the new ring."""
    publisher = node.publisher("/large", Scan, expected_bytes=3_000_000)
    subscribers = []
    for count in range(1, 4):
        subscribers.append(node.subscriber("/large", Scan, policy=reliable()))
        assert publisher.wait_for_subscribers(count, timeout_s=SOON_S)
        made = slots_of(publisher)
        assert made[0] >= 2 * count + 2
        publisher.publish(scan(count, 2_900_000))
        for subscriber in subscribers:
            message = subscriber.recv(SOON_S)
            assert (message.stamp_ns, message.ranges.nbytes) == (count, 2_900_000)
            del message
        assert slots_of(publisher) == made


def test_small_messages_need_no_memory(node):
    publisher, subscriber = connect(node, "/large", Scan, latest(), expected_bytes=1000)
    publisher.publish(scan(1, 400))
    assert subscriber.recv(SOON_S).stamp_ns == 1
    assert slots_of(publisher) == (0, 0)
