"""Raw pyzmq, written by a careful hand: what a library on top of it is measured against.

Each message is 64 bytes of header (sequence, stamp, room) and the payload; the receiver gets a NumPy view.
XPUB_NODROP and bounded queues make the publisher wait instead of losing anything.
"""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import zmq

from cortex.bench.age import Ages
from cortex.bench.job import PATIENCE_S, PONG_FLOATS, Job, Sender
from cortex.bench.tally import END, Finished, Floats, Handler, Tally, make_payloads

_HEADER = struct.Struct("<qq48x")
_HEADER_BYTES = _HEADER.size
_F32 = np.dtype(np.float32)
_VIEW: Any = np.ndarray


def sender(job: Job) -> Sender:
    """Bind a publisher as the job's options ``frames`` (1 or 2) and ``tcp`` say."""
    return _Sender(job)


class _Sender:
    def __init__(self, job: Job) -> None:
        self._context = zmq.Context()
        self._socket, self.address = _bind(self._context, zmq.PUB, job, "data")
        self.send = _send_function(self._socket, job)

    def report(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        self._socket.close(0)
        self._context.term()


def receive(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Count the messages of one flood in a blocking loop."""
    tally = Tally(job.floats, connected=connected, finish=_raise_finished, settle_at=job.count // 10)
    handle = tally.copying_handler() if job.options.get("consume") else tally.handler()
    context = zmq.Context()
    socket = _connect(context, zmq.SUB, job, job.address["data"])
    try:
        with contextlib.suppress(Finished):
            count = _count_one if job.options.get("frames", 1) == 1 else _count_two
            count(socket, handle, (job.floats,))
    finally:
        socket.close(0)
        context.term()
    return tally.report()


def _count_one(socket: zmq.Socket[Any], handle: Handler, shape: tuple[int, ...]) -> None:
    recv, unpack, view, dtype = socket.recv, _HEADER.unpack_from, _VIEW, _F32
    while True:
        frame = recv()
        handle(unpack(frame)[0], view(shape, dtype, frame, _HEADER_BYTES))


def _count_two(socket: zmq.Socket[Any], handle: Handler, shape: tuple[int, ...]) -> None:
    recv, unpack, view, dtype = socket.recv, _HEADER.unpack_from, _VIEW, _F32
    while True:
        header = recv()
        handle(unpack(header)[0], view(shape, dtype, recv(copy=False)))


def client(job: Job) -> Client:
    """Bind both ways of a round trip."""
    return Client(job)


class Client:
    """Sends the payload; waits for 40 bytes."""

    def __init__(self, job: Job) -> None:
        self._context = zmq.Context()
        self._ping, ping = _bind(self._context, zmq.PUB, job, "ping")
        self._pong, pong = _bind(self._context, zmq.SUB, job, "pong")
        self.address: Mapping[str, Any] = {**ping, **pong}
        self._send = _send_function(self._ping, job)
        self._job = job

    def ping(self, sequence: int, data: Floats, timeout_s: float) -> bool:
        """Send one message and wait for its answer."""
        self._send(sequence, data)
        if timeout_s < PATIENCE_S and not self._pong.poll(int(timeout_s * 1000)):
            return False
        receive_pong = self._pong.recv
        while True:
            frame = receive_pong()
            answered, _ = _HEADER.unpack_from(frame)
            np.ndarray((PONG_FLOATS,), _F32, frame, _HEADER_BYTES)
            if answered == sequence:
                return True

    def close(self) -> None:
        """End the server and close."""
        self._send(END, make_payloads(self._job.floats)[0])
        self._ping.close(1000)
        self._pong.close(0)
        self._context.term()


def serve(job: Job) -> None:
    """Answer each message with 40 bytes."""
    context = zmq.Context()
    ping = _connect(context, zmq.SUB, job, job.address["ping"])
    pong = _connect(context, zmq.PUB, job, job.address["pong"])
    take = _receive_function(ping, job)
    answer = make_payloads(PONG_FLOATS)[0]
    try:
        while True:
            sequence, _ = take()
            if sequence == END:
                return
            pong.send(_HEADER.pack(sequence, time.monotonic_ns()) + answer.tobytes())
    finally:
        ping.close(0)
        pong.close(0)
        context.term()


def _raise_finished() -> None:
    raise Finished


def _bind(
    context: zmq.Context[Any], kind: int, job: Job, name: str
) -> tuple[zmq.Socket[Any], Mapping[str, Any]]:
    socket: zmq.Socket[Any] = context.socket(kind)
    _prepare(socket, kind, job)
    if job.options.get("tcp"):
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        return socket, {name: f"tcp://127.0.0.1:{port}"}
    endpoint = f"ipc://{job.folder}/{name}"
    socket.bind(endpoint)
    return socket, {name: endpoint}


def _connect(context: zmq.Context[Any], kind: int, job: Job, endpoint: str) -> zmq.Socket[Any]:
    socket: zmq.Socket[Any] = context.socket(kind)
    _prepare(socket, kind, job)
    socket.connect(endpoint)
    return socket


def _prepare(socket: zmq.Socket[Any], kind: int, job: Job) -> None:
    socket.linger = 0
    socket.sndhwm = socket.rcvhwm = job.depth
    socket.sndtimeo = socket.rcvtimeo = int(PATIENCE_S * 1000)
    socket.copy_threshold = 0  # two frames "without copy" means it, also for small payloads
    if kind == zmq.SUB:
        socket.subscribe(b"")
    else:
        socket.setsockopt(zmq.XPUB_NODROP, 1)


def _send_function(socket: zmq.Socket[Any], job: Job) -> Callable[[int, Floats], None]:
    send: Callable[..., Any] = socket.send
    pack = _HEADER.pack
    now = time.monotonic_ns
    if job.options.get("frames", 1) == 1:

        def send_one(sequence: int, data: Floats) -> None:
            send(pack(sequence, now()) + data.tobytes())

        return send_one

    more = zmq.SNDMORE

    def send_two(sequence: int, data: Floats) -> None:
        send(pack(sequence, now()), more)
        send(data, copy=False)

    return send_two


def _receive_function(socket: zmq.Socket[Any], job: Job) -> Callable[[], tuple[int, Floats]]:
    recv = socket.recv
    unpack = _HEADER.unpack_from
    view = _VIEW
    shape = (job.floats,)
    if job.options.get("frames", 1) == 1:

        def take_one() -> tuple[int, Floats]:
            frame = recv()
            sequence, _ = unpack(frame)
            return sequence, view(shape, _F32, frame, _HEADER_BYTES)

        return take_one

    def take_two() -> tuple[int, Floats]:
        sequence, _ = unpack(recv())
        return sequence, view(shape, _F32, recv(copy=False))

    return take_two


def receive_latest(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Take only the newest message (ZMQ_CONFLATE), work on it, and return its age at each use [ns]."""
    ages = Ages(job, connected)
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.CONFLATE, 1)
    socket.rcvtimeo = int(PATIENCE_S * 1000)
    socket.subscribe(b"")
    socket.connect(job.address["data"])
    try:
        while not ages.done:
            frame = socket.recv()
            sequence, stamp_ns = _HEADER.unpack_from(frame)
            ages.use(sequence, stamp_ns)
        return ages.report()
    finally:
        socket.close(0)
        context.term()
