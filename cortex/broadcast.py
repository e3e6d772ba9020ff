"""The ring of one publisher, which carries its frames to all readers of this host; see WIRE.md, 3.3 and 6.

A reader asks for it at its publisher's node before it attaches; a publisher that takes it in sends everything
but the answer through the ring. Large bodies are written into slots behind the frames; readers lease them.
Who does not ask, and everybody where there is no C, goes on with ZeroMQ.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import zmq

from cortex.compiled import native
from cortex.pub_socket import PubSocket
from cortex.wire import AttachKey

if TYPE_CHECKING:
    from cortex.fanout import Fanout

logger = logging.getLogger(__name__)

WAITING_MAX = 256
"""Readers that have asked and not attached; older ones are forgotten."""

DEEP_QUOTA = 67
"""A reader that may hold so many messages keeps more than by default, see `keep_last`."""
MOVE_S = 0.1
"""How long readers have at least to come to their sockets, where there is no memory for slots."""
RETRY_S = 5.0
"""After slots could not be made, it is not tried again for so long."""


@dataclass(eq=False)
class Reader:
    """One subscriber's link to this publisher."""

    key: bytes
    request: AttachKey
    pub_socket: PubSocket
    member: int | None = None
    """Its number in the publisher's ring, through which its frames go; None: through the socket."""
    confirmed: int = 0
    """It has accounted for all messages below this; the end of the stream counts as one."""
    has_answer: bool = False
    """Whether it has confirmed its answer, or need not."""

    @property
    def timeout_s(self) -> float:
        """How long this reader may hold up the publisher [s]."""
        return self.request.timeout_ms / 1000.0 if self.request.strict else 0.0


class Hello(NamedTuple):
    """The descriptors of a reader that asks for the ring."""

    socket: int
    page: int
    wakeup: int
    """The eventfd that wakes the reader."""

    def close(self) -> None:
        """Let go of them."""
        for fd in self:
            os.close(fd)


