"""Reliable over tcp, while either side closes or is killed and connections are cut, at random moments.

What was sent is received or counted as lost. `CORTEX_TCP_RUNS=1000` runs the long version.
"""

from __future__ import annotations

import contextlib
import os
import random
import socket
import stat
import threading
import time

import pytest
from peer import Block, accounted, is_whole, make_block
from processes import SOON_S, Beside, fork_server, wait_for

import cortex.node
from cortex import keep_last, reliable
from cortex.context import Closed

RUNS = int(os.environ.get("CORTEX_TCP_RUNS", "8"))
SIZES = [[40], [3_000], [40_000], [40, 40_000, 3_000, 200_000]]
ELSEWHERE = {"listen": "127.0.0.1", "host": "elsewhere", "forked": True}


@pytest.fixture(scope="module", autouse=True)
def forks():
    """What starts the processes that are killed."""
    return fork_server()


class Reading:
    """A thread that reads one subscriber, sometimes slowly, and looks at each message."""

    def __init__(self, subscriber, pause_s):
        self.subscriber = subscriber
        self.wrong = []
        self._pause_s = pause_s
        self._thread = Beside(self._run)

    def _run(self):
        last = -1
        with contextlib.suppress(Closed):
            for block in self.subscriber:
                if block.number <= last or not is_whole(block):
                    self.wrong.append(block.number)
                last = block.number
                if self._pause_s and block.number % 50 == 0:
                    time.sleep(self._pause_s)

    def accounted(self):
        return accounted(self.subscriber.counters)

    def wait_for_end(self):
        """Until its publisher has left, and all that came of it was read."""
        wait_for(lambda: not (self.subscriber._links or self.subscriber._queue))

    def close(self):
        self.subscriber.close()
        self._thread.join()
        assert self.wrong == []
        assert self.subscriber.counters.rejected == self.subscriber.counters.overtaken == 0


def cut_connections(port):
    """Shut down the connections of this process to a port of this host, as a network does that fails."""
    for number in map(int, os.listdir("/proc/self/fd")):
        with contextlib.suppress(OSError):
            if not stat.S_ISSOCK(os.fstat(number).st_mode):
                continue
            with socket.socket(fileno=os.dup(number)) as each:
                if each.family in (socket.AF_INET, socket.AF_INET6) and each.getpeername()[1] == port:
                    each.shutdown(socket.SHUT_RDWR)


def read(node, generator):
    """A reader of any kind, to which its publisher is still to come."""
    depth, timeout_s = generator.choice([1, 4, 64, 1000]), generator.choice([0.002, 0.05, SOON_S])
    pause_s = generator.choice([0.0, 0.0, 0.01])
    return Reading(node.subscriber("/blocks", Block, policy=reliable(depth, timeout_s)), pause_s)


def publish(child, reading, generator):
    """Begin to publish, once both ends know of each other, and then close; how many, and by which port."""
    count = generator.randrange(1, 1500)
    child.ask(do="publisher", topic="/blocks", type="Block", max_wait_s=SOON_S)
    assert child.ask(do="await_subscribers", topic="/blocks")["ok"]
    assert reading.subscriber.wait_for_publisher(SOON_S)
    (link,) = reading.subscriber._links
    rate_hz = generator.choice([0.0, 5000.0])
    child.say(do="publish", topic="/blocks", count=count, sizes=generator.choice(SIZES), rate_hz=rate_hz)
    child.say(do="counters", topic="/blocks")
    child.say(do="close", topic="/blocks")
    return count, int(link.address.rpartition(":")[2])


def a_publisher_closes(node, child, start_child, generator, tmp_path):
    reading = read(node, generator)
    count, _ = publish(child, reading, generator)
    delivered, published = child.hear()["delivered"], child.hear()
    child.hear()
    reading.wait_for_end()
    counters = reading.subscriber.counters
    assert published["published"] == count == reading.accounted()
    assert counters.cut_off == 0
    assert counters.lost <= published["timeouts"] == count - delivered
    reading.close()


def connections_are_cut(node, child, start_child, generator, tmp_path):
    """Those that the reader has to its publisher; ZeroMQ makes new ones, and what was in flight is lost.

    With it the end, or not: without it nobody may believe to have heard all.
    """
    reading = read(node, generator)
    count, port = publish(child, reading, generator)
    for _ in range(generator.randrange(1, 4)):
        time.sleep(generator.uniform(0.0, 0.15))
        cut_connections(port)
    for _ in range(3):
        child.hear()
    reading.wait_for_end()
    assert reading.accounted() == count or (
        reading.accounted() < count and reading.subscriber.counters.cut_off == 1
    )
    reading.close()


