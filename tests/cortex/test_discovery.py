"""The registry and the directories: who sees whom, when, and what survives whose death."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import random
import secrets
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from cortex.codec import MalformedMessage
from cortex.control import HEARTBEAT_NS, LEASE_NS, control_types, make_control_socket
from cortex.discovery import Directory, main
from cortex.host import REGISTRY_LOCK, REGISTRY_LOG, REGISTRY_SOCKET, FileLock, NodeFiles, runtime_dir
from cortex.records import (
    Alive,
    Changed,
    Describe,
    Endpoint,
    Gone,
    Heartbeat,
    Hello,
    Leave,
    NodeRecord,
    PublisherRecord,
    Refused,
    Welcome,
    check_record,
)
from cortex.registry import Registry, RegistryRunning, ensure_registry
from cortex.wire import HEADER_SIZE, control_frame, parse_control

ROOT = Path(__file__).resolve().parents[2]
NODE = Path(__file__).with_name("discovery_node.py")
SOON_S = 10.0
"""Deadline of things that take milliseconds, on a machine that does a lot besides."""
LEASE_S = LEASE_NS / 1e9


@pytest.fixture(autouse=True)
def base(monkeypatch) -> Iterator[Path]:
    """A runtime directory for the test; whatever serves in it is ended with it."""
    path = Path(tempfile.mkdtemp(prefix="cortex-test-"))
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", str(path))
    yield path
    pid = registry_pid()
    if pid is not None:
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: registry_pid() is None)
    shutil.rmtree(path)


def wait_for(condition: Callable[[], object], timeout_s: float = SOON_S) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come true in time"
        time.sleep(0.005)


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
    """A directory, and a ROUTER that answers as a node's does; driven by `drive` in the test's thread."""

    def __init__(self, context, name, *, router=False, **options):
        self.record = make_record(name)
        self.changes: list[frozenset[int]] = []
        self.ever_lost: set[int] = set()
        self.directory = Directory(
            context,
            domain=0,
            record=lambda: self.record,
            on_change=self._on_change,
            **options,
        )
        self.router = context.socket(zmq.ROUTER) if router else None
        self.address = ""
        if self.router is not None:
            self.router.bind("tcp://127.0.0.1:*")
            self.address = self.router.getsockopt_string(zmq.LAST_ENDPOINT)

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
        if self.router is not None:
            self.router.close()


def drive(nodes, condition, timeout_s=SOON_S):
    """Let the nodes work until a condition holds."""
    poller = zmq.Poller()
    owner = {}
    for node in nodes:
        for socket in [*node.directory.sockets(), *([node.router] if node.router else [])]:
            poller.register(socket, zmq.POLLIN)
            owner[socket] = node
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, [(n.record.name, n.names, n.directory.connected) for n in nodes]
        next_ns = min((node.directory.deadline_ns for node in nodes), default=0)
        wait_ms = (next_ns - time.monotonic_ns()) // 1_000_000
        for socket, _ in poller.poll(min(max(wait_ms, 0), 20)):
            node = owner[socket]
            if socket is node.router:
                identity, frame = socket.recv_multipart()
                answer = node.directory.answer(frame)
                if answer is not None:
                    socket.send_multipart([identity, answer])
            else:
                node.directory.handle(socket)
        for node in nodes:
            node.directory.tick()


def drive_for(nodes, seconds):
    end = time.monotonic() + seconds
    drive(nodes, lambda: time.monotonic() >= end, seconds + SOON_S)


@pytest.fixture
def context():
    with zmq.Context() as made:
        made.linger = 0
        yield made


@pytest.fixture
def make(context):
    """Makes nodes, and closes them."""
    with contextlib.ExitStack() as stack:

        def make_node(name, **options):
            node = Node(context, name, **options)
            stack.callback(node.close)
            return node

        yield make_node


@contextlib.contextmanager
def serving(**options):
    """A registry in a thread."""
    registry = Registry(0, **options)
    thread = threading.Thread(target=registry.run)
    thread.start()
    try:
        yield registry
    finally:
        registry.stop()
        thread.join(10)
        assert not thread.is_alive()
        registry.close()


@contextlib.contextmanager
def node_process(name, **options):
    """A node in a process of its own."""
    arguments = [sys.executable, str(NODE), json.dumps({"name": name, **options})]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    # No buffer: what lies in one, `select` does not see.
    process = subprocess.Popen(arguments, env=environment, stdin=pipe, stdout=pipe, bufsize=0)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGCONT)
        process.stdin.close()
        try:
            process.wait(10)
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


def read_until(process, condition, timeout_s=SOON_S):
    """Read what a node process prints until a line satisfies the condition, and return it."""
    deadline = time.monotonic() + timeout_s
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while selector.select(max(deadline - time.monotonic(), 0)):
            line = process.stdout.readline()
            assert line, "the node has ended"
            seen = json.loads(line)
            if "names" in seen and condition(seen):
                return seen
    raise AssertionError("the node did not print what was expected in time")


# Seeing each other


def test_two_nodes_see_each_other_change_and_leave(make):
    one, two = make("one"), make("two")
    drive([one, two], lambda: one.names == ["two"] and two.names == ["one"])
    assert one.directory.nodes[two.id] == dataclasses.replace(two.record, revision=1)
    assert one.changes == [frozenset({two.id})]
    two.record = dataclasses.replace(two.record, publishers=[publisher("/scan")])
    two.directory.announce()
    drive([one, two], lambda: one.directory.nodes[two.id].publishers)
    assert one.directory.nodes[two.id] == dataclasses.replace(two.record, revision=2)
    two.close()
    drive(
        [one], lambda: not one.directory.nodes, timeout_s=LEASE_S * 0.9
    )  # it says so, no lease has to run out
    assert one.changes == [frozenset({two.id})] * 3


def test_changes_made_together_travel_together(make):
    one, two = make("one"), make("two")
    drive([one, two], lambda: one.names and two.names)
    begin = time.monotonic()
    for index in range(200):
        publishers = [publisher(f"/topic_{k}") for k in range(index + 1)]
        two.record = dataclasses.replace(two.record, publishers=publishers)
        two.directory.announce()
        two.directory.tick()
    drive([one, two], lambda: len(one.directory.nodes[two.id].publishers) == 200)
    assert one.directory.nodes[two.id].revision <= 3 + (time.monotonic() - begin) / 0.01


def test_two_hundred_topics_with_large_schemas(make):
    one, two = make("one"), make("two")
    schema = "x" * 5000
    two.record = dataclasses.replace(two.record, publishers=[publisher(f"/t{k}", schema) for k in range(200)])
    two.directory.announce()
    drive([one, two], lambda: one.names and len(one.directory.nodes[two.id].publishers) == 200)
    assert one.directory.nodes[two.id].publishers == two.record.publishers


def test_fifty_nodes_see_each_other(make):
    nodes = [make(f"node {k:02}") for k in range(50)]
    drive(nodes, lambda: all(len(node.directory.nodes) == 49 for node in nodes), timeout_s=30)
    drive_for(nodes, 2.2 * LEASE_S)  # and go on doing so
    assert all(len(node.directory.nodes) == 49 and not node.ever_lost for node in nodes)
    for node in nodes[1:]:
        node.close()
    drive(nodes[:1], lambda: not nodes[0].directory.nodes)


def test_a_node_that_is_started_before_the_registry(make, base):
    address = f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}"
    early = [make("one", registry=address), make("two", registry=address)]
    drive_for(early, 0.3)
    assert not early[0].directory.connected
    with serving():
        drive(early, lambda: early[0].names == ["two"] and early[1].names == ["one"], timeout_s=1.0)


def test_domains_are_apart(make, context):
    one = make("one")
    record = make_record("other")
    other = Directory(context, domain=1, record=lambda: record)
    try:
        drive([one], lambda: one.directory.connected)
        deadline = time.monotonic() + SOON_S
        while not other.connected:
            assert time.monotonic() < deadline
            other.tick()
            other.handle(other.sockets()[0])
            time.sleep(0.005)
        drive_for([one], 0.3)
        assert not one.directory.nodes
        assert not other.nodes
    finally:
        other.close()
        os.kill(registry_pid(1), signal.SIGTERM)
        wait_for(lambda: registry_pid(1) is None)


# Death


def test_a_killed_registry_is_replaced_within_a_second(make):
    """Nodes start another, register by themselves, and meanwhile nobody is forgotten."""
    nodes = [make(f"node {k}") for k in range(5)]
    drive(nodes, lambda: all(len(node.directory.nodes) == 4 for node in nodes))
    for _ in range(3):
        old = registry_pid()
        os.kill(old, signal.SIGKILL)
        killed = time.monotonic()
        drive(nodes, lambda old=old: registry_pid() not in (None, old))
        newcomer = make("newcomer")
        drive([*nodes, newcomer], lambda newcomer=newcomer: len(newcomer.directory.nodes) == 5)
        took_s = time.monotonic() - killed
        drive([*nodes, newcomer], lambda: all("newcomer" in node.names for node in nodes))
        drive_for([*nodes, newcomer], 1.3 * LEASE_S)  # past the lease of grace
        newcomer.close()
        drive(nodes, lambda: all(len(node.directory.nodes) == 4 for node in nodes))
        assert not {node.id for node in nodes} & set().union(*(node.ever_lost for node in nodes))
        assert took_s < 1.0


def test_a_registry_whose_files_were_removed_makes_way(make):
    """By a cleaner of /tmp, say: else newcomers would start a second one, and the domain would be split."""
    nodes = [make("one"), make("two")]
    drive(nodes, lambda: nodes[0].names == ["two"] and nodes[1].names == ["one"])
    old = registry_pid()
    for name in (REGISTRY_LOCK, REGISTRY_SOCKET):
        (runtime_dir(0) / name).unlink()
    drive(
        nodes, lambda: registry_pid() not in (None, old) and all(node.directory.connected for node in nodes)
    )
    nodes.append(make("newcomer"))
    drive(nodes, lambda: all(len(node.directory.nodes) == 2 for node in nodes))
    wait_for(lambda: not Path(f"/proc/{old}").exists())
    assert not any(node.ever_lost for node in nodes)


def test_who_died_with_the_registry_is_dropped_after_a_lease(make):
    """The new registry has never heard of it."""
    one, two, dead = make("one"), make("two"), make("dead")
    drive([one, two, dead], lambda: len(one.directory.nodes) == len(two.directory.nodes) == 2)
    os.kill(registry_pid(), signal.SIGKILL)
    drive([one, two], lambda: registry_pid() is not None and one.directory.connected)
    assert dead.id in one.directory.nodes
    drive([one, two], lambda: one.names == ["two"] and two.names == ["one"], timeout_s=3 * LEASE_S)
    assert one.ever_lost == {dead.id}


def test_a_killed_node_disappears_with_its_files(make):
    watcher = make("watcher")
    with node_process("victim", node=0xBAD) as victim:
        drive([watcher], lambda: watcher.names == ["victim"])
        directory = runtime_dir(0)
        assert (directory / f"{0xBAD:016x}.control").is_socket()
        victim.kill()
        killed = time.monotonic()
        drive([watcher], lambda: not watcher.directory.nodes)
        # The lease, the registry's period of 0.1 s, and what the machine needs to get round to it.
        assert time.monotonic() - killed < LEASE_S + 0.4
        wait_for(lambda: not list(directory.glob(f"{0xBAD:016x}.*")))


def test_a_node_whose_process_lives_is_given_time(make):
    """A long call that holds Python's lock must not cut its streams."""
    watcher = make("watcher")
    with node_process("sleeper") as sleeper:
        drive([watcher], lambda: watcher.names == ["sleeper"])
        sleeper.send_signal(signal.SIGSTOP)
        drive_for([watcher], 2 * LEASE_S)
        assert watcher.names == ["sleeper"]
        sleeper.kill()  # but not once it is dead
        drive([watcher], lambda: not watcher.directory.nodes, timeout_s=0.5)


