"""The bounded queue of a subscriber: messages read from its sockets, until they are asked for."""

from __future__ import annotations

import time
from collections import deque
from functools import partial
from typing import Any

import zmq

from cortex.codec import MalformedMessage
from cortex.fast_receive import make_fast_receive
from cortex.link import Item, Link, make
from cortex.policy import Policy
from cortex.pub_socket import DONTWAIT
from cortex.receive_lock import ReceiveLock
from cortex.stats import SubscriberCounters, note_latency
from cortex.wire import HEAD_SIZE, HEADER_SIZE, REST

monotonic_ns = time.monotonic_ns
unpack_rest = REST.unpack_from

DRAIN_MAX = 64
"""Frames that are read at a time, so that one subscriber does not keep a thread for itself."""
DRAIN_LOSSY_MAX = 4096
"""Where only the last messages count, all that has arrived is read: more than a socket holds."""


class Intake:
    """Reads the sockets of one subscriber. Every method runs under its lock."""

    def __init__(self, policy: Policy, counters: SubscriberCounters, receive_lock: ReceiveLock) -> None:
        self.links: list[Link] = []
        """To all publishers; always this list."""
        self.queue: deque[Item] = deque()
        """What has been read and not been asked for; always this one."""
        self.fast_receive = make_fast_receive(
            receive_lock, self.queue, counters, partial(self.accept, timed=True)
        )
        """The short way past all this."""
        self.drained_ns = 0
        """When the sockets were last read as a whole."""
        self.leaving: dict[Link, int] = {}
        """Links of publishers that have left, and when they are closed, on the monotonic clock."""
        self._policy = policy
        self._counters = counters
        self._receive_lock = receive_lock
        self._first = 0

    def receive_one(self, *, block: bool = False) -> None:
        """Read one frame into the queue.

        Finding a socket empty costs more than reading a message: that is done after one is handed out.
        Waiting in the socket itself costs half of what waiting for its descriptor does.
        """
        links = self.links
        flags = 0 if block and len(links) == 1 and not self._receive_lock.waiting else DONTWAIT
        self.fast_receive.exhausted = True
        for link in links if len(links) == 1 else self._rotated():
            try:
                frame = link.receive(flags)
            except zmq.Again:
                continue
            self.fast_receive.exhausted = False
            self.accept(link, frame, timed=True)
            if self.queue:
                return

    def drain(self) -> list[Link]:
        """Read what has arrived into the queue.

        Where only the last messages count, that ends with the first message that was published meanwhile: a
        publisher that is faster than we are would keep us here.

        Returns:
            The links that were not found empty.
        """
        unread: list[Link] = []
        begin_ns = monotonic_ns()
        links, queue, reliable = self._rotated(), self.queue, self._policy.reliable
        for index, link in enumerate(links):
            receive = link.receive
            budget = DRAIN_LOSSY_MAX
            if reliable:
                budget = -(-(self._policy.depth - len(queue)) // (len(links) - index))
            for count in range(budget):
                try:
                    frame = receive(DONTWAIT)
                except zmq.Again:
                    if reliable or not link.is_crowded:
                        break
                    self._make_room(link)
                    continue
                self.accept(link, frame, timed=count & 7 == 0)
                receive = link.receive  # what came may have told it to read elsewhere
                overtaken = not reliable and queue and queue[-1].publish_ns + link.clock_offset_ns > begin_ns
                if overtaken:
                    unread.append(link)
                    break
            else:
                unread.append(link)
        self.fast_receive.exhausted = not unread
        self.drained_ns = monotonic_ns()
        return unread

    def _make_room(self, link: Link) -> None:
        """Let the oldest message give way to a large one, or that one, if the user keeps all the memory."""
        if self.queue:
            self.queue.popleft()
            self._counters.overtaken += 1
        else:
            link.pass_over()

    def drain_decoded(self, messages: deque[Any], *, may_wait: bool) -> None:
        """As `drain`, for an empty queue that cannot overflow: messages are decoded on the spot.

        This is where a stream spends its time. A message that cannot be decoded here goes to the queue, and
        what follows it waits in the socket, so that the order is kept.

        Args:
            messages: Where they are appended.
            may_wait: Wait up to `BLOCK_S` for the first if there is one socket only.
        """
        links = self._rotated()
        if any(link.coder is None for link in links):
            if may_wait:
                self.receive_one(block=True)
            self.drain()
            return
        may_wait = may_wait and len(links) == 1 and not self._receive_lock.waiting
        exhausted = True
        self.drained_ns = monotonic_ns()
        for link in links:
            left = min(self._policy.depth, DRAIN_MAX) - len(messages)
            while left > 0 and not self.queue:
                before = len(messages)
                frame = self.fast_receive.drain(link, messages, left, may_wait)
                may_wait = False
                left -= len(messages) - before
                if frame is None:
                    break
                left -= 1
                self._take_decoded(link, frame, messages)
                if len(messages) >= DRAIN_MAX:
                    left = 0
            if left <= 0 or self.queue:
                exhausted = False
            if self.queue:
                break
        self.fast_receive.exhausted = exhausted

    def _take_decoded(self, link: Link, frame: bytes, messages: deque[Any]) -> None:
        """Decode what a frame holds that does not simply follow; what cannot be is rejected, or queued."""
        self.accept(link, frame, timed=True)
        while self.queue:
            item = self.queue.popleft()
            try:
                messages.append(item.link.codec.decode(item.buffer, item.offset, item.size))
            except MalformedMessage as error:
                link.reject(str(error))

    def take_all(self, messages: deque[Any], items: deque[Item], *, block: bool) -> int:
        """Take what has arrived: decoded into `messages` where that is quicker, the rest into `items`.

        Args:
            messages: Where decoded messages are appended.
            items: Where the others are.
            block: Wait up to `BLOCK_S` for the first if there is one socket only.

        Returns:
            How many there were.
        """
        if self._policy.reliable or self._policy.depth >= DRAIN_MAX:
            if not self.queue:
                self.drain_decoded(messages, may_wait=block)
        else:
            if block and not self.queue:
                self.receive_one(block=True)
            self.drain()
        items.extend(self.queue)
        self.queue.clear()
        received = len(messages) + len(items)
        self._counters.received += received
        return received

    def leave(self, source: int, until_ns: int) -> bool:
        """A publisher has left: read what is still in flight until then; False if it is not here."""
        left = [link for link in self.links if link.source == source and link not in self.leaving]
        for link in left:
            self.leaving[link] = until_ns
            link.leave()
            self.fast_receive.exhausted = False
        return bool(left)

    def end_overdue(self, now_ns: int) -> list[Link]:
        """End links that have ended or had their time, once a reliable one has all; they are to be closed."""
        overdue = [link for link, until_ns in self.leaving.items() if now_ns >= until_ns or link.has_ended]
        if overdue and self._policy.reliable:  # what is in flight stays there until there is room for it
            unread = self.drain()
            overdue = [link for link in overdue if link not in unread]
        for link in overdue:
            link.end()
            self.links.remove(link)
            del self.leaving[link]
        return overdue

    def accept(self, link: Link, frame: bytes, *, timed: bool) -> None:
        """Put the message of a frame into the queue."""
        if frame[:HEAD_SIZE] != link.message_head or len(frame) < HEADER_SIZE:
            for item in link.handle(frame):
                self._time(item.publish_ns, link)
                self._enqueue(item)
            return
        sequence, stamp_ns, publish_ns, size, _ = unpack_rest(frame, HEAD_SIZE)
        if size != len(frame) - HEADER_SIZE:
            link.reject(f"a message of {len(frame)} bytes: says its body has {size}")
            link.skip(sequence)
            return
        if sequence == link.expected:
            link.expected = sequence + 1
        elif not link.advance(sequence):
            return
        if timed:
            self._time(publish_ns, link)
        self._enqueue(make(Item, (link, frame, HEADER_SIZE, size, sequence, stamp_ns, publish_ns)))

    def _rotated(self) -> list[Link]:
        """The links, a different one first each time, so that no publisher starves another."""
        links = self.links
        if len(links) > 1:
            self._first = (self._first + 1) % len(links)
            return links[self._first :] + links[: self._first]
        return links

    def _time(self, publish_ns: int, link: Link) -> None:
        """Add to the histogram: of plain messages the first of a wake-up and every eighth (all cost 10 %)."""
        note_latency(self._counters.latency, monotonic_ns() - publish_ns - link.clock_offset_ns)

    def _enqueue(self, item: Item) -> None:
        queue, depth = self.queue, self._policy.depth
        queue.append(item)
        if not self._policy.reliable and len(queue) > depth:
            queue.popleft()
            self._counters.overtaken += 1
