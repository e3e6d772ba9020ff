"""Publishing: one topic, one type, any number of subscribers, each with its own policy."""

from __future__ import annotations

import dataclasses
import math
import secrets
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, Generic, TypeVar

import numpy as np

from cortex.back_pressure import BackPressure
from cortex.codec import Codec, coder_of
from cortex.context import Closed, Closing
from cortex.fanout import Fanout
from cortex.fast_send import FastSend, make_fast_send
from cortex.loan import Loan
from cortex.pub_socket import Backoff, PubSockets
from cortex.records import PublisherRecord, PublisherStats
from cortex.stats import PublisherCounters
from cortex.wire import MESSAGE, REST, message_head

monotonic_ns = time.monotonic_ns

T = TypeVar("T")

INLINE_MAX = 16_384
"""Bodies up to this size travel in the frame; measured by `cortex bench threshold`."""
REFRESH_NS = 1_000_000
LINGER_S = 0.5
"""How long `close` waits for whom it owes nothing: lossy readers of sockets."""

MAX_WAIT_S = 1.0
COMMAND_MAX_WAIT_S = 0.1
"""Default of `max_wait_s` for the types of `cortex.messages.commands`: a controller must not stand still."""


def usual_max_wait_s(message_type: type) -> float:
    """Longest time that `publish` waits for reliable subscribers, unless the publisher says otherwise [s]."""
    return COMMAND_MAX_WAIT_S if message_type.__module__ == "cortex.messages.commands" else MAX_WAIT_S