def test_a_node_that_was_stopped_for_too_long_comes_back(make):
    with serving(stalled_s=1.5):
        watcher = make("watcher")
        with node_process("sleeper", node=0xBED) as sleeper:
            drive([watcher], lambda: watcher.names == ["sleeper"])
            sleeper.send_signal(signal.SIGSTOP)
            drive([watcher], lambda: not watcher.directory.nodes)
            assert (runtime_dir(0) / f"{0xBED:016x}.control").is_socket()  # it lives: nothing of it is swept
            sleeper.send_signal(signal.SIGCONT)
            drive([watcher], lambda: watcher.names == ["sleeper"], timeout_s=3)


def test_a_stopped_registry_disturbs_nobody(make):
    nodes = [make("one"), make("two")]
    drive(nodes, lambda: nodes[0].names == ["two"] and nodes[1].names == ["one"])
    pid = registry_pid()
    os.kill(pid, signal.SIGSTOP)
    try:
        drive_for(nodes, 2.5 * LEASE_S)
        assert registry_pid() == pid
    finally:
        os.kill(pid, signal.SIGCONT)
    newcomer = make("newcomer")
    drive([*nodes, newcomer], lambda: len(newcomer.directory.nodes) == 2, timeout_s=3)
    drive_for(nodes, 0.5)
    assert not any(node.ever_lost for node in nodes)


