"""What the tests of the C++ client talk to and with: its test program, rich messages, a node that lies."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from cpp_messages import Mode, Point, Rich, Scan
from processes import SOON_S, Beside, Lines

from cortex import records, wire
from cortex.host import host_id
from cortex.node import Node
from cortex.schema import schema_of


class Peer(Lines):
    """A running `peer` program."""

    def __init__(self, command: Sequence[object]) -> None:
        words, pipe = [str(part) for part in command], subprocess.PIPE
        super().__init__(subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0), "C++")
        try:
            assert self.line() == "ready"
        except BaseException:
            self.process.kill()
            self.process.communicate()
            raise

    def await_complaint(self, text: str) -> None:
        """Wait until it writes this to standard error, which `end` returns no more then."""
        said = ""
        while text not in said:
            more = self.errors(SOON_S)
            assert more, said
            said += more

    def close_input(self) -> None:
        """Have it say what it has counted, and end."""
        self.process.stdin.close()
        self.process.stdin = None

    def end(self) -> str:
        """Close its input, wait, and return what it wrote to standard error."""
        try:
            _, errors = self.process.communicate(timeout=SOON_S)
        finally:
            self.process.kill()
            self.process.wait()
        assert self.process.returncode in (0, -9), (self.process.returncode, errors)
        return errors.decode()


def _stats_of_cpp(node: Node) -> list[records.StatsReply]:
    """What those C++ programs have counted that answer soon: one may be about to leave."""
    replies = []
    for record in node.nodes():
        if record.name == "cpp":
            with contextlib.suppress(KeyError, TimeoutError):
                replies.append(node.ask_stats(record.node))
    return replies


def publishers_in_cpp(node: Node) -> list[records.PublisherStats]:
    """The counters of all publishers in C++ programs that answer soon."""
    return [found for reply in _stats_of_cpp(node) for found in reply.publishers]


def subscribers_in_cpp(node: Node) -> list[records.SubscriberStats]:
    """The counters of all subscribers in C++ programs that answer soon."""
    return [found for reply in _stats_of_cpp(node) for found in reply.subscribers]


def _point(number: int) -> Point:
    return Point(number / 4, f"point {number} " + "ü" * number, np.arange(number, dtype=np.float64))


def make_rich(number: int, height: int, width: int) -> Rich:
    rng = np.random.default_rng(number)
    return Rich(
        stamp_ns=number,
        truth=number % 2 == 1,
        tiny=-128,
        small=65535,
        middle=-(2**31),
        large=2**64 - 1,
        real=-0.1,
        text="grüß 🚀" * number,
        data=bytes(range(256)) * (number % 3),
        mode=Mode.ACTIVE,
        class_=-(2**63),
        default=255,
        point=_point(3),
        maybe=None if number % 2 else 1e300,
        maybe_point=_point(number) if number % 2 else None,
        maybe_mode=Mode.NULL if number % 2 else None,
        numbers=list(range(-number, number)),
        truths=[True, False] * number,
        words=["", "a", "long enough to leave the object of std::string"] * number,
        points=[_point(k) for k in range(number)],
        modes=[Mode.IDLE, Mode.ACTIVE] * number,
        ragged=[np.arange(k, dtype=np.uint32) for k in range(number)],
        pose=rng.standard_normal((3, 4)),
        flags=np.array([True, False, True, True, False]),
        plane=rng.standard_normal((16, 32)).astype(np.float32),
        image=rng.integers(0, 255, (height, width, 3), np.uint8),
        depth=rng.standard_normal((height, width)).astype(np.float16),
        waves=rng.standard_normal(number) + 1j,
        anything=rng.integers(-9, 9, (number, 2)).astype((np.int16, np.float64, np.complex64)[number % 3]),
    )


class Impostor:
    """A registry and its only node, which speak through raw sockets, so that they can say anything."""

    SOURCE = 77

    def __init__(self, directory: Path) -> None:
        self.context = zmq.Context()
        self.router = self.context.socket(zmq.ROUTER)
        self.xpub = self.context.socket(zmq.XPUB)
        self.registry = f"ipc://{directory}/liar"
        data = f"ipc://{directory}/data"
        self.router.bind(self.registry)
        self.xpub.bind(data)
        endpoint = records.Endpoint("ipc", data, data, "", "")
        schema = schema_of(Scan)
        publisher = records.PublisherRecord(
            "/scan", self.SOURCE, schema.name, schema.fingerprint, schema.to_json(), False
        )
        record = records.NodeRecord(5, "impostor", host_id(), 1, 1, 0, [endpoint], [publisher], [], [])
        self.welcome = wire.control_frame(records.Welcome(1, 1, [record.node], [record.revision]))
        self.record = wire.control_frame(records.Changed(1, record))
        self.stopping = False
        self._answering = Beside(self._answer)

    def _answer(self) -> None:
        """Say who we are, between frames of nonsense, to whoever asks."""
        while not self.stopping:
            if not self.router.poll(20):
                continue
            identity, *_ = self.router.recv_multipart()
            for frame in (b"", b"CTX", self.record[:-3], self.welcome, self.record, b"\xff" * 200):
                self.router.send_multipart([identity, frame])

    def await_key(self) -> bytes:
        """The attach key of the subscriber."""
        while True:
            assert self.xpub.poll(1e3 * 60.0)
            event = self.xpub.recv()
            if event[:5] == b"\x01CTXA":
                return bytes(event[1:])

    def leave(self) -> None:
        """Be gone."""
        self.welcome = wire.control_frame(records.Welcome(1, 2, [], []))
        self.record = wire.control_frame(records.Gone(2, 5, ""))

    def close(self) -> None:
        self.stopping = True
        self._answering.join()
        self.context.destroy(linger=0)


def make_frame(
    kind: bytes, sequence: int, body: bytes, *, size: int | None = None, aux: int = 0, **change: Any
) -> bytes:
    header = wire.Header(
        kind,
        Impostor.SOURCE,
        schema_of(Scan).fingerprint,
        sequence,
        0,
        0,
        len(body) if size is None else size,
        aux,
    )
    return wire.pack_header(header._replace(**change)) + body


def bad_frames(good: bytes, key: bytes) -> Iterator[list[bytes]]:
    """Frames of every kind that a subscriber must reject; all of them match its subscriptions."""
    head = good[:16]
    yield [head]
    yield [good[:63]]
    yield [good[:-1]]
    yield [good + b"x"]
    yield [make_frame(b"M", 9, good[64:], fingerprint=1)]
    yield [make_frame(b"M", 9, good[64:], size=2**63)]
    yield [make_frame(b"L", 9, b"", size=40)]
    yield [make_frame(b"L", 9, b"", size=41), good[64:]]
    yield [make_frame(b"L", 9, b"", size=2**40), good[64:]]
    yield [make_frame(b"N", 9, b"a body")]
    yield [make_frame(b"N", 9, b"a body", size=0)]
    yield [key + bytes(31)]
    yield [key + wire._ANSWER.pack(0, 0, 2**64 - 1, 0)]
