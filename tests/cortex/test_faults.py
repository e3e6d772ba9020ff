"""Processes that are killed, stopped or restarted at any moment: nothing hangs, leaks or is torn.

`CORTEX_KILLS=200 CORTEX_STOP_S=5` runs the long version.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import signal
import threading
import time

import numpy as np
import pytest
from c_module import needs_native
from peer import Block, accounted, is_whole, make_block, slots_held, take
from processes import SOON_S, Beside, fork_server, processes_with, shared_mappings, wait_for

from cortex import keep_last, latest, reliable
from cortex.host import REGISTRY_LOCK, runtime_dir

KILLS = int(os.environ.get("CORTEX_KILLS", "15"))
STOP_S = float(os.environ.get("CORTEX_STOP_S", "2"))
SIZES = [100, 200_000, 5_000, 60_000, 100]
POLICIES = [["keep_last", {"depth": 8}], ["latest"], ["reliable", {"depth": 4, "timeout_s": 60.0}]]


class Stream:
    """Publishes blocks in a thread, for the time of a block of code."""

    def __init__(self, publisher, rate_hz=1000.0, sizes=SIZES):
        self.publisher = publisher
        self.longest_s = 0.0
        self.refused = 0
        self._blocks = [make_block(0, size) for size in sizes]
        self._pause_s = 1.0 / rate_hz
        self._stopping = threading.Event()
        self._thread = Beside(self._run)

    @property
    def published(self):
        return self.publisher.counters.published

    def _run(self):
        for number in itertools.takewhile(
            lambda _: not self._stopping.wait(self._pause_s), itertools.count()
        ):
            block = self._blocks[number % len(self._blocks)]
            begin = time.monotonic()
            self.refused += not self.publisher.publish(Block(number, block.check, block.data))
            self.longest_s = max(self.longest_s, time.monotonic() - begin)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join()


@pytest.fixture(scope="module", autouse=True)
def forks():
    """What starts the processes that are killed."""
    return fork_server()


def goes_on(stream, count=20):
    """The stream publishes more."""
    before = stream.published
    wait_for(lambda: stream.published >= before + count)


def left(base, *subscribers):
    """How many files the nodes have, and how many descriptors and rings this process."""
    wait_for(lambda: len(list(base.glob("*/*.lock"))) <= 2)  # what a dead process had is swept
    wait_for(lambda: not any(subscriber.carriers for subscriber in subscribers))
    return np.array([len(list(base.glob("*/*"))), len(os.listdir("/proc/self/fd")), len(shared_mappings())])


def registry_pid(base):
    """The registry's process."""
    with contextlib.suppress(FileNotFoundError, ValueError):
        pid = int((runtime_dir(0) / REGISTRY_LOCK).read_text())
        return pid if pid in processes_with(str(base)) else None


