"""Large messages: leases, quotas, growing rings, loans, and what happens without shared memory."""

from __future__ import annotations

import contextlib
import gc
import mmap
import time
import tracemalloc
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from c_module import needs_native
from peer import (
    Block,
    Scan,
    accounted,
    connect,
    go_on,
    is_whole,
    make_block,
    slots_held,
    stand_still,
    take,
    take_all,
    without_rings,
)
from processes import SOON_S, Beside, shared_mappings, wait_for

import cortex.back_pressure
import cortex.broadcast
import cortex.large
import cortex.link
from cortex import Closed, keep_last, latest, reliable
from cortex.pub_socket import Backoff

pytestmark = needs_native
LARGE = 100_000


def scan(number, size=LARGE):
    return Scan(number, np.full(size, number, np.float32))


def connected(node, kind, policy, **options):
    return connect(node, "/large", kind, policy, **options)


def is_shared(message):
    """Whether a received array lies in a ring, not in memory of its own."""
    address = message.ranges.__array_interface__["data"][0]
    for line in Path("/proc/self/maps").read_text(encoding="ascii").splitlines():
        low, high = (int(part, 16) for part in line.split()[0].split("-"))
        if low <= address < high:
            return "memfd:cortex" in line
    return False


def test_an_array_that_is_copied_past_the_caches(node):
    """In 64-byte steps, and what is left of them."""
    publisher, subscriber = connected(node, Block, reliable())
    for number in range(4):  # after the first they take the fast path
        block = make_block(number, (8 << 20) + 13)
        assert publisher.publish(block)
        assert np.array_equal(subscriber.recv(SOON_S).data, block.data)


def test_a_large_message_is_a_view(node):
    publisher, subscriber = connected(node, Scan, keep_last())
    publisher.publish(scan(1))
    message = subscriber.recv(SOON_S)
    assert is_shared(message)
    assert slots_held(publisher) == 1
    publisher.publish(scan(2, 10))
    assert not is_shared(subscriber.recv(SOON_S))
    del message
    assert slots_held(publisher) == 0


@pytest.mark.parametrize("end", ["subscriber", "publisher", "node of the reader", "node of the writer"])
def test_views_outlive_everything(make_node, end):
    """What is closed leaves what was received as it was, also where its slots are written again."""
    one, two = make_node("one"), make_node("two")
    publisher = one.publisher("/large", Block)
    subscriber = two.subscriber("/large", Block, policy=reliable(4))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    kept = []
    for number in range(2):
        publisher.publish(make_block(number, 300_000))
        kept.append(subscriber.recv(SOON_S))
    {"subscriber": subscriber, "publisher": publisher, "node of the reader": two}.get(end, one).close()
    gc.collect()
    if end == "subscriber":
        other = two.subscriber("/large", Block, policy=latest())
        assert other.wait_for_publisher(timeout_s=SOON_S)
        for number in range(10, 30):
            publisher.publish(make_block(number, 300_000))
            other.recv(SOON_S)
    assert all(map(is_whole, kept))
    one.close()
    two.close()
    assert [(block.number, is_whole(block)) for block in kept] == [(0, True), (1, True)]
    kept.clear()
    gc.collect()
    wait_for(lambda: not shared_mappings())


def test_a_reader_that_hoards_hurts_only_itself(node):
    """It copies what it may lease no more; the other gets all, and the publisher waits for neither."""
    publisher, hoarder = connected(node, Scan, keep_last(64))
    other = node.subscriber("/large", Scan, policy=keep_last(64))
    assert publisher.wait_for_subscribers(2, SOON_S)
    kept, took_s = [], []
    for number in range(100):
        begin = time.monotonic()
        assert publisher.publish(scan(number))
        took_s.append(time.monotonic() - begin)
        assert other.recv(SOON_S).stamp_ns == number
        kept += filter(None, [take(hoarder, 0.005)])
    assert sorted(took_s)[80] < 0.05  # the last 60 of them are those that it could wait for
    wait_for(lambda: kept.extend(take_all(hoarder)) or accounted(hoarder.counters) == 100)
    assert [message.stamp_ns for message in kept] == list(range(100))
    assert all((message.ranges == message.stamp_ns).all() for message in kept)
    assert (other.counters.received, other.counters.lost, hoarder.counters.received) == (100, 0, 100)
    assert 1 <= sum(map(is_shared, kept)) <= 32
    kept.clear()
    publisher.publish(scan(100))
    assert is_shared(hoarder.recv(SOON_S))


