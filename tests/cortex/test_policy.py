"""What each policy promises when messages come faster than they are taken."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from c_module import needs_native
from peer import Number, Scan, accounted, connect, memory, take, take_all
from processes import SOON_S, wait_for

from cortex import keep_last, latest, reliable

MANY = int(os.environ.get("CORTEX_MESSAGES", "100000"))
"""Messages of one stream; ten millions take about two minutes."""


def connected(node, policy, **options):
    """A publisher and a subscriber of one node."""
    publisher, subscriber = connect(node, "/numbers", Number, policy, **options)
    assert subscriber.wait_for_publisher(SOON_S)
    return publisher, subscriber


@pytest.mark.parametrize("make", [keep_last, reliable])
def test_policies_have_bounds(make):
    for depth in (0, -1, 65_537):
        with pytest.raises(ValueError, match=f"1 to 65536, got {depth}"):
            make(depth)
    for timeout_s in (-1.0, float("nan"), float("inf"), 5e6):
        with pytest.raises(ValueError, match="timeout_s must be 0 to"):
            reliable(timeout_s=timeout_s)


def test_policies_say_what_they_are():
    assert str(keep_last(3)) == "keep_last(3)"
    assert str(latest()) == "latest()"
    assert str(reliable(8, 0.5)) == "reliable(depth=8, timeout_s=0.5)"
    assert latest() == keep_last(1)
    assert reliable(8) != keep_last(8)


@pytest.mark.parametrize("depth", [1, 5, 64, 100])
@needs_native
def test_keep_last_hands_out_exactly_the_last(node, depth):
    """Whatever was published while nobody looked; the others were overtaken, none was lost."""
    publisher, subscriber = connected(node, keep_last(depth))
    for value in range(700):
        publisher.publish(Number(0, value))
    assert [message.value for message in take_all(subscriber)] == list(range(700 - depth, 700))
    counters = subscriber.counters
    assert (counters.received, counters.overtaken, counters.lost) == (depth, 700 - depth, 0)


@needs_native
def test_latest_gives_the_newest_at_once(node):
    """Each time that it is asked, however many have come since."""
    publisher, subscriber = connected(node, latest())
    value = 0
    for burst in (1, 2, 63, 64, 65, 500, 1):
        for _ in range(burst):
            publisher.publish(Number(0, value))
            value += 1
        assert subscriber.recv(SOON_S).value == value - 1
    assert take_all(subscriber) == []


@pytest.mark.alone
def test_a_reader_that_works_gets_the_newest_each_time(make_node, start_child):
    """Age of the datum: with 5 ms of work for each message at 2 kHz, what is read was published just now."""
    child = start_child("peer")
    child.ask(do="publisher", topic="/numbers", type="Number")
    subscriber = make_node().subscriber("/numbers", Number, policy=latest())
    assert subscriber.wait_for_publisher(SOON_S)
    child.say(do="publish", topic="/numbers", count=2000, rate_hz=2000)
    ages_s, value = [], 0
    while value < 1900:
        message, info = subscriber.recv_with_info(SOON_S)
        value = message.value
        ages_s.append(info.latency_ns * 1e-9)
        busy_until = time.monotonic() + 5e-3
        while time.monotonic() < busy_until:
            pass
    child.hear()
    # The period is 0.5 ms; what was there before the work is 5 ms old, or more. A machine that stands still
    # makes some messages old, and a pipe full.
    assert np.quantile(ages_s, 0.1) < 2e-3
    counters = subscriber.counters
    assert counters.received == len(ages_s)
    assert value < accounted(counters) <= 2000
    assert counters.overtaken > 100


@pytest.mark.parametrize("place", [{}, {"listen": "127.0.0.1", "host": "elsewhere"}], ids=["ring", "tcp"])
def test_every_message_of_a_reliable_stream_comes_in_order(make_node, start_child, place):
    """Received + lost == sent, and lost 0, whatever the pace of the two; and neither of them grows by it."""
    child = start_child("peer", **place)
    policy = ["reliable", {"depth": 16, "timeout_s": 60.0}]
    child.ask(do="subscriber", topic="/numbers", type="Number", policy=policy)
    publisher = make_node(listen=place.get("listen")).publisher("/numbers", Number, max_wait_s=60.0)
    assert publisher.wait_for_subscribers(1, SOON_S)
    sizes, limit_s, begin = [], SOON_S + MANY * 1e-4, 0
    for end in (MANY // 10, MANY):
        child.say(do="receive", topic="/numbers", until=end - 1, timeout_s=limit_s)
        assert all(publisher.publish(Number(value, value)) for value in range(begin, end))
        received = {"count": end - begin, "first": begin, "last": end - 1, "ordered": True, "whole": True}
        assert child.hear(limit_s) == received
        sizes.append([child.ask(do="memory")["bytes"], memory()["bytes"]])
        begin = end
    counters = child.ask(do="counters", topic="/numbers")
    assert (counters["received"], counters["lost"], counters["overtaken"]) == (MANY, 0, 0)
    assert publisher.counters.timeouts == 0
    # A queue and a ring may be touched for the first time, as they never were so full before.
    assert (np.diff(sizes, axis=0) < 4_000_000).all(), sizes


def test_back_pressure_has_an_end(node):
    """The publisher is held up for the time allowed, not longer; both sides count what is lost."""
    publisher, subscriber = connected(node, reliable(depth=4, timeout_s=0.05))
    delivered, took_s = [], []
    while len(delivered) < 20 or all(delivered[-4:]):
        assert len(delivered) < 100_000
        begin = time.monotonic()
        delivered.append(publisher.publish(Number(0, len(delivered))))
        took_s.append(time.monotonic() - begin)
    first = delivered.index(False)
    assert first > 4
    assert 0.045 < took_s[first] < 10.0
    while len(delivered) < first + 4:  # it goes on, and does not believe that these arrive
        delivered.append(publisher.publish(Number(0, len(delivered))))
    assert not any(delivered[first:])
    assert [subscriber.recv(SOON_S).value for _ in range(first)] == list(range(first))

    def resumed():
        delivered.append(publisher.publish(Number(0, len(delivered))))
        return take(subscriber)

    value = wait_for(resumed).value
    lost = value - first  # all of them, and only they
    wait_for(lambda: publisher.publish(Number(0, len(delivered))))
    counters = subscriber.counters
    assert (counters.received, counters.lost) == (first + 1, lost)
    assert publisher.counters.timeouts >= lost


@needs_native
def test_a_reader_of_large_messages_that_is_late_holds_up_once(node):
    """Until it has read about half it loses messages, which `publish` says, and nobody waits for it."""
    publisher, subscriber = connect(node, "/scans", Scan, reliable(depth=4, timeout_s=1.0))
    ranges = np.zeros(50_000, np.float32)
    delivered = []
    while all(delivered):
        begin = time.monotonic()
        delivered.append(publisher.publish(Scan(len(delivered), ranges)))
    assert 0.9 < time.monotonic() - begin < 10.0
    begin = time.monotonic()
    for _ in range(20):
        delivered.append(publisher.publish(Scan(len(delivered), ranges)))
    assert time.monotonic() - begin < 10.0  # 20 s if each waited
    assert not any(delivered[-20:])
    received = [subscriber.recv(SOON_S).stamp_ns for _ in range(sum(delivered))]
    assert received == [number for number, came in enumerate(delivered) if came]
    assert publisher.publish(Scan(-1, ranges))
    assert subscriber.recv(SOON_S).stamp_ns == -1
    assert subscriber.counters.lost == delivered.count(False) == publisher.counters.timeouts


def test_a_stopped_lossy_reader_never_holds_up_a_reliable_one(make_node, start_child):
    """On one topic: the first is stopped, the second gets everything, the publisher waits for neither."""
    stopped, steady = start_child("peer", name="stopped"), start_child("peer", name="steady")
    for child, policy in (
        (stopped, ["keep_last", {"depth": 10}]),
        (steady, ["reliable", {"timeout_s": 60.0}]),
    ):
        child.ask(do="subscriber", topic="/numbers", type="Number", policy=policy)
    publisher = make_node().publisher("/numbers", Number)
    assert publisher.wait_for_subscribers(2, SOON_S)
    count = 40_000  # more than the ring of small messages holds
    with stopped.stopped():
        steady.say(do="receive", topic="/numbers", until=count - 1)
        assert all(publisher.publish(Number(value, value)) for value in range(count))
        assert steady.hear()["count"] == count
    steady.ask(do="close", topic="/numbers")  # it reads no more
    stopped.say(do="receive", topic="/numbers", until=count)
    sent = count
    while not stopped.has_line(1e-3):  # it hears of new ones when it has read old ones
        assert publisher.publish(Number(sent, sent))
        sent += 1
        assert sent < count + 60_000
    last = stopped.hear()
    assert last["last"] >= count
    assert last["ordered"]
    counters = stopped.ask(do="counters", topic="/numbers")
    assert last["last"] + 1 <= counters["received"] + counters["overtaken"] + counters["lost"] <= sent
    assert counters["lost"] > 0
