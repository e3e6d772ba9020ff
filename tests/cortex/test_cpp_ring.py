"""Rings between the C++ client and Python, and between two C++ processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import zmq
from cpp_client import Impostor, Peer, make_frame, publishers_in_cpp, subscribers_in_cpp
from cpp_messages import Scan
from cpp_programs import needs_compiler, programs, start
from peer import stand_still
from processes import SOON_S, wait_for

from cortex import wire
from cortex.codec import codec_of
from cortex.compiled import native
from cortex.node import Node
from cortex.policy import reliable

__all__ = ["programs", "start"]

pytestmark = needs_compiler

SIZES = [10, 20_000, 4000, 0, 50_000]
"""Items of scans: in frames, in slots, in frames larger than a page, none, in slots of a second ring."""


def share_a_ring(peer: Peer, other: int) -> bool:
    """Whether a C++ program and another process have a ring, or a page of a reader, in common."""
    maps = [Path(f"/proc/{pid}/maps").read_text("ascii").splitlines() for pid in (peer.process.pid, other)]
    rings = [{line.split()[4] for line in lines if "/memfd:cortex (" in line} for lines in maps]
    return bool(rings[0] & rings[1])


def result_of(peer: Peer) -> dict[str, int]:
    return json.loads(peer.line())


def scan(number: int, size: int) -> Scan:
    return Scan(number, np.full(size, number, np.float32))


@pytest.mark.parametrize("direction", ["Python to C++", "C++ to Python", "C++ to C++"])
def test_all_sizes_in_one_order(start, make_node, direction):
    writer, _, reader = direction.partition(" to ")
    node = make_node()
    counting = start("count", "/scan", "reliable", 0, 3, 3000) if reader == "C++" else None
    scans = node.subscriber("/scan", Scan, policy=reliable(64, SOON_S)) if reader == "Python" else None
    publishing = start("publish", "/scan", 3000, ",".join(map(str, SIZES))) if writer == "C++" else None
    if writer == "Python":
        publisher = node.publisher("/scan", Scan)
        assert publisher.wait_for_subscribers(1, SOON_S)
        assert all(publisher.publish(scan(number, SIZES[number % 5])) for number in range(3000))
    if scans is not None:
        for number in range(3000):
            assert scans.recv(SOON_S) == scan(number, SIZES[number % 5])
        assert (scans.counters.lost, scans.counters.rejected) == (0, 0)
        assert scans.carriers == ["ipc, shared memory"]
    if counting is not None:
        result = result_of(counting)
        assert result["received"] == 3000
        assert result["wrong"] == result["lost"] == result["rejected"] == result["overtaken"] == 0
    if publishing is not None:
        assert result_of(publishing) == {"published": 3000, "refused": 0, "timeouts": 0}


@pytest.mark.parametrize("reason", ["no descriptor left for slots", "a reader without the C module"])
def test_a_cpp_publisher_serves_its_reader_through_the_socket(start, make_node, request, reason):
    if "reader" in reason:
        request.getfixturevalue("sockets_alone")
    scans = make_node().subscriber("/scan", Scan, policy=reliable(64, SOON_S))
    start("publish", "/scan", 100, "100000,10", "" if "reader" in reason else "full")
    for number in range(100):
        assert scans.recv(SOON_S) == scan(number, 10 if number % 2 else 100_000)
    assert (scans.counters.lost, scans.counters.rejected) == (0, 0)


def counted(node: Node) -> list[int]:
    """How many messages each subscription of the C++ programs knows of: received, lost or overtaken."""
    return [found.received + found.lost + found.overtaken for found in subscribers_in_cpp(node)]


@pytest.mark.parametrize("policy", ["4", "brief"])
def test_stopped_reader_of_cpp_keeps_nothing_from_the_others(start, make_node, policy):
    """It loses what it is too late for, and counts that; it gets the rest once it goes on."""
    node = make_node()
    stopped = start("count", "/scan", policy, 0, 0)
    others = [node.subscriber("/scan", Scan, policy=reliable(64, SOON_S)) for _ in range(3)]
    writer = start("publish", "/scan", 9000, "100", "", 4)
    for number in range(9000):
        assert {other.recv(SOON_S).stamp_ns for other in others} == {number}
        if number in (500, 8000):  # meanwhile comes more than the ring holds
            stopped.process.send_signal(signal.SIGSTOP if number == 500 else signal.SIGCONT)
    assert all(other.counters.lost == 0 for other in others)
    result = result_of(writer)
    assert (result["timeouts"] > 0) == (policy == "brief")
    wait_for(lambda: counted(node) == [9000])


@pytest.mark.usefixtures("sockets_alone")
@pytest.mark.parametrize("timeout_s", [0.05, 1.0])
def test_reader_of_a_socket_that_stands_still_holds_up_a_cpp_publisher_once(start, make_node, timeout_s):
    """After 8 MB, as one in Python: for a second, not for one with each large message."""
    scans = make_node().subscriber("/scan", Scan, policy=reliable(1, timeout_s))
    stand_still(scans)
    role = ("fill", "/scan", 200) if timeout_s < 1.0 else ("publish", "/scan", 40)
    begin_s = time.monotonic()
    writer = start(*role, 250_000)  # 1 MB each
    assert scans.wait_for_publisher(SOON_S)
    result = result_of(writer)
    if timeout_s < 1.0:  # what is in flight besides: in the kernel, and one in the queue of the reader
        assert 8 <= result["taken"] <= 12
    else:
        assert result["refused"] >= 28
        assert time.monotonic() - begin_s < 20.0


@pytest.mark.parametrize(("others", "size", "held"), [(0, 10, 500), (2, 10, 500), (0, 20_000, 45)])
def test_killed_cpp_reader_that_holds_up_its_publisher(start, make_node, others, size, held):
    """The publisher waits for a reliable reader, with all slots of its share; when that dies it goes on."""
    node = make_node()
    slow = start("count", "/scan", "reliable", 50_000, 3)
    for _ in range(others):
        start("count", "/scan", "64", 0, 0)
    writer = start("publish", "/scan", -1, size, "", 1 + others)

    def published() -> int:
        return max((found.published for found in publishers_in_cpp(node)), default=0)

    wait_for(lambda: published() > held)  # more than one message each 50 ms
    before = [0, published()]
    while before[-1] > before[-2]:
        time.sleep(0.02)
        before.append(published())
    slow.process.kill()
    scans = node.subscriber("/scan", Scan, policy=reliable(64, SOON_S))
    first = scans.recv(SOON_S).stamp_ns
    for number in range(first + 1, first + 10 * held):
        assert scans.recv(SOON_S).stamp_ns == number
    assert scans.counters.lost == 0
    assert writer.process.poll() is None  # no signal has killed it


def place_of(node: Node, topic: str) -> tuple[int, str]:
    """Source and strict address of the only publisher of a topic."""
    ((record, publisher),) = wait_for(
        lambda: [(each, p) for each in node.nodes() for p in each.publishers if p.topic == topic]
    )
    return publisher.source, record.endpoints[0].strict


def sequence_of(frame: bytes) -> int:
    return int.from_bytes(frame[24:32], "little")


def aux_of(frame: bytes) -> int:
    return int.from_bytes(frame[56:64], "little")


def test_what_a_closed_cpp_publisher_has_taken_stays(start, make_node):
    """Also when its process has ended, and nobody has read; behind it the number that tells of the loss."""
    scans = make_node().subscriber("/scan", Scan, policy=reliable(1, 0.01))
    stand_still(scans)
    writer = start("fill", "/scan", 10**9, 2700)
    result = result_of(writer)
    writer.end()
    for number in range(result["taken"]):
        assert scans.recv(SOON_S) == scan(number, 2700)
    with pytest.raises(TimeoutError):
        scans.recv(0.1)
    assert scans.counters.lost == result["published"] - result["taken"] == 1
    assert scans.counters.rejected == scans.counters.cut_off == 0


def test_the_end_of_a_cpp_publisher_is_said_again_until_it_is_confirmed(start, make_node):
    """To a reader of its socket: what libzmq has no room for gets lost without a word."""
    start("fill", "/scan", 5, 10)
    source, address = place_of(make_node(), "/scan")
    key = wire.attach_key(wire.AttachKey(source, 1, False, True, 10, 60_000), stamped=True)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        reader = context.socket(zmq.SUB)
        reader.connect(address)
        for kind in (wire.MESSAGE, wire.NEXT):
            reader.subscribe(wire.prefix(kind, source, stamped=True))
        reader.subscribe(key)
        assert wire.parse_answer(reader.recv()) == (0, b"")
        assert not reader.poll(100.0)  # it counts once it has confirmed its answer
        reader.subscribe(wire.resume_key(source, 1, 0, stamped=True))
        kinds = []
        while kinds.count(b"N") < 4:
            assert reader.poll(1e3 * SOON_S), kinds
            frame = reader.recv()
            kinds.append(frame[3:4])
            assert kinds[-1] != b"N" or (sequence_of(frame), aux_of(frame)) == (5, wire.LAST)
        assert kinds.count(b"M") == 5
        reader.subscribe(wire.resume_key(source, 1, 5, stamped=True))
        for _ in range(10):
            assert reader.recv()[3:4] == b"N"
        reader.subscribe(wire.resume_key(source, 1, 6, stamped=True))
        while reader.poll(100.0):  # five times the time after which it would be said again
            assert reader.recv()[3:4] == b"N"
    finally:
        context.destroy(linger=0)


def test_cpp_reader_counts_what_it_had_no_time_for(start, make_node):
    """It stands still until a publisher in Python, and another one in C++, have ended."""
    watcher, node = make_node(), make_node()
    reader = start("count", "/scan", "brief", 0, 0)
    scans = node.publisher("/scan", Scan)
    assert scans.wait_for_subscribers(1, SOON_S)
    reader.process.send_signal(signal.SIGSTOP)
    sent = 1
    while scans.publish(scan(sent, 10)):
        sent += 1
    node.close()
    reader.process.send_signal(signal.SIGCONT)
    wait_for(lambda: counted(watcher) == [sent])

    writer = start("fill", "/scan", 10**9, 10)
    wait_for(lambda: share_a_ring(reader, writer.process.pid) or writer.has_line())  # or one message was late
    reader.process.send_signal(signal.SIGSTOP)
    sent += result_of(writer)["published"]
    writer.end()
    reader.process.send_signal(signal.SIGCONT)
    wait_for(lambda: counted(watcher) == [sent])


@pytest.mark.parametrize("busy", [False, True], ids=["", "while another is busy"])
def test_cpp_reader_counts_a_stream_that_was_cut_off(start, start_child, make_node, busy):
    """Nobody knows how much of it was lost; one that was closed in order is complete."""
    reader = start("count", "/scan", "reliable", 0, 0)
    for orderly in (True, False):
        child = start_child("peer")
        child.ask(do="publisher", topic="/scan", type="Scan")
        assert child.ask(do="await_subscribers", topic="/scan")["ok"]
        if busy and not orderly:
            start("publish", "/scan", -1, 10)  # without a pause, for ever
        child.say(do="leave", topic="/scan", count=10, orderly=orderly)
    node = make_node()
    wait_for(lambda: [found.cut_off for found in subscribers_in_cpp(node)] == [1])
    assert reader.process.poll() is None
    if not busy:
        last = node.publisher("/scan", Scan)
        assert last.wait_for_subscribers(1, SOON_S)
        last.publish(scan(-1, 0))
        result = result_of(reader)
        assert (result["received"], result["lost"], result["cut_off"]) == (20, 0, 1)
        assert "ended without saying how much it had sent" in reader.end()


class RingImpostor(Impostor):
    """A publisher that takes its subscriber into a ring, and writes there what it likes."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.listener = native.listen(str(directory / "data.ring"))
        self.ring = native.Broadcast(self.SOURCE, zmq.Again)

    def take_in(self, key: bytes, *, answers: bool = True) -> None:
        fd = native.accept(self.listener)
        source, number, page, wakeup = native.hear(fd)
        assert (source, number) == (self.SOURCE, int.from_bytes(key[16:24], "little"))
        self.ring.add(fd, page, wakeup, False, 0, 0)
        if answers:
            self.xpub.send(wire.answer_frame(key, wire.AttachAnswer(0, b"")))

    def close(self) -> None:
        super().close()
        self.ring.close()
        os.close(self.listener)


