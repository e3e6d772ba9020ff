"""Closing a publisher: what it has taken arrives, what it has not is counted, and nothing is left behind."""

from __future__ import annotations

import contextlib
import os
import signal
import time

import pytest
from c_module import needs_native
from peer import Block, connect, make_block
from processes import SOON_S, Beside, wait_for

from cortex import reliable
from cortex.context import Closed

PATIENT = ["reliable", {"timeout_s": SOON_S}]  # as long as a machine may stand still


def subscribe(publisher, start_child, policy: list, count: int = 1) -> list:
    children = [start_child("endless_subscriber", topic="/blocks", policy=policy) for _ in range(count)]
    assert publisher.wait_for_subscribers(count, timeout_s=SOON_S)
    return children


def begin_close(publisher, **options) -> Beside:
    """Close in a thread, which has time for it."""
    closing = Beside(publisher.close, **options)
    closing.thread.join(0.2)  # one that does not wait for the reader is done by then
    return closing


def arrives(child, sent: int, lost: int = 0) -> bool:
    """Whether a child has seen so many; what is lost is counted, and nothing is torn or rejected."""
    found = child.ask()
    assert (found["torn"], found["rejected"]) == (0, 0)
    return found["count"] == sent - lost and found["lost"] == lost


class Sent:
    """Publishes blocks, and counts."""

    def __init__(self, publisher, size: int) -> None:
        self.publisher = publisher
        self.block = make_block(0, size)
        self.count = self.refused = 0

    def __call__(self) -> int:
        """Publish one; about the bytes of its frame."""
        self.refused += not self.publisher.publish(Block(self.count, self.block.check, self.block.data))
        self.count += 1
        return len(self.block.data) + 200

    def wait_until_held_up(self) -> None:
        """Wait until another thread has published nothing more for 0.1 s."""
        seen: list[int] = []
        wait_for(lambda: seen.append(self.count) or seen[-50:].count(self.count) == 50)


@pytest.mark.parametrize("readers", [1, 3])
def test_what_was_taken_outlives_the_publisher(make_node, start_child, readers):
    """The readers stand still when the publisher is closed, without a linger: the ring stays theirs."""
    publisher = make_node().publisher("/blocks", Block)
    children = subscribe(publisher, start_child, PATIENT, count=readers)
    sent = Sent(publisher, 3_000)
    with contextlib.ExitStack() as stopped:
        for child in children:
            stopped.enter_context(child.stopped())
        for _ in range(100):
            sent()
        publisher.close(linger_s=0.0)
    for child in children:
        wait_for(lambda child=child: arrives(child, sent.count))
    assert not sent.refused


@pytest.mark.parametrize("size", [8_000, 100_000])
def test_a_publisher_that_stops_waiting_holds_up_nobody(make_node, start_child, size):
    """Not who publishes already, nor later; what the reader loses is counted. Through the ring and slots."""
    node = make_node()
    publisher = node.publisher("/blocks", Block)
    (child,) = subscribe(publisher, start_child, ["reliable", {"depth": 1, "timeout_s": 10.0 * SOON_S}])
    sent = Sent(publisher, size)

    def publish() -> None:
        while not sent.refused:
            sent()

    with child.stopped():
        with Beside(publish):
            sent.wait_until_held_up()
            node.stop_waiting()
        sent()
        assert (sent.refused, publisher.counters.timeouts) == (2, 2)
    with begin_close(publisher):
        wait_for(lambda: arrives(child, sent.count, lost=2))


def test_nobody_holds_up_a_node_for_long(make_node, start_child):
    """A reader that stands still, and may hold up `publish` for a day."""
    node = make_node()
    publisher = node.publisher("/blocks", Block, max_wait_s=86_400.0)
    (child,) = subscribe(publisher, start_child, ["reliable", {"timeout_s": 86_400.0}])
    before = len(os.listdir("/proc/self/fd"))
    sent = Sent(publisher, 1000)

    def publish() -> None:
        with contextlib.suppress(Closed):
            while True:
                sent()

    with child.stopped():
        with Beside(publish):
            sent.wait_until_held_up()
            Beside(node.close).join()
        assert len(os.listdir("/proc/self/fd")) < before


