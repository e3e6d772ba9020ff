"""Memory of large messages that is made when a reader comes, not while they are sent."""

from __future__ import annotations

import numpy as np
import pytest
from peer import Scan
from processes import SOON_S, wait_for

import cortex.link
from cortex import keep_last, latest, reliable
from cortex.shm import ShmUnavailable

EXPECTED = 400_000


@pytest.fixture
def node(make_node):
    return make_node(registry="off")


def scan(number, size_bytes):
    return Scan(number, np.full(size_bytes // 4, number, np.float32))


def rings_of(publisher):
    """Number, slots and size of slots of a publisher's rings."""
    with publisher._outlets.lock:
        return [(ring.ring_id, ring.slots, ring.slot_bytes) for ring in publisher._large._rings]


@pytest.mark.parametrize("policy", [latest(), keep_last(), keep_last(256), reliable()])
def test_messages_find_the_memory_that_was_made_before_them(node, policy):
    publisher = node.publisher("/large", Scan, expected_bytes=EXPECTED)
    assert rings_of(publisher) == []  # nobody listens
    subscriber = node.subscriber("/large", Scan, policy=policy)
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    made = rings_of(publisher)
    assert [ring_id for ring_id, _, _ in made] == [0]
    assert made[0][2] >= EXPECTED
    for number, size in enumerate((20_000, 100_000, 30_000, 300_000, EXPECTED - 4096)):
        publisher.publish(scan(number, size))
        message = subscriber.recv(SOON_S)
        assert (message.stamp_ns, message.ranges.nbytes) == (number, size)
        del message
    assert rings_of(publisher) == made


def test_a_larger_message_than_expected_makes_memory_of_its_own(node):
    publisher = node.publisher("/large", Scan, expected_bytes=EXPECTED)
    subscriber = node.subscriber("/large", Scan, policy=latest())
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    publisher.publish(scan(1, 3 * EXPECTED))
    message = subscriber.recv(SOON_S)
    assert (message.stamp_ns, message.ranges.nbytes) == (1, 3 * EXPECTED)
    assert rings_of(publisher)[-1][2] >= 3 * EXPECTED


def test_one_reader_more_is_given_its_share_when_it_comes(node):
    """A share is two slots: more readers need more, and who is there already is told of the new ring."""
    publisher = node.publisher("/large", Scan, expected_bytes=3_000_000)
    subscribers = []
    for count in range(1, 4):
        subscribers.append(node.subscriber("/large", Scan, policy=reliable()))
        assert publisher.wait_for_subscribers(count, timeout_s=SOON_S)
        made = rings_of(publisher)
        assert made[-1][1] >= 2 * count + 2
        publisher.publish(scan(count, 2_900_000))
        for subscriber in subscribers:
            message = subscriber.recv(SOON_S)
            assert (message.stamp_ns, message.ranges.nbytes) == (count, 2_900_000)
            del message
        assert rings_of(publisher)[-1] == made[-1]  # the one before is let go of once it is idle


def test_small_messages_need_no_memory(node):
    publisher = node.publisher("/large", Scan, expected_bytes=1000)
    subscriber = node.subscriber("/large", Scan, policy=latest())
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    publisher.publish(scan(1, 400))
    assert subscriber.recv(SOON_S).stamp_ns == 1
    assert rings_of(publisher) == []


def test_a_reader_that_cannot_map_it_gets_the_messages_otherwise(node, monkeypatch):
    def refuse(*_):
        raise ShmUnavailable("not for you")

    monkeypatch.setattr(cortex.link, "RingView", refuse)
    publisher = node.publisher("/large", Scan, expected_bytes=EXPECTED)
    subscriber = node.subscriber("/large", Scan, policy=reliable(8, 60.0))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert subscriber.wait_for_publisher(SOON_S)

    def arrives():
        publisher.publish(scan(1, 200_000))
        try:
            return subscriber.recv(0.1)
        except TimeoutError:
            return None

    message = wait_for(arrives)  # those that were under way while it asked again are lost
    assert (message.stamp_ns, message.ranges.nbytes) == (1, 200_000)


def test_without_memory_messages_go_through_sockets(node, monkeypatch, caplog):
    def refuse(*_, **__):
        raise ShmUnavailable("none left")

    monkeypatch.setattr("cortex.large.Ring", refuse)
    publisher = node.publisher("/large", Scan, expected_bytes=EXPECTED)
    subscriber = node.subscriber("/large", Scan, policy=reliable())
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    wait_for(lambda: "none left" in caplog.text)
    publisher.publish(scan(1, 200_000))
    assert subscriber.recv(SOON_S).stamp_ns == 1