# The registry's process


def test_many_processes_at_once_start_one_registry(base):
    code = (
        "import sys, time\nfrom cortex.registry import ensure_registry\n"
        "print('ready', flush=True)\nsys.stdin.read()\nprint(ensure_registry(0, linger_s=20.0))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    pipe = subprocess.PIPE
    racers = [
        subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, text=True) for _ in range(6)
    ]
    assert all(racer.stdout.readline() == "ready\n" for racer in racers)
    for racer in racers:
        racer.stdin.close()
    answers = [racer.stdout.read().strip() for racer in racers]
    for racer in racers:
        assert racer.wait(10) == 0
        racer.stdout.close()
    assert sorted(answers) == ["False"] * 5 + ["True"]
    wait_for(registry_pid)


def test_the_registry_is_detached_from_who_started_it(base):
    """It keeps none of our descriptors, our session, our directory or our standard streams."""
    read, write = os.pipe()
    os.set_inheritable(write, True)
    try:
        assert ensure_registry(0, linger_s=20.0)
        assert not ensure_registry(0)
        wait_for(registry_pid)
        pid = registry_pid()
        process = Path(f"/proc/{pid}")
        wait_for(lambda: (runtime_dir(0) / REGISTRY_SOCKET).is_socket())
        open_files = {os.readlink(entry) for entry in (process / "fd").iterdir()}
        assert os.readlink(f"/proc/self/fd/{write}") not in open_files
        assert os.readlink(process / "fd" / "0") == "/dev/null"
        assert os.readlink(process / "fd" / "2") == str(runtime_dir(0) / REGISTRY_LOG)
        assert os.readlink(process / "cwd") == "/"
        fields = (process / "stat").read_text().rpartition(")")[2].split()
        assert int(fields[1]) != os.getpid()  # not our child: nobody has to wait for it
        assert os.getsid(pid) != os.getsid(0)
    finally:
        os.close(read)
        os.close(write)


