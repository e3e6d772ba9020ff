"""Publishing: one topic, one type, any number of subscribers, each with its own policy."""

from __future__ import annotations

import math
import secrets
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
import zmq

from cortex.codec import Codec
from cortex.context import Closed
from cortex.gate import BATCH_BYTES, BATCH_COUNT, BATCH_NS, Gate, LongGate, make_gate
from cortex.large import LargeSender, Reader, Slot, Stamps
from cortex.loan import Loan
from cortex.outlet import DONTWAIT, Backoff, Outlet, Outlets
from cortex.packer import coder_of
from cortex.pipes import Pipes
from cortex.stats import PublisherCounters
from cortex.wire import (
    BATCH,
    LARGE,
    MESSAGE,
    RECORD,
    REST,
    TAIL,
    AttachAnswer,
    AttachKey,
    answer_frame,
    message_head,
    prefix,
)

monotonic_ns = time.monotonic_ns

T = TypeVar("T")

INLINE_MAX = 16_384
"""Bodies up to this size travel in the frame; measured by `cortex bench threshold`."""
REFRESH_NS = 1_000_000
READERS_MAX = 1024
SILENCE_MAX_NS = 30_000_000_000
SILENCE_NS = 100_000_000
"""After so long without a message readers are told how many there have been."""
TELL_AGAIN_S = 0.02
"""A reader that was late when the publisher is closed is told this often how many messages there were."""
LINGER_S = 0.5
"""How long `close` waits for whom it owes nothing: lossy readers, and slots that nobody has given back."""

BURST_NS = 15_000
"""Two messages closer than this are a burst."""


