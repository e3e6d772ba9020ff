"""Frames between two processes of one host through a FIFO: one wake-up from `publish` to the reader.

ZeroMQ hands a message from the sender's thread to its I/O thread, from there through a socket to the reader's
I/O thread, and from there to the reader: three wake-ups, each several times the cost of the message. A pipe
has one, and none while the reader is busy. So a local reader that shares memory offers a FIFO, named after
its number, before it attaches; a publisher that can open it sends everything but the answer there (WIRE.md,
section 3.3). Who does not know of this goes on with ZeroMQ.

The ends are in C (`_pipe.c`) where that was compiled, else the classes here.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import zmq

from cortex.host import pipe_path
from cortex.native import NativePipeReader, NativePipeWriter, NativeRelay
from cortex.wire import BATCH, BODY_LIMIT, HEADER_SIZE, MASK, MESSAGE, PLACE_SIZE, SLOT

PIPE_BYTES = 1 << 18
"""What a pipe holds [bytes]; where the system grants less, the usual 64 KiB."""
READ_BYTES = 1 << 16
SLOT_FRAME_SIZE = HEADER_SIZE + MASK.size + PLACE_SIZE
_SET_SIZE = 1031  # F_SETPIPE_SZ of Linux


class Writer(Protocol):
    """The publisher's end. Not for several threads at once."""

    def send(self, frame: bytes, flags: int = 0, /) -> None:
        """Write a frame; zmq.Again if there is no room. A reader that is gone takes everything."""
        ...

    def offer(self, frame: bytes, flags: int = 0, /) -> None:
        """Write a frame if there is room."""
        ...

    def flush(self) -> bool:
        """Write what is left of a frame that did not fit as a whole; whether all is written."""
        ...

    def detach(self) -> tuple[int, bytes]:
        """Give the pipe up without closing it.

        Returns:
            Its descriptor, and what is left of a frame.
        """
        ...

    def close(self) -> None:
        """Write no more."""
        ...


class Relay(Protocol):
    """Writes frames into the pipes of many readers, in a thread of its own."""

    def add(self, fd: int, left: bytes, strict: bool, late: bool, /) -> int:
        """Write to one more pipe; see `_relay.c`."""
        ...

    def take(self, member: int | None, /) -> tuple[int, bytes, bool]:
        """Give a pipe back: its descriptor, what is to be written there first, and whether it is late."""
        ...

    def remove(self, member: int | None, /) -> None:
        """Write to a pipe no more, and close it."""
        ...

    def send(self, frame: bytes, flags: int = 0, /) -> bool:
        """Have a frame written to all; zmq.Again if a reliable reader has no room, or is late."""
        ...

    def offer(self, frame: bytes, flags: int = 0, /) -> bool:
        """As `send`, but do not mind who is late; False if somebody is, and loses it."""
        ...

    def in_the_way(self, frame: bytes, /) -> list[int]:
        """The reliable readers that have no room for a frame."""
        ...

    def give_up(self, frame: bytes, member: int, /) -> None:
        """Who has no room for a frame is late: it loses what comes until it has read half of what waits."""
        ...

    def is_idle(self) -> bool:
        """Whether everything has been written."""
        ...

    def close(self) -> None:
        """Write no more, and close the pipes."""
        ...


class Reader(Protocol):
    """The subscriber's end. Not for several threads at once."""

    def receive(self, flags: int, /) -> bytes:
        """Take the next frame, from the pipe or else from the socket; zmq.Again if there is none.

        Without DONTWAIT it waits a little.
        """
        ...

    @property
    def broken(self) -> bool:
        """Whether the pipe brought something that is no frame: nothing after it can be read."""
        ...