def test_the_registry_ends_after_the_last_node_even_if_all_were_killed(base):
    with node_process("one") as one, node_process("two") as two:
        read_until(one, lambda seen: seen["names"] == ["two"])
        pid = registry_pid()
        one.kill()
        two.kill()
        one.wait()
        two.wait()
    wait_for(lambda: registry_pid() is None, timeout_s=LEASE_S + 2.0 + 2.0)
    wait_for(lambda: not Path(f"/proc/{pid}").exists())
    left = {path.name for path in runtime_dir(0).iterdir()}
    assert left <= {REGISTRY_LOCK, REGISTRY_LOG}
    assert (runtime_dir(0) / REGISTRY_LOG).read_text() == ""


def test_the_registry_costs_little(base):
    """CPU time to start below 0.25 s on any machine of today; idle with a node, below 1 %."""
    with node_process("one") as one:
        read_until(one, lambda seen: seen["connected"])
        status = Path(f"/proc/{registry_pid()}/schedstat")
        started_ns = int(status.read_text().split()[0])
        begin = time.monotonic()
        wait_for(lambda: time.monotonic() - begin > 2.0)
        idle = (int(status.read_text().split()[0]) - started_ns) / (time.monotonic() - begin) / 1e9
    assert started_ns < 500e6  # twice, for a machine that is busy with other things
    assert idle < 0.01


def test_two_registries_cannot_serve_one_domain(base, caplog):
    with serving() as first:
        with pytest.raises(RegistryRunning, match=f"process {os.getpid()}"):
            Registry(0)
        assert main(["--domain", "0"]) == 1
        assert "serves domain 0" in caplog.text
        assert first.node_count == 0
    with serving():
        pass


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--domain", "233"], "domain must be"),
        (["--listen", "tcp://0.0.0.0:7460"], "insecure"),
        (["--listen", "udp://127.0.0.1:1"], "tcp:// address"),
        (["--keys", "/nonexistent"], "key.secret"),
    ],
)
def test_wrong_options_end_with_a_message(caplog, arguments, message):
    assert main(arguments) == 1
    assert message in caplog.text
    assert registry_pid() is None


def test_a_registry_that_cannot_start_is_tried_again_but_not_in_a_loop(make, monkeypatch, caplog):
    tried = []

    def fail(domain):
        tried.append(time.monotonic())
        raise OSError("no process for you")

    monkeypatch.setattr("cortex.discovery.ensure_registry", fail)
    node = make("one")
    drive_for([node], 2.0)
    assert 2 <= len(tried) <= 3  # at 0 s, 1 s and 3 s
    assert caplog.text.count("no process for you") == 1


