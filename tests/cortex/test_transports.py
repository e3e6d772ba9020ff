"""The same messages over ipc and tcp, plain and encrypted, with a registry and without."""

from __future__ import annotations

import pytest
import zmq
from c_module import needs_native
from peer import Block, Number, is_whole, make_block
from processes import SOON_S

import cortex.node
from cortex import reliable
from cortex.context import new_socket
from cortex.matching import Matcher
from cortex.places import network, reach
from cortex.records import Endpoint, NodeRecord
from cortex.security import AUTHORIZED_FILE, load_keys, new_keys
from cortex.wire import BODY_LIMIT, CONTROL_LIMIT, HEADER_SIZE

SIZES = [0, 10, 4000, 16_384, 16_500, 100_000, 1_000_000, 30]
"""Bytes of content, on both sides of what goes inline."""


def keys_of(base, names):
    """Directories of keys that trust each other."""
    lines = "".join(f"{new_keys(base / name).public}\n" for name in names)
    for name in names:
        (base / name / AUTHORIZED_FILE).write_text(lines)
    return {name: base / name for name in names}


ELSEWHERE = {"listen": "127.0.0.1", "host": "elsewhere"}
TRANSPORTS = {
    "ipc": ({}, {}),
    "tcp": ({"listen": "127.0.0.1"}, ELSEWHERE),
    "tcp6": ({"listen": "::1"}, ELSEWHERE | {"listen": "::1"}),
    "curve": ({"listen": "127.0.0.1"}, ELSEWHERE),
}


@pytest.fixture
def pair(make_node, start_child, runtime, tmp_path):
    """Makes a node and a child that talk over a transport."""

    def make_pair(transport):
        ours, theirs = ({**options} for options in TRANSPORTS[transport])
        if transport == "curve":
            directories = keys_of(tmp_path, ("ours", "theirs"))
            ours["keys"] = load_keys(directories["ours"])
            theirs["keys"] = str(directories["theirs"])
        child = start_child("peer", **theirs)
        return make_node("ours", **ours), child

    return make_pair


@pytest.mark.parametrize("policy", [["keep_last"], ["reliable", {"depth": 8, "timeout_s": 60.0}]], ids=str)
@pytest.mark.parametrize("transport", TRANSPORTS)
@needs_native
def test_between_processes(pair, transport, policy):
    """Both ways: we publish and they check, then they publish and we check."""
    node, child = pair(transport)
    child.ask(do="subscriber", topic="/ours", type="Block", policy=policy)
    child.ask(do="publisher", topic="/theirs", type="Block")
    publisher = node.publisher("/ours", Block)
    subscriber = node.subscriber("/theirs", Block, policy=reliable(8, 60.0))
    assert publisher.wait_for_subscribers(1, SOON_S)
    assert child.ask(do="await_subscribers", topic="/theirs")["ok"]
    number = 0
    for _ in range(2):
        for size in SIZES:
            child.say(do="receive", topic="/ours", until=number)
            assert publisher.publish(make_block(number, size))
            got = child.hear()
            assert (got["count"], got["last"], got["whole"]) == (1, number, True)
            child.ask(do="publish", topic="/theirs", count=1, start=number, size=size)
            block = subscriber.recv(SOON_S)
            assert (block.number, len(block.data), is_whole(block)) == (number, size, True)
            number += 1
    counters = child.ask(do="counters", topic="/ours")
    assert (counters["received"], counters["lost"], counters["rejected"]) == (number, 0, 0)
    assert subscriber.counters.lost == 0
    assert subscriber.carriers == ["tcp" if transport != "ipc" else "ipc, shared memory"]
    child.finish()


def test_near_and_far_subscribers_of_one_topic(make_node, start_child):
    """One in this process, one on this host, one over tcp: all get the same bytes."""
    children = [start_child("peer", name="near"), start_child("peer", name="far", **ELSEWHERE)]
    node = make_node(listen="127.0.0.1")
    for child in children:
        child.ask(do="subscriber", topic="/blocks", type="Block", policy=["reliable", {"timeout_s": 60.0}])
    own = node.subscriber("/blocks", Block, policy=reliable(8, 60.0))
    publisher = node.publisher("/blocks", Block)
    assert publisher.wait_for_subscribers(3, SOON_S)
    for child in children:
        child.say(do="receive", topic="/blocks", until=40)
    for number in range(40):
        assert publisher.publish(make_block(number, SIZES[number % len(SIZES)]))
        assert is_whole(own.recv(SOON_S))
    made = make_block(40, 200_000)
    with publisher.loan(n=200_000) as draft:
        draft.number, draft.check, draft.data[:] = 40, made.check, made.data
    for child in children:
        assert child.hear() == {"count": 41, "first": 0, "last": 40, "ordered": True, "whole": True}


def test_a_latch_over_tcp(pair):
    node, child = pair("tcp")
    publisher = node.publisher("/blocks", Block, latch=True)
    for size in (10, 1_000_000):
        publisher.publish(make_block(size, size))
        child.ask(do="subscriber", topic="/blocks", type="Block", policy=["keep_last"])
        got = child.ask(do="receive", topic="/blocks", until=size)
        assert (got["count"], got["whole"]) == (1, True)
        child.ask(do="close", topic="/blocks")


