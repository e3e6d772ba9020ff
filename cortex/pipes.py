"""The pipes of one publisher's local readers: a few it writes itself, more are written by a relay.

To write one pipe and wake its reader is the quickest way to one reader. Done for each of many readers it
makes a storm where there are fewer processors than readers: each of them takes the processor from the
publisher, reads one message and sleeps again. A relay, a thread in C (`_relay.c`), takes the frames instead
and writes to each reader in turn what has come meanwhile. 8 readers of 40 B on two cores, each: 83-139 k/s
written directly (12-20 on a busy machine), 450-560 by a relay; 160-230 through two pipes and ZeroMQ.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import zmq

from cortex.large import PIPES_MAX, Reader
from cortex.pipe import Relay, make_relay, make_writer


class Pipes:
    """Who of a publisher's readers has a pipe, and how it is written. The caller holds the outlets' lock.

    Args:
        await_room: Calls a function until it returns true, for so many seconds at most, and says whether it
            did; the lock is let go meanwhile.
        is_over: Says whether nobody is waited for any more.
    """

    def __init__(
        self, await_room: Callable[[Callable[[], bool], float], bool], is_over: Callable[[], bool]
    ) -> None:
        self._await_room = await_room
        self._is_over = is_over
        self._direct: list[Reader] = []
        self._relayed: list[Reader] = []
        self._relay: Relay | None = None
        self.lossy: tuple[Callable[..., Any], ...] = ()
        """Take a frame and flags; never refuse one."""
        self.strict: dict[Callable[..., Any], Callable[[bytes], bool]] = {}
        """Take a frame and flags, or raise `zmq.Again`; with what to call then, see `send`."""

    def admit(self, reader: Reader) -> None:
        """Write to a reader's pipe from now on."""
        self._direct.append(reader)
        self._route()

    def dismiss(self, reader: Reader) -> None:
        """A reader has left."""
        if reader in self._direct:
            self._direct.remove(reader)
            assert reader.pipe is not None
            reader.pipe.close()
        elif reader in self._relayed:
            self._relayed.remove(reader)
            assert self._relay is not None
            self._relay.remove(reader.member)
        self._route()

    def settle(self) -> bool:
        """Let a relay write the pipes if there are many, else ourselves; not while a frame waits for room.

        Returns:
            Whether something has changed.
        """
        many = len(self._direct) + len(self._relayed) > PIPES_MAX
        if many and self._direct:
            self._relay = self._relay or make_relay()
            if self._relay is not None:
                self._hand_over(self._relay)
                return True
        return not many and self._take_back()

    def _hand_over(self, relay: Relay) -> None:
        """Let a relay write all pipes; those for which there is no memory we go on to write ourselves."""
        while self._direct:
            reader = self._direct.pop(0)
            assert reader.pipe is not None
            fd, left = reader.pipe.detach()
            try:
                reader.member = relay.add(fd, left, reader.request.strict, reader.late)
            except MemoryError:
                reader.pipe = make_writer(fd, left)
                self._direct.insert(0, reader)
                break
            self._relayed.append(reader)
        self._route()

    def _take_back(self) -> bool:
        """Write all pipes ourselves; whether that is new."""
        if self._relay is None:
            return False
        for reader in self._relayed:
            fd, left, reader.late = self._relay.take(reader.member)
            reader.pipe = make_writer(fd, left)
        self._direct += self._relayed
        self._relayed = []
        self._relay.close()
        self._relay = None
        self._route()
        return True

    def _route(self) -> None:
        pipes = [(reader, reader.pipe) for reader in self._direct if reader.pipe is not None]
        self.lossy = tuple(pipe.offer for reader, pipe in pipes if not reader.request.strict)
        self.strict = {
            pipe.send: lambda frame, reader=reader: self._send_direct(reader, frame)  # type: ignore[misc]
            for reader, pipe in pipes
            if reader.request.strict
        }
        if self._relay is not None and self._relayed:
            self.strict[self._relay.send] = self._send_relayed

    def send(self, frame: bytes) -> bool:
        """Write a frame to all, waiting for reliable readers; False if one of them lost it."""
        for offer in self.lossy:
            offer(frame)
        on_time = True
        for send in list(self.strict.values()):
            on_time &= send(frame)
        return on_time

    def offer(self, frame: bytes) -> None:
        """Write a frame to all that have room."""
        for offer in self.lossy:
            offer(frame)
        relay = self._relay
        for send in self.strict:
            try:
                if relay is not None and send == relay.send:
                    relay.offer(frame)  # somebody who is late is no reason not to
                else:
                    send(frame)
            except zmq.Again:
                continue

    def _send_direct(self, reader: Reader, frame: bytes) -> bool:
        pipe = reader.pipe
        assert pipe is not None

        def send() -> bool:
            try:
                pipe.send(frame)
            except zmq.Again:
                return reader not in self._direct  # it has left
            return True

        reader.late = not send() and (reader.late or not self._await_room(send, reader.timeout_s))
        return not reader.late

    def _send_relayed(self, frame: bytes) -> bool:
        relay = self._relay
        if relay is None:
            return True
        on_time = True

        def send() -> bool:
            nonlocal on_time
            try:
                on_time = relay.offer(frame)
            except zmq.Again:
                return False
            return True

        begin_s = time.monotonic()
        while not send():
            slow = relay.in_the_way(frame)
            timeout_s = min((r.timeout_s for r in self._relayed if r.member in slow), default=0.0)
            if self._await_room(send, timeout_s - (time.monotonic() - begin_s)):
                break
            waited_s, is_over = time.monotonic() - begin_s, self._is_over()
            for reader in self._relayed:
                if reader.member in slow and (is_over or reader.timeout_s <= waited_s):
                    relay.give_up(frame, reader.member)
        return on_time

    def flush(self) -> None:
        """Write what did not fit as a whole."""
        for reader in self._direct:
            if reader.pipe is not None:
                reader.pipe.flush()

    def finish(self, last: bytes, waited_s: float, linger_s: float) -> bool:
        """Write what is left and a last frame to each, as far as there is room; to be called again and again.

        Args:
            last: Nothing is sent after it.
            waited_s: For how long this has gone on [s].
            linger_s: How long to wait for a reader that may not hold us up for longer [s].

        Returns:
            Whether each has all of it, or has had its time.
        """
        self._take_back()
        done = True
        for reader in self._direct:
            assert reader.pipe is not None
            if not reader.has_last:
                try:
                    reader.pipe.send(last)
                    reader.has_last = True
                except zmq.Again:
                    pass
            done &= _has_all(reader) or waited_s >= max(linger_s, reader.timeout_s)
        return done

    def unfinished(self) -> list[Reader]:
        """Who has not got all yet, after `finish`: what is left will not come."""
        self._take_back()
        return [reader for reader in self._direct if not _has_all(reader)]

    def close(self) -> None:
        """Write no more."""
        for reader in (*self._direct, *self._relayed):
            self.dismiss(reader)
        if self._relay is not None:
            self._relay.close()
        self._relay = None
        self._route()


def _has_all(reader: Reader) -> bool:
    """Whether everything has been written into a reader's pipe, the last frame of all included."""
    assert reader.pipe is not None
    return reader.has_last and reader.pipe.flush()
