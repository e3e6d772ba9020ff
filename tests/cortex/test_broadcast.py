"""The ring that carries a publisher's frames to local readers: what each gets, and when it is woken."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import random
import resource
import select
import socket
import struct
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import zmq
from c_module import needs_native
from peer import Block, Number, accounted, connect, is_whole, make_block, stand_still, take_all
from processes import SOON_S, Beside, wait_for

import cortex.broadcast
import cortex.link
from cortex import keep_last, reliable
from cortex.broadcast import Listener
from cortex.compiled import native
from cortex.wire import MESSAGE, AttachKey, Header, attach_key, message_head, pack_header

pytestmark = needs_native


SOURCE = 7
RING_BYTES, WIDE_BYTES = 1 << 19, 1 << 21


def frame(number: int, size: int) -> bytes:
    """A frame that says which it is, and whose every byte depends on that."""
    return pack_header(Header(MESSAGE, 1, SOURCE, number, None, 3, size, 0)) + bytes([number % 251]) * size


def number_of(found: bytes) -> int:
    """The number of a frame, which must be whole."""
    number = int.from_bytes(found[24:32], "little")
    assert found == frame(number, len(found) - 64)
    return number


class Ring:
    """A publisher's ring, and its readers."""

    def __init__(self, path: Path) -> None:
        self.path = str(path / "1.ring")
        self.listener = native.listen(self.path)
        self.writer = native.Broadcast(SOURCE, zmq.Again)
        self.readers: list = []
        self._idle = socket.socketpair()

    def join(self, *, strict: bool, timeout_ms: int = 700):
        """A reader, and its number."""
        reader = native.RingReader(
            self.path, SOURCE, len(self.readers) + 1, self._idle[0].fileno(), nothing, zmq.Again, 20
        )
        connection = native.accept(self.listener)
        source, number, page, wakeup = native.hear(connection)
        assert (source, number) == (SOURCE, len(self.readers) + 1)
        assert reader.welcomed() is None
        member = self.writer.add(connection, page, wakeup, strict, timeout_ms, 5)
        assert reader.welcomed() == 5
        self.readers.append(reader)
        return reader, member

    def close(self) -> None:
        """Let go of everything."""
        self.writer.close()
        for reader in self.readers:
            reader.close()
        os.close(self.listener)
        for end in self._idle:
            end.close()


def nothing(flags: int) -> bytes:
    """A socket to which nothing comes."""
    raise zmq.Again


@pytest.fixture
def ring(tmp_path):
    made = Ring(tmp_path)
    yield made
    made.close()


def takes(writer, each: bytes) -> bool:
    """Whether there is room for a frame, which then is sent."""
    try:
        assert writer.send(each) is True
    except zmq.Again:
        return False
    return True


def read_all(reader) -> list[int]:
    """The numbers of all frames that are there."""
    numbers = []
    try:
        while True:
            numbers.append(number_of(reader.receive(zmq.DONTWAIT)))
    except zmq.Again:
        return numbers


def fill(ring: Ring, size: int) -> int:
    """Send frames until a reliable reader has no room; how many there was room for."""
    count = 0
    while takes(ring.writer, frame(count, size)):
        count += 1
    return count


@pytest.mark.parametrize("largest", [200, 20_000, 3 * RING_BYTES], ids=str)
def test_every_reliable_reader_gets_every_frame_in_order(ring, largest):
    """Small ones, ones that wrap around, and ones that need a larger ring."""
    generator = random.Random(largest)
    readers = [ring.join(strict=True)[0] for _ in range(3)]
    got: list[list[int]] = [[] for _ in readers]
    count = 4_000_000 // (largest + 2000)
    for number in range(count):
        each = frame(number, generator.randrange(largest))
        while not takes(ring.writer, each):
            for reader, numbers in zip(readers, got, strict=True):
                numbers += read_all(reader)
        if generator.random() < 0.1:
            index = generator.randrange(3)
            got[index] += read_all(readers[index])
    for reader, numbers in zip(readers, got, strict=True):
        assert numbers + read_all(reader) == list(range(count))
        assert not reader.broken


def test_threads_read_while_the_publisher_writes(ring):
    """Each sleeps until it is woken; it waits for the slowest, and nobody loses anything."""
    count = 20_000

    def read(reader) -> list[int]:
        numbers: list[int] = []
        while len(numbers) < count:
            with contextlib.suppress(zmq.Again):
                numbers.append(number_of(reader.receive(0)))
        return numbers

    threads = [Beside(read, ring.join(strict=True)[0]) for _ in range(3)]
    for number in range(count):
        wait_for(lambda number=number: takes(ring.writer, frame(number, 40)), every_s=1e-5)
    assert [thread.join() for thread in threads] == [[list(range(count))]] * 3


