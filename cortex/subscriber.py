"""Subscribing: a bounded queue per subscriber, read by a callback, a blocking iterator or asyncio.

The three share one path, which reads the socket where the message is wanted; there is no thread between
socket and user. A callback runs on the node's callback thread, `async for` on the running loop, whose other
tasks get a turn after a millisecond. `cortex bench receive` prints what each costs.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import selectors
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, Generic, TypeVar

import numpy as np

from cortex.codec import Codec, MalformedMessage
from cortex.context import Closed, Closing
from cortex.fast_receive import NOTHING
from cortex.intake import DRAIN_MAX, Intake
from cortex.link import BLOCK_MS, Info, Item, Link
from cortex.loop_reader import WAIT_MAX_S, AsyncReceiver
from cortex.policy import Policy
from cortex.receive_lock import ReceiveLock
from cortex.records import SubscriberRecord, SubscriberStats
from cortex.schema import Schema, TypeMismatch
from cortex.stats import SubscriberCounters
from cortex.wakeup import Wakeup

logger = logging.getLogger(__name__)
monotonic_ns = time.monotonic_ns

T = TypeVar("T")
R = TypeVar("R")

FRESH_NS = 1_000_000
"""A queue that was filled longer ago is topped up before the next message is taken."""
TOP_UP_NS = 20_000_000
"""A subscriber that nobody has read for so long is read by the node's control thread."""
LOOK_EVERY = 64
"""After a look in vain, every so many calls of `look_out` one looks again."""
BLOCK_S = BLOCK_MS * 1e-3
LEAVING_NS = 2_000_000_000
"""How long the connection to a publisher that has left is kept, for what is still in flight."""