# Limits, and frames that are not what they should be


def test_a_flood_of_nodes_is_bounded_and_told_why(make, caplog):
    with serving(nodes_max=3) as registry:
        nodes = [make(f"node {k}") for k in range(5)]
        drive(nodes, lambda: registry.node_count == 3 and registry.refused >= 2)
        drive_for(nodes, 0.5)
        assert registry.node_count == 3
        refused = [node for node in nodes if not node.directory.connected]
        assert len(refused) == 2
        assert (
            sum("there are 3 nodes already" in r.getMessage() for r in caplog.records) == 4
        )  # both sides, once
        next(node for node in nodes if node.directory.connected).close()
        live = [node for node in nodes if not node.directory._links[0].socket.closed]
        drive(live, lambda: any(node.directory.connected for node in refused))  # the place is taken


def test_a_record_that_is_too_large_is_refused_and_the_node_told(make, caplog):
    with serving(record_bytes_max=10_000) as registry:
        large, small = make("large"), make("small")
        large.record = dataclasses.replace(large.record, publishers=[publisher("/t", "x" * 20_000)])
        large.directory.announce()
        drive([large, small], lambda: registry.refused >= 1 and small.directory.connected)
        assert registry.node_count == 1
    assert "10000 are allowed" in caplog.text


def test_a_record_beyond_every_limit_is_not_even_sent(make, caplog):
    with serving() as registry:
        large = make("large")
        large.record = dataclasses.replace(large.record, publishers=[publisher("/t", "x" * (17 << 20))])
        large.directory.announce()
        drive([large], lambda: "cannot be announced" in caplog.text)
        assert registry.rejected == 0


def test_one_connection_speaks_for_one_node(context):
    with serving() as registry:
        socket = dealer(context)
        for index in range(20):
            socket.send(control_frame(Hello(False, make_record(f"ghost {index}"))))
        answers = [receive(socket) for _ in range(20)]
        assert [type(answer) for answer in answers] == [Welcome] + [Refused] * 19
        assert registry.node_count == 1
        socket.close()


def dealer(context):
    socket = context.socket(zmq.DEALER)
    socket.connect(f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}")
    return socket


TYPES = control_types(Alive, Changed, Describe, Gone, Heartbeat, Hello, Leave, Refused, Welcome)


def receive(socket, timeout_ms=5000):
    assert socket.poll(timeout_ms), "no answer"
    return parse_control(socket.recv(), TYPES)[0]


def mutate(frame: bytes, random: random.Random) -> bytes:
    data = bytearray(frame)
    for _ in range(random.randint(1, 4)):
        position = random.randrange(len(data))
        kind = random.randrange(5)
        if kind == 0:
            data[position] ^= 1 << random.randrange(8)
        elif kind == 1:
            data[position] = random.choice((0, 1, 0x7F, 0x80, 0xFF))
        elif kind == 2:
            del data[position:]
        elif kind == 3:
            data[position:position] = random.randbytes(random.randint(1, 16))
        else:
            start = max(position - 4, 0)
            data[start : start + 4] = random.choice((b"\xff" * 4, b"\0" * 4, b"\0\0\0\x80"))
        if not data:
            return b""
    return bytes(data)


def test_mutated_frames_do_no_harm(context, make, caplog):
    """20 000 of them over real sockets: all answered or counted, two real nodes undisturbed."""
    rng = random.Random(7)
    record = make_record("fuzz", publishers=[publisher("/a"), publisher("/b/c")])
    record = dataclasses.replace(record, endpoints=[Endpoint("ipc", "ipc:///x", "", "ipc:///y", "")])
    seeds = [
        control_frame(message)
        for message in (
            Hello(True, record),
            Hello(False, record),
            Heartbeat(record.node, 1, 0),
            Leave(record.node),
            Describe(record.node),
            Welcome(1, 1, [1, 2], [3, 4]),
        )
    ]
    with serving() as registry:
        one, two = make("one"), make("two")
        drive([one, two], lambda: one.names == ["two"] and two.names == ["one"])
        for _ in range(20):
            socket = dealer(context)
            for _ in range(1000):
                frames = [mutate(rng.choice(seeds), rng)]
                if rng.random() < 0.02:
                    frames.append(b"more")
                socket.send_multipart(frames)
                with contextlib.suppress(zmq.Again):
                    while True:
                        socket.recv(zmq.NOBLOCK)
            drive_for([one, two], 0.001)
            # What is counted was read; the last frame's answer says that all before it were.
            sequence = rng.getrandbits(32)
            socket.send(control_frame(Heartbeat(12345, 1, 0), sequence))
            drive([one, two], lambda socket=socket: answers_unknown(socket))
            socket.close()
        drive_for([one, two], 1.3 * LEASE_S)
        assert registry.rejected > 10_000
        assert registry.node_count == 2  # ghosts have no heartbeat
        assert one.names == ["two"]
        assert two.names == ["one"]
        assert two.id not in one.ever_lost
        said = sum("rejected a frame" in r.getMessage() for r in caplog.records)
        assert 1 <= said <= 20 + 2  # once for each connection, not for each frame