def test_a_reader_that_keeps_all_there_is_holds_up_its_publisher(node):
    """A reliable one, that may copy nothing more: what is lost is counted at both ends, and it goes on."""
    publisher, subscriber = connected(node, Scan, reliable(2, 0.01))
    kept = []
    for number in range(60):
        delivered = publisher.publish(scan(number, 4_000_000))
        kept += filter(None, [take(subscriber, 0.005)])
    assert not delivered
    assert sum(not is_shared(message) for message in kept) * 16_000_000 <= 64 << 20
    assert all((message.ranges == message.stamp_ns).all() for message in kept)
    kept.clear()

    def arrives():
        publisher.publish(scan(99, 10))
        return 99 in [message.stamp_ns for message in take_all(subscriber)]

    wait_for(arrives)
    wait_for(lambda: take_all(subscriber) or accounted(subscriber.counters) == publisher.counters.published)


@pytest.mark.parametrize("count", [3, 70])
def test_many_readers(node, count):
    """More than the ring takes: the others get the same bytes through the socket."""
    publisher = node.publisher("/large", Scan)
    subscribers = [node.subscriber("/large", Scan, policy=keep_last(8)) for _ in range(count)]
    assert publisher.wait_for_subscribers(count, SOON_S)
    for number in range(5):
        assert publisher.publish(scan(number, 30_000))
        messages = [subscriber.recv(SOON_S) for subscriber in subscribers]
        assert all(message == scan(number, 30_000) for message in messages)
        with publisher._pub_sockets.lock:
            assert len(publisher._fanout.ring._readers) == min(count, 64)
        del messages
    assert sum(subscriber.counters.lost for subscriber in subscribers) == 0
    wait_for(lambda: slots_held(publisher) == 0)


@pytest.mark.parametrize(
    ("policy", "waiting"), [(reliable(64, 60.0), 1), (reliable(64, 60.0), 3), (keep_last(64), 1)], ids=str
)
def test_messages_that_grow_and_shrink(node, policy, waiting):
    """Also while some wait: what lies in an older ring is still delivered."""
    publisher, subscriber = connected(node, Scan, policy)
    sizes = [5_000, 10, 20_000, 80_000, 320_000, 640_000, 5_000, 1_000_000, 10, 4_200, 1_000_001]
    kept = []
    for begin in range(0, 24, waiting):
        sent = [scan(number, sizes[number % 11]) for number in range(begin, begin + waiting)]
        assert all(map(publisher.publish, sent))
        for expected in sent:
            kept.append(subscriber.recv(SOON_S))
            assert kept[-1] == expected
        del kept[:-2]
    assert subscriber.counters.lost == 0
    kept.clear()
    wait_for(lambda: len(shared_mappings()) < 12)  # the small ones are given up


def test_who_comes_while_a_message_waits_for_room(node):
    """Its body lies in a slot: that ring is kept, and more slots are made for the next message."""
    size, options = 500_000, {"expected_bytes": 2_500_000, "max_wait_s": 60.0}
    publisher, subscriber = connected(node, Scan, reliable(1, 60.0), **options)
    stand_still(subscriber)
    ring, count = publisher._fanout.ring._ring, 0
    while ring.patience(64) < 0:  # less than a frame that names a slot would find
        publisher.publish(scan(1, 3_000 if ring.patience(13_000) < 0 else 1))
        count += 1
    slots = ring.slots
    with Beside(publisher.publish, scan(2, size)) as waiting:
        waiting.thread.join(0.2)
        assert waiting.thread.is_alive()
        other = node.subscriber("/large", Scan, policy=reliable(1, 60.0))
        assert other.wait_for_publisher(timeout_s=SOON_S)
        for _ in range(count):
            assert subscriber.recv(SOON_S).stamp_ns == 1
        assert subscriber.recv(SOON_S) == scan(2, size)
    assert waiting.results == [True]
    assert publisher.publish(scan(3, size))
    assert other.recv(SOON_S) in (scan(2, size), scan(3, size))
    assert ring.slots > slots


