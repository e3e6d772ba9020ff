"""A publisher's ring and its readers, without nodes."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
import zmq

from cortex.compiled import native
from cortex.wire import MESSAGE, Header, pack_header

SOURCE = 7
RING_BYTES, WIDE_BYTES = 1 << 19, 1 << 21


def frame(number: int, size: int) -> bytes:
    """A frame that says which it is, and whose every byte depends on that."""
    return pack_header(Header(MESSAGE, 1, SOURCE, number, None, 3, size, 0)) + bytes([number % 251]) * size


def number_of(found: bytes) -> int:
    """The number of a frame, which must be whole."""
    number = int.from_bytes(found[24:32], "little")
    assert found == frame(number, len(found) - 64)
    return number


class Ring:
    """A publisher's ring, and its readers."""

    def __init__(self, path: Path) -> None:
        self.path = str(path / "1.ring")
        self.listener = native.listen(self.path)
        self.writer = native.Broadcast(SOURCE, zmq.Again)
        self.readers: list = []
        self._idle = socket.socketpair()

    def join(self, *, strict: bool, timeout_ms: int = 700):
        """A reader, and its number."""
        reader = native.RingReader(
            self.path, SOURCE, len(self.readers) + 1, self._idle[0].fileno(), nothing, zmq.Again, 20
        )
        connection = native.accept(self.listener)
        source, number, page, bell = native.hear(connection)
        assert (source, number) == (SOURCE, len(self.readers) + 1)
        assert reader.welcomed() is None
        member = self.writer.add(connection, page, bell, strict, timeout_ms, 5)
        assert reader.welcomed() == 5
        self.readers.append(reader)
        return reader, member

    def close(self) -> None:
        """Let go of everything."""
        self.writer.close()
        for reader in self.readers:
            reader.close()
        os.close(self.listener)
        for end in self._idle:
            end.close()


def nothing(flags: int) -> bytes:
    """A socket to which nothing comes."""
    raise zmq.Again


@pytest.fixture
def ring(tmp_path):
    made = Ring(tmp_path)
    yield made
    made.close()


def takes(writer, each: bytes) -> bool:
    """Whether there is room for a frame, which then is sent."""
    try:
        assert writer.send(each) is True
    except zmq.Again:
        return False
    return True


def read_all(reader) -> list[int]:
    """The numbers of all frames that are there."""
    numbers = []
    try:
        while True:
            numbers.append(number_of(reader.receive(zmq.DONTWAIT)))
    except zmq.Again:
        return numbers


def fill(ring: Ring, size: int) -> int:
    """Send frames until a reliable reader has no room; how many there was room for."""
    count = 0
    while takes(ring.writer, frame(count, size)):
        count += 1
    return count
