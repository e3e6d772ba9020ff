"""The registry: its process, its limits, and frames that are not what they should be."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zmq
from damage import mutate
from directories import (
    answers_unknown,
    context,
    dealer,
    drive,
    drive_for,
    fake_registry,
    make,
    make_record,
    publisher,
    receive,
    registry_pid,
    serving,
)
from processes import ROOT, wait_for

import cortex.registry
from cortex.codec import MalformedMessage
from cortex.discovery import main
from cortex.host import REGISTRY_LOCK, REGISTRY_LOG, REGISTRY_SOCKET, runtime_dir
from cortex.records import (
    Alive,
    Changed,
    Endpoint,
    Gone,
    Heartbeat,
    Hello,
    Leave,
    Refused,
    Welcome,
    check_record,
)
from cortex.registry import Registry, RegistryRunning, ensure_registry
from cortex.security import AUTHORIZED_FILE, load_keys, new_keys
from cortex.wire import control_frame

__all__ = ["context", "make"]

pytestmark = pytest.mark.usefixtures("runtime")


def test_many_processes_at_once_start_one_registry():
    code = (
        "import sys, time\nfrom cortex.registry import ensure_registry\n"
        "print('ready', flush=True)\nsys.stdin.read()\nprint(ensure_registry(0, linger_s=20.0))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    options = {"env": environment, "stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with contextlib.ExitStack() as stack:
        racers = [
            stack.enter_context(subprocess.Popen([sys.executable, "-c", code], **options)) for _ in range(6)
        ]
        assert all(racer.stdout.readline() == "ready\n" for racer in racers)
        for racer in racers:
            racer.stdin.close()
        answers = [racer.stdout.read().strip() for racer in racers]
    assert [racer.returncode for racer in racers] == [0] * 6
    assert sorted(answers) == ["False"] * 5 + ["True"]
    wait_for(registry_pid)


def test_the_registry_is_detached_from_who_started_it(monkeypatch):
    """It keeps none of our descriptors, our session, our directory or our standard streams."""
    monkeypatch.setattr(cortex.registry, "_spawn", cortex.registry._spawn.real)
    read, write = os.pipe()
    os.set_inheritable(write, True)
    try:
        assert ensure_registry(0, linger_s=20.0)
        assert not ensure_registry(0)
        wait_for(registry_pid)
        pid = registry_pid()
        process = Path(f"/proc/{pid}")
        wait_for(lambda: (runtime_dir(0) / REGISTRY_SOCKET).is_socket())
        open_files = set()
        for entry in (process / "fd").iterdir():
            with contextlib.suppress(FileNotFoundError):  # it closes files while they are listed
                open_files.add(os.readlink(entry))
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


def test_the_registry_ends_after_the_last_node_even_if_all_were_killed(start_child):
    one, two = (start_child("peer", name=name) for name in ("one", "two"))
    wait_for(lambda: one.ask(do="nodes")["names"] == ["one", "two"])
    pid = registry_pid()
    one.kill()
    two.kill()
    wait_for(lambda: registry_pid() is None)
    wait_for(lambda: not Path(f"/proc/{pid}").exists())
    left = {path.name for path in runtime_dir(0).iterdir()}
    assert left <= {REGISTRY_LOCK, REGISTRY_LOG}
    assert (runtime_dir(0) / REGISTRY_LOG).read_text() == ""


def test_two_registries_cannot_serve_one_domain(caplog):
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
    drive([node], lambda: len(tried) == 3)  # at 0 s, 1 s and 3 s
    assert tried[1] - tried[0] > 0.99
    assert tried[2] - tried[1] > 1.99
    assert caplog.text.count("no process for you") == 1


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
        live = [node for node in nodes if not node.directory.socket.closed]
        drive(live, lambda: any(node.directory.connected for node in refused))  # the place is taken


def test_a_record_that_is_too_large_is_refused_and_the_node_told(make, caplog):
    with serving(record_bytes_max=10_000) as registry:
        large, small = make("large"), make("small")
        large.record = dataclasses.replace(large.record, publishers=[publisher("/t", "x" * 20_000)])
        large.directory.announce()
        drive([large, small], lambda: registry.refused >= 1 and small.directory.connected)
        assert registry.node_count == 1
    assert "10000 are allowed" in caplog.text


def test_mutated_frames_do_no_harm(context, make, caplog):
    """5000 of them over real sockets: all answered or counted, two real nodes undisturbed."""
    rng = random.Random(7)
    record = make_record("fuzz", publishers=[publisher("/a"), publisher("/b/c")])
    record = dataclasses.replace(record, endpoints=[Endpoint("ipc", "ipc:///x", "", "ipc:///y", "")])
    hellos = (Hello(True, record), Hello(False, record))
    others = (Heartbeat(record.node, 1, 0), Leave(record.node), Welcome(1, 1, [1, 2], [3, 4]))
    seeds = [control_frame(message) for message in (*hellos, *others)]
    with serving() as registry:
        one, two = make("one"), make("two")
        drive([one, two], lambda: one.names == ["two"] and two.names == ["one"])
        for _ in range(10):
            socket = dealer(context)
            for _ in range(500):
                frames = [mutate(rng, rng.choice(seeds))]
                if rng.random() < 0.02:
                    frames.append(b"more")
                socket.send_multipart(frames)
                with contextlib.suppress(zmq.Again):
                    while True:
                        socket.recv(zmq.NOBLOCK)
            drive_for([one, two], 0.001)
            # What is counted was read; the last frame's answer says that all before it were.
            socket.send(control_frame(Heartbeat(12345, 1, 0), rng.getrandbits(32)))
            drive([one, two], lambda socket=socket: answers_unknown(socket))
            socket.close()
        assert registry.rejected > 1_250
        drive([one, two], lambda: registry.node_count == 2)  # ghosts have no heartbeat
        drive([one, two], lambda: one.names == ["two"] and two.names == ["one"])
        assert two.id not in one.ever_lost
        said = sum("rejected a frame" in r.getMessage() for r in caplog.records)
        assert 1 <= said <= 10 + 2  # once for each connection, not for each frame


def test_mutated_answers_do_no_harm_to_a_directory(context, make):
    """A ROUTER in the registry's place sends 5000 mutated frames; then a real registry takes over."""
    rng = random.Random(3)
    fake = fake_registry(context)
    node = make("one", registry=f"ipc://{runtime_dir(0) / REGISTRY_SOCKET}")
    other = make_record("other")
    changes = (Welcome(1, 1, [other.node], [1]), Changed(2, other), Gone(3, other.node, "left"))
    seeds = [control_frame(message) for message in (*changes, Alive(1, 3, 1), Refused(node.id, "no"))]
    drive([node], lambda: fake.poll(1))
    identity, _ = fake.recv_multipart()
    for _ in range(50):
        for _ in range(100):
            fake.send_multipart([identity, mutate(rng, rng.choice(seeds))])
        drive_for([node], 0.01)
    assert node.directory.rejected > 1000
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
        *(dataclasses.replace(good, clock_offset_ns=offset_ns) for offset_ns in (2**62, -(2**63))),
        dataclasses.replace(good, publishers=[publisher("no slash")]),
        dataclasses.replace(good, publishers=[publisher("/a/../b")]),
        dataclasses.replace(good, publishers=[dataclasses.replace(publisher("/a"), source=0)]),
        dataclasses.replace(good, endpoints=[Endpoint("ipc", "tcp://evil:1", "", "", "")]),
    ):
        with pytest.raises(MalformedMessage):
            check_record(bad)