def test_memory_stays_flat(node):
    """Thousands of messages, large ones among them, on both sides of one process."""

    def resident():
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * mmap.PAGESIZE

    publisher, subscriber = connected(node, Scan, reliable(8, 60.0))
    small, large = scan(1, 10), scan(2, 50_000)

    def run(count):
        for number in range(count):
            assert publisher.publish(large if number % 8 == 0 else small)
            subscriber.recv(SOON_S)
        gc.collect()

    run(3000)
    before = resident()
    run(12_000)
    assert resident() - before < 8 << 20  # 1 kB each would be 12 MB; one large one leaked in eight, 300 MB


def test_a_reader_without_shared_memory(node):
    """It gets the same bytes; one that can share goes on sharing."""
    publisher, sharing = connected(node, Scan, reliable(8, 60.0))
    with without_rings():
        plain = node.subscriber("/large", Scan, policy=reliable(8, 60.0))
        assert publisher.wait_for_subscribers(2, SOON_S)
        assert plain.wait_for_publisher(SOON_S)
    for number, size in enumerate((10, LARGE, 5_000, 10, 300_000)):
        publisher.publish(scan(number, size))
        first, second = sharing.recv(SOON_S), plain.recv(SOON_S)
        assert first == second == scan(number, size)
        assert is_shared(first) == (size > 4096)
        assert not second.ranges.flags.writeable
    assert plain.counters.rejected == 0


@pytest.mark.usefixtures("sockets_alone")
def test_sockets_send_a_body_from_memory_that_is_used_again(node):
    """No second copy of it is made, and nothing is allocated for it once one has been sent."""
    publisher, subscriber = connected(node, Scan, reliable())
    message, peaks = scan(7, 1_000_000), []
    for _ in range(6):
        tracemalloc.start()
        assert publisher.publish(message)
        peaks.append(tracemalloc.get_traced_memory()[1] / message.ranges.nbytes)
        tracemalloc.stop()
        assert subscriber.recv(SOON_S) == message
        wait_for(lambda: publisher._fanout.large._free, SOON_S)
    assert max(peaks) < 1.5
    assert min(peaks) < 0.5
    tracemalloc.start()
    with publisher.loan(n=1_000_000) as draft:
        draft.stamp_ns, draft.ranges[:] = message.stamp_ns, message.ranges
    assert tracemalloc.get_traced_memory()[1] / message.ranges.nbytes < 1.5
    tracemalloc.stop()
    assert subscriber.recv(SOON_S) == message
    del draft
    wait_for(lambda: publisher._fanout.large._free, SOON_S)

    def is_given_back(after_s):
        publisher.tick(time.monotonic_ns() + int(1e9 * after_s))
        return not publisher._fanout.large._free

    assert not is_given_back(after_s=1.0)
    wait_for(lambda: is_given_back(after_s=11.0))


@pytest.mark.usefixtures("sockets_alone")
def test_a_small_body_in_memory_of_a_larger_one_counts_as_that(node):
    """What waits for a reliable reader is bounded by the memory that it takes."""
    publisher, subscriber = connected(node, Scan, reliable(1, 0.05))
    large = publisher._fanout.large
    bodies = [large.acquire(4_000_000) for _ in range(8)]
    bodies.clear()
    assert len(large._free) == 8
    stand_still(subscriber)
    for _ in range(10):
        publisher.publish(scan(0, 300_000))  # 1.2 MB
    held = sum(large._lent.values())
    assert 0 < held <= large.waiting_bytes[True] <= 8 << 20
    del bodies


@pytest.mark.usefixtures("sockets_alone")
@pytest.mark.parametrize("policy", [reliable(2, 0.05), keep_last(4)], ids=str)
def test_what_waits_in_sockets_is_bounded(node, monkeypatch, policy):
    """A reader that reads nothing, large messages, no shared memory: memory does not grow for ever."""
    monkeypatch.setattr(cortex.link, "QUEUE_MAX", 4)  # else all 60 may wait in its socket
    publisher, subscriber = connected(node, Scan, policy)
    message = scan(0, 1_000_000)
    stand_still(subscriber)
    for _ in range(60):
        publisher.publish(message)
    assert sum(publisher._fanout.large.waiting_bytes.values()) <= 80 << 20

    def has_caught_up():
        publisher.publish(scan(1, 10))
        return 1 in [message.stamp_ns for message in take_all(subscriber)]

    wait_for(has_caught_up)
    counters = subscriber.counters
    assert counters.received > 1
    assert counters.lost + counters.overtaken > 0  # overtaken: read late, when newer ones were there


