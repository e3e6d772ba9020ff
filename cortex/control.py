"""Shared by the registry and the directories of the nodes: times of their protocol, limits, sockets."""

from __future__ import annotations

import contextlib
import os
from typing import Any

import zmq

from cortex.codec import codec_of
from cortex.context import set_up

HEARTBEAT_NS = 250_000_000
LEASE_NS = 1_000_000_000
STALL_NS = 300_000_000
"""A loop that did not run for longer than this was itself stopped: then it must not judge who was silent."""
NODES_MAX = 1024
RECORD_BYTES_MAX = 4 << 20
TOTAL_BYTES_MAX = 256 << 20
QUEUE_MAX = 4 * NODES_MAX
"""Frames that wait for one node; what exceeds it is dropped, and the node notices by the missing number."""


def control_types(*types: type) -> dict[int, type]:
    """The types that a socket expects, by fingerprint, as `parse_control` wants them."""
    return {codec_of(kind).fingerprint: kind for kind in types}


def make_control_socket(context: zmq.Context[Any], kind: int, *, tcp: bool) -> zmq.Socket[Any]:
    """A DEALER or ROUTER that bounds what waits and what comes; over tcp it notices that its peer is gone."""
    socket: zmq.Socket[Any] = context.socket(kind, socket_class=zmq.Socket)
    socket.set_hwm(QUEUE_MAX)
    set_up(socket, kind, tcp=tcp, linger_ms=200)
    if tcp:
        socket.ipv6 = kind == zmq.DEALER  # who binds decides by its address
        socket.setsockopt(zmq.CONNECT_TIMEOUT, 3000)
    else:
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 0)
    return socket


def sender_of(frame: zmq.Frame) -> str:
    """Who sent a frame: its CURVE key; else `localhost:UID:GID:PID`, or the address of another host."""
    for name in ("User-Id", "Peer-Address"):
        with contextlib.suppress(zmq.ZMQError):
            found = frame.get(name)
            if found:
                return str(found)
    return ""


def watch_process(sender: str) -> int:
    """A descriptor that becomes readable when the process of a sender ends; -1 where there is none."""
    kind, _, rest = sender.partition(":")
    pid = rest.rpartition(":")[2]
    if kind == "localhost" and pid.isdigit() and int(pid):
        with contextlib.suppress(OSError, AttributeError):  # no descriptors left; not Linux
            return os.pidfd_open(int(pid))
    return -1


def try_send(socket: zmq.Socket[Any], frame: bytes) -> bool:
    """Send without waiting; False if the queue is full or nobody is connected."""
    try:
        socket.send(frame, zmq.NOBLOCK)
    except zmq.Again:
        return False
    return True
