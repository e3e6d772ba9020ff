"""Who asks for a ring: what it may hand over, what it cannot do, and how it is forgotten."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import socket
import struct

import pytest
import zmq
from peer import Number, connect
from processes import SOON_S, wait_for
from rings import RING_BYTES, SOURCE, fill, frame, nothing, ring, takes

import cortex.broadcast
from cortex import reliable
from cortex.broadcast import Listener
from cortex.compiled import native
from cortex.wire import MESSAGE, AttachKey, attach_key, message_head

__all__ = ["ring"]

pytestmark = pytest.mark.skipif(native is None, reason="no C module")


@contextlib.contextmanager
def asks_by_hand(path: str, source: int, magic: bytes = b"CTXCAST3", bell: int | None = None):
    """The connection of a reader, number 1, that has said hello."""
    page, bell = os.memfd_create("page", os.MFD_ALLOW_SEALING), os.eventfd(0) if bell is None else bell
    os.ftruncate(page, 4096)
    fcntl.fcntl(page, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.connect(path)
        socket.send_fds(other, [magic + struct.pack("<QQ", source, 1)], [page, bell])
        os.close(page)
        os.close(bell)
        yield other


@pytest.mark.parametrize(
    "make", [os.pipe, lambda: [end.detach() for end in socket.socketpair()]], ids=["pipe", "socket"]
)
def test_a_bell_whose_ringing_would_end_the_process_is_refused(ring, make):
    """Nobody is at its other end: to write there sends SIGPIPE."""
    other, bell = make()
    os.close(other)
    with asks_by_hand(ring.path, SOURCE, bell=bell):
        connection = native.accept(ring.listener)
        with pytest.raises(OSError, match=r"[Pp]rotocol"):
            native.hear(connection)
        os.close(connection)


def test_a_reader_that_spoke_and_died_is_forgotten(ring):
    """What it has said waits in its connection, which has ended all the same."""
    with asks_by_hand(ring.path, SOURCE) as other:
        connection = native.accept(ring.listener)
        ring.writer.add(connection, *native.hear(connection)[2:], True, 700, 5)
        other.send(b"still here")
        fill(ring, 1000)
        for _ in range(2):  # of the first ring, and of the larger one
            assert other.recv(64)[:8] == b"CTXCAST3"
        assert ring.writer.patience(1064) == 700
    assert takes(ring.writer, frame(0, 1000))


def test_a_reader_of_another_version_gets_messages_and_it_is_said(make_node, caplog):
    """It asks for a ring of an older kind. That is said once, not by each publisher of the node."""
    node = make_node()
    publisher = node.publisher("/numbers", Number)
    address = publisher._pub_sockets._pub_sockets[0].socket.last_endpoint.decode()
    key = attach_key(AttachKey(publisher.source, 1, True, False, 10, 0), stamped=True)
    path = address.removeprefix("ipc://").rpartition(".")[0] + ".ring"
    context = zmq.Context()
    with asks_by_hand(path, publisher.source, b"CTXCAST2"), context.socket(zmq.SUB) as other:
        other.connect(address)
        for each in (message_head(MESSAGE, publisher.source, publisher.codec.fingerprint, stamped=True), key):
            other.subscribe(each)
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        wait_for(lambda: "a subscriber with another version of cortex" in caplog.text)
        publisher.publish(Number(1, 2))
        assert other.recv()[:32] == key
        assert other.recv()[3:4] == MESSAGE
    context.term()
    second = node.publisher("/others", Number)
    with make_node().subscriber("/others", Number):
        assert second.wait_for_subscribers(timeout_s=SOON_S)
    second._pub_sockets.emit_notes()
    assert caplog.text.count("a subscriber with another version of cortex") == 1


def test_a_publisher_of_another_version_is_heard_and_it_is_said(make_node, monkeypatch, caplog):
    """It closes the connection of who asks for a ring that it does not know. That is said once for a node."""
    take, asked = Listener.take, []

    def close(self, source, reader):
        asked.append(reader)
        take(self, source, reader).close()

    monkeypatch.setattr(Listener, "take", close)
    node = make_node()
    publisher, subscriber = connect(node, "/numbers", Number, reliable())
    publisher.publish(Number(1, 2))
    assert subscriber.recv(SOON_S) == Number(1, 2)
    assert subscriber.wait_for_publisher(SOON_S)
    assert subscriber.carriers == ["ipc"]
    node.publisher("/others", Number)
    others = node.subscriber("/others", Number, policy=reliable())
    assert others.wait_for_publisher(SOON_S)
    said = [record for record in caplog.records if "another version of cortex" in record.message]
    assert [record.levelname for record in said if record.levelno >= logging.WARNING] == ["WARNING"]
    assert len(asked) == 2


def test_a_reader_cannot_write_to_the_ring(ring):
    """Its memory is sealed: a second mapping for writing is refused."""
    ring.join(strict=True)
    fds = [f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")]
    rings = [fd for fd in fds if os.path.exists(fd) and os.stat(fd).st_size == RING_BYTES + (1 << 16)]
    assert rings
    with pytest.raises(PermissionError), open(rings[0], "r+b", buffering=0) as file:
        file.write(b"x")


@pytest.mark.parametrize(
    "said", [b"", b"x" * 24, (b"CTXCAST3" * 3)], ids=["nothing", "nonsense", "no descriptors"]
)
def test_who_says_something_else_is_refused(ring, said):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.connect(ring.path)
        connection = native.accept(ring.listener)
        if said:
            other.send(said)
            with pytest.raises(OSError, match=r"[Pp]rotocol"):
                native.hear(connection)
        else:
            with pytest.raises(BlockingIOError):
                native.hear(connection)
        os.close(connection)


def test_who_connects_and_says_nothing_is_forgotten(tmp_path, monkeypatch):
    """More of them than are waited for: the older ones are let go of."""
    monkeypatch.setattr(cortex.broadcast, "WAITING_MAX", 16)
    listener = Listener(tmp_path / "1.ring")
    before = len(os.listdir("/proc/self/fd"))
    with contextlib.ExitStack() as others:
        for _ in range(3):
            for _ in range(10):
                other = others.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
                other.connect(str(tmp_path / "1.ring"))
            listener.take(SOURCE, 1)
        listener.take(SOURCE, 1)
        assert len(os.listdir("/proc/self/fd")) == before + 30 + 16
    listener.take(SOURCE, 1)
    assert len(os.listdir("/proc/self/fd")) == before
    listener.close()


def test_a_reader_that_leaves_before_it_attaches_is_forgotten(tmp_path):
    """What it has handed over is closed; a reader that is still about to attach stays."""
    listener = Listener(tmp_path / "1.ring")
    idle, other = socket.socketpair()
    leaving, staying = (
        native.RingReader(str(tmp_path / "1.ring"), SOURCE, n, idle.fileno(), nothing, zmq.Again, 20)
        for n in (1, 2)
    )
    assert listener.take(SOURCE, 3) is None  # both have been heard
    before = len(os.listdir("/proc/self/fd"))
    listener.forget()
    assert len(os.listdir("/proc/self/fd")) == before
    leaving.close()
    after_close = len(os.listdir("/proc/self/fd"))
    listener.forget()
    assert len(os.listdir("/proc/self/fd")) == after_close - 3  # socket, page and bell
    assert listener.take(SOURCE, 1) is None
    hello = listener.take(SOURCE, 2)
    assert hello is not None
    hello.close()
    staying.close()
    listener.close()
    idle.close()
    other.close()
