"""One subscriber's connection to one publisher: attaching, sequence numbers, leases of shared memory."""

from __future__ import annotations

import logging
import re
import secrets
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import zmq

from cortex.codec import Codec, MalformedMessage
from cortex.compiled import native
from cortex.context import Frames, new_socket
from cortex.packer import make_reader
from cortex.policy import Policy
from cortex.records import PublisherRecord
from cortex.schema import Schema
from cortex.shm import RingGone, RingView, ShmUnavailable
from cortex.stats import SubscriberCounters
from cortex.wire import (
    ATTACH,
    BATCH,
    BODY_LIMIT,
    HEADER_SIZE,
    LARGE,
    MASK,
    MESSAGE,
    PLACE_SIZE,
    RECORD,
    SLOT,
    TAIL,
    AttachKey,
    RingPlace,
    attach_key,
    batch_records,
    message_head,
    parse_answer,
    parse_place,
    prefix,
    resume_key,
)

logger = logging.getLogger(__name__)

QUEUE_MAX = 1000
BLOCK_MS = 20
"""Longest time that `receive(0)` waits."""
JUMP_MAX = 1 << 32
"""A sequence that is further ahead than this is not believed: after it every other would count as seen."""
_NUMBERS = re.compile(r"[0-9a-f]{6,}|\d+")
RINGS_MAX = 8
"""Most rings of one publisher that are kept mapped."""
WHOLE_BATCH = -1
make = tuple.__new__
"""Makes a named tuple in half of the time that its own constructor takes."""


class Item(NamedTuple):
    """A message that has arrived and waits: where its body is.

    A leased slot is the buffer itself, so that dropping the item gives the slot back. An offset of
    `WHOLE_BATCH` marks the records of a batch that was not taken apart; the size is then their number.
    """

    link: Link
    buffer: bytes | np.ndarray | None
    offset: int
    size: int
    sequence: int
    stamp_ns: int
    publish_ns: int
    slot: tuple[RingView, int] | None