def test_a_reliable_reader_holds_up_the_publisher(ring):
    reader, _ = ring.join(strict=True)
    count = fill(ring, 1000)
    assert WIDE_BYTES - 2000 < count * 1072 < WIDE_BYTES  # it has grown once
    assert ring.writer.patience(1064) == 700
    number_of(reader.receive(zmq.DONTWAIT))
    assert ring.writer.patience(1064) == -1
    assert takes(ring.writer, frame(count, 1000))
    assert read_all(reader) == list(range(1, count + 1))


def test_a_ring_that_finds_no_memory_tries_once(ring):
    """Each attempt costs more than a message."""
    ring.join(strict=True)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    free = os.dup(0)
    os.close(free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, before[1]))
    try:
        count = fill(ring, 1000)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert RING_BYTES - 2000 < count * 1072 < RING_BYTES
    assert not takes(ring.writer, frame(count, 1000))


def test_a_ring_grows_while_one_of_its_readers_stands_still(ring):
    """What it had not read waits in the old one; both get all, in order."""
    (still, _), (steady, _) = ring.join(strict=True), ring.join(strict=True)
    count, got = 3 * RING_BYTES // 1072, []
    for number in range(count):
        assert takes(ring.writer, frame(number, 1000))
        got += read_all(steady)
    assert got == read_all(still) == list(range(count))