def test_one_connection_speaks_for_one_node(context):
    """For no other: neither a heartbeat on another connection counts, nor a farewell."""
    record = make_record("x")
    with serving() as registry:
        mine, stranger = dealer(context), dealer(context)
        mine.send(control_frame(Hello(False, record)))
        for index in range(20):
            mine.send(control_frame(Hello(False, make_record(f"ghost {index}"))))
        assert [type(receive(mine)) for _ in range(21)] == [Welcome] + [Refused] * 20
        stranger.send(control_frame(Heartbeat(record.node, 1, 0)))
        assert receive(stranger).held == 0
        stranger.send(control_frame(Leave(record.node)))
        stranger.send(control_frame(Heartbeat(record.node, 1, 0)))
        receive(stranger)  # the farewell was read before
        mine.send(control_frame(Heartbeat(record.node, 1, 0)))
        assert receive(mine).held == 1
        assert registry.node_count == 1
        mine.close()
        stranger.close()


def test_a_node_belongs_to_the_process_that_came_with_it(make, start_child):
    """Another process of this host cannot put its record in its place, whatever revision it says."""
    with serving():
        owner, watcher = start_child("peer", name="owner"), make("watcher")
        node = owner.hello["node"]
        drive([watcher], lambda: watcher.names == ["owner"])
        thief = make("thief")
        thief.record = make_record("thief", node=node)
        thief.directory._revision = 1000
        thief.directory.announce()
        drive_for([watcher, thief], 0.3)
        assert watcher.directory.nodes[node].name == "owner"
        owner.kill()
        drive([watcher], lambda: node not in watcher.directory.nodes)


def test_a_node_belongs_to_its_key(make, tmp_path):
    """Over CURVE: neither another key's record nor its farewell counts, nor addresses with another's key."""
    public = {name: new_keys(tmp_path / name).public for name in ("registry", "owner", "thief")}
    lines = [public["owner"], public["thief"], f"{public['registry']} 127.0.0.1"]
    for name in public:
        (tmp_path / name / AUTHORIZED_FILE).write_text("\n".join(lines))
    keys = {name: load_keys(tmp_path / name) for name in public}
    with serving(listen="tcp://127.0.0.1:*", keys=keys["registry"]) as registry:
        watcher = make("watcher")
        owner = make("owner", registry=registry.address, keys=keys["owner"])
        endpoint = Endpoint("tcp", "tcp://h:1", "tcp://h:2", "tcp://h:3", public["owner"])
        owner.record = dataclasses.replace(owner.record, endpoints=[endpoint])
        drive([owner, watcher], lambda: watcher.names == ["owner"])
        for node, refusals in ((owner.id, 1), (make_record("x").node, 2)):  # its number, or its key
            thief = make("thief", registry=registry.address, keys=keys["thief"])
            thief.record = dataclasses.replace(owner.record, node=node, name="theft")
            thief.directory._revision = 1000
            thief.directory.announce()
            drive([owner, watcher, thief], lambda refusals=refusals: registry.refused >= refusals)
            thief.close()
        drive_for([owner, watcher], 0.3)
        assert watcher.names == ["owner"]
        assert not watcher.ever_lost