@pytest.mark.usefixtures("sockets_alone")
def test_a_reader_of_a_socket_that_stands_still_holds_up_once(node):
    """Not each large message, nor with each new reader; it goes on when it reads, and counts what it lost."""
    patience_s = 0.5
    publisher, subscriber = connected(node, Scan, reliable(1, patience_s))
    delivered, took_s = [], []

    def publish():
        begin_s = time.monotonic()
        delivered.append(publisher.publish(scan(len(delivered), 250_000)))
        took_s.append(time.monotonic() - begin_s)

    stand_still(subscriber)
    for _ in range(25):
        publish()
    with node.subscriber("/large", Scan, policy=reliable(64, 0.0)):
        assert publisher.wait_for_subscribers(2, SOON_S)
        for _ in range(5):
            publish()
    go_on(subscriber)
    assert delivered == [True] * sum(delivered) + [False] * delivered.count(False)
    assert sum(each_s >= patience_s for each_s in took_s) == 1
    received = []

    def goes_on():
        publish()
        received.extend(message.stamp_ns for message in take_all(subscriber))
        return delivered[-1]

    wait_for(goes_on)
    wait_for(
        lambda: received.extend(m.stamp_ns for m in take_all(subscriber)) or len(delivered) - 1 in received
    )
    assert received == sorted(set(received))
    assert accounted(subscriber.counters) == len(delivered)


def fill_slots(publisher):
    """Publish until a reader that stands still has all slots."""
    ring = publisher._fanout.ring
    while (slot := ring._ring.acquire(100_000)) is not None or not ring._ring.slots:
        del slot
        assert publisher.publish(scan(0, 25_000))


def recorded_waits_s(monkeypatch):
    """How long publishers are ready to wait for readers, each time that they do [s]."""
    waits_s = []

    class Recording(Backoff):
        def __init__(self, timeout_s):
            waits_s.append(max(timeout_s, 0.0))
            super().__init__(timeout_s)

    monkeypatch.setattr(cortex.back_pressure, "Backoff", Recording)
    return waits_s


def test_a_large_message_has_all_its_time_after_one_that_was_held_up(node, monkeypatch):
    """Of another thread, whose turn came between this one's check and its own turn."""
    publisher, subscriber = connect(node, "/scans", Scan, reliable(1, SOON_S), max_wait_s=0.5)
    assert subscriber.wait_for_publisher(SOON_S)
    stand_still(subscriber)
    fill_slots(publisher)
    lock = publisher._large_lock

    class Turn:
        def __enter__(self):
            lock.acquire()
            publisher._back_pressure.waited_s = 0.4

        def __exit__(self, *_):
            lock.release()

    monkeypatch.setattr(publisher, "_large_lock", Turn())
    waits_s = recorded_waits_s(monkeypatch)
    assert not publisher.publish(scan(1, 25_000))
    assert waits_s[0] == 0.5


def test_all_that_stand_still_hold_up_a_message_for_the_time_of_one(node, monkeypatch):
    """One reads the ring and has all slots, for one there is no memory: `max_wait_s` is that of a message."""
    publisher = node.publisher("/scans", Scan, max_wait_s=0.5)
    readers = []
    for reading in (contextlib.nullcontext(), without_rings()):
        with reading:
            readers.append(node.subscriber("/scans", Scan, policy=reliable(1, SOON_S)))
            assert publisher.wait_for_subscribers(len(readers), SOON_S)
            assert readers[-1].wait_for_publisher(SOON_S)
        stand_still(readers[-1])
    fill_slots(publisher)
    monkeypatch.setattr(cortex.large, "STRICT_BYTES", 0)
    waits_s = recorded_waits_s(monkeypatch)
    assert not publisher.publish(scan(1, 25_000))
    assert len(waits_s) > 1
    assert 0.5 <= sum(waits_s) < 0.6


def test_a_message_for_which_there_is_no_memory_keeps_none_from_the_next(node, monkeypatch):
    """Not even from one of another thread."""
    publisher, subscriber = connected(node, Scan, keep_last())

    def refuse(*_: object, **__: object) -> None:
        raise MemoryError

    with monkeypatch.context() as poor:
        poor.setattr(publisher._fanout.ring, "acquire", refuse)
        with pytest.raises(MemoryError):
            publisher.publish(scan(0))
    assert Beside(publisher.publish, scan(1)).join() == [True]
    assert subscriber.recv(SOON_S).stamp_ns == 1
    assert subscriber.counters.lost == 0