def answers_unknown(socket):
    """Whether the registry has answered the heartbeat of a node that it does not know."""
    with contextlib.suppress(zmq.Again):
        while True:
            frame = socket.recv(zmq.NOBLOCK)
            message = parse_control(frame, TYPES)[0]
            if isinstance(message, Alive) and message.held == 0:
                return True
    return False


def test_mutated_answers_do_no_harm_to_a_directory(context, make):
    """A ROUTER in the registry's place sends 5000 mutated frames; then a real registry takes over."""
    rng = random.Random(3)
    fake = fake_registry(context)
    node = make("one", registry=f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}")
    other = make_record("other")
    seeds = [
        control_frame(message)
        for message in (
            Welcome(1, 1, [other.node], [1]),
            Changed(2, other),
            Gone(3, other.node, "left"),
            Alive(1, 3, 1),
            Refused(node.id, "no"),
        )
    ]
    drive([node], lambda: fake.poll(1))
    identity, _ = fake.recv_multipart()
    for _ in range(50):
        for _ in range(100):
            fake.send_multipart([identity, mutate(rng.choice(seeds), rng)])
        drive_for([node], 0.01)
    assert node.directory.rejected > 2500
    fake.close()
    (runtime_dir(0) / REGISTRY_SOCKET).unlink(missing_ok=True)
    with serving():
        two = make("two")
        drive([node, two], lambda: node.names == ["two"] and two.names == ["one"])


def test_a_record_that_no_node_of_ours_would_send_is_rejected():
    good = make_record("x", publishers=[publisher("/a")])
    check_record(good)
    for bad in (
        dataclasses.replace(good, node=0),
        dataclasses.replace(good, revision=0),
        dataclasses.replace(good, publishers=[publisher("no slash")]),
        dataclasses.replace(good, publishers=[publisher("/a/../b")]),
        dataclasses.replace(good, publishers=[dataclasses.replace(publisher("/a"), source=0)]),
        dataclasses.replace(good, endpoints=[Endpoint("ipc", "tcp://evil:1", "", "", "")]),
    ):
        with pytest.raises(MalformedMessage):
            check_record(bad)


# What order and loss may do: a registry that the test plays itself


def fake_registry(context):
    socket = make_control_socket(context, zmq.ROUTER, tcp=False)
    socket.bind(f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}")
    return socket


class Played:
    """A registry whose words the test chooses."""

    def __init__(self, context, make):
        self.socket = fake_registry(context)
        self.node = make("one", registry=f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}")
        self.identity = b""

    def expect(self, kind):
        """Drive the node until it sends a message of a type."""
        found = []

        def look():
            while self.socket.poll(0):
                self.identity, frame = self.socket.recv_multipart()
                message = parse_control(frame, TYPES)[0]
                if isinstance(message, kind):
                    found.append(message)
            return found

        drive([self.node], look)
        return found[-1]

    def say(self, *messages):
        for message in messages:
            self.socket.send_multipart([self.identity, control_frame(message)])
        drive_for([self.node], 0.05)


@pytest.fixture
def played(context, make):
    made = Played(context, make)
    yield made
    made.socket.close()


def test_a_missing_number_makes_the_node_ask_again(played):
    other, lost = make_record("other"), make_record("lost")
    assert played.expect(Hello).snapshot
    played.say(Welcome(9, 4, [], []))
    played.say(Changed(6, other))  # number 5 was lost
    assert played.node.names == ["other"]
    played.expect(Heartbeat)
    played.say(Alive(9, 6, 1))
    assert played.expect(Hello).snapshot
    played.say(Welcome(9, 6, [other.node, lost.node], [1, 1]), Changed(6, other))
    played.expect(Heartbeat)
    played.say(Alive(9, 6, 1))
    assert played.expect(Hello).snapshot  # a record that was named has not come
    played.say(Welcome(9, 6, [other.node, lost.node], [1, 1]), Changed(6, other), Changed(5, lost))
    played.expect(Heartbeat)
    played.say(Alive(9, 6, 1))
    played.expect(Heartbeat)
    assert played.node.names == ["lost", "other"]