class Listener:
    """Where a node's local readers ask for rings. The caller holds the sockets' lock."""

    def __init__(self, path: Path) -> None:
        self._fd = native.listen(str(path))
        self._unheard: list[int] = []
        self._heard: dict[tuple[int, int], Hello] = {}
        self.heard_other_version = False
        """Whether a reader asked for a ring of another kind."""
        self.has_complained = False
        """Whether that was said; it is said once for all publishers."""

    def take(self, source: int, reader: int) -> Hello | None:
        """What a reader has handed over, if it has asked for the ring of a publisher; now the caller's."""
        with contextlib.suppress(OSError):  # too many files, or somebody else's process
            for _ in range(WAITING_MAX):  # others may come faster than they can be taken in
                if (fd := native.accept(self._fd)) < 0:
                    break
                self._unheard.append(fd)
        for fd in self._unheard[:-WAITING_MAX]:
            os.close(fd)
        unheard, self._unheard = self._unheard[-WAITING_MAX:], []
        for fd in unheard:
            try:
                asked, number, page, wakeup = native.hear(fd)
                self._heard[asked, number] = Hello(fd, page, wakeup)
            except BlockingIOError:
                self._unheard.append(fd)
            except OSError as error:
                self.heard_other_version |= error.errno == errno.EPROTONOSUPPORT
                os.close(fd)
        while len(self._heard) > WAITING_MAX:
            self._heard.pop(next(iter(self._heard))).close()
        return self._heard.pop((source, reader), None)

    def forget(self) -> None:
        """Let go of what readers handed over that have left before they attached."""
        poll = select.poll()
        for hello in self._heard.values():
            poll.register(hello.socket, 0)
        gone = {fd for fd, _ in poll.poll(0)} if self._heard else set()
        for key in [key for key, hello in self._heard.items() if hello.socket in gone]:
            self._heard.pop(key).close()

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
    """The ring of one publisher and who reads it. The caller holds the sockets' lock.

    Args:
        fanout: Of the publisher: waits for readers, and sends frames another way to readers of the ring.
        expected_bytes: Make slots for messages of this size before the first reader is answered; 0: do not.
    """

    def __init__(self, fanout: Fanout, expected_bytes: int = 0) -> None:
        self._fanout = fanout
        self._back_pressure = fanout.back_pressure
        self._expected_bytes = expected_bytes
        self._unavailable_until_s = 0.0
        self._is_dissolved = False
        self._ring: Any = None
        self._readers: dict[int, Reader] = {}
        self._moving: set[Reader] = set()
        """Those that were sent another way, and have not come there yet."""
        self.sends: dict[Callable[..., Any], Callable[[bytes], bool]] = {}
        """Takes a frame and flags, or raises `zmq.Again`; with what to call then, see `send`."""

    def admit(self, reader: Reader, sequence: int) -> None:
        """Take a reader in that asks for the ring, from a message on; it then is a member of it."""
        listener = reader.pub_socket.listener
        hello = None if listener is None else listener.take(self._fanout.source, reader.request.reader)
        if listener is not None and listener.heard_other_version and not listener.has_complained:
            listener.has_complained = True
            self._fanout.note(
                "a subscriber with another version of cortex cannot share memory, which is slower"
            )
        if hello is None:
            return
        try:
            if self._ring is None and not self._is_dissolved:
                self._ring = native.Broadcast(self._fanout.source, zmq.Again)
        except OSError as error:
            self._is_dissolved = True
            self._fanout.note(f"no shared memory for a ring: {error}")
        if self._is_dissolved:
            hello.close()
            return
        with contextlib.suppress(OSError):  # it has left
            request = reader.request
            reader.member = self._ring.add(*hello, request.strict, request.timeout_ms, sequence)
            self._readers[reader.member] = reader
            self.sends = {self._ring.send: self.send}
            # a message that waits may lie in a slot of this ring: then `acquire` makes them for the next
            if self._expected_bytes and not self._back_pressure.is_waiting:
                self._provide(self._expected_bytes, exact=True)

    def dismiss(self, reader: Reader) -> None:
        """A reader has left."""
        self._moving.discard(reader)
        if reader.member is None or self._ring is None:
            return
        self._ring.remove(reader.member)
        del self._readers[reader.member]
        reader.member = None
        if not self._readers:
            self.sends = {}

    @property
    def short_cut(self) -> Any:
        """The ring in C, if it has readers and slots enough for them; see `fast_send.py`."""
        if not self._readers or self._ring.slots < 2 * len(self._readers) + 2:
            return None
        return self._ring

    @property
    def has_readers(self) -> bool:
        """Whether somebody reads it."""
        return bool(self._readers)

    def has_slots(self, size: int) -> bool:
        """Whether there are slots for bodies of a size, free or not."""
        return self.has_readers and self._ring.slot_bytes >= size

    def send(self, frame: bytes) -> bool:
        """Send a frame to all, waiting for reliable readers; False if one of them lost it."""
        return not self._readers or self._send(lambda: self._ring.send(frame), len(frame))

    def commit(self, slot: Any, header: bytes) -> bool:
        """Send the header of what was written into a slot, as `send`."""
        return self._send(lambda: self._ring.commit(slot, header), len(header))

    def acquire(self, size: int, *, exact: bool, may_wait: bool = False) -> Any:
        """Return a slot in which a body may be written; dropping it gives it back.

        Args:
            size: Bytes that will be written at most.
            exact: Whether all messages have this size, so that nothing is kept for growth.
            may_wait: Wait for reliable readers that have still to read what is in the slots.

        Returns:
            None if there is none.
        """
        if not self._readers:
            return None
        if not self._provide(size, exact=exact):
            self._dissolve()
            return None
        slot: Any = None

        def acquire() -> bool:
            nonlocal slot
            slot = self._ring.acquire(size)
            return slot is not None

        if not acquire() and may_wait:
            self._wait(acquire, 0)
        return slot

    def _provide(self, size: int, *, exact: bool) -> bool:
        """Make slots for bodies of a size, if need be; whether there are any."""
        ring, deep = self._ring, any(r.request.quota >= DEEP_QUOTA for r in self._readers.values())
        if ring.slot_bytes >= size and time.monotonic() < self._unavailable_until_s:
            return True
        try:
            if time.monotonic() >= self._unavailable_until_s:
                ring.provide(size, exact, deep)
        except OSError as error:
            self._unavailable_until_s = time.monotonic() + RETRY_S
            if ring.slot_bytes < size:
                self._fanout.note(f"no shared memory for slots of {size} bytes: {error}")
        return bool(ring.slot_bytes >= size)

    def _dissolve(self) -> None:
        """Send all readers to their sockets, for good, and wait a little until they are there."""
        self._moving = set(self._readers.values())
        self._is_dissolved = True
        self._ring.dissolve()
        self._forget()
        self._fanout.route()
        timeout_s = max(MOVE_S, *(reader.timeout_s for reader in self._moving))
        self._back_pressure.wait_for(lambda: not self._moving, timeout_s)

    @property
    def has_lost(self) -> bool:
        """Whether a reliable reader has still to come to its socket: it misses what is sent meanwhile."""
        return any(reader.request.strict for reader in self._moving)

    def _send(self, send: Callable[[], bool], size: int) -> bool:
        """Call what sends a frame of so many bytes, until reliable readers have room or had their time."""
        on_time = True

        def attempt() -> bool:
            nonlocal on_time
            try:
                on_time = send()
            except zmq.Again:
                return False
            return True

        if not attempt():
            self._wait(attempt, size)
        return on_time

    def _wait(self, attempt: Callable[[], bool], size: int) -> None:
        """Attempt something until it works, or nobody is in its way; give up readers whose time is over."""
        while not attempt():
            patience_ms = self._ring.patience(size)
            if patience_ms < 0:
                attempt()
                return
            if self._fanout.await_room(attempt, patience_ms / 1000.0):
                return
            waited_ms = int(self._back_pressure.waited_s * 1000.0)
            self._ring.give_up(size, 2**32 if self._back_pressure.is_over() else waited_ms)

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
        if self._ring is not None:
            self._ring.close()
        self._forget()

    def _forget(self) -> None:
        for reader in self._readers.values():
            reader.member = None
        self._readers.clear()
        self.sends = {}
        self._ring = None