@pytest.mark.parametrize("size", [3, LARGE])
def test_a_loan_is_published_when_it_ends(node, size):
    """Or by another thread; once."""
    publisher, subscriber = connected(node, Scan, keep_last())
    with publisher.loan(n=size) as draft:
        draft.stamp_ns = 5
        draft.ranges[:] = np.arange(size)
        with pytest.raises(TimeoutError):
            subscriber.recv(0.02)
    message, info = subscriber.recv_with_info(SOON_S)
    assert (message.stamp_ns, info.stamp_ns, info.sequence) == (5, 5, 0)
    np.testing.assert_array_equal(message.ranges, np.arange(size, dtype=np.float32))
    loan = publisher.try_loan(n=size)
    loan.draft.stamp_ns, loan.draft.ranges[:] = 4, 4.0
    assert Beside(loan.publish).join() == [True]
    assert subscriber.recv(SOON_S) == scan(4, size)
    with pytest.raises(RuntimeError, match="published or dropped before"):
        loan.publish()
    loan.drop()  # nothing is left to be given back
    assert publisher.counters.published == 2


@pytest.mark.parametrize("size", [3, LARGE])
def test_a_loan_that_raises_is_dropped(node, size):
    """It takes no number and no slot."""
    publisher, subscriber = connected(node, Scan, keep_last())

    def change_ones_mind():
        with publisher.loan(n=size) as draft:
            draft.ranges[:] = 1.0
            raise KeyError("changed my mind")

    for _ in range(100):
        with pytest.raises(KeyError, match="changed my mind"):
            change_ones_mind()
    with pytest.raises((TypeError, ValueError), match="stamp_ns"), publisher.loan(n=size) as draft:
        draft.ranges[:] = 1.0  # and no stamp
    with publisher.loan(n=size) as draft:
        draft.stamp_ns = 1
        draft.ranges[:] = 2.0
    message, info = subscriber.recv_with_info(SOON_S)
    assert (message.stamp_ns, info.sequence) == (1, 0)
    assert subscriber.counters.lost == 0


def test_several_loans_at_once(node):
    """Numbers are given when they are published; another message may go in between."""
    publisher, subscriber = connected(node, Scan, keep_last())
    with publisher.loan(n=LARGE) as first:
        first.stamp_ns, first.ranges[:] = 1, 1.0
        with publisher.loan(n=LARGE) as second:
            second.stamp_ns, second.ranges[:] = 2, 2.0
            publisher.publish(scan(3))
            publisher.publish(scan(4, 10))
    received = [subscriber.recv_with_info(SOON_S) for _ in range(4)]
    assert [message.stamp_ns for message, _ in received] == [3, 4, 2, 1]
    assert [info.sequence for _, info in received] == [0, 1, 2, 3]
    assert all((message.ranges == message.stamp_ns).all() for message, _ in received)


def test_too_many_loans(node):
    publisher, subscriber = connected(node, Scan, keep_last(64))
    with contextlib.ExitStack() as loans:
        with pytest.raises(RuntimeError, match="every slot is out on loan"):
            deque(loans.enter_context(publisher.loan(n=1_000_000)) for _ in range(200))
        loans.pop_all().__exit__(KeyError, KeyError("no"), None)
    with publisher.loan(n=1_000_000) as draft:
        draft.stamp_ns, draft.ranges[:] = 9, 9.0
    message, info = subscriber.recv_with_info(SOON_S)
    assert message.stamp_ns == 9
    assert info.sequence == subscriber.counters.lost  # a loan that was refused may count as skipped


EXPECTED = 400_000


def slots_of(publisher):
    """Number and size of a publisher's slots; None if there is no ring."""
    with publisher._pub_sockets.lock:
        ring = publisher._fanout.ring._ring
        return None if ring is None else (ring.slots, ring.slot_bytes)


