"""Callbacks of subscribers: their order, what they may do, and when there are no more of them."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from peer import Number, Scan, connect
from processes import SOON_S, wait_for

from cortex import reliable
from cortex.publisher import Closed

LARGE = 100_000


def scan(number, size=LARGE):
    return Scan(number, np.full(size, number, np.float32))


def test_callbacks_are_called_in_order(node):
    received = []
    publisher, subscriber = connect(node, "/numbers", Number, reliable(64, 60.0), received.append)
    for value in range(3000):
        assert publisher.publish(Number(value, value))
    wait_for(lambda: len(received) == 3000)
    assert [message.value for message in received] == list(range(3000))
    assert subscriber.counters.received == 3000
    assert sum(subscriber.counters.latency) >= 3000 / 8


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

    publisher, subscriber = connect(node, "/numbers", Number, callback=slow)
    for value in range(30):
        publisher.publish(Number(value, value))
    assert started.wait(SOON_S)
    subscriber.close()
    running, state["closed"] = state["running"], True
    assert not running
    done = threading.Event()
    other = node.subscriber("/numbers", Number, lambda message: done.set())
    assert publisher.wait_for_subscribers(1, SOON_S)
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
    node.subscriber("/block", Number, lambda message: (blocker.set(), free.wait(SOON_S)))
    block = node.publisher("/block", Number)
    subscribers.append(node.subscriber("/numbers", Number, once))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert block.wait_for_subscribers(timeout_s=SOON_S)
    block.publish(Number(0, 0))
    assert blocker.wait(SOON_S)
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

    publisher, _ = connect(node, "/numbers", Number, callback=close)
    publisher.publish(Number(0, 0))
    assert closed.wait(SOON_S)
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

    first, _ = connect(node, "/first", Number, reliable(), forward)
    first.publish(Number(0, 0))
    assert second.wait_for_subscribers(timeout_s=SOON_S)
    for value in range(1, 100):
        first.publish(Number(0, value))
    wait_for(lambda: received and received[-1].value == 100)


def test_coroutine_functions_are_refused(node):
    """Called, they would give coroutines that nobody awaits: each message would be lost without a word."""

    async def take(message):
        pass

    for call in (
        lambda: node.subscriber("/numbers", Number, take),
        lambda: node.service("/double", Number, Number, take),
        lambda: node.watch("/**", take),
    ):
        with pytest.raises(TypeError, match=r"coroutine function .*take.*, which no loop would run"):
            call()
    assert not node.topics()