@pytest.fixture
def impostor(runtime, monkeypatch):
    liar = RingImpostor(runtime)
    monkeypatch.setenv("CORTEX_TEST_REGISTRY", liar.registry)
    yield liar
    liar.close()
    shutil.rmtree(runtime, ignore_errors=True)
    runtime.mkdir(mode=0o700)


def body_of(number: int, size: int = 4) -> bytes:
    body = codec_of(Scan).encode(scan(number, size), 100_000)
    return body


def bad_frames() -> list[bytes]:
    """Frames that the subscriber must reject."""
    body = body_of(1)
    changes = [{"fingerprint": 1}, {"source": 78}, {"sequence": 2**63}]
    wrong = [make_frame(b"M", **{"sequence": 1} | change, body=body) for change in changes]
    no_slot = make_frame(b"S", 0, b"", size=40, aux=9)
    return [*wrong, make_frame(b"N", 1, body), make_frame(b"N", 2**63, b""), no_slot]


def test_lies_in_a_ring_are_rejected(programs, impostor):
    """Bad frames between good ones, at last none at all: then the socket is used again."""
    peer = Peer([programs / "peer", "count", "/scan", "100", 0, 0])
    key = impostor.await_key()
    assert key[24] & 1
    impostor.take_in(key)
    bad = [*bad_frames(), b"this is no frame" * 10]
    for frame in (
        make_frame(b"M", 0, body_of(0)),
        *bad,
        make_frame(b"M", 1, body_of(1)),
        make_frame(b"M", 2, b"\xff" * 40),  # the codec rejects it
        make_frame(b"M", 3, body_of(3, 20_000)),
        b"",
    ):
        assert impostor.ring.send(frame)
    second = impostor.await_key()  # it attaches anew, without shared memory
    assert second[16:24] != key[16:24]
    assert not second[24] & 1
    impostor.xpub.send(wire.answer_frame(second, wire.AttachAnswer(6, b"")))
    impostor.xpub.send(make_frame(b"M", 6, body_of(6)))
    impostor.xpub.send_multipart([make_frame(b"L", 7, b"", size=len(body_of(7))), body_of(7)])
    impostor.xpub.send(make_frame(b"M", 8, codec_of(Scan).encode(scan(-1, 0), 1000)))
    result = result_of(peer)
    assert result["received"] == 5  # 0, 1, 3, 6, 7
    assert result["wrong"] == 0
    assert result["rejected"] == len(bad) + 1 + 1  # with the body, and the ring
    assert result["lost"] == 2  # 4 and 5
    assert "nothing more comes through its ring" in peer.end()