def test_who_is_late_keeps_what_it_has_and_loses_what_comes(ring):
    """Until it has read half of what waits for it."""
    reader, _ = ring.join(strict=True)
    count = fill(ring, 1000)
    ring.writer.give_up(1064, 699)
    assert ring.writer.patience(1064) == 700
    ring.writer.give_up(1064, 700)
    assert ring.writer.patience(1064) == -1
    for number in range(count, count + 5):
        assert ring.writer.send(frame(number, 1000)) is False
    for number in range(count // 2 + 2):
        assert number_of(reader.receive(zmq.DONTWAIT)) == number
    assert takes(ring.writer, frame(count + 5, 1000))
    assert read_all(reader) == [*range(count // 2 + 2, count), count + 5]


def test_who_is_late_holds_up_nobody_else(ring):
    """The others get everything, and what it cannot keep it loses as a whole."""
    other, _ = ring.join(strict=True)
    late, _ = ring.join(strict=True, timeout_ms=300)
    count = fill(ring, 1000)
    assert ring.writer.patience(1064) == 300
    ring.writer.give_up(1064, 300)
    assert ring.writer.patience(1064) == 700
    got = read_all(other)
    for number in range(count, 3 * count):
        assert ring.writer.send(frame(number, 1000)) is False
        got += read_all(other)
    assert got == list(range(3 * count))
    rest = read_all(late)
    first = RING_BYTES // 1072 - 1  # of the ring before it grew, which nobody writes over
    assert rest == [*range(first), *range(rest[first], 3 * count)]
    assert rest[first] > count
    assert takes(ring.writer, frame(3 * count, 1000))


def test_a_lossy_reader_keeps_the_newest_and_disturbs_nobody(ring):
    reader, _ = ring.join(strict=False)
    count = 3 * RING_BYTES // 1072
    for number in range(count):
        assert takes(ring.writer, frame(number, 1000))
    got = read_all(reader)
    assert got == list(range(got[0], count))
    assert len(got) * 1072 > RING_BYTES // 2


def test_a_lossy_reader_in_a_race_sees_no_torn_frame(ring):
    """Each frame is checked byte by byte; numbers only grow."""
    reader, _ = ring.join(strict=False)
    got: list[int] = []
    with Beside(lambda: [takes(ring.writer, frame(number, 3000)) for number in range(20_000)]) as writing:
        while writing.thread.is_alive():
            got += read_all(reader)
    got += read_all(reader)
    assert got == sorted(set(got))
    assert got[-1] == 19_999


def test_the_last_frame_finds_room_and_outlives_the_publisher(ring):
    reader, _ = ring.join(strict=True)
    count = fill(ring, 1000)
    ring.writer.end(frame(count, 0))
    ring.writer.close()
    assert read_all(reader) == list(range(count + 1))


def test_the_wakeup_is_signalled_for_a_frame_after_none_was_there(ring):
    """Once, not for each frame; and never while nothing has come."""
    reader, _ = ring.join(strict=True)
    poll = select.poll()
    poll.register(reader.fd, select.POLLIN)
    assert read_all(reader) == []
    assert not poll.poll(0)
    takes(ring.writer, frame(0, 10))
    assert poll.poll(0)
    assert read_all(reader) == [0]
    assert not poll.poll(0)
    takes(ring.writer, frame(1, 10))
    takes(ring.writer, frame(2, 10))
    assert poll.poll(0)
    assert number_of(reader.receive(zmq.DONTWAIT)) == 1
    assert not poll.poll(0)  # it is known that there is more
    assert read_all(reader) == [2]


def test_a_reader_that_is_gone_is_forgotten(ring):
    before = len(os.listdir("/proc/self/fd"))
    reader, member = ring.join(strict=True)
    fill(ring, 1000)
    reader.close()
    assert takes(ring.writer, frame(0, 1000))  # at once: its connection has ended
    ring.writer.remove(member)
    assert takes(ring.writer, frame(1, 10))
    assert len(os.listdir("/proc/self/fd")) == before
    with pytest.raises(IndexError, match="no member"):
        ring.writer.remove(member)
    assert ring.join(strict=True)[1] == member


def test_a_ring_that_brings_nonsense_is_left_for_the_socket(make_node, start_child):
    """What was published meanwhile is counted as lost, and nothing after it."""
    publisher = make_node().publisher("/blocks", Block)
    child = start_child("endless_subscriber", topic="/blocks", policy=["reliable", {"timeout_s": SOON_S}])
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    for sent in (1, 2):
        assert publisher.publish(make_block(sent, 100))
        wait_for(lambda sent=sent: child.ask()["count"] == sent)
        if sent == 1:
            publisher._fanout.ring._ring.send(b"nonsense" * 20)
            wait_for(lambda: child.ask()["rejected"] == 1)
    assert child.ask()["lost"] == 0


def test_a_ring_is_read_to_its_end_however_long_that_takes(make_node, start_child):
    """Its publisher has left long ago when its reader comes to read."""
    child = start_child("peer")
    child.ask(do="publisher", topic="/blocks", type="Block")
    subscriber = make_node().subscriber("/blocks", Block, policy=reliable(2, SOON_S))
    child.ask(do="await_subscribers", topic="/blocks")
    assert child.ask(do="publish", topic="/blocks", count=40, size=100)["delivered"] == 40
    child.finish()
    wait_for(lambda: not subscriber.sources())
    for _ in range(5):
        subscriber.dismiss(time.monotonic_ns() + 10**11)
    assert [subscriber.recv(SOON_S).number for _ in range(40)] == list(range(40))
    wait_for(lambda: subscriber.dismiss(time.monotonic_ns() + 10**11) or not subscriber.carriers)
    assert subscriber.counters.lost == 0


def test_what_came_before_the_answer_was_read_counts(make_node, start_child):
    """Its publisher was gone before the reader, which lost most of it, looked for the first time."""
    child = start_child("peer")
    child.ask(do="publisher", topic="/blocks", type="Block")
    subscriber = make_node().subscriber("/blocks", Block, policy=keep_last(8))
    stand_still(subscriber)
    child.ask(do="await_subscribers", topic="/blocks")
    child.ask(do="publish", topic="/blocks", count=100, size=RING_BYTES // 20)
    child.finish()
    wait_for(lambda: not subscriber.sources())

    def all_known() -> bool:
        assert all(map(is_whole, take_all(subscriber)))
        return accounted(subscriber.counters) >= 100

    wait_for(all_known)
    assert accounted(subscriber.counters) == 100
    assert subscriber.counters.lost > 0


@pytest.fixture
def asked(monkeypatch):
    """The ends of readers that are welcome, and cannot map what they are given."""
    ends = []

    class Refusing:
        def __init__(self, *arguments):
            ends.append(native.RingReader(*arguments))

        def welcomed(self):
            if ends[-1].welcomed() is not None:
                raise OSError("not here")

        def __getattr__(self, name):
            return getattr(ends[-1], name)

    monkeypatch.setattr(cortex.link, "native", SimpleNamespace(RingReader=Refusing))
    return ends


@pytest.mark.parametrize("policy", [reliable(8, 60.0), keep_last(8)], ids=str)
def test_a_reader_that_cannot_map_the_ring(make_node, start_child, asked, policy):
    """It attaches anew, through the socket: the latched message comes all the same."""
    child = start_child("peer")
    child.ask(do="publisher", topic="/blocks", type="Block", latch=True)
    child.ask(do="publish", topic="/blocks", count=1, start=7, size=100_000)
    subscriber = make_node().subscriber("/blocks", Block, policy=policy)
    block = subscriber.recv(SOON_S)
    assert (block.number, is_whole(block)) == (7, True)
    assert asked
    assert subscriber.carriers == ["ipc"]
    child.ask(do="publish", topic="/blocks", count=2, start=8, size=100_000)
    assert [subscriber.recv(SOON_S).number for _ in range(2)] == [8, 9]
    assert subscriber.counters.lost == subscriber.counters.rejected == 0
    child.finish()


@pytest.mark.parametrize("latch", [False, True], ids=["", "latched"])
def test_what_lies_in_a_ring_that_cannot_be_mapped_is_lost(make_node, start_child, asked, latch):
    """It was published to a reader that was attached, and had not looked yet."""
    child = start_child("peer")
    child.ask(do="publisher", topic="/numbers", type="Number", latch=latch)
    subscriber = make_node().subscriber("/numbers", Number, policy=reliable(8, 60.0))
    stand_still(subscriber)
    child.ask(do="await_subscribers", topic="/numbers")
    child.ask(do="publish", topic="/numbers", count=5)
    values = []

    def has_read(count: int) -> bool:
        values.extend(message.value for message in take_all(subscriber))
        return subscriber.publisher_count == 1 and len(values) >= count

    wait_for(lambda: has_read(int(latch)))
    child.ask(do="publish", topic="/numbers", count=3, start=5)
    wait_for(lambda: has_read(3 + latch))
    assert values == [4, 5, 6, 7][1 - latch :]
    assert asked
    assert (subscriber.counters.lost, subscriber.counters.rejected) == (5 - latch, 0)
    child.finish()


@contextlib.contextmanager
def asks_by_hand(path: str, source: int, magic: bytes = b"CTXCAST3", wakeup: int | None = None):
    """The connection of a reader, number 1, that has said hello."""
    page, wakeup = os.memfd_create("page", os.MFD_ALLOW_SEALING), os.eventfd(0) if wakeup is None else wakeup
    os.ftruncate(page, 4096)
    fcntl.fcntl(page, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.connect(path)
        socket.send_fds(other, [magic + struct.pack("<QQ", source, 1)], [page, wakeup])
        os.close(page)
        os.close(wakeup)
        yield other


@pytest.mark.parametrize(
    "make", [os.pipe, lambda: [end.detach() for end in socket.socketpair()]], ids=["pipe", "socket"]
)
def test_a_wakeup_whose_signal_would_end_the_process_is_refused(ring, make):
    """Nobody is at its other end: to write there sends SIGPIPE."""
    other, wakeup = make()
    os.close(other)
    with asks_by_hand(ring.path, SOURCE, wakeup=wakeup):
        connection = native.accept(ring.listener)
        with pytest.raises(OSError, match=r"[Pp]rotocol"):
            native.hear(connection)
        os.close(connection)


def test_a_reader_that_spoke_and_died_is_forgotten(ring):
    """What it has said waits in its connection, which has ended all the same."""
    with asks_by_hand(ring.path, SOURCE) as other:
        connection = native.accept(ring.listener)
        ring.writer.add(connection, *native.hear(connection)[2:], True, 700, 5)
        other.send(b"still here")
        fill(ring, 1000)
        for _ in range(2):  # of the first ring, and of the larger one
            assert other.recv(64)[:8] == b"CTXCAST3"
        assert ring.writer.patience(1064) == 700
    assert takes(ring.writer, frame(0, 1000))


def test_a_reader_of_another_version_gets_messages_and_it_is_said(make_node, caplog):
    """It asks for a ring of an older kind. That is said once, not by each publisher of the node."""
    node = make_node()
    publisher = node.publisher("/numbers", Number)
    address = publisher._pub_sockets._pub_sockets[0].socket.last_endpoint.decode()
    key = attach_key(AttachKey(publisher.source, 1, True, False, 10, 0), stamped=True)
    path = address.removeprefix("ipc://").rpartition(".")[0] + ".ring"
    context = zmq.Context()
    with asks_by_hand(path, publisher.source, b"CTXCAST2"), context.socket(zmq.SUB) as other:
        other.connect(address)
        for each in (message_head(MESSAGE, publisher.source, publisher.codec.fingerprint, stamped=True), key):
            other.subscribe(each)
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        wait_for(lambda: "a subscriber with another version of cortex" in caplog.text)
        publisher.publish(Number(1, 2))
        assert other.recv()[:32] == key
        assert other.recv()[3:4] == MESSAGE
    context.term()
    second = node.publisher("/others", Number)
    with make_node().subscriber("/others", Number):
        assert second.wait_for_subscribers(timeout_s=SOON_S)
    second._pub_sockets.emit_notes()
    assert caplog.text.count("a subscriber with another version of cortex") == 1


def test_a_publisher_of_another_version_is_heard_and_it_is_said(make_node, monkeypatch, caplog):
    """It closes the connection of who asks for a ring that it does not know. That is said once for a node."""
    take, asked = Listener.take, []

    def close(self, source, reader):
        asked.append(reader)
        take(self, source, reader).close()

    monkeypatch.setattr(Listener, "take", close)
    node = make_node()
    publisher, subscriber = connect(node, "/numbers", Number, reliable())
    publisher.publish(Number(1, 2))
    assert subscriber.recv(SOON_S) == Number(1, 2)
    assert subscriber.wait_for_publisher(SOON_S)
    assert subscriber.carriers == ["ipc"]
    node.publisher("/others", Number)
    others = node.subscriber("/others", Number, policy=reliable())
    assert others.wait_for_publisher(SOON_S)
    said = [record for record in caplog.records if "another version of cortex" in record.message]
    assert [record.levelname for record in said if record.levelno >= logging.WARNING] == ["WARNING"]
    assert len(asked) == 2


def test_a_reader_cannot_write_to_the_ring(ring):
    """Its memory is sealed: a second mapping for writing is refused."""
    ring.join(strict=True)
    fds = [f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")]
    rings = [fd for fd in fds if os.path.exists(fd) and os.stat(fd).st_size == RING_BYTES + (1 << 16)]
    assert rings
    with pytest.raises(PermissionError), open(rings[0], "r+b", buffering=0) as file:
        file.write(b"x")


@pytest.mark.parametrize(
    "said", [b"", b"x" * 24, (b"CTXCAST3" * 3)], ids=["nothing", "nonsense", "no descriptors"]
)
def test_who_says_something_else_is_refused(ring, said):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.connect(ring.path)
        connection = native.accept(ring.listener)
        if said:
            other.send(said)
            with pytest.raises(OSError, match=r"[Pp]rotocol"):
                native.hear(connection)
        else:
            with pytest.raises(BlockingIOError):
                native.hear(connection)
        os.close(connection)


def test_who_connects_and_says_nothing_is_forgotten(tmp_path, monkeypatch):
    """More of them than are waited for: the older ones are let go of."""
    monkeypatch.setattr(cortex.broadcast, "WAITING_MAX", 16)
    listener = Listener(tmp_path / "1.ring")
    before = len(os.listdir("/proc/self/fd"))
    with contextlib.ExitStack() as others:
        for _ in range(3):
            for _ in range(10):
                other = others.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
                other.connect(str(tmp_path / "1.ring"))
            listener.take(SOURCE, 1)
        listener.take(SOURCE, 1)
        assert len(os.listdir("/proc/self/fd")) == before + 30 + 16
    listener.take(SOURCE, 1)
    assert len(os.listdir("/proc/self/fd")) == before
    listener.close()


def test_a_reader_that_leaves_before_it_attaches_is_forgotten(tmp_path):
    """What it has handed over is closed; a reader that is still about to attach stays."""
    listener = Listener(tmp_path / "1.ring")
    idle, other = socket.socketpair()
    leaving, staying = (
        native.RingReader(str(tmp_path / "1.ring"), SOURCE, n, idle.fileno(), nothing, zmq.Again, 20)
        for n in (1, 2)
    )
    assert listener.take(SOURCE, 3) is None  # both have been heard
    before = len(os.listdir("/proc/self/fd"))
    listener.forget()
    assert len(os.listdir("/proc/self/fd")) == before
    leaving.close()
    after_close = len(os.listdir("/proc/self/fd"))
    listener.forget()
    assert len(os.listdir("/proc/self/fd")) == after_close - 3  # socket, page and wakeup
    assert listener.take(SOURCE, 1) is None
    hello = listener.take(SOURCE, 2)
    assert hello is not None
    hello.close()
    staying.close()
    listener.close()
    idle.close()
    other.close()
