"""The relay, which writes the pipes of many readers: what each of them gets, whatever the others do."""

from __future__ import annotations

import contextlib
import os
import random
import select
import threading

import pytest
import zmq
from peer import Block, is_whole, make_block
from processes import SOON_S, wait_for

import cortex.large
import cortex.pipes
from cortex import native
from cortex.pipe import PIPE_BYTES, make_writer
from cortex.wire import BATCH, HEADER_SIZE, MESSAGE, AttachKey, Header, pack_header

pytestmark = pytest.mark.skipif(native.NativeRelay is None, reason="no C module")

RING_BYTES = 1 << 18


def frame(number: int, size: int) -> bytes:
    """A frame that says which it is, and whose every byte depends on that."""
    kind = BATCH if number % 5 == 0 else MESSAGE
    return pack_header(Header(kind, 1, 2, number, None, 3, size, 0)) + bytes([number % 251]) * size


def numbers_of(stream: bytes) -> list[int]:
    """The numbers of the frames that a stream consists of; each must be whole."""
    numbers, at = [], 0
    while at < len(stream):
        number = int.from_bytes(stream[at + 24 : at + 32], "little")
        size = int.from_bytes(stream[at + 48 : at + 56], "little")
        assert stream[at : at + HEADER_SIZE + size] == frame(number, size)
        numbers.append(number)
        at += HEADER_SIZE + size
    assert at == len(stream)
    return numbers


class End:
    """A reader's end of a pipe of a relay."""

    def __init__(self, relay, *, strict: bool, left: bytes = b"") -> None:
        self.fd, write = os.pipe()
        os.set_blocking(self.fd, False)
        os.set_blocking(write, False)
        self.write_fd = write
        self.stream = bytearray()
        self.member = relay.add(write, left, strict, False)

    def read(self) -> bool:
        """Take what is there; whether there was something."""
        try:
            found = os.read(self.fd, 1 << 20)
        except BlockingIOError:
            return False
        self.stream += found
        return bool(found)

    def read_until(self, size: int) -> None:
        """Take what comes, until so many bytes have come in all."""
        wait_for(lambda: (self.read(), len(self.stream) >= size)[1], every_s=1e-4)


@pytest.fixture
def relay():
    made = native.NativeRelay(zmq.Again)
    yield made
    made.close()


@pytest.fixture
def ends(relay):
    """Makes readers' ends, and closes them."""
    made = []

    def make(**options) -> End:
        made.append(End(relay, **options))
        return made[-1]

    yield make
    for end in made:
        os.close(end.fd)


def takes(relay, each: bytes) -> bool:
    """Whether a relay, or a writer, takes a frame."""
    try:
        assert relay.send(each) is not False
    except zmq.Again:
        return False
    return True


def fill(relay, end: End, size: int = 1000, *, beside: End | None = None) -> int:
    """Send frames to a reader that does not read, beside one that does, until there is no room at all.

    Returns:
        How many were taken.
    """
    count = 0
    poll = select.poll()
    poll.register(end.write_fd, select.POLLOUT)
    while True:
        if beside is not None:
            beside.read()
        if takes(relay, frame(count, size)):
            count += 1
        elif not poll.poll(0):
            if not takes(relay, frame(count, size)):
                return count
            count += 1