class Publisher(Generic[T]):
    """Sends messages of one type; made by `Node.publisher`. Every method may be called from any thread."""

    def __init__(
        self,
        topic: str,
        codec: Codec,
        outlets: Outlets,
        *,
        latch: bool = False,
        coalesce: bool = False,
        inline_max: int = INLINE_MAX,
        on_batch: Callable[[], None] | None = None,
        on_close: Callable[[Publisher[T]], None] | None = None,
    ) -> None:
        self.topic = topic
        self.codec = codec
        self.source = secrets.randbits(64) or 1
        self.latch = latch
        self._timeouts = 0
        self._skipped = 0
        stamped = codec.stamp_of is not None
        self._type = codec.type
        self._stamp_of = codec.stamp_of
        self._fingerprint = codec.fingerprint
        self._inline_max = inline_max
        self._head = message_head(MESSAGE, self.source, codec.fingerprint, stamped=stamped)
        self._batch_head = message_head(BATCH, self.source, codec.fingerprint, stamped=stamped)
        coder = coder_of(codec, self._head)
        self._pack_record = None if coder is None else coder.record
        self._plain = not latch and not coalesce
        self._gathers = coalesce and not latch
        self._large_kind = prefix(LARGE, self.source, stamped=stamped)
        self._outlets = outlets
        self._lock = outlets.lock
        self._gate: Gate = make_gate(
            coder,
            outlets.lock,
            slowly=self._publish_slowly,
            retry=self._send_again,
            limit=inline_max,
            flush=self._flush,
        )
        """Sends small messages if nothing special is to be done."""
        self._retries: dict[Callable[..., Any], Callable[[bytes], bool]] = {}
        """What to call where one of the gate's `sends` refuses."""
        self._pipes = Pipes(self._await_room)
        self._large_lock = threading.Lock()
        self._large = LargeSender(
            self.source, codec.fingerprint, stamped=stamped, topic=topic, outlets=outlets
        )
        self._readers: dict[bytes, Reader] = {}
        self._lossy_sends: tuple[Callable[..., Any], ...] = ()
        self._strict_outlets: tuple[Outlet, ...] = ()
        self._latched = b""
        self._was_large = False
        self._crowded = False
        self._told = 0
        self._untold: list[Outlet] = []
        self._tell_again_s = 0.0
        self._tell_after_ns = SILENCE_NS
        self._late: dict[Outlet, int] = {}
        """Strict outlets on which a reader was too late, and the sequence from which on it may get messages.

        libzmq sends it nothing until it has caught up."""
        self._blocked = False
        self._batch: list[bytes] = []
        if self._gathers:
            self._gate.records = self._batch
        self._gate.prepare = self._prepare
        self._gate.large_acquire, self._gate.large_release = (
            self._large_lock.acquire,
            self._large_lock.release,
        )
        self._gate.finish = self._finish
        self._batch_sequence = 0
        self._on_batch = on_batch
        self._on_close = on_close
        self._closing = False
        self._closed = False
        outlets.register(self.source, self)

    def publish(self, message: T) -> bool:
        """Send a message; what it refers to may be changed or freed afterwards.

        Returns:
            False if a reliable subscriber lost it, because it held up the publisher for too long: the longest
            `timeout_s` of the topic's reliable subscribers for small messages, its own for those in shared
            memory. True otherwise, also if there is no subscriber. A subscriber that was too late once
            holds up no further messages, and loses them, until it has read about half of what waits for it.

        Raises:
            TypeError: The message is of another type.
            ValueError: A field's value does not fit its type.
            Closed: The publisher was closed.
        """
        return self._gate(message)

    def _publish_slowly(self, message: T) -> bool:
        """Send a message that the gate cannot."""
        self._lock.acquire()
        try:
            now_ns = monotonic_ns()
            if now_ns >= self._gate.refresh_ns:
                self._prepare(now_ns)
            if self._gathers and (self._batch or now_ns - self._gate.last_ns < BURST_NS):
                record = self._pack_record and self._pack_record(message, now_ns, self._inline_max)
                if record is not None:
                    return self._collect(record, now_ns)
            if type(message) is not self._type:
                raise TypeError(f"{self.topic} carries {self._type.__name__}, got {type(message).__name__}")
            if not self._readers and not self.latch:
                self._flush()
                self._gate.sequence += 1
                return True
            if self._was_large:  # the next is most likely large, too
                prepared: Any = self.codec.plan(message)
                if prepared.size <= self._inline_max:
                    prepared = self.codec.prepare(message, self._inline_max)
            else:
                prepared = self.codec.prepare(message, self._inline_max)
            stamp_ns = 0 if self._stamp_of is None else self._stamp_of(message)
            if self._was_large == isinstance(prepared, bytes):
                self._was_large = not self._was_large
                self._route()
            if not self._was_large:
                return self._publish_inline(prepared, stamp_ns, now_ns)
            ours = self._large_lock.acquire(blocking=False)
            slot = self._acquire_slot(prepared.size, spare=True) if ours else None
        finally:
            self._lock.release()
        if not ours:
            self._large_lock.acquire()
            with self._lock:
                slot = self._acquire_slot(prepared.size, spare=True)
        try:
            if slot is None:
                return False
            try:
                prepared.write(slot.buffer)
            except BaseException:
                with self._lock:
                    self._large.abandon(slot)
                raise
            with self._lock:
                return self._publish_slot(slot, prepared.size, stamp_ns, now_ns)
        finally:
            self._large_lock.release()

    @contextmanager
    def loan(self, dtypes: Mapping[str, Any] | None = None, /, **dims: int) -> Iterator[Any]:
        """Write a message where its readers will find it: the way to publish without a copy.

        Args:
            dtypes: The dtype of each array field that is declared as `any`.
            **dims: The size of every named dimension of the type's arrays.

        Yields:
            A draft with the type's fields: arrays are writable views to fill, the others are to be set. It is
            published when the block ends, and dropped if the block raises. Do not keep its arrays.

        Raises:
            RuntimeError: All slots are out on loan.
        """
        loan = self.try_loan(dtypes, **dims)
        if loan is None:
            with self._lock:
                self._skip()
            raise RuntimeError(f"{self.topic}: every slot is out on loan; publish or drop one first")
        try:
            yield loan.draft
        except BaseException:
            loan.drop()
            raise
        loan.publish()

    def try_loan(self, dtypes: Mapping[str, Any] | None = None, /, **dims: int) -> Loan | None:
        """Begin a message as `loan` does, to be published or dropped later, by any thread.

        Args:
            dtypes: The dtype of each array field that is declared as `any`.
            **dims: The size of every named dimension of the type's arrays.

        Returns:
            The message; None if there is no slot for it now.
        """
        size = self.codec.draft_size(dims, dtypes)
        inline = size <= self._inline_max
        slot: Slot | None
        if inline:
            self._check_open()
            slot = Slot(np.empty(size, np.uint8), None, 0)
        else:
            with self._large_lock, self._lock:
                self._prepare(monotonic_ns())
                exact = self.codec.fixed_size is not None
                slot = self._large.acquire(size, self._gate.sequence, exact=exact)
            if slot is None:
                return None
        room = None if slot.ring is None else slot.ring.room(slot.number)
        try:
            draft = self.codec.draft(slot.buffer if room is None else room.view(np.ndarray), dims, dtypes)
        except BaseException:
            self._large.give_back(slot)
            raise
        if room is not None:
            room.on_forgotten = partial(self._recall, slot)
        return Loan(draft, slot, room, inline=inline, publish=self._publish_loan, drop=self._large.give_back)

    def _recall(self, slot: Slot) -> None:
        """Take back the slot of a loan that nobody can publish any more; takes no lock, see `Room`."""
        self._large.give_back(slot)
        if not self._closed:
            text = f"{self.topic}: a loan was forgotten, neither published nor dropped"
            warnings.warn(text, ResourceWarning, stacklevel=2)

    def _publish_loan(self, draft: Any, slot: Slot, inline: bool) -> bool:
        """Send what was written on loan; returns and raises as `Loan.publish`."""
        try:
            size = self.codec.finish(draft)
            stamp_ns = 0 if self._stamp_of is None else int(draft.stamp_ns)
        except BaseException:
            self._large.give_back(slot)
            raise
        if inline:
            with self._lock:
                now_ns = monotonic_ns()
                self._prepare(now_ns)
                return self._publish_inline(slot.buffer[:size].tobytes(), stamp_ns, now_ns)
        with self._large_lock, self._lock:
            now_ns = monotonic_ns()
            try:
                self._prepare(now_ns)
            except BaseException:
                self._large.abandon(slot)
                raise
            renewed = self._large.renew(slot, size, self._gate.sequence)
            if renewed is None:
                self._skip()
                return False
            return self._publish_slot(renewed, size, stamp_ns, now_ns)

    def _publish_inline(self, body: bytes, stamp_ns: int, now_ns: int) -> bool:
        """Send or collect a small message; the lock is held."""
        size = len(body)
        if self._gathers:
            if self._batch or now_ns - self._gate.last_ns < BURST_NS:
                return self._collect(RECORD.pack(stamp_ns, now_ns, size, 0) + body + bytes(-size % 8), now_ns)
            self._gate.last_ns = now_ns
        self._gate.bytes += size
        sequence = self._gate.sequence
        self._gate.sequence = sequence + 1
        frame = self._head + REST.pack(sequence, stamp_ns, now_ns, size, 0) + body
        if self.latch:
            self._latched = frame
        for send in self._lossy_sends:
            send(frame, DONTWAIT)
        return self._send_strict_all(frame)

    def _send_strict_all(self, frame: bytes) -> bool:
        on_time = not self._late
        for outlet in self._strict_outlets:
            try:
                outlet.send(frame, DONTWAIT)
            except zmq.Again:
                on_time &= self._send_strict(outlet, frame, 0)
        on_time &= self._pipes.send(frame)
        if not on_time:
            self._timeouts += 1
        return on_time

    def _send_again(self, frame: bytes, send: Callable[..., Any]) -> bool:
        """Send what the gate could not; the lock is held, and let go while sleeping."""
        retry = self._retries.get(send)  # None: it has left since
        on_time = retry is None or retry(frame)
        if not on_time:
            self._timeouts += 1
        return on_time

    def _send_strict(self, outlet: Outlet, frame: bytes, flags: int) -> bool:
        """Send, waiting for the slowest reliable reader; the lock is held, and let go while sleeping."""

        def send() -> bool:
            return outlet.try_send(frame, flags)

        readers = [r for r in self._readers.values() if r.outlet is outlet and r.pipe is None]
        if send() or self._await_room(send, max((r.timeout_s for r in readers), default=0.0)):
            return True
        self._late[outlet] = self._gate.sequence
        self._route()
        outlet.send_anyway(frame, flags)
        return False

    def _await_room(self, send: Callable[[], bool], timeout_s: float) -> bool:
        """Try to send until it works, or for so long; the lock is held, and let go while sleeping."""
        backoff = Backoff(timeout_s)
        self._block()
        try:
            while not send():
                self._lock.release()
                try:
                    more = backoff.wait()
                finally:
                    self._lock.acquire()
                self._check_open()
                self._outlets.refresh()
                if not more or time.monotonic() >= self._pipes.close_by_s:
                    if not self._timeouts:
                        self._outlets.note(
                            f"{self.topic}: a reliable subscriber was too late and lost a message"
                        )
                    return False
        finally:
            self._blocked = False
        return True

    def _collect(self, record: bytes, now_ns: int) -> bool:
        """Add a message of a burst to the batch, and send that when it is full or old; the lock is held."""
        batch = self._batch
        if not batch:
            self._batch_sequence = self._gate.sequence
            self._gate.batch_start_ns = now_ns
            if self._on_batch is not None:
                self._on_batch()
        self._gate.last_ns = now_ns
        self._gate.sequence += 1
        batch.append(record)
        self._gate.batch_bytes += len(record)
        if (
            len(batch) >= BATCH_COUNT
            or self._gate.batch_bytes >= BATCH_BYTES
            or now_ns - self._gate.batch_start_ns >= BATCH_NS
        ):
            return self._flush()
        return True

    def _flush(self) -> bool:
        """Send the batch; the lock is held."""
        if not self._batch:
            return True
        records = b"".join(self._batch)
        self._gate.bytes += len(records) - RECORD.size * len(self._batch)
        first = self._batch_sequence
        rest = REST.pack(first, 0, self._gate.batch_start_ns, len(records), self._gate.sequence - first)
        self._batch.clear()
        self._gate.batch_bytes = 0
        frame = self._batch_head + rest + records
        for send in self._lossy_sends:
            send(frame, DONTWAIT)
        return self._send_strict_all(frame)

    def flush_old(self, now_ns: int) -> bool:
        """Send a batch that has waited long enough; called by the node's flusher, which holds no lock.

        Returns:
            Whether a batch still waits.
        """
        with self._lock:
            if self._batch and not self._blocked and now_ns - self._gate.batch_start_ns >= BATCH_NS:
                self._flush()
            return bool(self._batch)

    def flush(self) -> bool:
        """Send what a coalescing publisher holds back; False if a reliable subscriber lost some of it."""
        with self._lock:
            return self._flush()

    def _acquire_slot(self, size: int, *, spare: bool = False) -> Slot | None:
        """Find memory for a large message, as `LargeSender.acquire`; both locks are held."""
        exact = self.codec.fixed_size is not None
        slot = self._large.acquire(size, self._gate.sequence, exact=exact, spare=spare)
        if slot is None:
            self._skip()
        return slot

    def _skip(self) -> None:
        """Count a message that finds no slot: its readers see the gap. The lock is held."""
        self._flush()
        self._gate.sequence += 1
        self._skipped += 1

    def _publish_slot(self, slot: Slot, size: int, stamp_ns: int, now_ns: int) -> bool:
        """Send what was written into a slot; both locks are held."""
        try:
            mask, passed_over, on_time = self._await_readers(slot, now_ns)
        except BaseException:  # of a signal, say, while it waits
            self._large.abandon(slot)
            raise
        stamps = Stamps(self._gate.sequence, stamp_ns, now_ns)
        self._gate.sequence += 1
        self._gate.bytes += size
        if self.latch:
            head = self._large_kind + TAIL.pack(self._fingerprint, *stamps, size, 0)
            self._latched = head + slot.buffer[:size].tobytes()
        sent, inline_passed_over = self._large.send(
            slot, size, mask, stamps, self._send_strict, self._pipes.send
        )
        self._skipped += passed_over or inline_passed_over
        on_time &= sent and not self._late
        self._timeouts += not on_time
        self._arm()
        return on_time

    def _await_readers(self, slot: Slot, now_ns: int) -> tuple[int, bool, bool]:
        """Wait until reliable readers have room for one more slot; both locks are held.

        Returns:
            The columns that get a lease, whether some reader is passed over, whether all had room in time.
        """
        if self._blocked:
            self._prepare(now_ns)
        if self._batch:
            self._flush()
        on_time = not self._late
        mask, full, passed_over = self._large.grant(slot.ring)
        if full:
            self._block()
            try:
                on_time &= self._large.await_strict(slot.ring)
            finally:
                self._blocked = False
            mask, _, passed_over = self._large.grant(slot.ring)
        if self._closed:
            self._check_open()
        return mask, passed_over, on_time and not self._large.is_leaving_out

    def _block(self) -> None:
        """Make other threads wait until this message is sent; the lock is held."""
        self._blocked = True
        self._gate.refresh_ns = 0  # they look at this

    def _prepare(self, now_ns: int) -> None:
        """Wait for our turn if another thread is held up; see who has come and gone. The lock is held."""
        while self._blocked:
            self._sleep_unlocked()
        self._check_open()
        self._gate.refresh_ns = now_ns + REFRESH_NS
        self._outlets.refresh_if_older(now_ns - REFRESH_NS)

    def _sleep_unlocked(self) -> None:
        self._lock.release()
        try:
            time.sleep(100e-6)
        finally:
            self._lock.acquire()

    def _check_open(self) -> None:
        if self._closed:
            raise Closed(f"the publisher of {self.topic} is closed")

    def attach(self, outlet: Outlet, key: bytes, request: AttachKey) -> None:
        """Take a reader in; called under the outlets' lock."""
        if key in self._readers or self._closed:
            return
        if len(self._readers) >= READERS_MAX:
            if not self._crowded:
                self._outlets.note(f"{self.topic}: has {READERS_MAX} subscribers, further ones are refused")
            self._crowded = True
            return
        reader = self._large.admit(key, request, outlet)
        self._readers[key] = reader
        sequence = self._batch_sequence if self._batch else self._gate.sequence
        if reader.pipe is not None:
            # This tells the reader that all else comes there.
            reader.pipe.offer(self._batch_head + REST.pack(sequence, 0, monotonic_ns(), 0, 0))
            self._pipes.admit(reader)
            if not self._blocked:
                self._pipes.settle()
        self._route()
        answer = self._large.answer(reader, sequence, self._latched)
        if outlet.strict:
            if not outlet.try_send(answer):
                outlet.send_anyway(answer)
        else:
            outlet.send(answer, DONTWAIT)

    def detach(self, outlet: Outlet, request: AttachKey) -> None:
        """Let a reader go; called under the outlets' lock."""
        for key, reader in self._readers.items():
            if reader.request.reader == request.reader and reader.outlet is outlet:
                del self._readers[key]
                self._large.dismiss(reader)
                self._pipes.dismiss(reader)
                self._late.pop(outlet, None)
                self._route()
                return

    def resume(self, outlet: Outlet, sequence: int) -> None:
        """A reader that was too late has caught up to a sequence; called under the outlets' lock."""
        if sequence >= self._late.get(outlet, 0):  # else it was too late once more since
            self._late.pop(outlet, None)
            self._route()

    def _route(self) -> None:
        """Work out where messages go, when readers or what is sent have changed."""
        readers = self._readers.values()
        outlets = {reader.outlet for reader in readers if reader.pipe is None}
        sends: list[Callable[..., Any]] = [outlet.send for outlet in outlets if not outlet.strict]
        self._lossy_sends = tuple(sends)
        self._strict_outlets = tuple(outlet for outlet in outlets if outlet.strict)
        usual = self._plain and not self._late
        retries = {outlet.send: self._retry_strict(outlet) for outlet in self._strict_outlets}
        self._retries = retries | self._pipes.strict
        self._gate.sends = (*self._lossy_sends, *self._pipes.lossy, *self._retries) if usual else ()
        self._arm()

    def _retry_strict(self, outlet: Outlet) -> Callable[[bytes], bool]:
        return lambda frame: self._send_strict(outlet, frame, 0)

    def _arm(self) -> None:
        """Let the gate send large messages, or not: when readers, the ring, or who is late has changed."""
        self._gate.ledger = self._large.short_cut if self._plain and not self._late else None

    def _finish(self, number: int, size: int, stamp_ns: int, now_ns: int) -> bool:
        """Send a slot that the gate has written, but that needs more care; both locks are held."""
        self._check_open()
        return self._publish_slot(self._large.slot_of(number), size, stamp_ns, now_ns)

    def tick(self, now_ns: int) -> None:
        """Free what the sockets have sent, end a burst; called by the node now and then."""
        if self._lock.acquire(blocking=False):
            try:
                if not self._closed:
                    self._large.prune()
                    self._pipes.flush()
                    if not self._blocked and self._pipes.settle():
                        self._route()
                    if self._told != self._gate.sequence:
                        self._told, self._tell_after_ns = self._gate.sequence, SILENCE_NS
                    if self._readers and now_ns - self._gate.refresh_ns > self._tell_after_ns:
                        self._tell_sequence(now_ns)
            finally:
                self._lock.release()

    def _tell_sequence(self, now_ns: int) -> None:
        """Send a batch of nothing, so that readers learn of a loss at the end of a burst; the lock is held.

        It is sent again after ever longer times: where the queue is full, it gets lost like what it tells of.
        """
        if self._batch or self._blocked:
            return
        frame = self._batch_head + REST.pack(self._gate.sequence, 0, now_ns, 0, 0)
        for send in self._lossy_sends:
            send(frame, DONTWAIT)
        for outlet in self._strict_outlets:
            outlet.try_send(frame)
        self._pipes.offer(frame)
        self._tell_after_ns = min(2 * self._tell_after_ns, now_ns - self._gate.refresh_ns + SILENCE_MAX_NS)

    @property
    def counters(self) -> PublisherCounters:
        """What has been published so far."""
        with self._lock:
            return PublisherCounters(self._gate.sequence, self._gate.bytes, self._timeouts, self._skipped)

    @property
    def subscriber_count(self) -> int:
        """Subscribers that are attached now."""
        with self._lock:
            if not self._outlets.closed:
                self._outlets.refresh()
            return len(self._readers)

    def wait_for_subscribers(self, count: int = 1, timeout_s: float = 5.0) -> bool:
        """Wait until so many subscribers are attached; False if they are not in time."""
        deadline_s = time.monotonic() + timeout_s
        while self.subscriber_count < count:
            self._check_open()
            if time.monotonic() >= deadline_s:
                return False
            time.sleep(0.5e-3)
        return True

    def disown(self) -> None:
        """Give up without touching the sockets, which belong to the process that this one was forked from."""
        self._lock = threading.Lock()  # the old one may have been held at the fork
        self._gate = LongGate(self._publish_slowly)
        self._blocked = False  # who was held up at the fork is not here
        self._closing = self._closed = True

    def stop_waiting(self) -> None:
        """Hold up nobody any more: a reliable subscriber that has no room loses messages, which is counted.

        Ends a wait of another thread, too; to be called when the end is asked for. It takes no lock.
        """
        self._pipes.close_by_s = self._large.wait_until_s = 0.0

    def close(self, linger_s: float = LINGER_S) -> None:
        """Send what is held back, tell readers how many messages there were, and leave the topic.

        What `publish` has taken reaches every local reliable subscriber that makes room for it within its
        `timeout_s`, counted from here. The others, and what goes through sockets, have `linger_s`.

        Args:
            linger_s: How long to wait for lossy subscribers, and for large messages that are on their way to
                be taken in [s].
        """
        close_publishers([self], linger_s=linger_s)

    def _claim_close(self) -> bool:
        """Whether the caller is the one to close it."""
        with self._lock:
            claimed, self._closing = not self._closing, True
        return claimed

    def _stop(self, by_s: float) -> None:
        """Send what is held back, until a time of the monotonic clock [s]; publish no more."""
        with self._lock:
            self._pipes.close_by_s = min(self._pipes.close_by_s, by_s)
            try:
                while self._batch and self._blocked and time.monotonic() < by_s:
                    self._sleep_unlocked()
                if not self._outlets.closed and not self._blocked:
                    self._flush()
                    self._tell_sequence(monotonic_ns())
            finally:
                self._untold = list(self._strict_outlets)
                self._closed = True
                self._gate.refresh_ns = 0  # so that `publish` looks

    def _is_finished(self, waited_s: float, linger_s: float) -> bool:
        """Whether nobody is worth waiting for any more; writes what there is room for."""
        with self._lock:
            if self._outlets.closed:
                return True
            self._outlets.refresh()
            last = self._batch_head + REST.pack(self._gate.sequence, 0, monotonic_ns(), 0, 0)
            written = self._pipes.finish(last, waited_s, linger_s)
            told = self._tell_outlets(last, waited_s, linger_s)
            return written and told and (waited_s >= linger_s or self._large.taken_in)

    def _tell_outlets(self, last: bytes, waited_s: float, linger_s: float) -> bool:
        """Send a last frame through strict outlets until all have it; whether each has had its time.

        While a reader is late, libzmq drops it: it is sent now and then, until the reader says that it reads.
        """
        if waited_s >= self._tell_again_s:
            self._tell_again_s = waited_s + TELL_AGAIN_S
            self._untold = [each for each in self._untold if not each.try_send(last) or each in self._late]
        timeouts_s = [r.timeout_s for r in self._readers.values() if r.outlet in self._untold]
        return not self._untold or waited_s >= max([linger_s, *timeouts_s])

    def _tell_who_lost(self) -> None:
        """Let readers that had too little time count what they lost; the lock is held."""
        last = self._batch_head + REST.pack(self._gate.sequence, 0, monotonic_ns(), 0, 0)
        for outlet in self._untold:
            outlet.send_anyway(last)
        unfinished = self._pipes.unfinished()
        for reader in unfinished:  # their pipes are full, their sockets are not
            answer = AttachAnswer(self._gate.sequence, reader.column, (), b"")
            reader.outlet.try_send(answer_frame(reader.key, answer))
        count = sum(reader.request.strict for reader in unfinished)
        if count:
            self._outlets.note(
                f"{self.topic}: {count} reliable subscribers had no time to read everything at the end"
            )

    def _end(self) -> None:
        """Let go of everything."""
        with self._lock:
            if not self._outlets.closed:
                self._tell_who_lost()
            self._pipes.close()
            self._readers.clear()
            self._route()
            self._large.close()
        self._outlets.unregister(self.source)
        if self._on_close is not None:
            self._on_close(self)

    def __enter__(self) -> Publisher[T]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def close_publishers(
    publishers: Iterable[Publisher[Any]], *, linger_s: float = LINGER_S, longest_s: float = math.inf
) -> None:
    """Close publishers as `Publisher.close` does, all at the same time.

    Args:
        publishers: Those that are closed already are left alone.
        linger_s: How long to wait for lossy subscribers and for large messages [s].
        longest_s: How long to wait in all, for reliable subscribers, too [s].
    """
    begin_s = time.monotonic()
    backoff = Backoff(longest_s)
    with ExitStack() as ends:  # whatever happens: a publisher is gone after this
        closing = [publisher for publisher in publishers if publisher._claim_close()]
        for publisher in closing:
            ends.callback(publisher._end)
        for publisher in closing:
            publisher._stop(begin_s + longest_s)
        stopped_s = time.monotonic()
        while closing:
            waited_s = time.monotonic() - stopped_s
            closing = [each for each in closing if not each._is_finished(waited_s, linger_s)]
            if closing and not backoff.wait():
                break