def test_ring_that_ends(programs, impostor):
    """All that is in it is read, what follows comes through the socket, and nothing is rejected."""
    peer = Peer([programs / "peer", "count", "/scan", "100", 0, 0])
    impostor.take_in(impostor.await_key())
    for number in range(3):
        assert impostor.ring.send(make_frame(b"M", number, body_of(number)))
    impostor.ring.dissolve()
    second = impostor.await_key()
    assert not second[24] & 1
    impostor.xpub.send(wire.answer_frame(second, wire.AttachAnswer(3, b"")))
    impostor.xpub.send_multipart([make_frame(b"L", 3, b"", size=len(body_of(3))), body_of(3)])
    impostor.xpub.send(make_frame(b"M", 4, codec_of(Scan).encode(scan(-1, 0), 1000)))
    result = result_of(peer)
    assert (result["received"], result["wrong"], result["rejected"], result["lost"]) == (4, 0, 0, 0)
    peer.end()


def test_ring_of_a_publisher_that_is_gone_before_its_answer_came(programs, impostor):
    """What is in it is read, and nobody has said that this is all."""
    peer = Peer([programs / "peer", "count", "/scan", "reliable", 0, 0])
    impostor.take_in(impostor.await_key(), answers=False)
    for number in range(3):
        assert impostor.ring.send(make_frame(b"M", number, body_of(number)))
    impostor.leave()
    peer.await_complaint("ended without saying how much it had sent")
    peer.close_input()
    result = result_of(peer)
    assert (result["received"], result["lost"], result["rejected"], result["cut_off"]) == (3, 0, 0, 1)
    peer.end()