@pytest.mark.parametrize("policy", [latest(), keep_last(), keep_last(256), reliable()])
def test_messages_find_the_memory_that_was_made_before_them(node, policy):
    """When a reader came; larger ones than expected get their own, and small ones need none."""
    publisher = node.publisher("/large", Scan, expected_bytes=EXPECTED)
    small = node.publisher("/small", Scan, expected_bytes=1000)
    assert slots_of(publisher) is None  # nobody listens
    subscriber, other = (node.subscriber(topic, Scan, policy=policy) for topic in ("/large", "/small"))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert small.wait_for_subscribers(timeout_s=SOON_S)
    made = slots_of(publisher)
    assert made[1] >= EXPECTED
    for number, size in enumerate((20_000, 100_000, 30_000, 300_000, EXPECTED - 4096, 3 * EXPECTED)):
        publisher.publish(scan(number, size // 4))
        assert subscriber.recv(SOON_S) == scan(number, size // 4)
        assert (slots_of(publisher) == made) == (size < EXPECTED)
    assert slots_of(publisher)[1] >= 3 * EXPECTED
    small.publish(scan(1, 100))
    assert other.recv(SOON_S).stamp_ns == 1
    assert slots_of(small) == (0, 0)


def test_one_reader_more_is_given_its_share_when_it_comes(node):
    """A share is two slots: more readers need more, and who is there already is told of the new ring."""
    publisher = node.publisher("/large", Scan, expected_bytes=3_000_000)
    subscribers = []
    for count in range(1, 4):
        subscribers.append(node.subscriber("/large", Scan, policy=reliable()))
        assert publisher.wait_for_subscribers(count, timeout_s=SOON_S)
        made = slots_of(publisher)
        assert made[0] >= 2 * count + 2
        publisher.publish(scan(count, 2_900_000 // 4))
        for subscriber in subscribers:
            message = subscriber.recv(SOON_S)
            assert (message.stamp_ns, message.ranges.nbytes) == (count, 2_900_000)
            del message
        assert slots_of(publisher) == made


def test_what_is_not_as_usual_goes_the_long_way(node):
    """Another class, a wrong dtype, an array that is not contiguous: the same words, and no slot is lost."""
    publisher, subscriber = connected(node, Scan, reliable(64, 5.0))
    for number in range(3):
        publisher.publish(scan(number))
        subscriber.recv(SOON_S)
    with pytest.raises(TypeError, match="carries Scan"):
        publisher.publish(make_block(0, 100_000))
    with pytest.raises(TypeError, match="float64"):
        publisher.publish(Scan(1, np.zeros(100_000)))
    with pytest.raises((TypeError, ValueError), match="stamp_ns"):
        publisher.publish(Scan("soon", np.zeros(100_000, np.float32)))
    assert publisher.publish(Scan(5, np.arange(200_000, dtype=np.float32)[::2]))
    message = subscriber.recv(SOON_S)
    assert message.stamp_ns == 5
    assert (message.ranges == np.arange(0, 200_000, 2)).all()
    del message
    wait_for(lambda: slots_held(publisher) == 0)


def test_publishers_in_several_threads(node):
    """Messages copied with and without the lock, small ones between them: each arrives once, in order."""
    publisher, subscriber = connected(node, Block, reliable(64, 60.0))
    sizes, count, threads = (10, 40_000, 200_000, 600_000), 40, 4
    made = [[make_block(1000 * k + n, sizes[(n + k) % 4]) for n in range(count)] for k in range(threads)]
    workers = [Beside(lambda blocks: all(map(publisher.publish, blocks)), blocks) for blocks in made]
    seen = []
    for _ in range(count * threads):
        block = subscriber.recv(SOON_S)
        assert is_whole(block)
        seen.append(block.number)
    assert all(worker.join() == [True] for worker in workers)
    for k in range(threads):
        assert [number % 1000 for number in seen if number // 1000 == k] == list(range(count))
    assert (subscriber.counters.received, subscriber.counters.lost) == (count * threads, 0)
    assert publisher.counters.published == count * threads


def test_closing_while_others_publish(node):
    """The memory stays as long as somebody copies into it."""
    message = scan(1, 1_000_000)

    def publish(publisher):
        with contextlib.suppress(Closed):
            while True:
                publisher.publish(message)

    for _ in range(10):
        publisher, subscriber = connected(node, Scan, keep_last(4))
        with Beside(publish, publisher):
            subscriber.recv(SOON_S)
            time.sleep(0.003)
            publisher.close(linger_s=0.0)
        subscriber.close()