class Subscriber(Closing, Generic[T]):
    """Receives the messages of a topic; made by `Node.subscriber`. Methods may be called from any thread."""

    def __init__(
        self,
        topic: str,
        codec: Codec | None,
        policy: Policy,
        *,
        callback: Callable[[T], object] | None = None,
        on_close: Callable[[Subscriber[T]], None] | None = None,
    ) -> None:
        self.topic = topic
        self.codec = codec
        self.policy = policy
        self.callback = callback
        self.counters = SubscriberCounters()
        self._receive_lock = ReceiveLock()
        self._lock = self._receive_lock.lock
        self.wakeup = Wakeup()
        self._selector = selectors.DefaultSelector()
        """Waits for `wakeup` and all sockets; changed under the lock.

        It ends with us: somebody may still watch `fd` when we are closed."""
        self._selector.register(self.wakeup.fd, selectors.EVENT_READ)
        self._problems: deque[Exception] = deque()
        self._intake = Intake(policy, self.counters, self._receive_lock)
        self._links, self._queue = self._intake.links, self._intake.queue
        self._fast_receive = self._intake.fast_receive
        self._leaving = self._intake.leaving
        self._on_close = on_close
        self._closed = False
        self._async_receiver: AsyncReceiver[T] | None = None
        self._raised = 0
        self.refused: set[int] = set()
        """Publishers that this subscriber cannot be connected to; kept by the node."""
        self._looks_left_out = 0
        self._mismatch: TypeMismatch | None = None

    def recv(self, timeout_s: float | None = None) -> T:
        """Take the next message.

        A signal handler that interrupts it may set a flag or raise, but not use the subscriber.

        Args:
            timeout_s: Longest wait [s]; None waits for ever.

        Raises:
            TimeoutError: None came in time.
            TypeMismatch: A publisher of this topic sends another type; raised once for each, and in place of
                TimeoutError while there is no publisher of the right type.
            Closed: The subscriber was closed.
        """
        message: T = self._fast_receive(timeout_s is None or timeout_s >= BLOCK_S)
        if message is NOTHING:
            message = self._receive(timeout_s, self._decode)
        return message

    def look_out(self, spin_s: float) -> bool:
        """Wait for a message without sleeping, for a while; then take it with one of the others.

        For an answer that is about to come. To be woken takes 20 to 50 us, and on a virtual machine a thread
        that is woken often has to share the core of who woke it. Whoever waits for this core gets it between
        two looks. After a look in vain the next 63 calls do nothing.

        Args:
            spin_s: How long to look [s].

        Returns:
            Whether something may have come.
        """
        self._looks_left_out -= 1
        if self._looks_left_out > 0:
            return False
        with self._receive_lock:
            if not (self._closed or self._queue or self._fast_receive.exhausted):
                self._intake.receive_one()  # descriptors show what comes after a look in vain
            if self._closed or self._queue:
                return True
        until_ns = monotonic_ns() + round(spin_s * 1e9)
        while not (found := self._selector.select(0)) and monotonic_ns() < until_ns:
            os.sched_yield()
        self.wakeup.clear()
        self._looks_left_out = 0 if found else LOOK_EVERY
        return bool(found)

    def recv_with_info(self, timeout_s: float | None = None) -> tuple[T, Info]:
        """Take the next message, and what is known of it; see `recv`."""
        return self._receive(timeout_s, lambda item: (self._decode(item), item.link.info(item)))

    def recv_raw(self, timeout_s: float | None = None) -> tuple[Info, bytes | np.ndarray, Schema]:
        """Take the next message as the bytes of its body, with its structure; see `recv`."""

        def raw(item: Item) -> tuple[Info, bytes | np.ndarray, Schema]:
            body = item.buffer[item.offset : item.offset + item.size]
            return item.link.info(item), body, item.link.codec.schema

        return self._receive(timeout_s, raw)

    def __iter__(self) -> Iterator[T]:
        """Messages as they come, until the subscriber is closed. An error ends it not: iterate again."""
        return self

    def __next__(self) -> T:
        """Take the next message, as `recv` without a timeout."""
        try:
            return self.recv()
        except Closed:
            raise StopIteration from None

    def __aiter__(self) -> AsyncIterator[T]:
        """Messages as they come, on the running loop, until the subscriber is closed."""
        return self._receiver_of_loops()

    async def recv_async(self, timeout_s: float | None = None) -> T:
        """Take the next message without blocking the running loop; see `recv`.

        A message that is there is returned without a switch of tasks, for up to a millisecond or 1024
        messages; then other tasks get a turn. A task that is cancelled while it waits has taken no message.
        """
        try:
            return await self._receiver_of_loops().receive(timeout_s)
        except TimeoutError:
            error = self._nothing_came(timeout_s)
        raise error

    def _receiver_of_loops(self) -> AsyncReceiver[T]:
        """What serves asyncio, made when wanted: it refers back to us, which delays our end."""
        if self._async_receiver is None:
            self._async_receiver = AsyncReceiver(self)
        return self._async_receiver

    def _take_now(self) -> Any:
        """Take the next message if it is there; `NOTHING` if not, or if it could not be read."""
        message = self._fast_receive(False)
        if message is NOTHING and (self._queue or not self._fast_receive.is_open):
            item = self._take()
            if item is not None:
                message = self._open(item, self._decode)
        return message

    def _nothing_came(self, timeout_s: float | None) -> TimeoutError:
        """What to raise when no message came in time: if all publishers have another type, that is why."""
        text = f"{self.topic}: no message within {timeout_s} s"
        if self._mismatch is not None and self.refused and not self._links:
            error = TimeoutError(f"{text}, because of its type. {self._mismatch}")
            error.__cause__ = self._mismatch
            return error
        others = f" ({len(self.refused)} publisher(s) of another type)" if self.refused else ""
        return TimeoutError(text + others)

    def _receive(self, timeout_s: float | None, use: Callable[[Item], R]) -> R:
        if self.callback is not None:
            raise RuntimeError(f"{self.topic}: the messages of this subscriber go to its callback")
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        left_s = WAIT_MAX_S if timeout_s is None else timeout_s
        while True:
            item = self._take(block=left_s >= BLOCK_S)
            if item is not None:
                result: R = self._open(item, use)
                if result is not NOTHING:
                    return result
            if deadline_s is not None:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0:
                    raise self._nothing_came(timeout_s)
            if item is None:  # else what came could not be read: look for the next
                self._wait(min(left_s, WAIT_MAX_S))
                if deadline_s is not None:
                    left_s = deadline_s - time.monotonic()

    def _take(self, *, block: bool = False) -> Item | None:
        """The next item if there is one; with `block` and one socket it is waited for up to `BLOCK_S`."""
        with self._lock:
            queue = self._queue
            if self._closed:
                raise Closed(f"the subscriber of {self.topic} is closed")
            if self._problems:
                problem = self._problems.popleft()
                self._open_fast_receive()
                raise problem
            if not self.policy.reliable:
                is_old = monotonic_ns() - self._intake.drained_ns > FRESH_NS
                if not queue or self.policy.depth < DRAIN_MAX or is_old:
                    self._intake.drain()
            if not queue:
                self._intake.receive_one(block=block)
            if not queue:
                return None
            item = queue.popleft()
            self.counters.received += 1
            return item

    def _open(self, item: Item, use: Callable[[Item], Any]) -> Any:
        """Apply `use`; a message that cannot be read is counted and `NOTHING` returned."""
        try:
            return use(item)
        except MalformedMessage as error:
            with self._receive_lock:
                self.counters.received -= 1
                item.link.reject(str(error))
        return NOTHING

    def _decode(self, item: Item) -> T:
        message: T = item.link.codec.decode(item.buffer, item.offset, item.size)
        return message

    def _wait(self, timeout_s: float) -> None:
        """Sleep until a socket may have something, or `wakeup` is called."""
        with self._receive_lock:
            if self._closed or not self._fast_receive.exhausted:
                return
        self._selector.select(timeout_s)
        self.wakeup.clear()

    def dispatch(self, *, block: bool = False) -> bool:
        """Hand what has arrived to the callback; for the callback thread.

        Args:
            block: Wait up to `BLOCK_S` for a message if there is one socket only.

        Returns:
            Whether there may be more; after blocking, whether anything came.
        """
        callback = self.callback
        assert callback is not None
        messages: deque[T] = deque()
        items: deque[Item] = deque()
        with self._lock:
            if self._closed:
                return False
            problems: deque[Exception] = deque()
            if self._problems:
                problems, self._problems = self._problems, problems
            received = self._intake.take_all(messages, items, block=block)
            more = not self._fast_receive.exhausted or (block and received > 0)
        for problem in problems:
            logger.error("%s", problem)
        while messages and not self._closed:  # each gives back its slot as soon as its callback is done
            try:
                callback(messages.popleft())
            except Exception:
                self._log_raised()
        while items and not self._closed:
            message = self._open(items.popleft(), self._decode)
            if message is not NOTHING:
                try:
                    callback(message)
                except Exception:
                    self._log_raised()
        return more

    def _log_raised(self) -> None:
        """Log what a callback raised: the first ten times, then the 20th, 40th, 80th, and so on."""
        self._raised += 1
        count = self._raised
        if count <= 10 or (count % 10 == 0 and (count // 10) & (count // 10 - 1) == 0):
            logger.exception("%s: the callback raised (time %d)", self.topic, count)

    @property
    def has_one_socket(self) -> bool:
        """Whether `dispatch` can block."""
        return len(self._links) == 1

    @property
    def must_read(self) -> bool:
        """Whether the last look left something in a socket, which its descriptor may not show."""
        return not self._fast_receive.exhausted and (
            not self.policy.reliable or len(self._queue) < self.policy.depth
        )

    @property
    def fd(self) -> int:
        """A descriptor that is readable when a message may have come, and while `wakeup` is set."""
        return self._selector.fileno()

    @property
    def has_input(self) -> bool:
        """Whether that descriptor is readable."""
        return bool(self._selector.select(0))

    def top_up(self, now_ns: int) -> None:
        """Read the sockets of a subscriber that nobody reads at the moment; for the node's control thread.

        So the queue keeps the last messages, not the first that filled the sockets.
        """
        read_ns = max(self._intake.drained_ns, self._fast_receive.taken_ns)
        if now_ns - read_ns > TOP_UP_NS and self._lock.acquire(blocking=False):
            try:
                if not self._closed:
                    self._intake.drain()
                    arrived = bool(self._queue)
            finally:
                self._lock.release()
            if not self._closed and arrived:
                self.wakeup.set()

    def record(self) -> SubscriberRecord:
        """What the others are told of it; for the node."""
        name, fingerprint = (
            ("", 0) if self.codec is None else (self.codec.schema.name, self.codec.fingerprint)
        )
        return SubscriberRecord(self.topic, name, fingerprint, str(self.policy))

    def stats(self) -> SubscriberStats:
        """What it has counted, as it travels."""
        counters = dataclasses.asdict(self.counters)
        latency = np.array(counters.pop("latency"), np.uint64)
        return SubscriberStats(self.topic, str(self.policy), latency_counts=latency, **counters)

    def wait_for_publisher(self, timeout_s: float = 5.0) -> bool:
        """Wait until a publisher has taken this subscriber in; False if none has in time."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            with self._receive_lock:
                if self._closed:
                    raise Closed(f"the subscriber of {self.topic} is closed")
                if len(self._queue) < self.policy.depth:
                    self._intake.drain()
                attached = any(link.attached for link in self._links)
                if self._queue:
                    self.wakeup.set()  # whoever sleeps on the descriptors would not notice
            if attached or time.monotonic() >= deadline_s:
                return attached
            time.sleep(0.5e-3)

    @property
    def publisher_count(self) -> int:
        """Publishers that have taken this subscriber in."""
        with self._receive_lock:
            return sum(link.attached for link in self._links if link not in self._leaving)

    @property
    def carriers(self) -> list[str]:
        """How the messages of each publisher come, such as "ipc, shared memory" or "tcp"."""
        with self._receive_lock:
            return [link.carrier for link in self._links if link.attached]

    def connect(self, link: Link) -> None:
        """Add a publisher; for the node."""
        with self._receive_lock:
            if self._closed:
                link.close()
                return
            self._links.append(link)
            for fd in link.fds:
                self._selector.register(fd, selectors.EVENT_READ)
            self._fast_receive.exhausted = False  # its descriptor shows nothing until it was found empty
            self._links_changed()

    def sources(self) -> dict[int, int]:
        """The publishers that are connected and have not left, and the sequence that comes next of each."""
        with self._receive_lock:
            return {link.source: link.expected for link in self._links if link not in self._leaving}

    def keep(self, source: int, clock_offset_ns: int) -> bool:
        """Keep the connection to a publisher that is there, or back; False if there is none. For the node.

        Args:
            source: The publisher's number.
            clock_offset_ns: What to add to its clock to read it on ours [ns].
        """
        with self._receive_lock:
            found = [link for link in self._links if link.source == source]
            for link in found:
                self._leaving.pop(link, None)
                if link.clock_offset_ns != clock_offset_ns:
                    link.clock_offset_ns = clock_offset_ns
                    self._open_fast_receive()
            return bool(found)

    def forget(self, source: int) -> None:
        """A publisher has left: read what is still in flight, then disconnect; for the node.

        A reliable subscriber disconnects once it has read all of it, however long its user takes.
        """
        with self._receive_lock:
            if self._intake.leave(source, monotonic_ns() + LEAVING_NS):
                self.wakeup.set()

    def complain(self, problem: TypeMismatch) -> None:
        """A publisher cannot be connected; the user hears of it at the next `recv`."""
        with self._receive_lock:
            self.counters.rejected += 1
            self._problems.append(problem)
            self._mismatch = problem
            self._open_fast_receive()
        self.wakeup.set()

    def _open_fast_receive(self) -> None:
        """Let the fast path read the only publisher, if there is nothing else to mind; the lock is held."""
        links = self._links if self.policy.reliable and self.callback is None and not self._closed else ()
        if len(links) == 1 and not self._problems:
            self._fast_receive.open(links[0], links[0].coder)
        else:
            self._fast_receive.open(None, None)

    def _links_changed(self) -> None:
        self._open_fast_receive()
        self.wakeup.set()

    def _part(self, link: Link) -> None:
        for fd in link.fds:  # before it is closed: its number may be given out again
            self._selector.unregister(fd)
        link.close()

    def dismiss(self, now_ns: int) -> None:
        """Close the connections to publishers that have left long enough ago; for the node."""
        if self._leaving and self._lock.acquire(blocking=False):
            try:
                ended = [] if self._closed else self._intake.end_overdue(now_ns)
                for link in ended:
                    self._part(link)
                if ended:
                    self._links_changed()
                if self._queue:
                    self.wakeup.set()
            finally:
                self._lock.release()

    def disown(self) -> None:
        """Give up without touching the sockets, which belong to the process that this one was forked from."""
        self._receive_lock = ReceiveLock()  # the old one may have been held at the fork
        self._lock = self._receive_lock.lock
        self._closed = True
        self._fast_receive.open(None, None)

    def close(self) -> None:
        """Stop receiving. Messages that the user still holds stay valid."""
        with self._receive_lock:
            if self._closed:
                return
            self._closed = True
            self._fast_receive.open(None, None)
            self._queue.clear()
            for link in self._links:
                self._part(link)
            self._links.clear()
            self._leaving.clear()
        if self._async_receiver is not None:
            self._async_receiver.stop()
        self.wakeup.set()
        if self._on_close is not None:
            self._on_close(self)
