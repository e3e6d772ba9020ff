"""One subscriber's connection to one publisher: attaching, sequence numbers, leases of shared memory."""

from __future__ import annotations

import contextlib
import logging
import re
import secrets
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import zmq

from cortex import wire
from cortex.codec import Codec, MalformedMessage, coder_of
from cortex.compiled import native
from cortex.context import Frames, new_socket
from cortex.policy import Policy
from cortex.records import PublisherRecord
from cortex.stats import SubscriberCounters

logger = logging.getLogger(__name__)

QUEUE_MAX = 1000
BLOCK_MS = 20
"""Longest time that `receive(0)` waits."""
JUMP_MAX = 1 << 32
"""A sequence that is further ahead than this is not believed: after it every other would count as seen."""
_warned_of: deque[str] = deque(maxlen=256)
_NUMBERS = re.compile(r"[0-9a-f]{6,}|\d+")
make = tuple.__new__
"""Makes a named tuple in half of the time that its own constructor takes."""


class Item(NamedTuple):
    """A message that has arrived and waits: where its body is.

    A leased slot is the buffer itself, so that dropping the item gives the slot back.
    """

    link: Link
    buffer: bytes | np.ndarray
    offset: int
    size: int
    sequence: int
    stamp_ns: int
    publish_ns: int