@pytest.mark.parametrize("policy", [keep_last(8), reliable(4, 60.0)], ids=str)
@needs_native
def test_publishers_are_killed(make_node, start_child, runtime, tmp_path, policy):
    """Whatever it was doing: what has arrived is whole, and stays so; the next publisher is heard.

    A message was published or was not: all that were are received, overtaken or lost.
    """
    generator = random.Random(str(policy))
    subscriber = make_node().subscriber("/blocks", Block, policy=policy)
    counters = subscriber.counters
    count_file = tmp_path / "published"
    kept, sources = [], set()
    before = None
    for _ in range(max(KILLS // 6, 1)):
        count_file.write_bytes(bytes(8))
        options = {"sizes": SIZES, "rate_hz": 2000.0, "count_file": str(count_file), "forked": True}
        child = start_child("endless_publisher", topic="/blocks", **options)
        first, known, last = accounted(counters), len(sources), -1
        end = None
        while end is None or time.monotonic() < end:
            block, info = subscriber.recv_with_info(SOON_S)
            assert is_whole(block)
            sources.add(info.source)
            assert block.number > last
            last = block.number
            if end is None and last >= 3:  # any moment within the next cycles is as good as another
                end = time.monotonic() + generator.uniform(0.0, 0.05)
            if len(block.data) > 100_000:
                kept = [*kept[-1:], block]
        assert len(sources) == known + 1
        child.kill()
        published = int.from_bytes(count_file.read_bytes(), "little")
        quiet_s = 0.0
        while accounted(counters) - first < published or quiet_s < 0.01:
            begin = time.monotonic()
            rest = take(subscriber, 0.01)
            assert rest is None or is_whole(rest)
            quiet_s = time.monotonic() - begin
        assert accounted(counters) - first in (published, published + 1)  # it died before it wrote that down
        assert all(is_whole(block) for block in kept)
        child.end()
        if before is None:
            kept.clear()
            before = left(runtime, subscriber)
    assert counters.rejected == 0
    assert counters.lost == 0 or not policy.reliable
    assert len(sources) == max(KILLS // 6, 1)
    assert all(is_whole(block) for block in kept)
    kept.clear()
    del block, rest
    wait_for(lambda: (left(runtime, subscriber) <= before).all())  # ZeroMQ closes descriptors later


@pytest.mark.parametrize("policy", POLICIES, ids=lambda policy: policy[0])
@needs_native
def test_subscribers_are_killed(make_node, start_child, runtime, policy):
    """While they hold messages and wait for more: the leases are back at once, the publisher goes on.

    Another reader loses nothing by it.
    """
    generator = random.Random(policy[0])
    node = make_node()
    publisher = node.publisher("/blocks", Block)
    numbers, torn = [], []

    def take(block):
        numbers.append(block.number)
        torn.extend([] if is_whole(block) else [block.number])

    witness = node.subscriber("/blocks", Block, take, policy=reliable(64, 60.0))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    freed_s, longest_s = [], []
    before = None
    with Stream(publisher) as stream:
        for _ in range(max(KILLS // 5, 1)):
            child = start_child("endless_subscriber", topic="/blocks", policy=policy, keep=2, forked=True)
            wait_for(lambda child=child: child.ask()["count"] > 20)
            assert child.ask()["torn"] == 0
            assert publisher.subscriber_count == 2
            pause_until = time.monotonic() + generator.uniform(0.0, 0.05)
            while time.monotonic() < pause_until:
                time.sleep(1e-3)
            stream.longest_s = 0.0
            begin = time.monotonic()
            child.kill()
            wait_for(lambda: slots_held(publisher) == 0, every_s=5e-4)
            freed_s.append(time.monotonic() - begin)
            goes_on(stream)
            wait_for(lambda: publisher.subscriber_count == 1)
            longest_s.append(stream.longest_s)
            child.end()
            before = left(runtime) if before is None else before
            came = numbers[:]
            assert came == list(range(came[0], came[0] + len(came)))
            del numbers[: len(came) - 1]
    wait_for(lambda: witness.counters.received == publisher.counters.published)
    wait_for(lambda: (left(runtime) <= before).all())
    assert not torn
    assert stream.refused == publisher.counters.timeouts == witness.counters.lost == 0
    assert min(freed_s) < 0.3  # 1 s, if nobody noticed; a busy machine makes some of them late, but not each
    assert min(longest_s) < 0.5


def test_registries_are_killed(make_node, start_child, runtime):
    """Streams between those who know each other lose nothing; newcomers are found soon after."""
    generator = random.Random(3)
    found_s = []
    child = start_child("endless_publisher", topic="/blocks", sizes=SIZES, rate_hz=500.0)
    numbers = []

    def take(block):
        assert is_whole(block)
        numbers.append(block.number)

    subscriber = make_node().subscriber("/blocks", Block, take, policy=reliable(64, 60.0))
    wait_for(lambda: len(numbers) > 10)
    for round_ in range(max(KILLS // 5, 1)):
        pid = wait_for(lambda: registry_pid(runtime))
        time.sleep(generator.uniform(0.0, 0.3))  # any moment is as good as another
        os.kill(pid, signal.SIGKILL)
        begin = time.monotonic()
        newcomer = make_node(f"newcomer {round_}")
        late = newcomer.subscriber("/blocks", Block, policy=latest())
        assert is_whole(late.recv(SOON_S))
        found_s.append(time.monotonic() - begin)
        newcomer.close()
    assert min(found_s) < 4.0  # a busy machine makes some of them late, but not each
    published = child.ask()["published"]
    wait_for(lambda: numbers[-1] >= published - 1)
    child.finish()  # then no more come
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert (subscriber.counters.lost, subscriber.counters.rejected) == (0, 0)


@pytest.mark.parametrize("sizes", [[100], [150_000]], ids=["small", "large"])
@pytest.mark.parametrize(
    "policy", [*POLICIES[:2], ["reliable", {"depth": 4, "timeout_s": 0.3}]], ids=lambda p: p[0]
)
def test_a_subscriber_is_stopped(make_node, start_child, runtime, policy, sizes):
    """The publisher waits once, for as long as the policy says; the subscriber learns what it has missed."""
    publisher = make_node().publisher("/blocks", Block)
    child = start_child("endless_subscriber", topic="/blocks", policy=policy, keep=1)
    assert publisher.wait_for_subscribers(1, SOON_S)

    def accounted(found):
        assert found["torn"] == found["rejected"] == 0
        total = found["count"] + found["lost"] + found["overtaken"]
        assert total <= publisher.counters.published
        return total == publisher.counters.published

    with Stream(publisher, rate_hz=2000.0, sizes=sizes) as stream:
        wait_for(lambda: child.ask()["count"] > 20)
        with child.stopped():
            time.sleep(STOP_S)
            goes_on(stream, int(2.0 * SOON_S / 0.3))  # it would not, if each of them waited
        before = child.ask()["count"]
        wait_for(lambda: child.ask()["count"] > before + 20)

    def complete():
        """After one more message, every earlier one was received, overtaken or lost."""
        publisher.publish(make_block(0, sizes[0]))
        return any(accounted(child.ask()) for _ in range(20))

    wait_for(complete)
    if policy[0] == "reliable":
        assert child.ask()["lost"] <= publisher.counters.timeouts
    child.finish()


def test_a_publisher_is_stopped(make_node, start_child, runtime):
    """It is not taken for dead, what it had sent is kept, and it goes on."""
    child = start_child("endless_publisher", topic="/blocks", sizes=SIZES, rate_hz=500.0)
    node = make_node()
    subscriber = node.subscriber("/blocks", Block, policy=reliable(64, 60.0))
    last = subscriber.recv(SOON_S).number
    with child.stopped():
        end = time.monotonic() + STOP_S
        while time.monotonic() < end:
            if (block := take(subscriber, 0.1)) is not None:
                assert block.number == last + 1
                last += 1
    for _ in range(100):
        block = subscriber.recv(SOON_S)
        assert (block.number, is_whole(block)) == (last + 1, True)
        last += 1
    assert subscriber.counters.lost == 0
    child.finish()


@pytest.mark.parametrize(("limit", "shared"), [(100_000, 0), (1_000_000, 2)], ids=["a ring", "slots"])
@pytest.mark.parametrize("policy", [keep_last(8), reliable(8, SOON_S)], ids=str)
@needs_native
def test_no_memory(make_node, start_child, runtime, policy, limit, shared):
    """A limit on the size of files stands for a full memory: messages go through the socket, in order."""
    child = start_child("peer", limit_file_bytes=limit)
    child.ask(do="publisher", topic="/blocks", type="Block", max_wait_s=SOON_S)
    subscriber = make_node().subscriber("/blocks", Block, policy=policy)
    assert child.ask(do="await_subscribers", topic="/blocks")["ok"]
    for number, size in enumerate((100, 100, 1_000_000, 100, 20_000, 300_000)):
        child.say(do="publish", topic="/blocks", count=1, start=number, size=size)
        block = subscriber.recv(SOON_S)
        assert (block.number, len(block.data), is_whole(block)) == (number, size, True)
        assert child.hear()["delivered"] == 1
        if policy.reliable:  # another attaches anew when it has read its message
            assert ("shared memory" in subscriber.carriers[0]) == (number < shared)
    assert (subscriber.counters.lost, subscriber.counters.rejected) == (0, 0)
    child.finish()
    assert "no shared memory" in child.errors()


@pytest.mark.parametrize("policy", [POLICIES[0], ["reliable", {"depth": 4, "timeout_s": 0.05}]], ids=str)
@needs_native
def test_no_memory_for_slots_and_a_reader_that_stands_still(start_child, runtime, policy):
    """The publisher waits for its time only; what came before is there, and what is lost is counted once."""
    child, reader = start_child("peer", limit_file_bytes=1_000_000), start_child("peer")
    child.ask(do="publisher", topic="/blocks", type="Block")
    reader.ask(do="subscriber", topic="/blocks", type="Block", policy=policy)
    assert child.ask(do="await_subscribers", topic="/blocks")["ok"]
    with reader.stopped():
        child.ask(do="publish", topic="/blocks", count=4, size=100)
        delivered = child.ask(do="publish", topic="/blocks", count=5, start=4, size=1_000_000)["delivered"]
        assert delivered == (0 if policy[0] == "reliable" else 5)
    published, received, last = 9, 0, -1
    while last < 9:
        child.ask(do="publish", topic="/blocks", count=1, start=published, size=100)
        published += 1
        got = reader.ask(do="receive", topic="/blocks", until=9, timeout_s=0.02)
        assert got["ordered"]
        assert got["whole"]
        received, last = received + got["count"], max(last, got["last"])
    counters = reader.ask(do="counters", topic="/blocks")
    assert counters["received"] == received
    assert received + counters["lost"] + counters["overtaken"] == last + 1
    child.finish()
    reader.finish()
