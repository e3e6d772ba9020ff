"""The directories: who sees whom, when, and what survives whose death."""

from __future__ import annotations

import dataclasses
import logging
import os
import signal
import time
from pathlib import Path

import pytest
import zmq
from c_module import needs_native
from directories import (
    LEASE_S,
    TYPES,
    context,
    drive,
    drive_for,
    fake_registry,
    make,
    make_record,
    publisher,
    registry_pid,
    serving,
)
from processes import SOON_S, wait_for

from cortex.control import LEASE_NS
from cortex.discovery import Directory
from cortex.host import REGISTRY_LOCK, REGISTRY_SOCKET, runtime_dir
from cortex.records import Alive, Changed, Heartbeat, Hello, Welcome
from cortex.wire import control_frame, parse_control

__all__ = ["context", "make"]

pytestmark = pytest.mark.usefixtures("runtime")


@pytest.fixture
def long_leases(monkeypatch):
    """No lease of this process runs out during a test: what ends before has another reason."""
    monkeypatch.setattr("cortex.control.LEASE_NS", 10 * LEASE_NS * round(SOON_S))


def test_two_nodes_see_each_other_change_and_leave(make, long_leases):
    with serving():
        one, two = make("one"), make("two")
        drive([one, two], lambda: one.names == ["two"] and two.names == ["one"])
        assert one.directory.nodes[two.id] == dataclasses.replace(two.record, revision=1)
        assert one.changes == [frozenset({two.id})]
        two.record = dataclasses.replace(two.record, publishers=[publisher("/scan")])
        two.directory.announce()
        drive([one, two], lambda: one.directory.nodes[two.id].publishers)
        assert one.directory.nodes[two.id] == dataclasses.replace(two.record, revision=2)
        two.close()
        drive([one], lambda: not one.directory.nodes)
        assert one.changes == [frozenset({two.id})] * 3


def test_fifty_nodes_see_each_other(make):
    nodes = [make(f"node {k:02}") for k in range(50)]
    drive(nodes, lambda: all(len(node.directory.nodes) == 49 for node in nodes))
    drive_for(nodes, 2.2 * LEASE_S)  # and go on doing so
    assert all(len(node.directory.nodes) == 49 and not node.ever_lost for node in nodes)
    for node in nodes[1:]:
        node.close()
    drive(nodes[:1], lambda: not nodes[0].directory.nodes)


def test_a_node_that_is_started_before_the_registry(make):
    address = f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}"
    early = [make("one", registry=address), make("two", registry=address)]
    drive_for(early, 0.3)
    assert not early[0].directory.connected
    with serving():
        drive(early, lambda: early[0].names == ["two"] and early[1].names == ["one"])


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
    drive([one, two], lambda: one.names == ["two"] and two.names == ["one"])
    assert one.ever_lost == {dead.id}


@needs_native
def test_a_killed_node_disappears_with_its_files(make, start_child):
    """Long before it would, were it alive and silent, and before its lease has run out: the kernel tells."""

    def took_s() -> float:
        with serving(stalled_s=1e6):
            victim, watcher = start_child("peer", name="victim"), make("watcher")
            files = runtime_dir(0), f"{victim.hello['node']:016x}.*"
            drive([watcher], lambda: watcher.names == ["victim"])
            assert len(list(files[0].glob(files[1]))) == 5
            victim.kill()
            begin_s = time.monotonic()
            drive([watcher], lambda: not watcher.directory.nodes)
            took = time.monotonic() - begin_s
            wait_for(lambda: not list(files[0].glob(files[1])))
            watcher.close()
            return took

    wait_for(lambda: took_s() < 0.5 * LEASE_S)  # a busy machine makes some of them late, but not each


def test_a_node_that_was_stopped_for_too_long_comes_back(make, start_child):
    with serving(stalled_s=1.5):
        sleeper, watcher = start_child("peer", name="sleeper"), make("watcher")
        drive([watcher], lambda: watcher.names == ["sleeper"])
        with sleeper.stopped():
            drive([watcher], lambda: not watcher.directory.nodes)
            socket = runtime_dir(0) / f"{sleeper.hello['node']:016x}.control"
            assert socket.is_socket()  # it lives: nothing of it is swept
        drive([watcher], lambda: watcher.names == ["sleeper"])


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
    drive([*nodes, newcomer], lambda: len(newcomer.directory.nodes) == 2)
    drive_for(nodes, 0.5)
    assert not any(node.ever_lost for node in nodes)


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


def test_a_new_registry_must_confirm_within_a_lease(played):
    kept, doubted = make_record("kept"), make_record("doubted")
    played.expect(Hello)
    played.say(Welcome(9, 2, [kept.node, doubted.node], [1, 1]), Changed(1, kept), Changed(2, doubted))
    played.expect(Heartbeat)
    played.say(Alive(77, 0, 0))  # another registry
    played.expect(Hello)
    begin = time.monotonic()
    played.say(Welcome(77, 1, [played.node.id], [1]), Changed(2, kept))
    drive([played.node], lambda: played.node.names == ["kept"])
    assert time.monotonic() - begin > LEASE_S
    assert played.node.ever_lost == {doubted.node}


def test_silence_is_said_once(make, caplog, monkeypatch):
    monkeypatch.setattr("cortex.discovery._SILENCE_NS", 200_000_000)
    node = make("one", registry="tcp://127.0.0.1:9")
    with caplog.at_level(logging.WARNING, "cortex.discovery"):
        drive([node], lambda: "no answer of" in caplog.text)
        drive_for([node], 0.4)
    assert caplog.text.count("no answer of the registry at tcp://127.0.0.1:9") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"registry": "on"}, 'registry must be "auto", "off"'),
        ({"registry": "tcp://10.0.0.1:5"}, "insecure=True"),
    ],
)
def test_wrong_addresses_are_refused(context, options, message):
    with pytest.raises(ValueError, match=message):
        Directory(context, domain=0, record=lambda: make_record("x"), **options)


def test_an_answer_that_comes_while_others_are_read_took_until_it_is_read(make, monkeypatch):
    """Else the round trip, and with it the error of the clock, seems shorter than it was."""
    with serving(listen="tcp://127.0.0.1:0") as registry:
        one = make("one", registry=str(registry.address))
        drive([one], lambda: one.directory.clock.clock(time.monotonic_ns()))
        directory, waits_s = one.directory, 0.2
        alive = Alive(directory._epoch, directory._version, directory._own.revision)

        class Slow:
            """Has an answer to what was asked after `handle` has begun."""

            frames = iter([True])

            def recv_multipart(self, flags):
                if not next(self.frames, False):
                    raise zmq.Again
                asked_ns = time.monotonic_ns()
                time.sleep(waits_s)
                return [control_frame(alive, asked_ns, told_ns=time.time_ns())]

        added = []
        with monkeypatch.context() as slow:
            slow.setattr(directory.clock, "add", lambda *times: added.append(times))
            slow.setattr(directory, "socket", Slow())
            directory.handle()
        ((asked_ns, _, answered_ns),) = added
        assert answered_ns - asked_ns >= waits_s * 1e9
