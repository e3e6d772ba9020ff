"""Frames: round trips, and what a link does with frames that are not what they must be."""

from __future__ import annotations

import itertools
import logging
import os
import struct

import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from peer import Number, Scan
from processes import wait_for

from cortex import keep_last
from cortex.codec import MalformedMessage, codec_of
from cortex.context import new_socket
from cortex.link import Link
from cortex.message import message
from cortex.records import Heartbeat, Leave, PublisherRecord
from cortex.registry import control_types
from cortex.shm import Ring
from cortex.subscriber import Subscriber
from cortex.wire import (
    ATTACH,
    BATCH,
    BODY_LIMIT,
    CONTROL,
    HEADER_SIZE,
    LARGE,
    MESSAGE,
    RECORD,
    SLOT,
    AttachAnswer,
    AttachKey,
    Header,
    RingPlace,
    answer_frame,
    attach_key,
    batch_records,
    check_body,
    control_frame,
    pack_header,
    parse_answer,
    parse_attach_key,
    parse_control,
    prefix,
    unpack_header,
)

FRAMES = int(os.environ.get("CORTEX_FUZZ_FRAMES", "4000"))
"""Mutated frames for a link, of all kinds together; a million takes about five minutes."""

u8, u32, u64 = (st.integers(0, 2**bits - 1) for bits in (8, 32, 64))
i64 = st.integers(-(2**63), 2**63 - 1)
headers = st.builds(
    Header,
    kind=st.sampled_from([b"M", b"L", b"S", b"B", b"A", b"C", b"Q", b"P", b"E"]),
    source=u64,
    fingerprint=u64,
    sequence=u64,
    stamp_ns=st.none() | i64,
    publish_ns=i64,
    body_size=u64,
    aux=u64,
)


# Round trips


@given(headers)
def test_a_header_survives(header):
    packed = pack_header(header)
    assert len(packed) == HEADER_SIZE
    assert unpack_header(packed) == header
    assert unpack_header(memoryview(packed + b"body")) == header


def test_a_header_lies_as_the_document_says():
    """WIRE.md, section 2, written out by hand."""
    packed = pack_header(Header(b"M", 1, 2, 3, -4, 5, 6, 7))
    assert packed[:8] == b"CTXM" + bytes([1, 1, 64, 0])
    assert struct.unpack("<7q", packed[8:]) == (1, 2, 3, -4, 5, 6, 7)
    assert packed[:16] == prefix(b"M", 1, stamped=True)
    assert pack_header(Header(b"M", 1, 2, 3, None, 5, 6, 7))[5] == 0


@given(headers, st.integers(0, 7), u8)
def test_a_header_with_another_beginning_is_refused(header, place, byte):
    packed = bytearray(pack_header(header))
    packed[place] = byte
    allowed = packed[:3] == b"CTX" and packed[4] == 1 and packed[5] < 2 and packed[6:8] == b"\x40\0"
    if allowed:
        unpack_header(bytes(packed))
    else:
        with pytest.raises(MalformedMessage, match="not a frame of Cortex 1"):
            unpack_header(bytes(packed))


@given(st.binary(max_size=HEADER_SIZE - 1))
def test_a_short_header_is_refused(data):
    with pytest.raises(MalformedMessage, match=f"a frame of {len(data)} bytes is shorter"):
        unpack_header(data)


keys = st.builds(
    AttachKey,
    source=u64,
    reader=u64,
    shared_memory=st.booleans(),
    strict=st.booleans(),
    quota=u8,
    timeout_ms=u32,
)


@given(keys, st.booleans())
def test_an_attach_key_survives(key, stamped):
    packed = attach_key(key, stamped=stamped)
    assert packed[:16] == prefix(ATTACH, key.source, stamped=stamped)
    assert parse_attach_key(packed) == key


@given(st.binary(max_size=80))
def test_other_subscriptions_are_no_attach_keys(data):
    assert parse_attach_key(data) is None
    assert parse_attach_key(prefix(MESSAGE, 1, stamped=False) + bytes(16)) is None


