"""The readers of one publisher: who they are, and how its frames reach each of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import zmq

from cortex import wire
from cortex.broadcast import Broadcast, Reader
from cortex.large import LargeSender
from cortex.pub_socket import DONTWAIT, SNDMORE, PubSocket

if TYPE_CHECKING:
    from cortex.publisher import Publisher

READERS_MAX = 1024
SILENCE_MAX_NS = 30_000_000_000
SILENCE_NS = 100_000_000
"""After so long without a message readers are told how many there have been."""
FORGET_NS = 10_000_000_000
"""After so long without a message the memory of large bodies that were sent is given back."""
TELL_AGAIN_S = 0.02
"""A reader that was lagging when the publisher is closed is told this often how many messages there were."""


class Fanout:
    """Sends frames to all readers, through the ring and sockets. The caller holds the sockets' lock."""

    def __init__(self, publisher: Publisher[Any], *, max_wait_s: float, expected_bytes: int) -> None:
        self.topic, self.source = publisher.topic, publisher.source
        stamped, fingerprint = publisher.codec.stamp_of is not None, publisher.codec.fingerprint
        self._message_head, self._next_head, self._slot_head, self._large_head = (
            wire.message_head(kind, self.source, fingerprint, stamped=stamped)
            for kind in (wire.MESSAGE, wire.NEXT, wire.SLOT, wire.LARGE)
        )
        self._fast_send = publisher._fast_send
        self.large = LargeSender()
        self.pub_sockets = publisher._pub_sockets
        self.back_pressure = publisher._back_pressure
        self.latching = publisher.latch
        self._max_wait_ms = round(max_wait_s * 1000.0)
        self.readers: dict[bytes, Reader] = {}
        self.ring = Broadcast(self, expected_bytes)
        self.lagging: dict[PubSocket, int] = {}
        """Strict sockets on which a reader is lagging, and the sequence from which on it may get messages.

        libzmq sends it nothing until it has caught up."""
        self.latched = b""
        """The frame that a reader gets when it comes, if any."""
        self.timeouts = 0
        self.skipped = 0
        """Messages that some reader did not get, because too much waited to be sent to it."""
        self.closed = False
        self._lossy_sends: tuple[Callable[..., Any], ...] = ()
        self._strict_sockets: tuple[PubSocket, ...] = ()
        self._retries: dict[Callable[..., Any], Callable[[bytes], bool]] = {}
        """What to call where one of the `sends` of the fast path refuses."""
        self._crowded = False
        self._told = 0
        self._tell_after_ns = SILENCE_NS
        self._untold: list[PubSocket] = []
        self._tell_again_s = 0.0

    # Who comes and goes; called by the sockets

    def attach(self, pub_socket: PubSocket, key: bytes, request: wire.AttachKey) -> None:
        """Take a reader in."""
        if key in self.readers or self.closed:
            return
        if len(self.readers) >= READERS_MAX:
            if not self._crowded:
                self.note(f"has {READERS_MAX} subscribers, further ones are refused")
            self._crowded = True
            return
        request = request._replace(timeout_ms=min(request.timeout_ms, self._max_wait_ms))
        sequence = self._fast_send.sequence
        reader = self.readers[key] = Reader(key, request, pub_socket)
        if request.shared_memory and pub_socket.local:
            self.ring.admit(reader, sequence)
        reader.has_answer = reader.member is not None or not request.strict
        self.route()
        answer = wire.answer_frame(key, wire.AttachAnswer(sequence, self.latched))
        if pub_socket.strict:
            if not pub_socket.try_send(answer):
                pub_socket.send_anyway(answer)
        else:
            pub_socket.send(answer, DONTWAIT)

    def detach(self, pub_socket: PubSocket, request: wire.AttachKey) -> None:
        """Let a reader go."""
        for key, reader in self.readers.items():
            if reader.request.reader == request.reader and reader.pub_socket is pub_socket:
                del self.readers[key]
                self.ring.dismiss(reader)
                self.lagging.pop(pub_socket, None)
                self.route()
                return

    def resume(self, pub_socket: PubSocket, reader: int, sequence: int) -> None:
        """A reader has accounted for all below a sequence."""
        is_new = False
        for each in self.readers.values():
            if each.request.reader == reader:
                is_new = not each.has_answer
                each.confirmed, each.has_answer = max(each.confirmed, sequence), True
        if is_new:
            return  # it was not the one that was lagging
        if sequence >= self.lagging.get(pub_socket, 0):  # else it was too late once more since
            self.lagging.pop(pub_socket, None)
            self.route()

    def route(self) -> None:
        """Work out where messages go, when readers or what is sent have changed."""
        readers = self.readers.values()
        pub_sockets = {reader.pub_socket for reader in readers if reader.member is None}
        sends: list[Callable[..., Any]] = [
            pub_socket.send for pub_socket in pub_sockets if not pub_socket.strict
        ]
        self._lossy_sends = tuple(sends)
        self._strict_sockets = tuple(pub_socket for pub_socket in pub_sockets if pub_socket.strict)
        usual = not (self.latching or self.lagging or self.ring.has_lost)
        retries = {each.send: partial(self.send_strict, each) for each in self._strict_sockets}
        self._retries = retries | self.ring.sends
        self._fast_send.sends = (*self._lossy_sends, *self._retries) if usual else ()
        self._fast_send.ring = self.ring.short_cut if usual and not pub_sockets else None

    @property
    def has_sockets(self) -> bool:
        """Whether somebody reads through a socket."""
        return bool(self._lossy_sends or self._strict_sockets)

    def tick(self, now_ns: int) -> None:
        """Let go of what was sent, and tell readers how many messages there were; called now and then."""
        self.large.prune()
        if self.back_pressure.is_waiting:
            return
        sequence, silent_ns = self._fast_send.sequence, now_ns - self._fast_send.refresh_ns
        if silent_ns > FORGET_NS:
            self.large.forget()
        if self._told != sequence:
            self._told, self._tell_after_ns = sequence, SILENCE_NS
        if self.readers and silent_ns > self._tell_after_ns:
            self.tell()
            # After ever longer times again: where the queue is full, it gets lost like what it tells of.
            self._tell_after_ns = min(2 * self._tell_after_ns, silent_ns + SILENCE_MAX_NS)

    # Sending

    def send(self, frame: bytes) -> bool:
        """Send a frame to all, waiting for reliable readers; False if one of them lost it."""
        for send in self._lossy_sends:
            send(frame, DONTWAIT)
        on_time = not (self.lagging or self.ring.has_lost)
        for pub_socket in self._strict_sockets:
            try:
                pub_socket.send(frame, DONTWAIT)
            except zmq.Again:
                on_time &= self.send_strict(pub_socket, frame)
        on_time &= self.ring.send(frame)
        if not on_time:
            self.timeouts += 1
        return on_time

    def send_large(
        self, body: memoryview, slot: Any, sequence: int, stamp_ns: int, publish_ns: int, size: int
    ) -> bool:
        """Send a large message as `send` does.

        Readers of sockets get `body`, which stays as it is, and all if there is no slot.
        """
        rest = wire.REST.pack(sequence, stamp_ns, publish_ns, size, 0)
        if self.latching:
            self.latched = self._large_head + rest + body
        on_time = not (self.lagging or self.ring.has_lost)
        for pub_socket in {r.pub_socket for r in self.readers.values() if r.member is None}:
            on_time &= self._send_body(pub_socket, self._large_head + rest, body)
        if slot is not None:
            rest = wire.REST.pack(sequence, stamp_ns, publish_ns, size, slot.number)
            on_time &= self.ring.commit(slot, self._slot_head + rest)
        elif self.ring.has_readers:
            on_time &= self.ring.send(self._message_head + rest + body)
        if self._fast_send.ring is None:  # there may be slots now
            self.route()
        self.timeouts += not on_time
        return on_time

    def _send_body(self, pub_socket: PubSocket, head: bytes, body: memoryview) -> bool:
        def has_room() -> bool:
            return self.large.has_room(pub_socket, body)

        may_wait = pub_socket.strict and pub_socket not in self.lagging
        if not has_room() and not (may_wait and self.await_room(has_room, self._timeout_s(pub_socket))):
            if may_wait:
                self._give_up(pub_socket)
            self.skipped += 1
            return not pub_socket.strict
        on_time = True
        if pub_socket.strict:
            on_time = self.send_strict(pub_socket, head, SNDMORE)
        else:
            pub_socket.send(head, DONTWAIT | SNDMORE)
        self.large.send(pub_socket, body)
        return on_time

    def _timeout_s(self, pub_socket: PubSocket) -> float:
        readers = (r for r in self.readers.values() if r.pub_socket is pub_socket and r.member is None)
        return max((reader.timeout_s for reader in readers), default=0.0)

    def retry(self, frame: bytes, send: Callable[..., Any]) -> bool:
        """Send what one of the fast path's `sends` refused, waiting; False if a reliable reader lost it."""
        self.back_pressure.begin(self._fast_send.sequence)
        retry = self._retries.get(send)  # None: it has left since
        on_time = retry is None or retry(frame)
        if not on_time:
            self.timeouts += 1
        return on_time

    def send_strict(self, pub_socket: PubSocket, frame: bytes, flags: int = 0) -> bool:
        """Send through a strict socket, waiting for its slowest reader; False if that one lost the frame."""

        def send() -> bool:
            return pub_socket.try_send(frame, flags)

        if send() or self.await_room(send, self._timeout_s(pub_socket)):
            return True
        self._give_up(pub_socket)
        pub_socket.send_anyway(frame, flags)
        return False

    def _give_up(self, pub_socket: PubSocket) -> None:
        """Wait for the readers of a strict socket no more, until they have found what they lost."""
        self.lagging[pub_socket] = self._fast_send.sequence
        self.route()

    def await_room(self, send: Callable[[], bool], timeout_s: float) -> bool:
        """Try to send until it works, or for so long [s]."""
        if self.back_pressure.wait_for(send, timeout_s):
            return True
        if not self.timeouts:
            self.note("a reliable subscriber was too late and lost a message")
        return False

    # Telling readers how many messages there have been

    def _news(self, sequence: int) -> bytes:
        """A frame that says which sequence comes next, or that none does."""
        return self._next_head + wire.REST.pack(
            sequence, 0, time.monotonic_ns(), 0, wire.LAST if self.closed else 0
        )

    def tell(self) -> None:
        """Tell all that have room which sequence comes next, so that they learn of a loss before it."""
        frame = self._news(self._fast_send.sequence)
        for send in self._lossy_sends:
            send(frame, DONTWAIT)
        for pub_socket in self._strict_sockets:
            pub_socket.try_send(frame)
        self.ring.offer(frame)

    def stop(self, *, may_send: bool) -> None:
        """Take in no reader any more, and end the ring; `finish` follows.

        Args:
            may_send: Whether no message is just being sent.
        """
        self.closed = True
        self._untold = list(self._strict_sockets)
        last = self._news(self._fast_send.sequence)
        self.ring.end(last)
        for send in self._lossy_sends if may_send else ():
            send(last, DONTWAIT)

    def finish(self, waited_s: float, linger_s: float) -> bool:
        """Tell each reader of a socket that the stream ends; called again and again.

        Args:
            waited_s: For how long this has gone on [s].
            linger_s: How long to wait for a reader that may not hold us up for longer [s].

        Returns:
            Whether each has all of it, or has had its time.
        """
        last = self._news(self._fast_send.sequence)
        # Libzmq drops it while a reader lags: it is sent now and then, until that one says that it reads.
        if waited_s >= self._tell_again_s:
            self._tell_again_s = waited_s + TELL_AGAIN_S
            self._untold = [each for each in self._untold if not each.try_send(last) or each in self.lagging]
            # A lossy socket drops it where a queue is full, and does not say so.
            for pub_socket in {r.pub_socket for r in self.readers.values() if self._owes(r)} - {
                *self._strict_sockets
            }:
                pub_socket.send(last, DONTWAIT)
        behind = [r for r in self.readers.values() if r.pub_socket in self._untold or self._owes(r)]
        return not (self._untold or behind) or waited_s >= max([linger_s, *(r.timeout_s for r in behind)])

    def _owes(self, reader: Reader) -> bool:
        """Whether a reader has yet to say that it has everything: a socket may lose what it has taken."""
        return reader.member is None and reader.confirmed <= self._fast_send.sequence

    def give_up(self) -> None:
        """Let readers that had too little time count what they lost."""
        sequence = self._fast_send.sequence
        for pub_socket in self._untold:
            pub_socket.send_anyway(self._news(sequence))
        count = sum(reader.pub_socket.strict and self._owes(reader) for reader in self.readers.values())
        if count:
            self.note(f"{count} reliable subscribers had no time to read everything at the end")

    def note(self, text: str) -> None:
        """Say that something goes wrong."""
        self.pub_sockets.note(f"{self.topic}: {text}")

    def close(self) -> None:
        """Send no more."""
        self.ring.close()
        self.readers.clear()
        self.route()