class Info(NamedTuple):
    """What is known of a message besides its content."""

    topic: str
    source: int
    """The publisher's number."""
    sequence: int
    stamp_ns: int | None
    """The message's own time, if its type has one [ns]."""
    publish_ns: int
    """When it was published, on this host's CLOCK_MONOTONIC [ns]."""
    latency_ns: int
    """From `publish` to now [ns]; between hosts as good as `Node.clock` of both says, but for 1 ms."""
    size: int


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
        self.clock_offset_ns = clock_offset_ns
        """What to add to this publisher's clock to read it on ours [ns]."""
        self._policy = policy
        stamped = codec.stamp_of is not None
        self._stamped = stamped
        self.message_head = wire.message_head(wire.MESSAGE, self.source, codec.fingerprint, stamped=stamped)
        """The first 24 bytes of every plain message."""
        self.coder = coder_of(codec, self.message_head)
        """Reads them in C; its `slots` may be a `RingReader`: then frames that name slots of it, too."""
        self._message_prefix = self.message_head[:16]
        self._handlers = {
            wire.prefix(wire.LARGE, self.source, stamped=stamped): self._on_large,
            wire.prefix(wire.SLOT, self.source, stamped=stamped): self._on_slot,
            wire.prefix(wire.NEXT, self.source, stamped=stamped): self._on_next,
            wire.prefix(wire.ATTACH, self.source, stamped=stamped): self._on_answer,
        }
        large_head, _, next_head = list(self._handlers)[:3]
        self._socket_heads = (self._message_prefix, next_head, large_head)
        self._reached = 0
        """The highest sequence that the publisher is known to have reached."""
        self._begins_again = False
        """Whether the first answer told of a ring that we cannot read: another one follows."""
        self._ended = -1
        """The sequence at which the publisher said that the stream ends."""
        self._complained: set[str] = set()
        self.socket = new_socket(
            zmq.SUB, tcp=not local, high_water_mark=policy.depth if policy.reliable else QUEUE_MAX
        )
        self.socket.rcvtimeo = BLOCK_MS
        self._frames = Frames(self.socket)
        self._receive_socket = self._frames.receive
        self.receive: Callable[[int], bytes] = self._receive_socket
        self._end: Any = None
        """Our end of the ring, if we have asked for it; open until the end, as others wait for its wakeup."""
        self._ring: Any = None
        """That which brings all messages; None: they come through the socket."""
        try:
            if secure is not None:
                secure(self.socket)
            self._socket_fd = int(self.socket.get(zmq.FD))
            self.socket.connect(address)
            for head in self._socket_heads:
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
        self._asks_for_ring = shared_memory
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
        key = wire.AttachKey(
            self.source,
            self._reader,
            self._end is not None and shared_memory,
            policy.reliable,
            min(policy.depth + 2, 255),
            min(int(policy.timeout_s * 1000.0), 2**32 - 1),
        )
        self._key = wire.attach_key(key, stamped=self._stamped)
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
        if not frame and self._ring is not None and self._ring.ended:
            self._do_without_shared_memory("it has none for such messages")
            return []
        handler = self._handlers.get(frame[:16])
        try:
            if handler is None or len(frame) < wire.HEADER_SIZE:
                raise MalformedMessage(
                    f"a frame of {len(frame)} bytes: not of this publisher, or not of this type"
                )
            return handler(frame)
        except MalformedMessage as error:
            self.reject(str(error))
            self._drop_parts()
            if (
                handler is not None
                and frame[3:4] in (wire.LARGE, wire.SLOT)
                and len(frame) >= wire.HEADER_SIZE
            ):
                self.skip(wire.TAIL.unpack_from(frame, 16)[1])
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
            if self._policy.reliable:
                self._confirm(sequence)
        self.expected = sequence + count
        return True

    def _confirm(self, sequence: int) -> None:
        """Tell the publisher that all below a sequence is accounted for."""
        key = wire.resume_key(self.source, self._reader, sequence, stamped=self._stamped)
        self.socket.subscribe(key)
        self.socket.unsubscribe(key)

    def _count_to(self, sequence: int, *, is_last: bool) -> None:
        """The publisher says which sequence comes next, or that none does."""
        if self.advance(sequence, 0):
            if is_last:
                self._ended = sequence
            if self._ring is None:
                self._confirm(sequence + is_last)

    def _check(self, fingerprint: int, size: int) -> None:
        if fingerprint != self.codec.fingerprint:
            raise MalformedMessage(f"fingerprint {fingerprint:016x}, expected {self.codec.fingerprint:016x}")
        if size > wire.BODY_LIMIT:
            raise MalformedMessage(f"a body of {size} bytes is over the limit of {wire.BODY_LIMIT}")

    def _on_large(self, frame: bytes) -> list[Item]:
        fingerprint, sequence, stamp_ns, publish_ns, size, _ = wire.TAIL.unpack_from(frame, 16)
        if len(frame) != wire.HEADER_SIZE or not self.socket.get(zmq.RCVMORE):
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
        return [Item(self, data, 0, size, sequence, stamp_ns, publish_ns)]

    def _on_slot(self, frame: bytes) -> list[Item]:
        fingerprint, sequence, stamp_ns, publish_ns, size, slot = wire.TAIL.unpack_from(frame, 16)
        data = None if self._ring is None else self._ring.take_body()
        if len(frame) != wire.HEADER_SIZE or data is None:
            raise MalformedMessage(f"slot {slot} does not hold message {sequence} of {size} bytes for us")
        self._check(fingerprint, size)
        if not self.advance(sequence):
            return []  # `data` gives the slot back
        return [make(Item, (self, data, 0, size, sequence, stamp_ns, publish_ns))]

    def _on_next(self, frame: bytes) -> list[Item]:
        fingerprint, sequence, _, _, size, options = wire.TAIL.unpack_from(frame, 16)
        self._check(fingerprint, size)
        if len(frame) != wire.HEADER_SIZE or size:
            raise MalformedMessage(f"a frame of {len(frame)} bytes that should have no body")
        self._count_to(sequence, is_last=bool(options & wire.LAST))
        return []

    def _on_answer(self, frame: bytes) -> list[Item]:
        if frame[: len(self._key)] != self._key:
            return []  # the answer to an earlier attempt
        answer = wire.parse_answer(frame)
        first = not self.attached
        self.attached = True
        self._reached = max(self._reached, answer.sequence)
        is_new = self.expected < 0 or self._begins_again
        if self.expected < 0:  # what is lost counts from here on, also in a ring that we cannot read
            self.expected = answer.sequence
        if first:
            try:
                self._use_ring()
            except OSError as error:
                reason = f"it is of another version of cortex, or has too many readers ({error})"
                is_warned = self.address in _warned_of  # a node has it once for all its publishers
                self._do_without_shared_memory(reason, logging.INFO if is_warned else logging.WARNING)
                if not is_warned:
                    _warned_of.append(self.address)
                self.attached, self._begins_again = False, is_new
                return []  # it is asked again
        self._begins_again = False
        if self._policy.reliable and self._ring is None:
            self._confirm(self.expected)
        return self._latched(answer.latched) if answer.latched and is_new else []

    def _use_ring(self) -> None:
        """If the publisher has taken us in, its ring has all that follows; OSError if we cannot read it."""
        first = self._end.welcomed() if self._end is not None and self._asks_for_ring else None
        if first is None:
            return
        self._ring = self._end
        self.receive = self._ring.receive
        if self.coder is not None:
            self.coder.slots = self._ring
        self.attached = True
        if self.expected < 0:  # what is lost counts from there on, also if the answer never comes
            self.expected = first
        for head in self._socket_heads:
            self.socket.unsubscribe(head)

    def _use_socket(self) -> None:
        """What follows comes through the socket again, as we shall be another reader to the publisher."""
        self.receive = self._receive_socket
        self._ring = None
        if self.coder is not None:
            self.coder.slots = None
        for head in self._socket_heads:
            self.socket.subscribe(head)

    @property
    def carrier(self) -> str:
        """How messages come: the transport, and what carries them on this host."""
        return self.address.partition("://")[0] + (", shared memory" if self._ring is not None else "")

    @property
    def is_crowded(self) -> bool:
        """Whether the next message waits in the ring, because the user keeps too many large ones."""
        return self._ring is not None and bool(self._ring.is_crowded)

    def pass_over(self) -> None:
        """Leave out the message for which there is no memory: it counts as lost when the next comes."""
        self._ring.pass_over()

    @property
    def fds(self) -> tuple[int, ...]:
        """Descriptors that become readable when something may have come."""
        return (self._socket_fd,) if self._end is None else (self._socket_fd, self._end.fd)

    def _latched(self, frame: bytes) -> list[Item]:
        if len(frame) < wire.HEADER_SIZE or frame[:16] not in self._socket_heads:
            raise MalformedMessage("a latched message that is none")
        fingerprint, sequence, stamp_ns, publish_ns, size, _ = wire.TAIL.unpack_from(frame, 16)
        self._check(fingerprint, size)
        if len(frame) != wire.HEADER_SIZE + size:
            raise MalformedMessage(f"a latched message of {len(frame)} bytes that says its body has {size}")
        if sequence >= self.expected and not self.advance(sequence):
            return []
        return [Item(self, frame, wire.HEADER_SIZE, size, sequence, stamp_ns, publish_ns)]

    def _do_without_shared_memory(self, reason: str, level: int = logging.INFO) -> None:
        logger.log(level, "%s: cannot share memory with %s: %s", self.record.topic, self.address, reason)
        if self._ring is not None:
            self._use_socket()
        key = self._key
        self._ask(shared_memory=False)
        self.socket.unsubscribe(key)  # after that, so that the publisher counts us all the time

    def leave(self) -> None:
        """The publisher has left: what it wrote into its ring counts, also if its answer never came."""
        if not self.attached:
            with contextlib.suppress(OSError):
                self._use_ring()

    @property
    def has_ended(self) -> bool:
        """Whether the publisher has said that nothing follows what has come."""
        return 0 <= self.expected == self._ended

    def end(self) -> None:
        """The publisher has left, and all that came of it was read: what it has published besides is lost."""
        if 0 <= self.expected < self._reached:
            self.advance(self._reached, 0)
        if self._policy.reliable and self.expected > self._ended:
            self.counters.cut_off += 1
            logger.warning("%s: a publisher ended without saying how much it had sent", self.record.topic)

    def close(self) -> None:
        """Disconnect. Messages that the user still holds stay as they are."""
        if self.coder is not None:
            self.coder.slots = None
        self._frames.close()
        self.socket.close(0)
        self._close_end()

    def _close_end(self) -> None:
        if self._end is not None:
            self._end.close()

    def info(self, item: Item) -> Info:
        """What is known of a message of this publisher."""
        publish_ns = item.publish_ns + self.clock_offset_ns
        return Info(
            self.record.topic,
            self.source,
            item.sequence,
            item.stamp_ns if self._stamped else None,
            publish_ns,
            time.monotonic_ns() - publish_ns,
            item.size,
        )