def test_what_the_environment_says_of_other_hosts_can_be_overridden(runtime, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    keys = new_keys(tmp_path / "keys")
    for name, value in (("LISTEN", "127.0.0.1"), ("REGISTRY", "tcp://127.0.0.1:9"), ("KEYS", "~/keys")):
        monkeypatch.setenv(f"CORTEX_{name}", value)
    assert network(None, None, None) == ("tcp://127.0.0.1:9", "127.0.0.1", load_keys(tmp_path / "keys"))
    assert network("auto", "", keys) == ("auto", None, keys)


def test_plain_tcp_stays_on_this_host(runtime):
    """Nothing else is opened before that is known."""
    for address in ("0.0.0.0", "192.168.1.5", "::"):
        with pytest.raises(ValueError, match="insecure"):
            cortex.node.Node("open", listen=address)
    assert not list(runtime.iterdir())


def record_at(address, server_key="", **others):
    places = {"lossy": address, "strict": address, "control": address, **others}
    endpoint = Endpoint("tcp", server_key=server_key, **places)
    return NodeRecord(1, "x", "elsewhere", 1, 1, 0, [endpoint], [], [], [])


FAR, NEAR = "tcp://192.0.2.7:5", "tcp://127.0.0.1:5"


def test_a_record_cannot_lead_to_plain_tcp_beyond_this_host(tmp_path):
    """Its addresses are held to the same rule as our own; one without a control socket can be used."""
    keys = new_keys(tmp_path)
    for address, ours, insecure, reached in (
        (NEAR, None, False, True),
        (NEAR, keys, False, True),
        (FAR, None, False, False),
        (FAR, None, True, True),
        (FAR, keys, False, False),
        (FAR, keys, True, False),
    ):
        assert (reach(record_at(address), "here", ours, insecure=insecure) is not None) == reached
    for role in ("lossy", "strict", "control"):
        assert reach(record_at(NEAR, **{role: FAR}), "here", None) is None
    assert reach(record_at(FAR, keys.public), "here", keys).secure is not None
    assert reach(record_at(FAR, keys.public), "here", None, insecure=True) is None
    matcher = Matcher("here", None, insecure=False)
    assert matcher.reach_control(record_at(NEAR)).endpoint.control == NEAR
    with pytest.raises(ConnectionError, match="cannot be asked"):
        matcher.reach_control(record_at(NEAR, control=""))
    assert reach(record_at(NEAR, control=""), "here", None) is not None


@pytest.mark.parametrize("who", ["stranger", "without keys"])
def test_who_is_not_let_in(make_node, start_child, tmp_path, who, runtime):
    """A node without our trust, or without keys, gets nothing; one with it does."""
    directories = keys_of(tmp_path, ("ours", "friend"))
    stranger = new_keys(tmp_path / "stranger")
    known = "".join(f"{load_keys(path).public}\n" for path in directories.values())
    (tmp_path / "stranger" / AUTHORIZED_FILE).write_text(known)  # it trusts us, we do not trust it
    node = make_node("ours", listen="127.0.0.1", keys=load_keys(directories["ours"]))
    options = {} if who == "without keys" else {"keys": str(tmp_path / "stranger")}
    refused = start_child("peer", name="refused", host="elsewhere", **options)
    friend = start_child("peer", name="friend", host="elsewhere", keys=str(directories["friend"]))
    for child in (refused, friend):
        child.ask(do="subscriber", topic="/numbers", type="Number", policy=["keep_last"])
    publisher = node.publisher("/numbers", Number, latch=True)
    publisher.publish(Number(1, 1))
    assert friend.ask(do="receive", topic="/numbers", until=1)["count"] == 1
    assert publisher.subscriber_count == 1
    assert refused.ask(do="receive", topic="/numbers", until=1, timeout_s=0.5)["count"] == 0
    assert stranger.public not in known


def disconnected(socket, action, within_s):
    """Whether the other side cuts the connection after an action."""
    monitor = socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    try:
        action()
        return bool(monitor.poll(1e3 * within_s))
    finally:
        socket.disable_monitor()
        monitor.close(0)


@pytest.mark.parametrize("size", [33, 5000])
def test_a_subscription_has_a_limit(make_node, size):
    """Who subscribes to more than any reader asks for is disconnected; libzmq would keep a node a byte."""
    node = make_node(registry="off")
    address = next(e.lossy for e in node.nodes()[0].endpoints if e.transport == "ipc")
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger = 0
        socket.connect(address)
        within_s = SOON_S if size > 33 else 1.0
        cut = disconnected(socket, lambda: socket.subscribe(b"x" * size), within_s)
    assert cut == (size > 33)
    publisher, subscriber = node.publisher("/n", Number), node.subscriber("/n", Number)
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    publisher.publish(Number(1, 1))
    assert subscriber.recv(SOON_S) == Number(1, 1)


def test_frames_have_a_limit(runtime):
    """Every kind of socket bounds what it takes in; the bodies that are allowed fit."""
    for kind, least in ((zmq.SUB, BODY_LIMIT), (zmq.DEALER, CONTROL_LIMIT), (zmq.ROUTER, CONTROL_LIMIT)):
        with new_socket(kind) as socket:
            assert least + HEADER_SIZE < socket.maxmsgsize < least + HEADER_SIZE + 10_000