def test_an_old_revision_held_by_the_registry_is_renewed(played):
    played.expect(Hello)
    played.say(Welcome(9, 0, [], []))
    played.expect(Heartbeat)
    played.say(Alive(9, 0, 0))  # it has lost us
    assert played.expect(Hello).record.node == played.node.id


def test_a_new_registry_must_confirm_within_a_lease(played):
    kept, doubted = make_record("kept"), make_record("doubted")
    played.expect(Hello)
    played.say(Welcome(9, 2, [kept.node, doubted.node], [1, 1]), Changed(1, kept), Changed(2, doubted))
    played.expect(Heartbeat)
    played.say(Alive(77, 0, 0))  # another registry
    played.expect(Hello)
    played.say(Welcome(77, 1, [played.node.id], [1]))
    begin = time.monotonic()
    drive_for([played.node], 0.5 * LEASE_S)
    assert played.node.names == ["doubted", "kept"]
    played.say(Changed(2, kept))
    drive([played.node], lambda: played.node.names == ["kept"])
    assert 0.9 * LEASE_S < time.monotonic() - begin < LEASE_S + 0.5


def test_a_registry_keeps_the_newest_record(context):
    """An old connection's last words may be read after the new connection's first."""
    new = dataclasses.replace(make_record("x"), revision=7, pid=7)
    old = dataclasses.replace(new, revision=6, pid=6)
    with serving():
        first, second, watcher = (dealer(context) for _ in range(3))
        first.send(control_frame(Hello(False, new)))
        assert isinstance(receive(first), Welcome)
        second.send(control_frame(Hello(False, old)))
        assert receive(second).revisions == [7]
        watcher.send(control_frame(Hello(True, make_record("watcher"))))
        assert isinstance(receive(watcher), Welcome)
        assert receive(watcher).record == new
        for socket in (first, second, watcher):
            socket.close()


def test_a_heartbeat_on_another_connection_keeps_nobody_alive(context):
    record = make_record("x")
    with serving() as registry:
        mine, stranger = dealer(context), dealer(context)
        mine.send(control_frame(Hello(False, record)))
        receive(mine)
        stranger.send(control_frame(Heartbeat(record.node, 1, 0)))
        assert receive(stranger).held == 0
        stranger.send(control_frame(Leave(record.node)))
        mine.send(control_frame(Heartbeat(record.node, 1, 0), 77))
        assert mine.poll(5000)
        alive, header = parse_control(mine.recv(), TYPES)
        assert (alive.held, header.sequence) == (1, 77)
        assert registry.node_count == 1
        mine.close()
        stranger.close()


# Without a registry


def test_static_peers_see_each_other_and_vanish_after_a_lease(make):
    listed = make("listed", registry="off", router=True)
    lister = make("lister", registry="off", peers=[listed.address])
    nodes = [listed, lister]
    drive(nodes, lambda: listed.names == ["lister"] and lister.names == ["listed"])
    for node in nodes:
        node.record = dataclasses.replace(node.record, publishers=[publisher("/new")])
        node.directory.announce()
    drive(nodes, lambda: all(next(iter(n.directory.nodes.values())).publishers for n in nodes), timeout_s=1.0)
    drive_for(nodes, 1.5 * LEASE_S)
    assert not listed.ever_lost | lister.ever_lost
    silent = time.monotonic()
    drive([listed], lambda: not listed.directory.nodes)  # the other is not driven: as if it were dead
    assert LEASE_S - 0.3 < time.monotonic() - silent < LEASE_S + 0.5


def test_a_static_peer_that_dies_vanishes_and_its_successor_is_found(make, context):
    listed = make("first", registry="off", router=True)
    lister = make("lister", registry="off", peers=[listed.address])
    drive([listed, lister], lambda: lister.names == ["first"])
    address = listed.address
    listed.close()
    begin = time.monotonic()
    drive([lister], lambda: not lister.directory.nodes)
    assert time.monotonic() - begin < LEASE_S + 0.5
    successor = make("second", registry="off", router=True)
    successor.router.unbind(successor.address)
    successor.router.bind(address)
    drive([successor, lister], lambda: lister.names == ["second"] and successor.names == ["lister"])


