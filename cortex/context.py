"""The process's ZeroMQ context, and how its sockets are set up."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import zmq

from cortex.compiled import native
from cortex.wire import BODY_LIMIT, CONTROL_LIMIT, HEADER_SIZE

_C = TypeVar("_C", bound="Closing")
_lock = threading.Lock()
_context: zmq.Context[zmq.Socket[bytes]] | None = None
_owner = 0

LINGER_MS = 1000
"""How long a closed socket goes on sending what is queued."""
HEARTBEAT_MS = 500
"""Interval of ZMTP heartbeats over tcp; a peer silent for four of them is disconnected."""
MAX_SOCKETS = 8192
_FRAME_ROOM = 4096
"""For what a frame holds besides header and body: CURVE, the places of rings in an attach answer [bytes]."""
_FRAME_MAX: dict[int, int] = {
    zmq.XPUB: 1024,  # a subscription has at most 33 bytes, the handshake of CURVE some 300
    zmq.SUB: BODY_LIMIT + HEADER_SIZE + _FRAME_ROOM,
    zmq.DEALER: CONTROL_LIMIT + HEADER_SIZE + _FRAME_ROOM,
    zmq.ROUTER: CONTROL_LIMIT + HEADER_SIZE + _FRAME_ROOM,
}
"""Largest frame that each kind of socket takes in [bytes]; who sends a larger one is disconnected."""


class Closed(RuntimeError):
    """The publisher, subscriber, client or node was closed."""


class Closing(ABC):
    """What closes at the end of a `with` block."""

    @abstractmethod
    def close(self) -> None:
        """Close it."""

    def __enter__(self: _C) -> _C:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def context() -> zmq.Context[zmq.Socket[bytes]]:
    """The one context of this process. A forked child gets its own."""
    global _context, _owner
    with _lock:
        if _context is None or _owner != os.getpid():
            _context, _owner = zmq.Context(), os.getpid()
            _context.set(zmq.MAX_SOCKETS, MAX_SOCKETS)
        return _context


def new_socket(kind: int, *, tcp: bool = False, high_water_mark: int = 1000) -> zmq.Socket[bytes]:
    """A socket of this process that bounds what waits and what comes, and never blocks its owner at close."""
    socket = context().socket(kind)
    socket.rcvhwm = high_water_mark  # that for sending, which also holds a SUB's subscriptions, stays 1000
    set_up(socket, kind, tcp=tcp, linger_ms=LINGER_MS)
    socket.setsockopt(zmq.IPV6, int(tcp))
    return socket


def set_up(socket: zmq.Socket[Any], kind: int, *, tcp: bool, linger_ms: int) -> None:
    """Set what all sockets have in common.

    There are no heartbeats on ipc: the kernel reports a dead peer at once, and a stopped one may
    still hold leases of shared memory.
    """
    socket.linger = linger_ms
    socket.setsockopt(zmq.MAXMSGSIZE, _FRAME_MAX[kind])
    socket.setsockopt(zmq.RECONNECT_IVL, 20)
    socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
    if tcp:
        socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 4 * HEARTBEAT_MS)
        socket.setsockopt(zmq.HEARTBEAT_TTL, 4 * HEARTBEAT_MS)
        socket.setsockopt(zmq.TCP_KEEPALIVE, 1)


class Frames:
    """Single frames through a socket, at the least cost. Not for several threads at once.

    pyzmq's own `send` spends half of its time on checking arguments that we never pass, and an empty socket
    costs it an exception; `_socket.c` calls libzmq directly, where it can.
    """

    send: Callable[..., Any]
    """Takes a frame as bytes, and flags; raises zmq.Again."""
    receive: Callable[[int], bytes]
    """Takes flags; raises zmq.Again."""

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._direct: Any = None
        library = sys.modules.get("zmq.backend.cython._zmq")  # not there: another backend
        with contextlib.suppress(AttributeError, OSError):  # a static libzmq, say
            if native is not None and library is not None:
                self._direct = native.Socket(socket.underlying, library.__file__, zmq.Again, zmq.ZMQError)
        plain: Any = super(zmq.Socket, socket)
        self.send = plain.send if self._direct is None else self._direct.send
        self.receive = plain.recv if self._direct is None else self._direct.receive

    def close(self) -> None:
        """Use the socket no more."""
        if self._direct is not None:
            self._direct.close()
