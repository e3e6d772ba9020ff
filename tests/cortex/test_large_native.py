"""The short cuts of large messages in C: the same bytes, leases and counts as Python, nothing on trust."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from peer import Block, Scan, is_whole, make_block
from processes import SOON_S, wait_for
from test_large import connected, scan, slots_held

from cortex import Closed, keep_last, reliable
from cortex.codec import codec_of
from cortex.compiled import native
from cortex.packer import make_reader
from cortex.shm import Ring, RingView
from cortex.wire import HEADER_SIZE, MESSAGE, SLOT, Header, message_head, pack_header, pack_place

pytestmark = pytest.mark.skipif(native is None, reason="without the C module there are no short cuts")
SOURCE = 0x0123456789ABCDEF
COLUMN = 3


@pytest.fixture
def node(make_node):
    return make_node(registry="off")


def test_the_gate_sends_large_messages_itself(node, monkeypatch):
    """As soon as there is a ring; a slot has the bytes that the codec writes."""
    publisher, subscriber = connected(node, Scan, reliable(64, 5.0))
    for number in range(3):
        publisher.publish(scan(number))
        subscriber.recv(SOON_S)
    ledger = publisher._gate.ledger
    assert ledger is not None
    monkeypatch.setattr(publisher, "_publish_slowly", None)
    for size in (5_000, 20_000, 100_000):  # copied at once, deferred, without the lock
        message = scan(7, size)
        assert publisher.publish(message)
        info, body, _ = subscriber.recv_raw(1.0)
        assert bytes(body) == publisher.codec.encode(message, 1 << 30)
        assert (info.stamp_ns, info.size) == (7, len(body))
        del body
    assert publisher.counters.bytes == sum(
        publisher.codec.size(scan(0, size)) for size in (100_000, 100_000, 100_000, 5_000, 20_000, 100_000)
    )
    assert publisher._gate.ledger is ledger
    wait_for(lambda: slots_held(publisher) == 0)
    assert subscriber.counters.lost == 0


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
    assert not any(ring.in_writing for ring in publisher._large._rings)


def test_a_reader_that_is_behind_holds_up_or_loses(node):
    """Whoever has no room is left to Python, which waits or counts."""
    publisher, subscriber = connected(node, Scan, keep_last(4))
    for number in range(200):
        assert publisher.publish(scan(number, 30_000))
    counters = subscriber.counters
    received = 0
    message = None
    while message is None or message.stamp_ns < 199:
        message = subscriber.recv(SOON_S)
        assert (message.ranges == message.stamp_ns).all()
        received += 1
    wait_for(lambda: received + counters.lost + counters.overtaken == 200)


def test_publishers_in_several_threads(node):
    """Messages copied with and without the lock, small ones between them: each arrives once, and whole."""
    publisher, subscriber = connected(node, Block, reliable(64, 60.0))
    sizes, count, threads = (10, 40_000, 200_000, 600_000), 40, 4
    made = {(k, size): make_block(1000 * k + size % 997, size) for k in range(threads) for size in sizes}
    refused = []

    def publish(k):
        for number in range(count):
            if not publisher.publish(made[k, sizes[(number + k) % 4]]):
                refused.append(number)

    workers = [threading.Thread(target=publish, args=(k,)) for k in range(threads)]
    for worker in workers:
        worker.start()
    seen = {}
    for _ in range(count * threads):
        block = subscriber.recv(SOON_S)
        assert is_whole(block)
        key = (block.number, len(block.data))
        seen[key] = seen.get(key, 0) + 1
    for worker in workers:
        worker.join(SOON_S)
    assert not refused
    assert seen == {(block.number, size): count // 4 for (_, size), block in made.items()}
    assert subscriber.counters.lost == 0


def test_closing_while_others_publish(node):
    """The memory stays as long as somebody copies into it."""
    for _ in range(10):
        publisher, subscriber = connected(node, Scan, keep_last(4))
        message = scan(1, 1_000_000)
        ended = []

        def publish(publisher=publisher, message=message, ended=ended):
            try:
                while True:
                    publisher.publish(message)
            except Closed:
                ended.append(True)

        thread = threading.Thread(target=publish)
        thread.start()
        subscriber.recv(SOON_S)
        time.sleep(0.003)
        publisher.close(linger_s=0.0)
        thread.join(SOON_S)
        assert ended
        subscriber.close()


class Slots:
    """A ring, its reader, and what reads descriptors in C."""

    def __init__(self):
        self.codec = codec_of(Scan)
        self.head = message_head(MESSAGE, SOURCE, self.codec.fingerprint, stamped=True)
        self.ring = Ring(SOURCE, 1, slots=4, slot_bytes=4096)
        ring = self.ring
        self.view = RingView(SOURCE, 1, 4, 4096, ring.pid, ring.fd, COLUMN)
        self.reader = make_reader(self.codec, self.head)
        self.reader.coder.slots = self.view.short_cut
        self.sequence = 0

    def publish(self, change=None):
        """Write a message, and return its slot and its descriptor."""
        body = bytearray(self.codec.encode(Scan(self.sequence, np.arange(400, dtype=np.float32)), 4096))
        if change is not None:
            body[change % len(body)] ^= 1 << change % 8
        slot = self.ring.acquire()
        self.ring.buffer(slot)[: len(body)] = np.frombuffer(body, np.uint8)
        self.ring.commit(slot, self.sequence, len(body), 1 << COLUMN)
        fields = (
            SLOT,
            SOURCE,
            self.codec.fingerprint,
            self.sequence,
            self.sequence,
            9,
            len(body),
            1 << 32 | slot,
        )
        mask = (1 << COLUMN).to_bytes(8, "little")
        self.sequence += 1
        header = bytearray(pack_header(Header(*fields)))
        header[5] = 1  # flags: it has a stamp
        return slot, bytes(header) + mask + pack_place(self.ring.place)

    def close(self):
        self.view.close()
        self.ring.close()


@pytest.fixture
def slots():
    made = Slots()
    yield made
    made.close()


def test_a_descriptor_is_read_as_its_message(slots):
    _, frame = slots.publish()
    assert frame[:3] + frame[4:24] == slots.head[:3] + slots.head[4:]
    sequence, publish_ns, message = slots.reader.read(frame)
    assert (sequence, publish_ns, message.stamp_ns) == (0, 9, 0)
    assert (message.ranges == np.arange(400)).all()
    with pytest.raises(ValueError, match="read-only"):
        message.ranges[0] = 1.0
    with pytest.raises(ValueError, match="cannot set WRITEABLE"):
        message.ranges.flags.writeable = True
    part = message.ranges[5:9]
    del message
    assert slots.ring.outstanding(COLUMN) == 1
    assert slots.reader.read(frame) is None  # it was delivered
    assert slots.ring.outstanding(COLUMN) == 1
    del part
    assert slots.ring.outstanding(COLUMN) == 0
    assert slots.reader.read(frame) is None


def test_no_descriptor_does_harm(slots):
    """Whatever bit of it or of the body is wrong: a message, or None and the slot as if nobody had looked."""
    generator = np.random.Generator(np.random.Philox(key=[7, 1]))
    read = refused = 0
    for count in range(4000):
        slot, good = slots.publish(change=int(generator.integers(10**6)) if count % 4 == 3 else None)
        bad = bytearray(good)
        for _ in range(count % 3):
            bad[int(generator.integers(len(bad)))] ^= 1 << int(generator.integers(8))
        found = slots.reader.read(bytes(bad))
        if found is None:
            refused += 1
            assert slots.view._table[slot * 64 + COLUMN] == 1
            slots.view.release(slot)
        else:
            read += 1
            assert len(found[2].ranges) <= 400
            del found
        assert slots.ring.outstanding(COLUMN) == 0
    assert read > 1000
    assert refused > 1000
    for size in range(HEADER_SIZE + 41):
        assert slots.reader.read(good[:size] + (b"" if size <= len(good) else b"x")) is None or size == len(
            good
        )


def test_ledger_and_view_refuse_memory_that_is_too_small(slots):
    memory = bytearray(8192)
    good = (memory, 1, 4096, 0, 64, 4096, 1, bytes(24), bytes(32))
    native.Ledger(*good)
    for place, value in ((1, 2), (1, 0), (1, -1), (2, 4097), (2, 0), (3, 8129), (3, -1), (4, 8129), (4, 65),
                         (5, 4097), (5, -1), (7, bytes(23)), (8, b"")):  # fmt: skip
        with pytest.raises((ValueError, OverflowError)):
            native.Ledger(*good[:place], value, *good[place + 1 :])
    with pytest.raises((BufferError, TypeError)):
        native.Ledger(bytes(8192), *good[1:])
    ledger = native.Ledger(*good)
    for call in (ledger.pin, ledger.unpin, ledger.abandon, ledger.is_writing):
        for slot in (-1, 1, 10**6):
            with pytest.raises(IndexError):
                call(slot)
    for column in (-1, 64):
        with pytest.raises(IndexError):
            ledger.outstanding(column)
        with pytest.raises(IndexError):
            ledger.plan([(column, 1)])
    view = (bytearray(128), bytes(4096), bytearray(8), 1, 4096, 0, 64, 1, 0)
    native.SlotView(*view)
    for place, value in ((0, bytearray(127)), (1, bytes(4095)), (2, bytearray(7)), (3, 2), (4, 4097), (5, 65),
                         (6, 72), (6, 1), (8, 64), (8, -1)):  # fmt: skip
        with pytest.raises(ValueError, match="smaller"):
            native.SlotView(*view[:place], value, *view[place + 1 :])
    assert native.SlotView(*view).lease(1, 0, 0) is None
    assert native.SlotView(*view).lease(0, 0, 5000) is None