class PyWriter:
    """As `Writer`.

    Args:
        fd: Its descriptor, non-blocking; belongs to the writer from now on.
        again: What `send` raises.
        left: To be written first.
    """

    def __init__(self, fd: int, again: type[BaseException] = zmq.Again, left: bytes = b"") -> None:
        self._fd = fd
        self._again = again
        self._left = memoryview(left)

    def send(self, frame: bytes, flags: int = 0, /) -> None:
        """Write a frame; zmq.Again if there is no room."""
        if self._left and not self.flush():
            raise self._again
        self._left = memoryview(frame)
        if not self.flush() and len(self._left) == len(frame):
            self._left = memoryview(b"")
            raise self._again

    def offer(self, frame: bytes, flags: int = 0, /) -> None:
        """Write a frame if there is room."""
        with contextlib.suppress(self._again):
            self.send(frame)

    def flush(self) -> bool:
        """Write what is left of a frame; whether all is written."""
        try:
            while self._left:
                self._left = self._left[os.write(self._fd, self._left) :]
        except BlockingIOError:
            return False
        except OSError:  # the reader is gone: the outlet will say so
            self._left = memoryview(b"")
        return True

    def detach(self) -> tuple[int, bytes]:
        """Give the pipe up without closing it: its descriptor, and what is left of a frame."""
        fd, self._fd = self._fd, -1
        left, self._left = bytes(self._left), memoryview(b"")
        return fd, left

    def close(self) -> None:
        """Write no more."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


class PyReader:
    """As `Reader`.

    Args:
        fd: Its descriptor, non-blocking; stays the caller's.
        socket_fd: That of the socket.
        receive: Takes a frame from the socket, called with DONTWAIT; raises `again`.
        again: The exception.
        wait_ms: Longest wait.
    """

    def __init__(
        self,
        fd: int,
        socket_fd: int,
        receive: Callable[[int], bytes],
        again: type[BaseException],
        wait_ms: int,
    ) -> None:
        self._fd = fd
        self._receive = receive
        self._wait_ms = wait_ms
        self._buffer = bytearray()
        self._at = 0
        self.broken = False
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)
        self._poll.register(socket_fd, select.POLLIN)

    def receive(self, flags: int, /) -> bytes:
        """Take the next frame."""
        frame = self._next()
        if frame is None and not flags & zmq.DONTWAIT:
            with contextlib.suppress(zmq.Again):
                return self._receive(zmq.DONTWAIT)
            self._poll.poll(self._wait_ms)
            frame = self._next()
        return self._receive(zmq.DONTWAIT) if frame is None else frame

    def _next(self) -> bytes | None:
        while not self.broken:
            size = frame_size(self._buffer, self._at)
            if size < 0:
                self.broken = True
                return bytes(self._buffer[self._at :])
            if 0 < size <= len(self._buffer) - self._at:
                frame = bytes(memoryview(self._buffer)[self._at : self._at + size])
                self._at += size
                return frame
            try:
                more = os.read(self._fd, READ_BYTES)
            except BlockingIOError:
                return None
            if not more:
                return None
            del self._buffer[: self._at]
            self._buffer += more
            self._at = 0
        return None


def frame_size(buffer: bytes | bytearray, offset: int) -> int:
    """Size of the frame that begins in a buffer; 0: its header is not there yet; -1: it is no frame."""
    if len(buffer) - offset < HEADER_SIZE:
        return 0
    if buffer[offset : offset + 3] != b"CTX":
        return -1
    kind = buffer[offset + 3 : offset + 4]
    if kind == SLOT:
        return SLOT_FRAME_SIZE
    body = int.from_bytes(buffer[offset + 48 : offset + 56], "little")
    return HEADER_SIZE + body if kind in (MESSAGE, BATCH) and body <= BODY_LIMIT else -1


def open_writer(directory: Path | None, number: int) -> Writer | None:
    """Open the pipe that a reader offers; None if it offers none.

    Args:
        directory: Where the nodes of this host meet; None: the reader is elsewhere.
        number: The reader's.
    """
    if directory is None:
        return None
    path, flags = pipe_path(directory, number), os.O_NONBLOCK | os.O_CLOEXEC
    try:
        os.close(os.open(path, os.O_WRONLY | flags))  # refused where nobody reads
        # With a reading end of our own there is no SIGPIPE, which ends programs that do not ignore it.
        fd = os.open(path, os.O_RDWR | flags)
    except OSError:
        return None
    if not stat.S_ISFIFO(os.fstat(fd).st_mode):
        os.close(fd)
        return None
    _enlarge(fd)
    return make_writer(fd)


def make_writer(fd: int, left: bytes = b"") -> Writer:
    """Return what writes a pipe.

    Args:
        fd: Its descriptor, non-blocking; belongs to the writer from now on.
        left: To be written first.
    """
    kind: Any = NativePipeWriter or PyWriter
    writer: Writer = kind(fd, zmq.Again, left)
    return writer


def make_relay() -> Relay | None:
    """Return what writes many pipes; None where there is no C, or no more threads."""
    if NativeRelay is None:
        return None
    try:
        relay: Relay = NativeRelay(zmq.Again)
    except OSError:
        return None
    return relay


def _enlarge(fd: int) -> None:
    with contextlib.suppress(OSError):
        fcntl.fcntl(fd, _SET_SIZE, PIPE_BYTES)


class Offer:
    """A pipe that a subscriber offers to one publisher; the name goes as soon as that has decided.

    Args:
        directory: Where the nodes of this host meet.
        number: The reader's.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(self, directory: Path, number: int) -> None:
        self._path: Path | None = pipe_path(directory, number)
        os.mkfifo(self._path, 0o600)
        self._fds: list[int] = []
        try:
            for flags in (os.O_RDONLY, os.O_WRONLY):  # with an end of our own it never looks closed
                self._fds.append(os.open(self._path, flags | os.O_NONBLOCK | os.O_CLOEXEC))
        except BaseException:
            self.close()
            raise

    @property
    def fd(self) -> int:
        """Descriptor to read from, and to wait for."""
        return self._fds[0]

    def taken(self) -> bool:
        """Whether the publisher has opened the pipe and said so with a first frame; the name is removed."""
        self._unlink()
        poll = select.poll()
        poll.register(self.fd, select.POLLIN)
        return bool(poll.poll(0))

    def reader(self, socket_fd: int, receive: Callable[[int], bytes], wait_ms: int) -> Reader:
        """Return what reads the pipe and, where that is empty, the socket."""
        kind: Any = NativePipeReader or PyReader
        reader: Reader = kind(self.fd, socket_fd, receive, zmq.Again, wait_ms)
        return reader

    def silence(self) -> None:
        """Read no more: the descriptor stays valid, as others may wait for it or read it, but is silent."""
        self._unlink()
        for fd, quiet in zip(self._fds, os.pipe(), strict=True):
            os.set_blocking(quiet, False)
            os.dup2(quiet, fd, inheritable=False)
            os.close(quiet)

    def _unlink(self) -> None:
        path, self._path = self._path, None
        if path is not None:
            with contextlib.suppress(FileNotFoundError):
                path.unlink()

    def close(self) -> None:
        """Give the pipe up."""
        self._unlink()
        fds, self._fds = self._fds, []
        for fd in fds:
            os.close(fd)
