"""A link that is fed by hand: what it does with frames that are not what they must be."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import random
import struct

import pytest
import zmq
from c_module import needs_native
from damage import mutate
from peer import Number, Scan, make, take_all
from processes import SOON_S, wait_for

from cortex import keep_last
from cortex.codec import codec_of
from cortex.compiled import native
from cortex.context import new_socket
from cortex.link import Link
from cortex.records import PublisherRecord
from cortex.subscriber import Subscriber
from cortex.wire import (
    ATTACH,
    BODY_LIMIT,
    LARGE,
    MESSAGE,
    NEXT,
    SLOT,
    AttachAnswer,
    Header,
    answer_frame,
    pack_header,
    parse_attach_key,
)

FRAMES = int(os.environ.get("CORTEX_FUZZ_FRAMES", "4000"))
"""Mutated frames for a link, of all kinds together; a million takes about five minutes."""

_numbers = itertools.count()


class Feed:
    """A raw XPUB socket in a publisher's place, and a subscriber that listens to it.

    Args:
        kind: Of the messages.
        directory: Where a ring is to be had, through which single frames go; None: all go through the socket.
    """

    SOURCE = 0x0123456789ABCDEF

    def __init__(self, kind, directory=None):
        self.codec = codec_of(kind)
        self.socket = new_socket(zmq.XPUB, high_water_mark=0)
        address = f"inproc://feed-{next(_numbers)}" if directory is None else f"ipc://{directory}/1.lossy"
        listener = None if directory is None else native.listen(f"{directory}/1.ring")
        self.socket.bind(address)
        record = PublisherRecord(
            "/feed", self.SOURCE, kind.__name__, self.codec.fingerprint, self.codec.schema.to_json(), False
        )
        self.sequence = -1
        self.subscriber = Subscriber("/feed", self.codec, keep_last(1000))
        self.link = Link(
            record,
            self.codec,
            address,
            policy=self.subscriber.policy,
            local=True,
            shared_memory=directory is not None,
            counters=self.subscriber.counters,
            clock_offset_ns=0,
        )
        self.subscriber.connect(self.link)
        self.key = wait_for(self._attach)
        self.answer = answer_frame(self.key, AttachAnswer(0, b""))
        self.ring = None
        if listener is not None:
            connection = native.accept(listener)
            self.ring = native.Broadcast(self.SOURCE, zmq.Again)
            self.ring.add(connection, *native.hear(connection)[2:], False, 0, 0)
            os.close(listener)
        self.socket.send(self.answer)
        assert self.subscriber.wait_for_publisher(SOON_S)

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
        return self.codec.encode(make(self.codec.type, value, 36), 1 << 20)

    def frames(self, kind, value):
        """A good message of a kind, as its frames."""
        self.sequence += 1
        body = self.body(value)
        if kind == MESSAGE:
            return [self.header(kind, len(body)) + body]
        if kind == LARGE:
            return [self.header(kind, len(body)), body]
        if kind == NEXT:
            return [self.header(kind, 0)]
        if kind == SLOT:
            return [self.header(kind, len(body), aux=value)]
        return [self.answer]

    def send(self, frames):
        """Send a message, of one frame or more."""
        if self.ring is None or len(frames) > 1:
            self.socket.send_multipart(frames)
        elif frames[0]:  # an empty one ends a ring
            self.ring.send(frames[0])

    def drain(self):
        return [message.stamp_ns for message in take_all(self.subscriber)]

    def still_lives(self, value):
        """The next good messages arrive, one of each kind."""
        for kind in (MESSAGE, LARGE) if self.ring is None else (MESSAGE,):
            self.send(self.frames(kind, value))
            assert self.drain() == [value], kind

    def close(self):
        self.subscriber.close()
        self.socket.close(0)
        if self.ring is not None:
            self.ring.close()


@pytest.fixture
def make_feed(runtime, tmp_path):
    """Makes links to a publisher of a type, and closes them."""
    with contextlib.ExitStack() as feeds:

        def made(kind, *, through="socket"):
            return feeds.enter_context(
                contextlib.closing(Feed(kind, tmp_path if through == "ring" else None))
            )

        yield made


BAD = {  # beside what `cortex/vectors/frames.json` has
    "only the prefix": lambda f: [f.header(MESSAGE, 0)[:24]],
    "size over the limit": lambda f: [_with(f.frames(MESSAGE, 1)[0], 48, "<Q", BODY_LIMIT + 1)],
    "empty body": lambda f: [f.header(MESSAGE, 0)],
    "large without body": lambda f: [f.header(LARGE, 10)],
    "large of another size": lambda f: [f.header(LARGE, 10), b"123"],
    "large over the limit": lambda f: [f.header(LARGE, BODY_LIMIT + 1), b"123"],
    "large that does not decode": lambda f: [f.header(LARGE, 5), b"12345"],
    "next with a body that it does not say": lambda f: [f.header(NEXT, 0) + bytes(8)],
    "next from nowhere": lambda f: [_with(f.frames(NEXT, 1)[0], 24, "<Q", 2**63)],
}


def _with(frame, offset, form, value):
    data = bytearray(frame)
    struct.pack_into(form, data, offset, value)
    return bytes(data)


@pytest.mark.parametrize("name", BAD)
def test_a_bad_frame_is_rejected_counted_and_logged_once(make_feed, name, caplog):
    feed = make_feed(Number)
    counters = feed.subscriber.counters
    feed.still_lives(7)
    assert (counters.received, counters.lost, counters.rejected) == (2, 0, 0)
    caplog.set_level(logging.DEBUG)
    for _ in range(3):
        feed.sequence += 1
        feed.socket.send_multipart(BAD[name](feed))
        assert feed.drain() == []
    assert counters.rejected >= 3
    assert counters.received == 2
    (logged,) = [record for record in caplog.records if record.name == "cortex.link"]
    assert logged.levelno == logging.WARNING
    assert "/feed" in logged.getMessage()
    feed.still_lives(8)


def test_a_latched_message_that_is_none_is_rejected(make_feed):
    feed = make_feed(Number)
    body = feed.body(3)
    good = pack_header(Header(MESSAGE, feed.SOURCE, feed.codec.fingerprint, 4, 3, 0, len(body), 0)) + body
    bad = (b"x", good[:-1], _with(good, 8, "<Q", 1), _with(good, 16, "<Q", 1), good[:70])
    for latched in (*bad, good):
        feed.link.expected, feed.link.attached = -1, False
        feed.socket.send(answer_frame(feed.key, AttachAnswer(5, latched)))
        assert feed.drain() == ([3] if latched == good else [])
    assert feed.subscriber.counters.rejected == 5
    assert feed.link.expected == 5


@pytest.mark.parametrize("kind", [Number, Scan])
@pytest.mark.parametrize("jump", [2**48, 2**63, 2**64 - 1])
def test_a_number_from_nowhere_does_not_end_the_stream(make_feed, kind, jump):
    """A frame with an absurd sequence is not believed: or all that follow would count as seen before."""
    feed = make_feed(kind)
    feed.still_lives(1)
    feed.socket.send(_with(feed.frames(MESSAGE, 2)[0], 24, "<Q", jump))
    feed.drain()
    feed.still_lives(3)
    assert feed.subscriber.counters.lost < 2**40


@pytest.mark.parametrize("through", ["socket", "ring"])
@pytest.mark.parametrize("kind", [Number, Scan])
@needs_native
def test_mutated_frames_never_hurt(make_feed, kind, through):
    """Whatever comes, the next good message arrives."""
    feed, rng = make_feed(kind, through=through), random.Random(1)
    kinds = (MESSAGE, LARGE, NEXT, ATTACH) if through == "socket" else (MESSAGE, SLOT, NEXT, ATTACH)
    for count in range(FRAMES // 4):
        frames = feed.frames(kinds[count % 4], 5)
        place, number = rng.randrange(len(frames)), frames[0][24:32]
        frames[place] = mutate(rng, frames[place])
        if len(frames[0]) >= 32:  # not the number: a message with another number is a message
            frames[0] = frames[0][:24] + number + frames[0][32:]
        if kinds[count % 4] != ATTACH and rng.random() < 0.2:
            frames.insert(rng.randrange(len(frames) + 1), rng.randbytes(8))
        feed.send(frames)
        feed.drain()
        if count % 8 == 7:
            feed.still_lives(6)
    assert feed.subscriber.counters.rejected > FRAMES // 40