class Link:
    """The receiving end of one publisher. Every method runs under its subscriber's lock."""

    def __init__(
        self,
        record: PublisherRecord,
        codec: Codec,
        address: str,
        *,
        policy: Policy,
        local: bool,
        shared_memory: bool,
        counters: SubscriberCounters,
        clock_offset_ns: int,
        secure: Callable[[zmq.Socket[bytes]], None] | None = None,
    ) -> None:
        self.record = record
        self.source = record.source
        self.codec = codec
        self.address = address
        self.counters = counters
        self.expected = -1
        self.attached = False
        self.whole_batches = False
        self.clock_offset_ns = clock_offset_ns
        """What to add to this publisher's clock to read it on ours [ns]."""
        self._policy = policy
        stamped = codec.stamp_of is not None
        self._stamped = stamped
        self.message_head = message_head(MESSAGE, self.source, codec.fingerprint, stamped=stamped)
        """The first 24 bytes of every plain message."""
        self.read, self.drain, self.gather, self.records, self.coder = make_reader(codec, self.message_head)
        self._message_prefix = self.message_head[:16]
        self._handlers = {
            prefix(LARGE, self.source, stamped=stamped): self._on_large,
            prefix(SLOT, self.source, stamped=stamped): self._on_slot,
            prefix(BATCH, self.source, stamped=stamped): self._on_batch,
            prefix(ATTACH, self.source, stamped=stamped): self._on_answer,
        }
        self._large_head, self._slot_head, self.batch_head = list(self._handlers)[:3]
        self._rings: dict[int, RingView] = {}
        self._newest_ring = -1
        """The highest number of a ring that was mapped."""
        self._given_up = 0
        """The publisher writes to no ring of a lower number any more."""
        self._reached = 0
        """The highest sequence that the publisher is known to have reached."""
        self._told = -1
        """The sequence that the publisher last said would come next."""
        self._column: int | None = None
        self._large_subscribed = True
        self._complained: set[str] = set()
        self.socket = new_socket(
            zmq.SUB, tcp=not local, high_water_mark=policy.depth if policy.reliable else QUEUE_MAX
        )
        self.socket.rcvtimeo = BLOCK_MS
        self._frames = Frames(self.socket)
        self._receive_socket = self._frames.receive
        self.receive: Callable[[int], bytes] = self._receive_socket
        self._end: Any = None
        """Our end of the ring, if we have asked for it; open until the end, as others wait for its bell."""
        self._ring: Any = None
        """That which brings all messages; None: they come through the socket."""
        try:
            if secure is not None:
                secure(self.socket)
            self._socket_fd = int(self.socket.get(zmq.FD))
            self.socket.connect(address)
            for head in (self._message_prefix, *list(self._handlers)[:3]):
                if head != self._slot_head or shared_memory:
                    self.socket.subscribe(head)
            self._key = b""
            self._ask(shared_memory=shared_memory)
        except BaseException:
            self._frames.close()
            self.socket.close(0)
            self._close_end()
            raise

    def _ask(self, *, shared_memory: bool) -> None:
        policy = self._policy
        self._reader = secrets.randbits(64) or 1
        self._confirms = not self.address.startswith("inproc:")  # within a process nothing is on its way
        if shared_memory and native is not None and self.address.startswith("ipc://"):
            path = self.address.removeprefix("ipc://").rpartition(".")[0] + ".ring"
            try:
                self._end = native.RingReader(
                    path,
                    self.source,
                    self._reader,
                    self._socket_fd,
                    self._receive_socket,
                    zmq.Again,
                    BLOCK_MS,
                )
            except OSError as error:
                logger.info("%s: no ring: %s", self.record.topic, error)
        key = AttachKey(
            self.source,
            self._reader,
            shared_memory,
            policy.reliable,
            min(policy.depth + 2, 255),
            min(int(policy.timeout_s * 1000.0), 2**32 - 1),
            self._confirms,
        )
        self._key = attach_key(key, stamped=self._stamped)
        self.socket.subscribe(self._key)

    def reject(self, reason: str) -> None:
        """Count a bad frame; say so once for each kind of reason."""
        self.counters.rejected += 1
        text = _NUMBERS.sub("#", reason)
        if text not in self._complained and len(self._complained) < 16:
            self._complained.add(text)
            logger.warning("%s: rejected a frame of %s: %s", self.record.topic, self.address, reason)
        if self._ring is not None and self._ring.broken:
            self._do_without_shared_memory("its ring carries something that is no frame")

    def handle(self, frame: bytes) -> list[Item]:
        """Take in a frame that is not a plain small message."""
        handler = self._handlers.get(frame[:16])
        try:
            if handler is None or len(frame) < HEADER_SIZE:
                raise MalformedMessage(
                    f"a frame of {len(frame)} bytes: not of this publisher, or not of this type"
                )
            return handler(frame)
        except MalformedMessage as error:
            self.reject(str(error))
            self._drop_parts()
            if handler is not None and frame[3:4] in (LARGE, SLOT) and len(frame) >= HEADER_SIZE:
                self.skip(TAIL.unpack_from(frame, 16)[1])
            return []

    def skip(self, sequence: int) -> None:
        """A message was rejected: it is accounted for, if it is the one that was to come."""
        if sequence == self.expected:
            self.expected = sequence + 1

    def _drop_parts(self) -> None:
        while self.socket.get(zmq.RCVMORE):
            self.counters.rejected += 1
            self.socket.recv(zmq.DONTWAIT)

    def advance(self, sequence: int, count: int = 1) -> bool:
        """Account for the numbers up to these; False if they have been seen before, or cannot be."""
        if sequence < self.expected:
            return False
        if sequence - self.expected > JUMP_MAX and self.expected >= 0:
            self.reject(f"sequence {sequence} after {self.expected}")
            return False
        if 0 <= self.expected < sequence:
            self.counters.lost += sequence - self.expected
            for ring in self._rings.values():
                ring.heal(sequence)
            if self._policy.reliable:
                self._confirm(sequence)
        self.expected = sequence + count
        return True

    def _confirm(self, sequence: int) -> None:
        """Tell the publisher that all below a sequence is accounted for."""
        key = resume_key(self.source, self._reader, sequence, stamped=self._stamped)
        self.socket.subscribe(key)
        self.socket.unsubscribe(key)

    def _count_to(self, sequence: int) -> None:
        """The publisher says which sequence comes next."""
        if self.advance(sequence, 0):
            self._told = sequence
            if self._confirms and self._ring is None:
                self._confirm(sequence)

    def _check(self, fingerprint: int, size: int) -> None:
        if fingerprint != self.codec.fingerprint:
            raise MalformedMessage(f"fingerprint {fingerprint:016x}, expected {self.codec.fingerprint:016x}")
        if size > BODY_LIMIT:
            raise MalformedMessage(f"a body of {size} bytes is over the limit of {BODY_LIMIT}")

    def _on_large(self, frame: bytes) -> list[Item]:
        fingerprint, sequence, stamp_ns, publish_ns, size, _ = TAIL.unpack_from(frame, 16)
        if len(frame) != HEADER_SIZE or not self.socket.get(zmq.RCVMORE):
            raise MalformedMessage("a large message without its body")
        body = self.socket.recv(zmq.DONTWAIT, copy=False)
        self._drop_parts()
        self._check(fingerprint, size)
        if len(body) != size:
            raise MalformedMessage(f"a large message of {len(body)} bytes that says it has {size}")
        if not self.advance(sequence):
            return []
        data = np.frombuffer(body.buffer, np.uint8)
        data.flags.writeable = False
        return [Item(self, data, 0, size, sequence, stamp_ns, publish_ns, None)]

    def _on_slot(self, frame: bytes) -> list[Item]:
        fingerprint, sequence, stamp_ns, publish_ns, size, aux = TAIL.unpack_from(frame, 16)
        if len(frame) != HEADER_SIZE + MASK.size + PLACE_SIZE:
            raise MalformedMessage(f"a descriptor of {len(frame)} bytes")
        if fingerprint != self.codec.fingerprint:
            self._check(fingerprint, size)
        (mask,) = MASK.unpack_from(frame, HEADER_SIZE)
        ring, slot = aux >> 32, aux & 0xFFFFFFFF
        view = self._rings.get(ring)
        if view is None and self._column is not None:
            place = parse_place(frame, HEADER_SIZE + MASK.size)
            if place.ring != ring:
                raise MalformedMessage(f"a descriptor for ring {ring} that places ring {place.ring}")
            view = self._open_ring(place)
        if len(self._rings) > 1:
            self._forget_rings(ring)
        leased = self._column is not None and bool(mask >> self._column & 1)
        if view is None or not leased:
            if self._large_subscribed or sequence < self.expected:
                self._reached = max(self._reached, sequence + 1)
                return []  # it comes, or came, as a large message; lost if the publisher ends before
            if view is None or self._policy.reliable:
                if self.advance(sequence):  # left out on purpose: the publisher held us to our share
                    self.counters.lost += 1
                return []
            if slot >= view.slots or size > view.slot_bytes:
                raise MalformedMessage(f"a descriptor of slot {slot} with {size} bytes: the ring has no such")
            self.advance(sequence)
            return [Item(self, None, 0, size, sequence, stamp_ns, publish_ns, (view, slot))]
        try:
            data = view.lease(slot, sequence, size)
        except ValueError as error:
            raise MalformedMessage(str(error)) from None
        if sequence == self.expected:
            self.expected = sequence + 1
        elif not self.advance(sequence):
            return []  # `data` gives the slot back
        return [make(Item, (self, data, 0, size, sequence, stamp_ns, publish_ns, None))]

    def _on_batch(self, frame: bytes) -> list[Item]:
        fingerprint, first, _, publish_ns, size, count = TAIL.unpack_from(frame, 16)
        self._check(fingerprint, size)
        if size != len(frame) - HEADER_SIZE or (count == 0) != (size == 0):
            raise MalformedMessage(f"a batch of {len(frame)} bytes that says its records have {size}")
        if not count:
            self._count_to(first)
            return []
        fixed = self.codec.fixed_size
        if self.whole_batches and fixed is not None:
            stride = RECORD.size + fixed + (-fixed % 8)
            if count * stride != size:
                raise MalformedMessage(f"a batch of {size} bytes cannot hold {count} records of {stride}")
            if not self.advance(first, count):
                return []
            return [Item(self, frame[HEADER_SIZE:], WHOLE_BATCH, count, first, 0, publish_ns, None)]
        records = self._records(frame, first, count)
        return records if self.advance(first, count) else []

    def read_batch(self, frame: bytes, messages: deque[Any]) -> None:
        """Decode the messages of a batch; a frame that is not whole is rejected as a whole."""
        try:
            fingerprint, first, _, _, size, count = TAIL.unpack_from(frame, 16)
            self._check(fingerprint, size)
            end, offset = len(frame), HEADER_SIZE
            if size != end - HEADER_SIZE or (count == 0) != (size == 0) or count > size // RECORD.size:
                raise MalformedMessage(f"a batch of {end} bytes that says {count} records of {size}")
            quickly = self.records(frame, count) if self.records is not None and count else None
            if quickly is not None:
                if self.advance(first, count):
                    messages.extend(quickly)
                return
            decode, unpack = self.codec.decode, RECORD.unpack_from
            decoded: list[Any] = []
            while offset + RECORD.size <= end and len(decoded) < count:
                _, _, length, reserved = unpack(frame, offset)
                offset += RECORD.size
                if reserved:
                    raise MalformedMessage("a record with reserved bits")
                decoded.append(decode(frame, offset, length))
                offset += (length + 7) & -8
            if offset != end or len(decoded) != count:
                raise MalformedMessage(f"a batch of {end} bytes whose {count} records do not fill it")
        except MalformedMessage as error:
            self.reject(str(error))
            return
        if not count:
            self._count_to(first)
        elif self.advance(first, count):
            messages.extend(decoded)

    def _records(self, frame: bytes, first: int, count: int) -> list[Item]:
        return [
            Item(self, frame, record.offset, record.size, first + k, record.stamp_ns, record.publish_ns, None)
            for k, record in enumerate(batch_records(frame, count))
        ]

    def take_apart(self, item: Item) -> list[Item]:
        """The messages of a whole batch."""
        assert self.codec.fixed_size is not None
        assert isinstance(item.buffer, bytes)
        size, stride = self.codec.fixed_size, len(item.buffer) // item.size
        items = []
        for k in range(item.size):
            stamp_ns, publish_ns, _, _ = RECORD.unpack_from(item.buffer, k * stride)
            offset = k * stride + RECORD.size
            items.append(Item(self, item.buffer, offset, size, item.sequence + k, stamp_ns, publish_ns, None))
        return items

    def cut(self, item: Item, count: int) -> Item:
        """A whole batch without its first messages."""
        assert isinstance(item.buffer, bytes)
        stride = len(item.buffer) // item.size
        return item._replace(
            buffer=item.buffer[count * stride :], size=item.size - count, sequence=item.sequence + count
        )

    def _on_answer(self, frame: bytes) -> list[Item]:
        if frame[: len(self._key)] != self._key:
            return []  # the answer to an earlier attempt
        answer = parse_answer(frame)
        first = not self.attached
        self.attached = True
        self._reached = max(self._reached, answer.sequence)
        self._told = max(self._told, answer.sequence)
        self._column = answer.column
        if answer.column is None and not self._large_subscribed:
            self.socket.subscribe(self._large_head)
            self._large_subscribed = True
            self._shorten()
        if answer.column is not None:
            if answer.rings and not self._take_rings(answer.rings):
                return []
            if self._large_subscribed:
                self.socket.unsubscribe(self._large_head)
                self._large_subscribed = False
                self._shorten()
        known = self.expected >= 0
        if first:
            self._use_ring()
        if known:
            return []
        items = self._latched(answer.latched) if answer.latched else []
        self.expected = answer.sequence
        return items

    def _use_ring(self) -> None:
        """If the publisher has taken us in, it sends all that follows through its ring."""
        first = None if self._end is None else self._end.welcomed()
        if first is None:
            return
        self._ring = self._end
        self.receive = self._ring.receive
        self.attached = True
        if self.expected < 0:  # what is lost counts from there on, also if the answer never comes
            self.expected = first
        for head in (self._message_prefix, self.batch_head, self._slot_head):
            self.socket.unsubscribe(head)

    def _use_socket(self) -> None:
        """What follows comes through the socket again, as we shall be another reader to the publisher."""
        self.receive = self._receive_socket
        self._ring = None
        for head in (self._message_prefix, self.batch_head, self._slot_head):
            self.socket.subscribe(head)

    @property
    def carrier(self) -> str:
        """How messages come: the transport, and what carries them on this host."""
        parts = [self.address.partition("://")[0]]
        parts += ["ring"] if self._ring is not None else []
        parts += ["shared memory"] if self._column is not None else []
        return ", ".join(parts)

    @property
    def fds(self) -> tuple[int, ...]:
        """Descriptors that become readable when something may have come."""
        return (self._socket_fd,) if self._end is None else (self._socket_fd, self._end.fd)

    def _take_rings(self, places: tuple[RingPlace, ...]) -> bool:
        """Map the newest ring that is announced, and forget those that are given up.

        An announcement comes through the socket, descriptors through a ring: what it says may be old news.

        Returns:
            False if there is no shared memory from now on.
        """
        self._given_up = max(self._given_up, min(places).ring)
        newest = max(places)
        if newest.ring > self._newest_ring:
            try:
                self._map_ring(newest)
            except RingGone:
                pass  # replaced meanwhile: descriptors say which ring there is
            except ShmUnavailable as error:
                self._do_without_shared_memory(error)
                return False
        self._forget_rings(self._newest_ring)
        return True

    def _map_ring(self, place: RingPlace) -> RingView:
        assert self._column is not None
        view = self._rings[place.ring] = RingView(self.source, *place, self._column)
        self._newest_ring = max(self._newest_ring, place.ring)
        self._shorten()
        return view

    def _shorten(self) -> None:
        """Let the short cut in C read the slots of the ring, if there is one ring only."""
        if self.coder is not None:
            views = list(self._rings.values())
            self.coder.slots = views[0].short_cut if len(views) == 1 and not self._large_subscribed else None

    def _open_ring(self, place: RingPlace) -> RingView | None:
        """Map the ring of a descriptor; where that cannot be done, go on without shared memory."""
        try:
            return self._map_ring(place)
        except ShmUnavailable as error:
            # The lease of a message keeps its ring; that of one that was left out may be gone.
            if not isinstance(error, RingGone) or place.ring >= self._newest_ring:
                self._do_without_shared_memory(error)
            return None

    def _forget_rings(self, newest: int) -> None:
        """Unmap older rings that are not in use; one that is needed after all is mapped again.

        Of a ring that the publisher has given up only messages on their way are waited for: those in use
        become private copies.
        """
        for number, view in list(self._rings.items()):
            surplus = len(self._rings) > RINGS_MAX  # whoever lets us wait for so many sends us nonsense
            given_up = number < self._given_up and not view.is_awaited
            if number < newest and (surplus or given_up or view.idle):
                del self._rings[number]
                self._shorten()
                view.close()

    def _latched(self, frame: bytes) -> list[Item]:
        if len(frame) < HEADER_SIZE or frame[:16] not in (self._message_prefix, self._large_head):
            raise MalformedMessage("a latched message that is none")
        fingerprint, sequence, stamp_ns, publish_ns, size, _ = TAIL.unpack_from(frame, 16)
        self._check(fingerprint, size)
        if len(frame) != HEADER_SIZE + size:
            raise MalformedMessage(f"a latched message of {len(frame)} bytes that says its body has {size}")
        return [Item(self, frame, HEADER_SIZE, size, sequence, stamp_ns, publish_ns, None)]

    def _do_without_shared_memory(self, reason: ShmUnavailable | str) -> None:
        logger.info("%s: cannot share memory with %s: %s", self.record.topic, self.address, reason)
        self._close_rings()  # before the publisher can learn that our column is free
        self._newest_ring = -1
        if self._ring is not None:
            self._use_socket()
        if not self._large_subscribed:
            self.socket.subscribe(self._large_head)
            self._large_subscribed = True
        self.socket.unsubscribe(self._slot_head)
        self.socket.unsubscribe(self._key)
        self._column = None
        self._ask(shared_memory=False)

    def leave(self) -> None:
        """The publisher has left: what it wrote into its ring counts, also if its answer never came."""
        if not self.attached:
            self._use_ring()

    def end(self) -> None:
        """The publisher has left, and all that came of it was read: what it has published besides is lost."""
        if 0 <= self.expected < self._reached:
            self.advance(self._reached, 0)
        if self._policy.reliable and self.expected > max(self._told, 0):
            self.counters.cut_off += 1
            logger.warning("%s: a publisher ended without saying how much it had sent", self.record.topic)

    def close(self) -> None:
        """Disconnect. Messages that the user still holds stay valid.

        The end of the socket tells the publisher that it may write to our slots again: the rings close first.
        """
        self._close_rings()
        self._frames.close()
        self.socket.close(0)
        self._close_end()

    def _close_end(self) -> None:
        if self._end is not None:
            self._end.close()

    def _close_rings(self) -> None:
        if self.coder is not None:
            self.coder.slots = None
        for ring in self._rings.values():
            ring.close()
        self._rings.clear()

    def schema(self) -> Schema:
        """The structure of this publisher's messages."""
        return self.codec.schema
