"""What a reliable reader reports of a publisher that is gone, by what it has heard of it; Python and C++.

Its publishers speak through a raw socket, and leave without a word besides.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from c_module import needs_native
from cpp_client import Impostor, Peer, make_frame
from cpp_messages import Scan
from cpp_programs import needs_compiler, programs
from peer import take_all
from processes import SOON_S, wait_for

import cortex
from cortex import records, reliable, wire
from cortex.codec import codec_of
from cortex.host import host_id
from cortex.node import Node
from cortex.schema import schema_of

__all__ = ["programs"]

COUNTERS = ("received", "lost", "rejected", "cut_off")


class Case(NamedTuple):
    """One publisher, and what its reader has to count."""

    name: str
    heard: list[str]
    """An answer; messages; what comes next; the end."""
    received: int = 0
    lost: int = 0
    rejected: int = 0
    cut_off: int = 1


CASES = [
    Case("nothing, so that nothing was promised", [], cut_off=0),
    Case("only the answer", ["answer 0"]),
    Case("only a message", ["message 0"], 1),
    Case("what comes next, then silence", ["answer 0", "message 0", "next 1"], 1),
    Case("the end", ["answer 0", "message 0", "end 1"], 1, cut_off=0),
    Case("the end of a stream without messages", ["answer 0", "end 0"], cut_off=0),
    Case("the end twice", ["answer 0", "message 0", "end 1", "end 1"], 1, cut_off=0),
    Case("the end, not what came before", ["answer 0", "message 0", "next 2", "end 3"], 1, 2, cut_off=0),
    Case("a second answer", ["answer 0", "message 0", "next 1", "answer 4"], 1, 3),
    Case("a large message that is none", ["answer 0", "message 0", "end 1", "bad 1"], 1, rejected=1),
]


def message(number: int, source: int) -> bytes:
    """A message of a publisher as a frame."""
    body = codec_of(Scan).encode(Scan(number, np.full(2, number, np.float32)), 1000)
    return make_frame(b"M", number, body, source=source)


class Leavers(Impostor):
    """A publisher for each case, on the topic `/cut0` or `/cut1`, as its stream is cut off or not."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.router.bind("tcp://127.0.0.1:*")
        self.tcp_registry = self.router.last_endpoint.decode()
        schema, data = schema_of(Scan), f"ipc://{directory}/data.strict"
        self.xpub.bind(data)
        publishers = [
            records.PublisherRecord(
                f"/cut{case.cut_off}", 100 + index, schema.name, schema.fingerprint, schema.to_json(), False
            )
            for index, case in enumerate(CASES)
        ]
        endpoint = records.Endpoint("ipc", data, data, "", "")
        record = records.NodeRecord(5, "leavers", host_id(), 1, 1, 0, [endpoint], publishers, [], [])
        self.record = wire.control_frame(records.Changed(1, record))

    def speak(self) -> None:
        """Say to each reader what its case is to hear."""
        for _ in CASES:
            key = self.await_key()
            assert key[24] & 2  # it is reliable
            source = int.from_bytes(key[8:16], "little")
            for heard in CASES[source - 100].heard:
                self._say(heard, key, source)

    def _say(self, heard: str, key: bytes, source: int) -> None:
        what, _, text = heard.rpartition(" ")
        number = int(text)
        if what == "answer":
            self.xpub.send(wire.answer_frame(key, wire.AttachAnswer(number, b"")))
        elif what == "message":
            self.xpub.send(message(number, source))
        elif what == "bad":
            self.xpub.send_multipart([make_frame(b"L", number, b"", size=9, source=source), b"short"])
        else:
            self.xpub.send(make_frame(b"N", number, b"", aux=int(what == "end"), source=source))


@pytest.fixture
def leavers(runtime):
    impostor = Leavers(runtime)
    yield impostor
    impostor.close()
    shutil.rmtree(runtime, ignore_errors=True)
    runtime.mkdir(mode=0o700)


def expected(cut_off: int) -> dict[str, int]:
    """What the reader of a topic counts in all."""
    cases = [case for case in CASES if case.cut_off == cut_off]
    return {name: sum(getattr(case, name) for case in cases) for name in COUNTERS}


def test_python_reports_what_it_has_not_heard_the_end_of(leavers):
    with Node("reader", registry=leavers.tcp_registry) as node:
        readers = [node.subscriber(f"/cut{number}", Scan, policy=reliable()) for number in (0, 1)]
        leavers.speak()
        leavers.leave()
        for number, reader in enumerate(readers):

            def counted(reader: Any = reader) -> dict[str, int]:
                take_all(reader)
                return {name: getattr(reader.counters, name) for name in COUNTERS}

            wait_for(lambda number=number, counted=counted: counted() == expected(number))
            wait_for(lambda reader=reader: not reader.sources() and not reader.carriers)
            assert counted() == expected(number)
            assert reader.stats().cut_off == reader.counters.cut_off