def test_who_takes_over_the_address_of_a_peer_replaces_it(make):
    """At once, although the lease of the first is renewed by nobody and ended by nobody."""
    listed = make("first", registry="off", router=True)
    lister = make("lister", registry="off", peers=[listed.address])
    drive([listed, lister], lambda: lister.names == ["first"])
    successor = make("second", registry="off")
    listed.directory, successor.directory = successor.directory, listed.directory
    drive([listed, lister], lambda: lister.names == ["second"], timeout_s=0.8 * LEASE_S)


def test_a_peer_that_leaves_is_dropped_at_once(make):
    listed = make("listed", registry="off", router=True)
    lister = make("lister", registry="off", peers=[listed.address])
    drive([listed, lister], lambda: listed.names == ["lister"] and lister.names == ["listed"])
    lister.close()
    drive([listed], lambda: not listed.directory.nodes, timeout_s=0.8 * LEASE_S)


def test_a_node_known_twice_stays_while_either_knows_it(make):
    """By the registry and as static peer: it leaves the view when the last of the two loses it."""
    address = f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}"
    with serving():
        listed = make("listed", registry=address, router=True)
        lister = make("lister", registry=address, peers=[listed.address])
        drive([listed, lister], lambda: lister.directory.connected and lister.names == ["listed"])
    drive_for([listed, lister], 1.5 * LEASE_S)
    assert not lister.ever_lost
    assert lister.names == ["listed"]


def test_a_node_may_list_itself(make):
    node = make("one", registry="off", router=True)
    with contextlib.closing(make("two", registry="off", peers=[node.address])) as two:
        drive([node, two], lambda: node.names == ["two"])
    itself = make("self", registry="off", router=True, peers=[])
    itself.directory._connect(itself.address, is_registry=False)
    drive([itself], lambda: itself.directory.connected)
    assert not itself.directory.nodes


def test_describe_is_answered_and_other_frames_are_malformed(make):
    node = make("one", registry="off")
    frame = node.directory.answer(control_frame(Describe(0), 88))
    message, header = parse_control(frame, TYPES)
    assert header.sequence == 88
    assert message == Changed(0, dataclasses.replace(node.record, revision=1))
    assert not node.directory.nodes
    for bad in (b"", b"x" * HEADER_SIZE, control_frame(Welcome(1, 1, [], []))):
        with pytest.raises(MalformedMessage):
            node.directory.answer(bad)


def test_a_node_that_was_stopped_does_not_judge_its_peers(make):
    listed = make("listed", registry="off", router=True)
    lister = make("lister", registry="off", peers=[listed.address])
    drive([listed, lister], lambda: listed.names == ["lister"] and lister.names == ["listed"])
    begin = time.monotonic()
    wait_for(lambda: time.monotonic() - begin > 1.5 * LEASE_S)  # nobody is driven: the whole process sleeps
    drive_for([listed, lister], 2 * HEARTBEAT_NS / 1e9)
    assert not listed.ever_lost | lister.ever_lost


def test_silence_is_said_once(make, caplog, monkeypatch):
    monkeypatch.setattr("cortex.discovery._SILENCE_NS", 200_000_000)
    node = make("one", registry="tcp://127.0.0.1:9", peers=["ipc:///nonexistent/x"])
    with caplog.at_level(logging.WARNING, "cortex.discovery"):
        drive_for([node], 0.6)
    assert caplog.text.count("no answer of the registry at tcp://127.0.0.1:9") == 1
    assert caplog.text.count("no answer of the peer at ipc:///nonexistent/x") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"registry": "on"}, 'registry must be "auto", "off"'),
        ({"registry": "tcp://10.0.0.1:5"}, "insecure=True"),
        ({"registry": "off", "peers": ["udp://x"]}, "a peer must be"),
        ({"registry": "off", "peers": ["tcp://10.0.0.1:5"]}, "insecure=True"),
    ],
)
def test_wrong_addresses_are_refused(context, options, message):
    with pytest.raises(ValueError, match=message):
        Directory(context, domain=0, record=lambda: make_record("x"), **options)


def test_no_clock_but_the_monotonic_one():
    """A jump of the wall clock must not end a lease."""
    for name in ("discovery", "registry", "control", "host"):
        text = (ROOT / "cortex" / f"{name}.py").read_text()
        assert "time.time" not in text
        assert "datetime" not in text


def test_files_of_a_node_that_left_are_gone(base):
    with node_process("one", node=5) as one:
        read_until(one, lambda seen: seen["connected"])
        with pytest.raises(FileExistsError):
            NodeFiles(0, 5)
    NodeFiles(0, 5).close()