@pytest.mark.parametrize("largest", [200, 20_000, 3 * RING_BYTES], ids=str)
def test_every_reader_gets_every_frame_in_order(relay, ends, largest):
    """Small ones, ones that wrap around, and ones that need a larger ring."""
    generator = random.Random(largest)
    frames = [frame(k, generator.randrange(largest)) for k in range(4_000_000 // (largest + 2000))]
    readers = [ends(strict=k % 2 == 0) for k in range(5)]
    whole = b"".join(frames)
    for k, each in enumerate(frames):
        while True:
            try:
                assert relay.send(each) is True
            except zmq.Again:
                for end in readers:
                    end.read()
                continue
            break
        if k % 7 == 0:
            for end in readers:
                end.read()
        if len(frames) - k > 1:  # nor may a lossy one fall behind by a ring
            wait_for(lambda: [end.read() for end in readers] and relay.is_idle(), every_s=1e-5)
    for end in readers:
        end.read_until(len(whole))
        assert end.stream == whole
    assert relay.is_idle()


def test_readers_at_their_own_pace_lose_nothing(relay, ends):
    """Threads that read while the publisher sends; it waits for the slowest."""
    readers = [ends(strict=True) for _ in range(4)]
    count, size = 20_000, 40
    total = count * (HEADER_SIZE + size)

    def read(end: End, generator: random.Random) -> None:
        while len(end.stream) < total:
            if not end.read() or generator.random() < 0.01:
                threading.Event().wait(1e-3)

    threads = [threading.Thread(target=read, args=(end, random.Random(k))) for k, end in enumerate(readers)]
    for thread in threads:
        thread.start()
    for k in range(count):
        wait_for(lambda k=k: takes(relay, frame(k, size)), every_s=1e-4)
    for thread in threads:
        thread.join(SOON_S)
    for end in readers:
        assert numbers_of(bytes(end.stream)) == list(range(count))


def test_a_reliable_reader_holds_up_the_sender_and_loses_nothing(relay, ends):
    slow, quick = ends(strict=True), ends(strict=False)
    count = fill(relay, slow, beside=quick)
    assert count > RING_BYTES // 1064
    with pytest.raises(zmq.Again):
        relay.offer(frame(count, 1000))
    slow.read_until(RING_BYTES)
    for k in range(count, count + 20):
        wait_for(lambda k=k: (slow.read(), quick.read(), takes(relay, frame(k, 1000)))[2])
    for end in (slow, quick):
        end.read_until((count + 20) * 1064)
        assert numbers_of(bytes(end.stream)) == list(range(count + 20))


def test_who_is_late_loses_what_comes_and_nothing_that_was_taken(relay, ends):
    late = ends(strict=True)
    count = fill(relay, late)
    assert relay.in_the_way(frame(count, 1000)) == [late.member]
    relay.give_up(frame(count, 1000), late.member)
    assert relay.in_the_way(frame(count, 1000)) == []
    other = ends(strict=True)
    for k in range(count, count + 300):
        with pytest.raises(zmq.Again):
            relay.send(frame(k, 1000))
        while True:
            try:
                assert relay.offer(frame(k, 1000)) is False
            except zmq.Again:
                other.read()
                continue
            break
    other.read_until(300 * 1064)
    assert numbers_of(bytes(other.stream)) == list(range(count, count + 300))
    # Once half of what waits has been written it takes part again, and then gets all.
    sent = count + 300
    wait_for(lambda: (late.read(), takes(relay, frame(sent, 1000)))[1])
    for k in range(sent + 1, sent + 10):
        wait_for(lambda k=k: (late.read(), other.read(), takes(relay, frame(k, 1000)))[2])
    late.read_until((count + 10) * 1064)
    assert numbers_of(bytes(late.stream)) == [*range(count), *range(sent, sent + 10)]
    other.read_until(310 * 1064)
    assert numbers_of(bytes(other.stream)) == list(range(count, sent + 10))


def test_a_lossy_reader_that_sleeps_loses_whole_frames_and_disturbs_nobody(relay, ends):
    asleep, awake = ends(strict=False), ends(strict=True)
    count = 3 * (RING_BYTES + PIPE_BYTES) // 1064
    for k in range(count):
        wait_for(lambda k=k: (awake.read(), takes(relay, frame(k, 1000)))[1])
    awake.read_until(count * 1064)
    assert numbers_of(bytes(awake.stream)) == list(range(count))
    wait_for(lambda: asleep.read() or relay.is_idle())
    wait_for(lambda: not asleep.read() and relay.is_idle())
    got = numbers_of(bytes(asleep.stream))
    assert got == sorted(set(got))
    assert RING_BYTES // 1064 < len(got) < count
    assert relay.send(frame(count, 10))
    wait_for(lambda: asleep.read())
    assert numbers_of(bytes(asleep.stream))[-1] == count


def test_a_reader_that_is_gone_holds_up_nobody(relay, ends):
    gone, full, other = ends(strict=True), ends(strict=True), ends(strict=True)
    os.close(gone.fd)
    gone.fd = os.dup(other.fd)
    for k in range(100):
        wait_for(lambda k=k: takes(relay, frame(k, 1000)))
    wait_for(lambda: (other.read(), full.read(), len(other.stream) == 100 * 1064)[2])
    count = 100
    while takes(relay, frame(count, 1000)):
        count += 1
        other.read()
    os.close(full.fd)  # while the relay waits for it to read
    full.fd = os.dup(other.fd)
    wait_for(lambda: (other.read(), takes(relay, frame(count, 1000)))[1])
    other.read_until((count + 1) * 1064)
    assert numbers_of(bytes(other.stream)) == list(range(count + 1))


def test_a_pipe_is_taken_over_and_given_back_between_any_two_bytes(relay, ends):
    first = frame(0, 5000)
    reader = ends(strict=True, left=first[100:])
    reader.stream += first[:100]
    count = 1
    while takes(relay, frame(count, 3000)):
        count += 1
    fd, left, late = relay.take(reader.member)
    assert fd == reader.write_fd
    assert left
    assert not late
    assert relay.is_idle()
    writer = native.NativePipeWriter(fd, zmq.Again, left)
    with pytest.raises(zmq.Again):
        writer.send(frame(count, 10))
    wait_for(lambda: (reader.read(), writer.flush())[1])
    wait_for(lambda: (reader.read(), takes(writer, frame(count, 100_000)))[1])
    wait_for(lambda: (reader.read(), writer.flush())[1])
    fd, left = writer.detach()
    again = relay.add(fd, left, True, False)
    relay.send(frame(count + 1, 10))
    reader.read_until(5064 + (count - 1) * 3064 + 100_064 + 74)
    assert numbers_of(bytes(reader.stream)) == list(range(count + 2))
    relay.remove(again)
    with pytest.raises(IndexError, match="no member"):
        relay.take(again)


def test_one_that_is_late_when_it_comes_holds_up_nobody(relay):
    """Its pipe is full, and nothing is left of a frame; it gets what comes once it reads."""
    fd, write = os.pipe()
    for end in (fd, write):
        os.set_blocking(end, False)
    before = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            before += os.write(write, frame(0, 1000))
    cut = before % 1064
    member = relay.add(write, frame(0, 1000)[cut:] if cut else b"", True, True)
    for number in range(1000):  # more than the ring holds
        assert relay.offer(frame(number, 1000)) is False
        with pytest.raises(zmq.Again):
            relay.send(frame(number, 1000))
    assert not relay.in_the_way(frame(0, 1000))
    stream = os.read(fd, 1 << 20)
    wait_for(lambda: takes(relay, frame(7, 10)))
    wait_for(relay.is_idle)
    stream += os.read(fd, 1 << 20)
    assert numbers_of(stream) == [0] * ((len(stream) - 74) // 1064) + [7]
    end, left, late = relay.take(member)
    assert (end, left, late) == (write, b"", False)
    for each in (fd, write):
        os.close(each)


@pytest.mark.skipif(not hasattr(os, "SCHED_BATCH"), reason="no such policy")
def test_the_thread_is_as_urgent_as_who_publishes(ends):
    """Whoever made it: a thread of a lower priority, that of a node, perhaps."""
    before = set(os.listdir("/proc/self/task"))
    relay = native.NativeRelay(zmq.Again)
    (thread,) = set(os.listdir("/proc/self/task")) - before
    assert os.sched_getscheduler(int(thread)) == os.sched_getscheduler(0)

    def publish() -> None:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        relay.send(frame(0, 10))

    publisher = threading.Thread(target=publish)
    publisher.start()
    publisher.join()
    assert os.sched_getscheduler(int(thread)) == os.SCHED_BATCH
    assert os.sched_getscheduler(0) != os.SCHED_BATCH
    relay.close()


def test_a_relay_has_a_limit_and_leaves_nothing(ends):
    before = sorted(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))
    relay = native.NativeRelay(zmq.Again)
    made = [End(relay, strict=True) for _ in range(64)]
    reader, write = os.pipe()
    with pytest.raises(ValueError, match="at most 64"):
        relay.add(write, b"", True, False)
    relay.send(frame(0, 10))
    relay.close()
    relay.close()
    assert relay.send(frame(1, 10)) is True  # to nobody
    for fd in (reader, write, *(end.fd for end in made)):
        os.close(fd)
    assert (sorted(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))) == before


def test_a_forked_child_drops_it_and_the_parent_goes_on(relay, ends):
    reader = ends(strict=True)
    relay.send(frame(0, 10))
    child = os.fork()
    if child == 0:
        relay.close()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    relay.send(frame(1, 10))
    reader.read_until(2 * 74)
    assert numbers_of(bytes(reader.stream)) == [0, 1]


@pytest.mark.parametrize("wrong", [(), (1,), ("text",), (b"x", 1, 2)], ids=str)
def test_only_frames_are_sent(relay, wrong):
    with pytest.raises(TypeError, match="expected a frame"):
        relay.send(*wrong)


# Publishers


def test_news_for_all_reaches_all_that_have_room():
    """A reliable reader that is late keeps it from nobody."""
    pipes = cortex.pipes.Pipes(lambda send, timeout_s: False, lambda: False)
    fds = []
    for strict in (True, True, False):
        fd, reader = open_reader(strict=strict)
        fds.append(fd)
        pipes.admit(reader)
    assert pipes.settle()
    streams = [bytearray() for _ in fds]

    def read(place: int) -> bool:
        try:
            streams[place] += os.read(fds[place], 1 << 20)
        except BlockingIOError:
            return False
        return True

    count = 0
    while pipes.send(frame(count, 1000)):
        count += 1
        size = count * 1064
        wait_for(lambda size=size: not read(1) and not read(2) and len(streams[1]) == len(streams[2]) == size)
    pipes.offer(frame(count + 1, 0))
    wait_for(lambda: [read(1), read(2)] and numbers_of(bytes(streams[1]))[-1] == count + 1)
    wait_for(lambda: [read(1), read(2)] and numbers_of(bytes(streams[2]))[-1] == count + 1)
    pipes.close()
    for fd in fds:
        os.close(fd)


def open_reader(*, strict: bool) -> tuple[int, cortex.large.Reader]:
    """A pipe that nobody has written to: the descriptor to read from, and who is served so."""
    fd, write = os.pipe()
    for end in (fd, write):
        os.set_blocking(end, False)
    request = AttachKey(1, 2, True, strict, 4, 100)
    return fd, cortex.large.Reader(os.urandom(4), request, None, 0, make_writer(write))


@pytest.mark.parametrize("size", [1000, 16_300])
def test_who_is_late_stays_so_whoever_writes(monkeypatch, size):
    """One that does not read is waited for once, and not again as its pipe goes to a relay and comes back."""
    waits = []
    pipes = cortex.pipes.Pipes(lambda send, timeout_s: waits.append(timeout_s), lambda: False)
    fd, reader = open_reader(strict=True)
    pipes.admit(reader)
    count = 0
    while pipes.send(frame(count, size)):
        count += 1
    for most in (0, 2, 0):
        monkeypatch.setattr(cortex.pipes, "PIPES_MAX", most)
        assert pipes.settle()
        for _ in range(2 * RING_BYTES // size):
            assert not pipes.send(frame(count, size))
    assert len(waits) == 1
    stream = bytearray()

    def read() -> bool:
        with contextlib.suppress(BlockingIOError):
            stream.extend(os.read(fd, 1 << 20))
        return pipes.send(frame(count + 1, 0))

    wait_for(read)
    wait_for(lambda: (read(), numbers_of(bytes(stream))[-1] == count + 1)[1])
    numbers = numbers_of(bytes(stream))
    assert numbers[:count] == list(range(count))
    assert set(numbers[count:]) == {count + 1}
    assert len(waits) == 1
    pipes.close()
    os.close(fd)


def test_without_memory_for_a_relay_pipes_are_written_as_before(monkeypatch):
    class Poor:
        """A relay with memory for one reader."""

        def __init__(self) -> None:
            self.relay = native.NativeRelay(zmq.Again)
            self.count = 0

        def add(self, *arguments):
            self.count += 1
            if self.count > 1:
                raise MemoryError
            return self.relay.add(*arguments)

        def __getattr__(self, name):
            return getattr(self.relay, name)

    monkeypatch.setattr(cortex.pipes, "make_relay", Poor)
    pipes = cortex.pipes.Pipes(lambda send, timeout_s: False, lambda: False)
    fds = []
    for _ in range(3):
        fd, reader = open_reader(strict=True)
        fds.append(fd)
        pipes.admit(reader)
    pipes.send(frame(0, 10))
    assert pipes.settle()
    pipes.send(frame(1, 10))
    streams = [bytearray() for _ in fds]

    def read() -> bool:
        for fd, stream in zip(fds, streams, strict=True):
            with contextlib.suppress(BlockingIOError):
                stream.extend(os.read(fd, 1 << 20))
        return all(len(stream) == 2 * 74 for stream in streams)

    wait_for(read)
    assert [numbers_of(bytes(stream)) for stream in streams] == [[0, 1]] * 3
    pipes.close()
    for fd in fds:
        os.close(fd)


SIZES = [100, 150_000, 6000, 20_000]
RELIABLE = ["reliable", {"timeout_s": 60.0}]


def subscribers(start_child, count: int, *, policy: list) -> list:
    """Processes that count and check what they get, see `peer.py`."""
    children = [start_child("endless_subscriber", topic="/blocks", policy=policy) for _ in range(count)]
    for child in children:
        child.hear()
    return children


def is_relaying(publisher) -> bool:
    return publisher._fanout.pipes._relay is not None


def test_readers_come_and_go_and_lose_nothing(make_node, start_child, runtime):
    """Two are written directly, more by a relay, and two again: nobody misses a message."""
    publisher = make_node().publisher("/blocks", Block)
    children = subscribers(start_child, 2, policy=RELIABLE)
    assert publisher.wait_for_subscribers(2, timeout_s=SOON_S)
    assert not is_relaying(publisher)
    blocks = [make_block(0, size) for size in SIZES]
    sent = 0

    def publish(count: int) -> None:
        nonlocal sent
        for _ in range(count):
            block = blocks[sent % len(blocks)]
            assert publisher.publish(Block(sent, block.check, block.data))
            sent += 1

    publish(200)
    more = subscribers(start_child, 3, policy=RELIABLE)
    assert publisher.wait_for_subscribers(5, timeout_s=SOON_S)
    assert is_relaying(publisher)
    publish(400)
    for child in more:
        wait_for(lambda child=child: child.ask()["count"] == 400)
        found = child.ask()
        assert (found["torn"], found["lost"], found["rejected"]) == (0, 0, 0)
    for child in more:
        child.kill()
        publish(50)
    wait_for(lambda: (publish(1), not is_relaying(publisher))[1], every_s=1e-2)
    publish(50)
    for child in children:
        wait_for(lambda child=child: child.ask()["count"] == sent)
        found = child.ask()
        assert (found["torn"], found["lost"], found["rejected"]) == (0, 0, 0)
    assert publisher.counters.timeouts == 0
    assert not list(runtime.glob("*/pipe.*"))


@pytest.mark.parametrize("policy", [["reliable", {"timeout_s": 0.2}], ["keep_last"]], ids=str)
def test_one_that_is_stopped_keeps_nothing_from_the_others(make_node, start_child, runtime, policy):
    """It loses what it is too late for, and counts that; it gets the rest once it goes on."""
    publisher = make_node().publisher("/blocks", Block)
    (stopped,) = subscribers(start_child, 1, policy=policy)
    others = subscribers(start_child, 3, policy=RELIABLE)
    assert publisher.wait_for_subscribers(4, timeout_s=SOON_S)
    assert is_relaying(publisher)
    block, sent, refused = make_block(0, 1000), 0, 0

    def publish(count: int) -> None:
        nonlocal sent, refused
        for _ in range(count):
            refused += not publisher.publish(Block(sent, block.check, block.data))
            sent += 1

    publish(10)
    wait_for(lambda: stopped.ask()["count"] == 10)
    with stopped.stopped():
        publish(2000)  # more than its pipe and the ring hold
        for other in others:
            wait_for(lambda other=other: other.ask()["count"] == sent)
    wait_for(lambda: (publish(1), stopped.ask()["lost"] > 0)[1])
    for other in others:
        wait_for(lambda other=other: other.ask()["count"] == sent)
        found = other.ask()
        assert (found["torn"], found["lost"], found["rejected"]) == (0, 0, 0)

    def accounts() -> bool:
        found = stopped.ask()
        return found["count"] + found["lost"] + found["overtaken"] == sent

    wait_for(accounts)
    assert stopped.ask()["torn"] == 0
    if policy[0] == "reliable":
        assert stopped.ask()["lost"] == refused > 0
    else:
        assert refused == 0


@pytest.mark.parametrize("policy", [["keep_last"], RELIABLE], ids=str)
def test_the_relay_alone_serves_like_pipes(make_node, start_child, runtime, monkeypatch, policy):
    """One reader, written by a relay: small and large messages in one order."""
    monkeypatch.setattr(cortex.pipes, "PIPES_MAX", 0)
    monkeypatch.setattr(cortex.large, "PIPES_MAX", 0)
    publisher = make_node().publisher("/blocks", Block)
    child = start_child("peer")
    child.hear()
    child.ask(do="subscriber", topic="/blocks", type="Block", policy=policy)
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert is_relaying(publisher)
    for number in range(60):
        block = make_block(number, SIZES[number % len(SIZES)])
        assert is_whole(block)
        assert publisher.publish(block)
        heard = child.ask(do="receive", topic="/blocks", until=number)
        assert (heard["count"], heard["whole"]) == (1, True)


def test_what_waits_in_the_relay_arrives_after_close(make_node, start_child, runtime, monkeypatch):
    monkeypatch.setattr(cortex.pipes, "PIPES_MAX", 0)
    publisher = make_node().publisher("/blocks", Block)
    (child,) = subscribers(start_child, 1, policy=RELIABLE)
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    for number in range(300):
        assert publisher.publish(make_block(number, 100))
    publisher.close(linger_s=SOON_S)
    wait_for(lambda: child.ask()["count"] == 300)