places = st.builds(
    RingPlace, ring=u32, slots=u32, slot_bytes=u64, pid=u32, fd=st.integers(-(2**31), 2**31 - 1)
)
answers = st.builds(
    AttachAnswer,
    sequence=u64,
    column=st.none() | st.integers(0, 63),
    rings=st.lists(places, max_size=4).map(tuple),
    latched=st.binary(max_size=200),
)


@given(keys, answers)
def test_an_attach_answer_survives(key, answer):
    assert parse_answer(answer_frame(attach_key(key, stamped=True), answer)) == answer


@given(keys, answers, st.data())
def test_an_attach_answer_is_refused_or_fits_its_frame(key, answer, data):
    """Whatever is changed, what comes out is all of the frame and no more."""
    frame = data.draw(mutated(answer_frame(attach_key(key, stamped=True), answer)))
    try:
        parsed = parse_answer(frame)
    except MalformedMessage:
        return
    assert len(frame) == 64 + 32 * len(parsed.rings) + len(parsed.latched)
    assert parsed.column is None or parsed.column < 64


@pytest.mark.parametrize(
    ("offset", "value", "text"),
    [(40, 64, "column 64"), (44, 2, "cannot hold 2 rings"), (44, 2**32 - 1, "rings"), (48, 1, "and 1 bytes")],
)
def test_an_attach_answer_with_bad_counts(offset, value, text):
    frame = bytearray(answer_frame(bytes(32), AttachAnswer(0, 3, (RingPlace(1, 4, 4096, 1, 3),), b"")))
    struct.pack_into("<I", frame, offset, value)
    with pytest.raises(MalformedMessage, match=text):
        parse_answer(bytes(frame))


# Mutation


def mutated(frame):
    """A strategy: the frame cut, extended, with bytes or numbers replaced, or a stretch of it repeated."""

    def cut(n):
        return frame[:n]

    def replace(changes):
        data = bytearray(frame)
        for place, byte in changes:
            if data:
                data[place % len(data)] = byte
        return bytes(data)

    def overwrite(place, number, size):
        data = bytearray(frame)
        raw = number.to_bytes(8, "little")[:size]
        place = place % max(len(data) - size, 1)
        data[place : place + size] = raw
        return bytes(data)

    extreme = st.sampled_from([0, 1, 63, 64, 65, 2**31, 2**32 - 1, 2**63, 2**64 - 1])
    return st.one_of(
        st.integers(0, len(frame)).map(cut),
        st.lists(st.tuples(st.integers(0, 2**16), u8), min_size=1, max_size=8).map(replace),
        st.builds(overwrite, st.integers(0, len(frame)), extreme, st.sampled_from([1, 2, 4, 8])),
        st.binary(min_size=1, max_size=64).map(lambda more: frame + more),
        st.integers(0, len(frame)).map(lambda n: frame[:n] + frame),
    )


def batch(bodies, *, source=1, fingerprint=2, sequence=0, padding=b"\0"):
    records = b"".join(
        RECORD.pack(k, k, len(body), 0) + body + padding * (-len(body) % 8) for k, body in enumerate(bodies)
    )
    return (
        pack_header(Header(BATCH, source, fingerprint, sequence, 0, 0, len(records), len(bodies))) + records
    )


@given(st.lists(st.binary(max_size=40), max_size=10))
def test_a_batch_survives(bodies):
    frame = batch(bodies)
    records = list(batch_records(frame, len(bodies)))
    assert [frame[r.offset : r.offset + r.size] for r in records] == bodies
    assert [r.stamp_ns for r in records] == list(range(len(bodies)))