def test_what_was_lost_at_the_end_is_counted(make_node, start_child):
    """The reader learns of it as it has room again, and the publisher is still there so long."""
    publisher = make_node().publisher("/blocks", Block)
    (child,) = subscribe(publisher, start_child, ["reliable", {"timeout_s": 0.01}])
    sent = Sent(publisher, 1000)
    with child.stopped():
        while sent.refused < 5:
            sent()
        closing = begin_close(publisher, linger_s=SOON_S)
    wait_for(lambda: arrives(child, sent.count, lost=sent.refused))
    closing.join()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # the threads of the node
@pytest.mark.parametrize("use", ["lend", "count"])
def test_a_forked_child_leaves_a_publisher_alone(make_node, use):
    """Also where a large message is written at the moment of the fork."""
    node = make_node(registry="off")
    publisher, subscriber = connect(node, "/blocks", Block)
    with publisher._large_lock, publisher._lock:
        child = os.fork()
        if child == 0:
            signal.alarm(int(SOON_S))
            try:
                if use == "lend":
                    with pytest.raises(Closed):
                        publisher.try_loan(n=100_000)
                else:
                    assert publisher.subscriber_count == 1
                os._exit(0)
            except BaseException:
                os._exit(2)
        assert os.waitpid(child, 0)[1] == 0
    subscriber.close()


@pytest.mark.parametrize("policy", ["reliable", "keep_last"])
@needs_native
def test_what_a_reader_has_no_time_for_is_counted(make_node, start_child, policy):
    """It stands still until its publisher has given up."""
    node = make_node()
    publisher = node.publisher("/blocks", Block)
    options = {"timeout_s": 0.01} if policy == "reliable" else {"depth": 8}
    (child,) = subscribe(publisher, start_child, [policy, options])
    sent = Sent(publisher, 16_000)
    with child.stopped():
        for _ in range(2000):
            sent()
        publisher.close(linger_s=0.0)
    found = wait_for(
        lambda: (heard := child.ask())["count"] + heard["overtaken"] + heard["lost"] >= sent.count and heard
    )
    assert (found["torn"], found["rejected"]) == (0, 0)
    assert found["count"] + found["overtaken"] + found["lost"] == sent.count
    assert found["lost"] > 0
    assert policy == "keep_last" or found["lost"] == sent.refused


@pytest.mark.parametrize("policy", [["keep_last"], ["latest"], ["reliable"]], ids=lambda policy: policy[0])
@needs_native
def test_a_publisher_that_dies_after_its_first_large_message(start_child, policy):
    """Nobody can map its memory any more: the subscriber goes on, and accounts for every message."""
    subscriber = start_child("endless_subscriber", topic="/blocks", policy=policy)
    for round_ in range(1, 3):
        child = start_child("peer")
        child.ask(do="publisher", topic="/blocks", type="Block")
        assert child.ask(do="await_subscribers", topic="/blocks")["ok"]
        with subscriber.stopped():
            child.say(do="leave", topic="/blocks", count=30, size=50, last_size=100_000, orderly=False)
            child.process.wait(SOON_S)

        def accounted(sent: int = 31 * round_) -> bool:
            found = subscriber.ask()
            return found["count"] + found["lost"] + found["overtaken"] == sent

        wait_for(accounted)


@pytest.mark.usefixtures("sockets_alone")
@pytest.mark.parametrize("listen", [{}, {"listen": "127.0.0.1", "host": "elsewhere"}], ids=["ipc", "tcp"])
def test_a_publisher_leaves_while_its_reader_reads(make_node, start_child, listen):
    """What a socket has taken is not yet with the reader: the publisher waits for its word."""
    subscriber = make_node(listen=listen.get("listen")).subscriber("/blocks", Block, policy=reliable())
    child = start_child("peer", **listen)
    child.ask(do="publisher", topic="/blocks", type="Block", max_wait_s=SOON_S)
    assert child.ask(do="await_subscribers", topic="/blocks")["ok"]
    child.say(
        do="leave", topic="/blocks", count=900, size=16_000
    )  # more than the kernel holds, less than a queue
    time.sleep(0.3)  # until the publisher has handed over everything, and would be gone
    for number in range(900):
        assert subscriber.recv(SOON_S).number == number
    assert subscriber.counters.lost == 0