class Publisher(Closing, Generic[T]):
    """Sends messages of one type; made by `Node.publisher`. Every method may be called from any thread."""

    def __init__(
        self,
        topic: str,
        codec: Codec,
        pub_sockets: PubSockets,
        *,
        latch: bool = False,
        inline_max: int = INLINE_MAX,
        expected_bytes: int = 0,
        max_wait_s: float = MAX_WAIT_S,
        on_close: Callable[[Publisher[T]], None] | None = None,
    ) -> None:
        self.topic = topic
        self.codec = codec
        self.source = secrets.randbits(64) or 1
        self.latch = latch
        stamped = codec.stamp_of is not None
        self._type = codec.type
        self._stamp_of = codec.stamp_of
        self._inline_max = inline_max
        self._head = message_head(MESSAGE, self.source, codec.fingerprint, stamped=stamped)
        self._pub_sockets = pub_sockets
        self._lock = pub_sockets.lock
        self._fast_send: FastSend = make_fast_send(
            coder_of(codec, self._head),
            pub_sockets.lock,
            slowly=self._publish_slowly,
            retry=lambda frame, send: self._fanout.retry(frame, send),
            limit=inline_max,
        )
        self._fast_send.prepare, self._fast_send.finish = self._prepare, self._finish
        self._large_lock = threading.Lock()
        self._fast_send.large_acquire = self._large_lock.acquire
        self._fast_send.large_release = self._large_lock.release
        self._back_pressure = BackPressure(pub_sockets, self._fast_send, self._check_open)
        large = expected_bytes if expected_bytes > inline_max else 0
        self._fanout = Fanout(self, max_wait_s=max_wait_s, expected_bytes=large)
        self._on_close = on_close
        self._closing = False
        self._closed = False
        pub_sockets.register(self.source, self._fanout)

    def publish(self, message: T) -> bool:
        """Send a message; what it refers to may be changed or freed afterwards.

        Returns:
            False if a reliable subscriber lost it, because it held up the publisher for too long: the longest
            `timeout_s` of the topic's reliable subscribers for small messages, its own for those in shared
            memory. True otherwise, also if there is no subscriber. A subscriber that was too late once
            holds up no further messages, and loses them, until it has read about half of what waits for it;
            where others read on meanwhile, it may lose what waits for it, too. It counts what it has lost.

        Raises:
            TypeError: The message is of another type.
            ValueError: A field's value does not fit its type.
            Closed: The publisher was closed.
        """
        return self._fast_send(message)

    def _publish_slowly(self, message: T) -> bool:
        with self._lock:
            now_ns = monotonic_ns()
            if now_ns >= self._fast_send.refresh_ns:
                self._prepare(now_ns)
            self._back_pressure.begin()
            if type(message) is not self._type:
                raise TypeError(f"{self.topic} carries {self._type.__name__}, got {type(message).__name__}")
            if not self._fanout.readers and not self.latch:
                if not self._fast_send.sequence:  # who has no subscriber yet hears of a mistake, too
                    self.codec.prepare(message, -1)
                self._fast_send.sequence += 1
                return True
            prepared: Any = self.codec.prepare(message, self._inline_max)
            stamp_ns = 0 if self._stamp_of is None else self._stamp_of(message)
            if isinstance(prepared, bytes):
                return self._publish_inline(prepared, stamp_ns, now_ns)
        return self._publish_large(prepared, stamp_ns, now_ns)

    def _publish_large(self, prepared: Any, stamp_ns: int, now_ns: int) -> bool:
        """Write a large message without the lock, into a slot if there is one, and send it."""
        with self._large_lock:
            with self._lock:
                slot = self._acquire(prepared.size, now_ns, may_wait=True)
                buffer = self._memory(slot, prepared.size)
                waited_s = self._back_pressure.waited_s
            prepared.write(buffer)
            with self._lock:
                return self._send_written(buffer, slot, prepared.size, stamp_ns, now_ns, waited_s)

    def _acquire(self, size: int, now_ns: int, *, may_wait: bool = False) -> Any:
        """A slot for a large message; None if there is none. The lock is held."""
        if self._back_pressure.is_waiting:
            self._prepare(now_ns)
        self._check_open()
        self._back_pressure.begin()
        exact = self.codec.fixed_size is not None
        return self._fanout.ring.acquire(size, exact=exact, may_wait=may_wait)

    def _memory(self, slot: Any, size: int) -> np.ndarray:
        """Where a body is written: a slot, or else memory of its own. The lock is held."""
        return self._fanout.large.acquire(size) if slot is None else np.frombuffer(slot, np.uint8)

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
            RuntimeError: All slots are out on loan. Reliable readers that have not come to them are waited
                for as by `publish`.
        """
        loan = self._acquire_loan(dtypes, dims, may_wait=True)
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
        return self._acquire_loan(dtypes, dims, may_wait=False)

    def _acquire_loan(
        self, dtypes: Mapping[str, Any] | None, dims: Mapping[str, int], *, may_wait: bool
    ) -> Loan | None:
        size = self.codec.drafter.size(dims, dtypes)
        slot = None
        if size <= self._inline_max:
            buffer = np.empty(size, np.uint8)
        else:
            with self._large_lock, self._lock:
                now_ns = monotonic_ns()
                self._prepare(now_ns)
                slot = self._acquire(size, now_ns, may_wait=may_wait)
                if slot is None and self._fanout.ring.has_slots(size):
                    return None
                buffer = self._memory(slot, size)
        self._check_open()
        draft = self.codec.drafter.draft(buffer, dims, dtypes)
        if slot is not None:
            slot.on_forgotten = self._warn_of_forgotten_loan
        return Loan(draft, buffer, slot, self._publish_loan)

    def _warn_of_forgotten_loan(self) -> None:
        if not self._closed:
            text = f"{self.topic}: a loan was forgotten, neither published nor dropped"
            warnings.warn(text, ResourceWarning, stacklevel=2)

    def _publish_loan(self, draft: Any, buffer: np.ndarray, slot: Any, message: Any) -> bool:
        if message is not None:
            in_place = slot is not None and self.codec.drafter.is_by_tail
            sent = self._send_loaned(message, slot) if in_place else None
            if sent is None:
                sent = self.publish(message)
            self.codec.drafter.seal(draft)
            return sent
        size = self.codec.drafter.finish(draft)
        stamp_ns = 0 if self._stamp_of is None else int(draft.stamp_ns)
        with self._large_lock, self._lock:
            now_ns = monotonic_ns()
            self._prepare(now_ns)
            self._back_pressure.begin()
            if size <= self._inline_max:
                return self._publish_inline(buffer[:size].tobytes(), stamp_ns, now_ns)
            if slot is None or not slot.is_current:  # its ring was replaced by one of larger slots
                replaced, slot = slot, self._acquire(size, now_ns, may_wait=True)
                if slot is not None or replaced is not None:  # else it stays where it is
                    written, buffer = buffer, self._memory(slot, size)
                    buffer[:size] = written[:size]
            return self._send_written(buffer, slot, size, stamp_ns, now_ns, self._back_pressure.waited_s)

    def _send_loaned(self, message: Any, slot: Any) -> bool | None:
        """Send a message that lies in a slot, if nothing special is to be done; None if something is."""
        with self._lock:
            now_ns = monotonic_ns()
            if now_ns >= self._fast_send.refresh_ns:
                self._prepare(now_ns)
            return self._fast_send.send_slot(message, slot)

    def _send_written(
        self, buffer: np.ndarray, slot: Any, size: int, stamp_ns: int, now_ns: int, waited_s: float = 0.0
    ) -> bool:
        """Send a large message that lies in a slot, or in memory of its own; both locks are held.

        It was held up for `waited_s` before.
        """
        if self._back_pressure.is_waiting:
            self._prepare(now_ns)
        self._check_open()
        self._back_pressure.waited_s = waited_s
        body = buffer[:size]
        if slot is not None:  # who reads it elsewhere gets a copy
            wanted = self.latch or self._fanout.has_sockets or not slot.is_current
            body = self._memory(None, size)[:size] if wanted else body[:0]
            np.copyto(body, buffer[: len(body)])
        sequence = self._fast_send.sequence
        self._fast_send.sequence += 1
        self._fast_send.bytes += size
        slot = slot if slot is not None and slot.is_current else None
        return self._fanout.send_large(body.data, slot, sequence, stamp_ns, now_ns, size)

    def _publish_inline(self, body: bytes, stamp_ns: int, now_ns: int) -> bool:
        size = len(body)
        self._fast_send.bytes += size
        sequence = self._fast_send.sequence
        self._fast_send.sequence = sequence + 1
        frame = self._head + REST.pack(sequence, stamp_ns, now_ns, size, 0) + body
        if self.latch:
            self._fanout.latched = frame
        return self._fanout.send(frame)

    def _skip(self) -> bool:
        """Count a message that finds no slot: its readers see the gap. The lock is held."""
        self._fast_send.sequence += 1
        self._fanout.skipped += 1
        return False

    def _prepare(self, now_ns: int) -> None:
        """Wait for our turn if another thread is held up; see who has come and gone. The lock is held."""
        while self._back_pressure.is_waiting:
            self._sleep_unlocked()
        self._check_open()
        self._fast_send.refresh_ns = now_ns + REFRESH_NS
        self._pub_sockets.refresh_if_older(now_ns - REFRESH_NS)

    def _sleep_unlocked(self) -> None:
        self._lock.release()
        try:
            time.sleep(100e-6)
        finally:
            self._lock.acquire()

    def _check_open(self) -> None:
        if self._closed:
            raise Closed(f"the publisher of {self.topic} is closed")

    def _finish(self, slot: Any, size: int, stamp_ns: int, now_ns: int) -> bool:
        """Send a slot that the fast path has written, but that needs more care; both locks are held."""
        return self._send_written(np.frombuffer(slot, np.uint8), slot, size, stamp_ns, now_ns)

    def tick(self, now_ns: int) -> None:
        """Free what the sockets have sent, tell readers what there was; called by the node now and then."""
        if self._lock.acquire(blocking=False):
            try:
                if not self._closed:
                    self._fanout.tick(now_ns)
            finally:
                self._lock.release()

    @property
    def counters(self) -> PublisherCounters:
        """What has been published so far."""
        with self._lock:
            fanout = self._fanout
            return PublisherCounters(
                self._fast_send.sequence, self._fast_send.bytes, fanout.timeouts, fanout.skipped
            )

    def record(self) -> PublisherRecord:
        """What others must know to connect to it; for the node."""
        schema = self.codec.schema
        described = schema.name, schema.fingerprint, schema.to_json()
        return PublisherRecord(self.topic, self.source, *described, self.latch)

    def stats(self) -> PublisherStats:
        """What it has counted, as it travels."""
        counters = dataclasses.asdict(self.counters)
        return PublisherStats(self.topic, self.source, self.subscriber_count, **counters)

    @property
    def subscriber_count(self) -> int:
        """Subscribers that are attached now: what follows reaches them, or they count it as lost."""
        with self._lock:
            if not (self._closed or self._pub_sockets.closed):
                self._pub_sockets.refresh()
            return sum(reader.has_answer for reader in self._fanout.readers.values())

    def wait_for_subscribers(self, count: int = 1, timeout_s: float = 5.0) -> bool:
        """Wait until so many subscribers are attached; False if they are not in time."""
        backoff = Backoff(timeout_s)
        while self.subscriber_count < count:
            self._check_open()
            if not backoff.wait():
                return False
        return True

    def disown(self) -> None:
        """Give up without touching the sockets, which belong to the process that this one was forked from."""
        self._lock = threading.Lock()  # the old ones may have been held at the fork
        self._large_lock = threading.Lock()
        self._fast_send = FastSend(self._publish_slowly)
        self._back_pressure.is_waiting = False  # who was held up at the fork is not here
        self._closing = self._closed = True

    def stop_waiting(self) -> None:
        """Hold up nobody any more: a reliable subscriber that has no room loses messages, which is counted.

        Ends a wait of another thread, too; to be called when the end is asked for. It takes no lock.
        """
        self._back_pressure.until_s = 0.0

    def close(self, linger_s: float = LINGER_S) -> None:
        """Tell readers how many messages there were, and leave the topic.

        What `publish` has taken is there for local subscribers to read, however long they take. What goes
        through sockets reaches reliable subscribers that confirm it within their `timeout_s`.

        Args:
            linger_s: How long to wait for other subscribers of sockets [s].
        """
        close_publishers([self], linger_s=linger_s)

    def _claim_close(self) -> bool:
        """Whether the caller is the one to close it."""
        with self._lock:
            claimed, self._closing = not self._closing, True
        return claimed

    def _stop(self, by_s: float) -> None:
        """Publish no more; nobody is waited for after a time of the monotonic clock [s]."""
        with self._lock:
            self._back_pressure.until_s = min(self._back_pressure.until_s, by_s)
            self._closed = True
            self._fast_send.refresh_ns = 0  # so that `publish` looks
            self._fanout.stop(may_send=not (self._pub_sockets.closed or self._back_pressure.is_waiting))

    def _is_finished(self, waited_s: float, linger_s: float) -> bool:
        """Whether nobody is worth waiting for any more; writes what there is room for."""
        with self._lock:
            if self._pub_sockets.closed:
                return True
            self._pub_sockets.refresh()
            return self._fanout.finish(waited_s, linger_s)

    def _end(self) -> None:
        with self._lock:
            if not self._pub_sockets.closed:
                self._fanout.give_up()
            self._fanout.close()
        self._pub_sockets.unregister(self.source)
        if self._on_close is not None:
            self._on_close(self)


def close_publishers(
    publishers: Iterable[Publisher[Any]], *, linger_s: float = LINGER_S, longest_s: float = math.inf
) -> None:
    """Close publishers as `Publisher.close` does, all at the same time.

    Args:
        publishers: Those that are closed already are left alone.
        linger_s: How long to wait for lossy subscribers [s].
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