@given(st.lists(st.binary(max_size=40), max_size=6), st.integers(-2, 2), st.data())
def test_a_batch_fills_its_frame_or_is_refused(bodies, more, data):
    frame = data.draw(mutated(batch(bodies)))
    count = max(len(bodies) + more, 0)
    try:
        records = list(batch_records(frame, count))
    except MalformedMessage:
        return
    assert len(records) == count
    end = HEADER_SIZE
    for record in records:
        assert record.offset == end + RECORD.size
        end = record.offset + -(-record.size // 8) * 8
    assert end == len(frame)


@pytest.mark.parametrize("count", [0, 1, 3, 2**32, 2**64 - 1])
def test_a_batch_of_another_count_is_refused(count):
    with pytest.raises(MalformedMessage, match="batch"):
        batch_records(batch([b"12345678", b"1"]), count)


# Control frames


@given(u64, u64, st.integers(0, 2**32))
def test_a_control_message_survives(node, revision, sequence):
    sent = Heartbeat(node, revision, 3)
    received, header = parse_control(control_frame(sent, sequence, source=7), control_types(Heartbeat, Leave))
    assert received == sent
    assert (header.kind, header.sequence, header.source) == (CONTROL, sequence, 7)


def test_a_control_message_of_another_type_is_refused():
    with pytest.raises(MalformedMessage, match="unexpected control message of type"):
        parse_control(control_frame(Leave(1)), control_types(Heartbeat))


@settings(max_examples=300)
@given(st.data())
def test_a_mutated_control_frame_is_refused_or_a_message(data):
    frame = data.draw(mutated(control_frame(Heartbeat(1, 2, 3))))
    try:
        received, _ = parse_control(frame, control_types(Heartbeat))
    except MalformedMessage:
        return
    assert isinstance(received, Heartbeat)
    assert len(frame) == HEADER_SIZE + 24


@message
class Bulk:
    data: bytes


def test_a_control_message_has_a_limit():
    with pytest.raises(ValueError, match="exceeds"):
        control_frame(Bulk(bytes(16 << 20)))
    with pytest.raises(MalformedMessage, match="limit"):
        check_body(Header(CONTROL, 0, 0, 0, None, 0, (16 << 20) + 1, 0), HEADER_SIZE + (16 << 20) + 1)


# A link that is fed by hand

EXTREMES = [0, 1, 63, 64, 65, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1]


_numbers = itertools.count()


class Feed:
    """A raw XPUB socket in a publisher's place, and a subscriber that listens to it."""

    SOURCE = 0x0123456789ABCDEF

    def __init__(self, kind, *, shared=True):
        self.codec = codec_of(kind)
        self.socket = new_socket(zmq.XPUB, high_water_mark=0)
        address = f"inproc://feed-{next(_numbers)}"
        self.socket.bind(address)
        record = PublisherRecord(
            "/feed", self.SOURCE, kind.__name__, self.codec.fingerprint, self.codec.schema.to_json(), False
        )
        self.ring = Ring(self.SOURCE, 0, slots=4, slot_bytes=4096)
        self.column = 5
        self.sequence = -1
        self.large = SLOT if shared else LARGE
        self.subscriber = Subscriber("/feed", self.codec, keep_last(1000))
        self.link = Link(
            record,
            self.codec,
            address,
            policy=self.subscriber.policy,
            local=True,
            shared_memory=True,
            counters=self.subscriber.counters,
            clock_offset_ns=0,
        )
        self.subscriber.connect(self.link)
        self.key = wait_for(self._attach)
        place = RingPlace(0, self.ring.slots, self.ring.slot_bytes, self.ring.pid, self.ring.fd)
        answer = AttachAnswer(0, self.column, (place,), b"") if shared else AttachAnswer(0, None, (), b"")
        self.answer = answer_frame(self.key, answer)
        self.socket.send(self.answer)
        assert self.subscriber.wait_for_publisher()

    def _attach(self):
        while self.socket.poll(0):
            event = self.socket.recv()
            if event[:1] == b"\1" and parse_attach_key(event[1:]) is not None:
                return event[1:]
        return None

    def header(self, kind, size, aux=0):
        """The header of the message that is made now."""
        return pack_header(Header(kind, self.SOURCE, self.codec.fingerprint, self.sequence, 0, 0, size, aux))

    def body(self, value):
        made = (
            Number(value, value) if self.codec.type is Number else Scan(value, np.full(9, value, np.float32))
        )
        body = self.codec.encode(made, 1 << 20)
        assert body is not None
        return body

    def frames(self, kind, value):
        """A good message of a kind, as its frames."""
        self.sequence += 1
        body = self.body(value)
        if kind == MESSAGE:
            return [self.header(kind, len(body)) + body]
        if kind == LARGE:
            return [self.header(kind, len(body)), body]
        if kind == SLOT:
            slot = self.ring.acquire()
            assert slot >= 0, "no slot came back"
            self.ring.buffer(slot)[: len(body)] = np.frombuffer(body, np.uint8)
            self.ring.commit(slot, self.sequence, len(body), 1 << self.column)
            return [self.header(kind, len(body), slot) + struct.pack("<Q", 1 << self.column)]
        if kind == BATCH:
            return [
                batch([body], source=self.SOURCE, fingerprint=self.codec.fingerprint, sequence=self.sequence)
            ]
        return [self.answer]

    def drain(self):
        taken = []
        while True:
            try:
                taken.append(self.subscriber.recv(0.0).stamp_ns)
            except TimeoutError:
                return taken

    def still_lives(self, value):
        """The next good messages arrive, one of each kind, and all slots come back."""
        for kind in (MESSAGE, self.large, BATCH):
            self.socket.send_multipart(self.frames(kind, value))
            assert self.drain() == [value], kind
        assert self.ring.outstanding(self.column) == 0

    def close(self):
        self.subscriber.close()
        self.socket.close(0)
        self.ring.close()


@pytest.fixture(params=[Number, Scan], ids=lambda kind: kind.__name__)
def feed(request, runtime):
    """A link that shares memory."""
    made = Feed(request.param)
    yield made
    made.close()


@pytest.mark.parametrize("shared", [True, False])
def test_the_feed_is_what_a_publisher_sends(runtime, shared):
    """Without this the tests below could pass by rejecting everything."""
    feed = Feed(Number, shared=shared)
    try:
        feed.still_lives(7)
        counters = feed.subscriber.counters
        assert (counters.received, counters.lost, counters.rejected) == (3, 0, 0)
    finally:
        feed.close()


BAD = {
    "short header": lambda f: [f.header(MESSAGE, 0)[:40]],
    "only the prefix": lambda f: [f.header(MESSAGE, 0)[:24]],
    "wrong fingerprint": lambda f: [_with(f.frames(MESSAGE, 1)[0], 16, "<Q", 12345)],
    "body too short": lambda f: [f.frames(MESSAGE, 1)[0][:-1]],
    "body too long": lambda f: [f.frames(MESSAGE, 1)[0] + b"x"],
    "size over the limit": lambda f: [_with(f.frames(MESSAGE, 1)[0], 48, "<Q", BODY_LIMIT + 1)],
    "empty body": lambda f: [f.header(MESSAGE, 0)],
    "large without body": lambda f: [f.header(LARGE, 10)],
    "large of another size": lambda f: [f.header(LARGE, 10), b"123"],
    "large over the limit": lambda f: [f.header(LARGE, BODY_LIMIT + 1), b"123"],
    "large that does not decode": lambda f: [f.header(LARGE, 5), b"12345"],
    "descriptor without mask": lambda f: [f.frames(SLOT, 1)[0][:-8]],
    "descriptor with more": lambda f: [f.frames(SLOT, 1)[0] + b"x"],
    "slot that does not exist": lambda f: [_with(f.frames(SLOT, 1)[0], 56, "<Q", 4)],
    "slot far outside": lambda f: [_with(f.frames(SLOT, 1)[0], 56, "<Q", 0xFFFFFFFF)],
    "slot of another size": lambda f: [_with(f.frames(SLOT, 1)[0], 48, "<Q", 17)],
    "slot larger than it is": lambda f: [_with(f.frames(SLOT, 1)[0], 48, "<Q", 1 << 20)],
    "copy of a slot that does not exist": lambda f: [_not_granted(f.frames(SLOT, 1)[0], 56, "<Q", 4)],
    "copy of more than a slot holds": lambda f: [_not_granted(f.frames(SLOT, 1)[0], 48, "<Q", 4097)],
    "batch of records that are not there": lambda f: [f.header(BATCH, 0, 2)],
    "batch of records not counted": lambda f: [_with(f.frames(BATCH, 1)[0], 56, "<Q", 0)],
    "batch of too many": lambda f: [_with(f.frames(BATCH, 1)[0], 56, "<Q", 2)],
    "batch of a great many": lambda f: [_with(f.frames(BATCH, 1)[0], 56, "<Q", 2**63)],
    "batch that ends early": lambda f: [f.frames(BATCH, 1)[0][:-8]],
    "batch with a reserved number": lambda f: [_with(f.frames(BATCH, 1)[0], HEADER_SIZE + 20, "<I", 1)],
    "batch with a record too long": lambda f: [
        _with(f.frames(BATCH, 1)[0], HEADER_SIZE + 16, "<I", 2**32 - 1)
    ],
    "answer with too many rings": lambda f: [_with(f.answer, 44, "<I", 5)],
    "answer with five rings": lambda f: [_with(f.answer, 44, "<I", 5) + 4 * f.answer[-32:]],
    "answer with rings that are not there": lambda f: [_with(f.answer, 44, "<I", 2)],
    "answer with a column too high": lambda f: [_with(f.answer, 40, "<I", 64)],
    "answer cut short": lambda f: [f.answer[:50]],
}


def _with(frame, offset, form, value):
    data = bytearray(frame)
    struct.pack_into(form, data, offset, value)
    return bytes(data)


def _not_granted(frame, offset, form, value):
    """A descriptor without the reader's bit: it may try to copy the slot."""
    return _with(_with(frame, offset, form, value), HEADER_SIZE, "<Q", 0)


@pytest.mark.parametrize("name", BAD)
def test_a_bad_frame_is_rejected_counted_and_logged_once(runtime, name, caplog):
    feed = Feed(Number, shared=not name.startswith("large"))
    caplog.set_level(logging.DEBUG)
    try:
        for _ in range(3):
            feed.sequence += 1
            feed.socket.send_multipart(BAD[name](feed))
            assert feed.drain() == []
        counters = feed.subscriber.counters
        assert counters.rejected >= 3
        assert counters.received == 0
        logged = [record for record in caplog.records if record.name == "cortex.link"]
        assert len(logged) == 1, logged
        assert logged[0].levelno == logging.WARNING
        assert "/feed" in logged[0].getMessage()
        feed.still_lives(8)
    finally:
        feed.close()


@pytest.mark.parametrize("kind", [MESSAGE, LARGE, BATCH])
def test_the_same_fault_in_other_numbers_is_the_same_fault(runtime, kind, caplog):
    """Or somebody who sends rubbish would fill the log."""
    feed = Feed(Scan, shared=False)
    try:
        for more in range(1, 40):
            frames = feed.frames(kind, 1)
            feed.socket.send_multipart([*frames[:-1], frames[-1] + bytes(more)])
            assert feed.drain() == []
        assert feed.subscriber.counters.rejected == 39
        assert len([record for record in caplog.records if record.name == "cortex.link"]) == 1
    finally:
        feed.close()


@pytest.mark.parametrize("kind", [MESSAGE, LARGE, BATCH])
def test_frames_that_follow_a_good_one_are_junk(runtime, kind):
    """A message has its frames and no more; what is behind them is not taken for another message."""
    feed = Feed(Number, shared=False)
    try:
        feed.socket.send_multipart([*feed.frames(kind, 1), b"junk", b""])
        assert feed.drain() == [1]
        assert feed.subscriber.counters.rejected == 2
        feed.still_lives(9)
    finally:
        feed.close()


def test_a_latched_message_that_is_none_is_rejected(runtime):
    feed = Feed(Number)
    try:
        body = feed.body(3)
        good = pack_header(Header(MESSAGE, feed.SOURCE, feed.codec.fingerprint, 4, 3, 0, len(body), 0)) + body
        for latched in (b"x", good[:-1], _with(good, 8, "<Q", 1), _with(good, 16, "<Q", 1), good[:70]):
            feed.link.expected, feed.link.attached = -1, False
            feed.socket.send(answer_frame(feed.key, AttachAnswer(5, None, (), latched)))
            assert feed.drain() == []
        assert feed.subscriber.counters.rejected == 5
        feed.link.expected, feed.link.attached = -1, False
        feed.socket.send(answer_frame(feed.key, AttachAnswer(5, None, (), good)))
        assert feed.drain() == [3]
        assert feed.link.expected == 5
    finally:
        feed.close()


def test_rings_that_cannot_be_mapped_are_done_without(feed):
    """Memory that is not what the answer says: the link asks for the messages through the socket."""
    bad = answer_frame(feed.key, AttachAnswer(0, 3, (RingPlace(9, 4, 4096, 1, 0),), b""))
    feed.socket.send(bad)
    assert feed.drain() == []
    key = wait_for(feed._attach)
    assert key != feed.key
    assert not parse_attach_key(key).shared_memory
    feed.socket.send(answer_frame(key, AttachAnswer(0, None, (), b"")))
    for kind in (MESSAGE, LARGE, BATCH):
        feed.socket.send_multipart(feed.frames(kind, 3))
        assert feed.drain() == [3]


@pytest.mark.parametrize("jump", [2**48, 2**63, 2**64 - 1])
def test_a_number_from_nowhere_does_not_end_the_stream(feed, jump):
    """A frame with an absurd sequence is not believed: or all that follow would count as seen before."""
    feed.still_lives(1)
    feed.socket.send(_with(feed.frames(MESSAGE, 2)[0], 24, "<Q", jump))
    feed.drain()
    feed.still_lives(3)
    assert feed.subscriber.counters.lost < 2**40


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("type_", [Number, Scan])
def test_mutated_frames_never_hurt(runtime, type_, shared):
    """Whatever comes, the next good message arrives, and all slots come back."""
    feed = Feed(type_, shared=shared)
    generator = np.random.Generator(np.random.Philox(key=[shared, len(feed.codec.schema.fields[1].name)]))
    kinds = (MESSAGE, feed.large, BATCH, ATTACH)
    rejected = 0
    try:
        for count in range(FRAMES // 4):
            kind = kinds[count % len(kinds)]
            frames = mutate(feed.frames(kind, 5), generator)
            if kind != ATTACH and generator.integers(5) == 0:
                frames.insert(int(generator.integers(len(frames) + 1)), generator.bytes(8))
            feed.socket.send_multipart(frames)
            feed.drain()
            if feed.socket.poll(0) or feed.link._column != (feed.column if shared else None):
                rejected += feed.subscriber.counters.rejected
                feed.close()  # an answer with another column or place was believed
                feed = Feed(type_, shared=shared)
            elif count % 8 == 7:
                feed.sequence += 1  # a gap, so that slots are taken back whose descriptor did not make sense
                feed.still_lives(6)
        feed.still_lives(6)
        assert rejected + feed.subscriber.counters.rejected > FRAMES // 40
    finally:
        feed.close()


def mutate(frames, generator):
    """Change one of the frames: shorter, longer, a bit, a byte or a number."""
    place = int(generator.integers(len(frames)))
    data = bytearray(frames[place])
    action = generator.integers(5)
    if action == 0:
        del data[int(generator.integers(len(data))) :]
    elif action == 1:
        data += generator.bytes(int(generator.integers(1, 40)))
    else:
        # Not the number: a message with another number is a message.
        at = int(generator.choice([p for p in range(len(data)) if place or not 24 <= p < 32]))
        if action == 2:
            data[at] ^= 1 << int(generator.integers(8))
        elif action == 3 and at + 8 <= len(data) and not 17 <= at < 32:
            struct.pack_into("<Q", data, at, EXTREMES[int(generator.integers(len(EXTREMES)))])
        else:
            data[at] = int(generator.integers(256))
    return [*frames[:place], bytes(data), *frames[place + 1 :]]