@pytest.mark.parametrize("before", [0, 20])
@pytest.mark.parametrize("after", [0, 10])
def test_a_connection_fails_for_good_in_silence(make_node, start_child, before, after):
    """Its reader has been told that nothing was missing so far: that is no end."""
    node = make_node("here", listen="127.0.0.1")
    child = start_child("peer", **ELSEWHERE)
    reading = Reading(node.subscriber("/blocks", Block, policy=reliable(timeout_s=SOON_S)), 0.0)
    child.ask(do="publisher", topic="/blocks", type="Block", max_wait_s=SOON_S)
    assert child.ask(do="await_subscribers", topic="/blocks")["ok"]
    child.ask(do="publish", topic="/blocks", count=before, sizes=[40], rate_hz=0.0)
    time.sleep(0.3)  # it says after 0.1 s how many there were
    assert reading.accounted() == before
    (link,) = reading.subscriber._links
    with reading.subscriber._lock:
        link.socket.disconnect(link.address)
    child.ask(do="publish", topic="/blocks", count=after, sizes=[40], rate_hz=0.0)
    child.ask(do="close", topic="/blocks")
    reading.wait_for_end()
    counters = reading.subscriber.counters
    assert (counters.received, counters.lost, counters.cut_off) == (before, 0, 1)
    reading.close()
    child.finish()


def a_publisher_is_killed(node, child, start_child, generator, tmp_path):
    """What was in flight is lost, nobody knows how much: the reader counts that the stream was cut off."""
    count_file = tmp_path / "published"
    count_file.write_bytes(bytes(8))
    victim = start_child(
        "endless_publisher",
        topic="/blocks",
        sizes=generator.choice(SIZES),
        rate_hz=generator.choice([300.0, 1e6]),
        count_file=str(count_file),
        **ELSEWHERE,
    )
    reading = read(node, generator)
    wait_for(lambda: reading.accounted() > generator.randrange(1, 100))
    time.sleep(generator.uniform(0.0, 0.05))
    victim.kill()
    reading.wait_for_end()
    published = int.from_bytes(count_file.read_bytes(), "little")
    assert reading.accounted() <= published + 1
    assert reading.subscriber.counters.cut_off == 1
    reading.close()
    victim.end()


def a_subscriber_leaves(node, child, start_child, generator, tmp_path):
    """It closes, or is killed; the publisher waits no longer for it, and another reader gets all."""
    victim = start_child(
        "endless_subscriber",
        topic="/numbers",
        policy=["reliable", {"depth": generator.choice([1, 64]), "timeout_s": SOON_S}],
        **ELSEWHERE,
    )
    child.ask(do="subscriber", topic="/numbers", type="Block", policy=["reliable", {"timeout_s": SOON_S}])
    longest_s = 0.0
    with node.publisher("/numbers", Block, max_wait_s=SOON_S) as publisher:
        assert publisher.wait_for_subscribers(2, SOON_S)
        count = generator.randrange(200, 1500)
        child.say(do="receive", topic="/numbers", until=count)
        leave = threading.Timer(
            generator.uniform(0.0, 0.1),
            victim.kill if generator.random() < 0.7 else victim.process.stdin.close,
        )
        leave.start()
        block = make_block(0, generator.choice(SIZES)[0])
        for number in range(count + 1):
            begin_s = time.monotonic()
            assert publisher.publish(Block(number, block.check, block.data))
            longest_s = max(longest_s, time.monotonic() - begin_s)
        leave.join()
        got = child.hear()
        assert publisher.counters.published == count + 1
        assert publisher.counters.timeouts == 0
    assert got == {"count": count + 1, "first": 0, "last": count, "ordered": True, "whole": True}
    assert longest_s < SOON_S / 2.0
    child.ask(do="close", topic="/numbers")
    victim.end()


def test_the_end_comes_after_a_full_queue(make_node, monkeypatch):
    """A reader of a lossy socket learns how many messages there were, also where its queue was full."""
    publisher = make_node("one", listen="127.0.0.1").publisher("/blocks", Block)
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(cortex.node, "host_id", lambda: "another host")
        node = make_node("two", listen="127.0.0.1")
    subscriber = node.subscriber("/blocks", Block, policy=keep_last(4))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert subscriber.wait_for_publisher(SOON_S)
    assert subscriber.carriers == ["tcp"]
    block, count = make_block(0, 10_000), 6_000
    with subscriber._receive_lock:  # nobody reads: queues and buffers fill up, and the rest is dropped
        for _ in range(count):
            publisher.publish(block)
        closing = Beside(publisher.close, linger_s=SOON_S)
        closing.thread.join(0.3)
        assert closing.thread.is_alive()  # the reader has not said yet that it knows
    wait_for(lambda: accounted(subscriber.counters) + len(subscriber._queue) == count)
    closing.join()
    assert subscriber.counters.lost > 0


@pytest.mark.parametrize(
    "run", [a_publisher_closes, a_publisher_is_killed, a_subscriber_leaves, connections_are_cut]
)
def test_reliable_over_tcp(make_node, start_child, runtime, tmp_path, run):
    node, generator = make_node("here", listen="127.0.0.1"), random.Random(run.__name__)
    child = start_child("peer", **ELSEWHERE)
    for _ in range(max(RUNS // 4, 1)):
        run(node, child, start_child, generator, tmp_path)
    child.finish()