@needs_compiler
def test_cpp_reports_what_it_has_not_heard_the_end_of(programs, leavers, monkeypatch):
    monkeypatch.setenv("CORTEX_TEST_REGISTRY", leavers.registry)
    peers = [Peer([programs / "peer", "count", f"/cut{number}", "reliable", 0, 0]) for number in (0, 1)]
    leavers.speak()
    leavers.leave()
    peers[1].await_complaint("ended without saying how much it had sent")
    time.sleep(0.5)  # for the other, which has nothing to say
    for number, peer in enumerate(peers):
        peer.close_input()
        counted = json.loads(peer.line())
        assert {name: counted[name] for name in COUNTERS} == expected(number), number
        peer.end()


@pytest.mark.parametrize("language", ["Python", pytest.param("C++", marks=needs_compiler)])
def test_a_lossy_reader_confirms_the_end(request, leavers, monkeypatch, language):
    """Else it is said once, and what the queue had no room for before it is counted by nobody."""
    with contextlib.ExitStack() as ends:
        if language == "C++":
            monkeypatch.setenv("CORTEX_TEST_REGISTRY", leavers.registry)
            program = request.getfixturevalue("programs") / "peer"
            peer = Peer([program, "count", "/cut0", 8, 0, 0])
            ends.callback(peer.end)
        else:
            node = ends.enter_context(Node("reader", registry=leavers.tcp_registry))
            node.subscriber("/cut0", Scan, policy=cortex.keep_last(8))
        key = leavers.await_key()
        assert not key[24] & 2
        source = int.from_bytes(key[8:16], "little")
        leavers._say("answer 0", key, source)
        leavers._say("end 3", key, source)
        await_confirmed(leavers, source, 4)


def await_confirmed(leavers: Leavers, source: int, sequence: int) -> None:
    """Wait until a reader has accounted for all below a sequence."""
    confirmed: tuple[int, ...] | None = None
    while confirmed is None or (confirmed[0], confirmed[2]) != (source, sequence):
        assert leavers.xpub.poll(1e3 * SOON_S)
        confirmed = wire.parse_resume_key(leavers.xpub.recv()[1:])


@pytest.mark.parametrize("language", ["Python", pytest.param("C++", marks=needs_compiler)])
@needs_native
def test_what_went_through_a_ring_that_cannot_be_mapped_is_lost(
    request, runtime, leavers, monkeypatch, language
):
    """Messages 5 to 8 did; the last of them is latched, and comes with the second answer."""
    with contextlib.ExitStack() as ends:
        listener = ends.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        listener.bind(str(runtime / "data.ring"))
        listener.listen(len(CASES))
        listener.settimeout(SOON_S)
        if language == "C++":
            monkeypatch.setenv("CORTEX_TEST_REGISTRY", leavers.registry)
            peer = Peer([request.getfixturevalue("programs") / "peer", "count", "/cut0", "reliable", 0, 0])
        else:
            node = ends.enter_context(Node("reader", registry=leavers.tcp_registry))
            subscriber = node.subscriber("/cut0", Scan, policy=reliable(64, SOON_S))
        key, hello = leavers.await_key(), b""
        source = int.from_bytes(key[8:16], "little")
        while hello[8:] != key[8:24]:
            connection = ends.enter_context(listener.accept()[0])
            hello, fds, *_ = socket.recv_fds(connection, 100, 2)
            for fd in fds:
                os.close(fd)
        memory = os.memfd_create("no ring")
        socket.send_fds(connection, [bytes(56)], [memory])
        os.close(memory)
        leavers._say("answer 5", key, source)
        first = key
        while key[8:16] != first[8:16] or key[24] & 1:
            key = leavers.await_key()
        leavers.xpub.send(wire.answer_frame(key, wire.AttachAnswer(9, message(8, source))))
        leavers._say("message 9", key, source)
        leavers._say("end 10", key, source)
        if language == "C++":
            await_confirmed(leavers, source, 11)
            time.sleep(0.2)
            peer.close_input()
            counted = json.loads(peer.line())
            peer.end()
        else:
            assert [subscriber.recv(SOON_S).stamp_ns for _ in range(2)] == [8, 9]
            wait_for(lambda: subscriber.sources()[source] == 10)
            counted = {name: getattr(subscriber.counters, name) for name in COUNTERS}
    assert {name: counted[name] for name in COUNTERS} == dict(zip(COUNTERS, (2, 3, 0, 0), strict=True))
