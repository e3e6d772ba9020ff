"""The ring of one publisher, which carries its frames to all readers of this host; see WIRE.md, section 3.3.

A reader asks for it at its publisher's node before it attaches; a publisher that takes it in sends everything
but the answer through the ring. Who does not ask, and everybody where there is no C, goes on with ZeroMQ.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import zmq

from cortex.compiled import native
from cortex.large import Reader

logger = logging.getLogger(__name__)

WAITING_MAX = 256
"""Readers that have asked and not attached; older ones are forgotten."""


class Hello(NamedTuple):
    """The descriptors of a reader that asks for the ring."""

    socket: int
    page: int
    bell: int

    def close(self) -> None:
        """Let go of them."""
        for fd in self:
            os.close(fd)


class Listener:
    """Where a node's local readers ask for rings. The caller holds the outlets' lock.

    Args:
        path: Of its socket.
    """

    def __init__(self, path: Path) -> None:
        self._fd = native.listen(str(path))
        self._unheard: list[int] = []
        self._heard: dict[tuple[int, int], Hello] = {}

    def take(self, source: int, reader: int) -> Hello | None:
        """What a reader has handed over, if it has asked for the ring of a publisher; now the caller's."""
        with contextlib.suppress(OSError):  # too many files, or somebody else's process
            while (fd := native.accept(self._fd)) >= 0:
                self._unheard.append(fd)
        unheard, self._unheard = self._unheard[-WAITING_MAX:], []
        for fd in unheard:
            try:
                asked, number, page, bell = native.hear(fd)
                self._heard[asked, number] = Hello(fd, page, bell)
            except BlockingIOError:
                self._unheard.append(fd)
            except OSError:
                os.close(fd)
        while len(self._heard) > WAITING_MAX:
            self._heard.pop(next(iter(self._heard))).close()
        return self._heard.pop((source, reader), None)

    def close(self) -> None:
        """Listen no more."""
        for fd in (self._fd, *self._unheard):
            os.close(fd)
        for hello in self._heard.values():
            hello.close()
        self._unheard.clear()
        self._heard.clear()


def make_listener(path: Path) -> Listener | None:
    """Return where readers may ask for rings; None where there are none."""
    if native is None:
        return None
    try:
        return Listener(path)
    except OSError as error:
        logger.info("no rings: %s", error)
        return None


class Broadcast:
    """The ring of one publisher and who reads it. The caller holds the outlets' lock.

    Args:
        source: The publisher's number.
        await_room: Calls a function until it returns true, for so many seconds at most, and says whether it
            did; the lock is let go meanwhile.
        is_over: Says whether nobody is waited for any more.
    """

    def __init__(
        self,
        source: int,
        await_room: Callable[[Callable[[], bool], float], bool],
        is_over: Callable[[], bool],
    ) -> None:
        self._source = source
        self._await_room = await_room
        self._is_over = is_over
        self._ring: Any = None
        self._readers: dict[int, Reader] = {}
        self.sends: dict[Callable[..., Any], Callable[[bytes], bool]] = {}
        """Takes a frame and flags, or raises `zmq.Again`; with what to call then, see `send`."""

    def admit(self, reader: Reader, sequence: int) -> None:
        """Take a reader in that asks for the ring, from a message on; it then is a member of it."""
        listener = reader.outlet.listener
        hello = None if listener is None else listener.take(self._source, reader.request.reader)
        if hello is None:
            return
        try:
            if self._ring is None:
                self._ring = native.Broadcast(self._source, zmq.Again)
        except OSError:  # no memory
            hello.close()
            return
        with contextlib.suppress(OSError):  # it has left
            reader.member = self._ring.add(*hello, reader.request.strict, sequence)
            self._readers[reader.member] = reader
            self.sends = {self._ring.send: self.send}

    def dismiss(self, reader: Reader) -> None:
        """A reader has left."""
        if reader.member is None or self._ring is None:
            return
        self._ring.remove(reader.member)
        del self._readers[reader.member]
        reader.member = None
        if not self._readers:
            self.sends = {}

    def send(self, frame: bytes) -> bool:
        """Send a frame to all, waiting for reliable readers; False if one of them lost it."""
        on_time = True

        def send() -> bool:
            nonlocal on_time
            try:
                on_time = not self._readers or self._ring.send(frame)
            except zmq.Again:
                return False
            return True

        begin_s = time.monotonic()
        while not send():
            slow = self._slow(frame)
            timeout_s = min((reader.timeout_s for reader in slow), default=0.0)
            if self._await_room(send, timeout_s - (time.monotonic() - begin_s)):
                break
            waited_s, is_over = time.monotonic() - begin_s, self._is_over()
            for reader in self._slow(frame):
                if is_over or reader.timeout_s <= waited_s:
                    self._ring.give_up(reader.member)
        return on_time

    def _slow(self, frame: bytes) -> list[Reader]:
        """The reliable readers that have no room for a frame."""
        return [self._readers[member] for member in self._ring.in_the_way(len(frame))]

    def offer(self, frame: bytes) -> None:
        """Send a frame if all have room."""
        if self._readers:
            with contextlib.suppress(zmq.Again):
                self._ring.send(frame)

    def end(self, last: bytes) -> None:
        """Send the last frame, for which there is room; what readers have not read yet stays theirs."""
        if self._readers:
            self._ring.end(last)

    def close(self) -> None:
        """Send no more."""
        for reader in self._readers.values():
            reader.member = None
        self._readers.clear()
        self.sends = {}
        if self._ring is not None:
            self._ring.close()
