"""Nodes, registries and frames for the tests of discovery."""

from __future__ import annotations

import contextlib
import dataclasses
import secrets
import time

import pytest
import zmq
from processes import SOON_S, Beside

from cortex.control import LEASE_NS, control_types, make_control_socket
from cortex.discovery import Directory
from cortex.host import REGISTRY_LOCK, REGISTRY_SOCKET, FileLock, runtime_dir
from cortex.records import (
    Alive,
    Changed,
    Gone,
    Heartbeat,
    Hello,
    Leave,
    NodeRecord,
    PublisherRecord,
    Refused,
    Welcome,
)
from cortex.registry import Registry
from cortex.wire import parse_control

LEASE_S = LEASE_NS / 1e9


def registry_pid(domain: int = 0) -> int | None:
    """The process that holds the registry's lock, if any does."""
    path = runtime_dir(domain) / REGISTRY_LOCK
    lock = FileLock.acquire(path)
    if lock is not None:
        lock.close()
        return None
    text = path.read_text()
    return int(text) if text else None


def make_record(name: str, **changes) -> NodeRecord:
    node = secrets.randbits(64) | 1
    return dataclasses.replace(NodeRecord(node, name, "host", 1, 1, 0, [], [], [], []), **changes)


def publisher(topic: str, schema: str = "{}") -> PublisherRecord:
    return PublisherRecord(topic, 1, "T", 2, schema, False)


class Node:
    """A directory that is driven by `drive` in the test's thread."""

    def __init__(self, context, name, **options):
        self.record = make_record(name)
        self.changes: list[frozenset[int]] = []
        self.ever_lost: set[int] = set()
        self.directory = Directory(
            context, domain=0, record=lambda: self.record, on_change=self._on_change, **options
        )
        registered = options.get("registry") != "off"
        # The sign of life of a node whose process lives: it is given time when this process stands still.
        self._lock = FileLock.acquire(runtime_dir(0) / f"{self.id:016x}.lock") if registered else None

    def _on_change(self, changed):
        self.changes.append(changed)
        self.ever_lost |= {node for node in changed if node not in self.directory.nodes}

    @property
    def id(self):
        return self.record.node

    @property
    def names(self):
        return sorted(record.name for record in self.directory.nodes.values())

    def close(self):
        self.directory.close()
        if self._lock is not None:
            self._lock.close(remove=True)
            self._lock = None


def drive(nodes, condition, timeout_s=SOON_S):
    """Let the nodes work until a condition holds."""
    poller = zmq.Poller()
    owner = {}
    for node in nodes:
        if node.directory.socket is not None:
            poller.register(node.directory.socket, zmq.POLLIN)
            owner[node.directory.socket] = node
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, [(n.record.name, n.names, n.directory.connected) for n in nodes]
        for socket, _ in poller.poll(2):
            owner[socket].directory.handle()
        for node in nodes:
            node.directory.tick()


def drive_for(nodes, seconds):
    end = time.monotonic() + seconds
    drive(nodes, lambda: time.monotonic() >= end, seconds + SOON_S)


@pytest.fixture
def context():
    """For sockets of the test."""
    with zmq.Context() as made:
        made.linger = 0
        yield made


@pytest.fixture
def make(runtime, context):
    """Makes nodes, and closes them."""
    with contextlib.ExitStack() as stack:

        def make_node(name, **options):
            node = Node(context, name, **options)
            stack.callback(node.close)
            return node

        yield make_node


@contextlib.contextmanager
def serving(domain=0, **options):
    """A registry in a thread."""
    registry = Registry(domain, **options)
    serving = Beside(registry.run)
    try:
        yield registry
    finally:
        registry.stop()
        serving.join()
        registry.close()


def dealer(context):
    socket = context.socket(zmq.DEALER)
    socket.connect(f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}")
    return socket


TYPES = control_types(Alive, Changed, Gone, Heartbeat, Hello, Leave, Refused, Welcome)


def receive(socket, timeout_ms=1e3 * SOON_S):
    assert socket.poll(timeout_ms), "no answer"
    return parse_control(socket.recv(), TYPES)[0]


def answers_unknown(socket):
    """Whether the registry has answered the heartbeat of a node that it does not know."""
    with contextlib.suppress(zmq.Again):
        while True:
            frame = socket.recv(zmq.NOBLOCK)
            message = parse_control(frame, TYPES)[0]
            if isinstance(message, Alive) and message.held == 0:
                return True
    return False


def fake_registry(context):
    socket = make_control_socket(context, zmq.ROUTER, tcp=False)
    socket.bind(f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}")
    return socket
